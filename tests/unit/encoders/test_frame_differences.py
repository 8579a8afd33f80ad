"""What moves in a clip: the difference of its frames from their mean."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from repdib_lightning.encoders import MultimodalEncoder
from repdib_lightning.encoders.clip_steps import observed_frames
from repdib_lightning.encoders.frame_differences import frame_input
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec


@pytest.fixture
def clip() -> torch.Tensor:
    frames = torch.randint(1, 256, (3, 5, 3, 8, 8), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    frames[1, 3:] = 0  # ends early
    frames[2] = 0  # is missing
    return frames


def test_differences_are_those_of_a_slow_version(clip):
    found = frame_input(clip, observed_frames(clip), "differences").numpy()
    for sample in range(2):
        frames = clip[sample].numpy().astype(np.float64)
        seen = frames[frames.any(axis=(1, 2, 3))]
        wanted = np.floor(127.5 + (frames - seen.mean(0)) / 2)
        assert np.abs(found[sample, : len(seen)] - wanted[: len(seen)]).max() <= 1  # float32 may round across a number


def test_what_stands_still_leaves_no_trace_and_what_moves_does(clip):
    still = clip[:1, :1].expand(1, 5, 3, 8, 8).clone()
    assert (frame_input(still, observed_frames(still), "differences") == 127).all()
    still[0, 2, :, 4, 4] = 255 - still[0, 2, :, 4, 4]
    moved = (frame_input(still, observed_frames(still), "differences") != 127).any(dim=2)[0]
    assert moved[:, 4, 4].all() and moved.sum() == 5


def test_both_are_side_by_side(clip):
    both = frame_input(clip, observed_frames(clip), "both")
    assert both.shape == (3, 5, 6, 8, 8) and (both[:, :, :3] == clip).all()
    assert (both[:, :, 3:] == frame_input(clip, observed_frames(clip), "differences")).all()
    assert frame_input(clip, observed_frames(clip), "frames") is clip


@pytest.mark.parametrize("chosen", ["frames", "differences", "both"])
def test_a_missing_end_and_the_other_clips_of_a_batch_change_nothing(clip, chosen):
    spec = DataSpec({"cam": ArraySpec((5, 3, 8, 8))})
    encoder = MultimodalEncoder(spec, features=8, width=8, frame_input=chosen, segments=0).eval()
    with torch.no_grad():
        together, alone = encoder({"cam": clip}), encoder({"cam": clip[1:2]})
        shorter = encoder({"cam": torch.cat([clip[1:2, :3], torch.zeros_like(clip[1:2, :2])], dim=1)})
    torch.testing.assert_close(together[1:2], alone)
    torch.testing.assert_close(shorter, alone)


def test_an_unknown_choice_is_one_line():
    with pytest.raises(UserError, match="unknown frame_input 'difference', did you mean 'differences'"):
        MultimodalEncoder(DataSpec({"cam": ArraySpec((5, 3, 8, 8))}), frame_input="difference")
