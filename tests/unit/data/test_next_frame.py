"""The fixed frame t + 1 in front of the drawn futures: it adds a frame and changes nothing that is drawn."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.mazes import MazeDataModule
from repdib_lightning.data.robot_arm import RobotArmDataModule
from repdib_lightning.data.sampling import FutureSampling
from repdib_lightning.errors import UserError
from repdib_lightning.export.rebuild import _spec
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec

NUMBERS = np.array([41, 3, 17, 90, 0, 200])


@pytest.fixture
def store(store_file):
    return EpisodeStore(store_file)


def sampling(store, **options):
    return FutureSampling(store, "train", **{"horizon": 4, "futures": 2, "seed": 3, **options})


def test_without_it_the_stream_is_that_of_the_generator(store):
    """Spelt out, so that no option moves the draws of runs that were made before it."""
    plain = sampling(store)
    rows, offsets = plain.draw(NUMBERS)
    for number, row, offset in zip(NUMBERS, rows, offsets, strict=True):
        epoch, position = divmod(int(number), len(plain))
        generator = np.random.Generator(np.random.Philox(key=np.array([3, epoch], np.uint64)))
        assert row == generator.permutation(plain.anchors)[position]
        assert offset.tolist() == [0, *generator.integers(1, 5, (len(plain), 2))[position]]


@pytest.mark.parametrize("horizon", [1, 4])
def test_with_it_the_same_futures_stand_behind_the_next_frame(store, horizon):
    rows, offsets = sampling(store, horizon=horizon).draw(NUMBERS)
    same_rows, more = sampling(store, horizon=horizon, next_frame=True).draw(NUMBERS)
    assert same_rows.tobytes() == rows.tobytes()
    assert more.shape == (6, 4) and (more[:, :2] == [0, 1]).all()
    assert (more[:, [0, 2, 3]] == offsets).all()


def test_every_frame_lies_in_the_anchors_episode(store):
    drawing = sampling(store, next_frame=True)
    rows, offsets = drawing.draw(np.arange(5 * len(drawing)))
    assert (store.row_episodes[rows[:, None] + offsets] == store.row_episodes[rows][:, None]).all()


@pytest.mark.parametrize("resident", [False, True])
def test_batches_hold_the_next_frame(store_file, resident):
    data = EpisodeDataModule(str(store_file), batch_size=4, horizon=3, next_frame=True, resident=resident)
    data.setup()
    assert data.spec.next_frame and data.spec.horizon == 3
    for loader in (data.train_dataloader(), data.val_dataloader()):
        batch = next(iter(loader))
        assert batch.observations["front"].shape[1] == 3 and (batch.offsets[:, 1] == 1).all()
        assert torch.equal(batch.observations["front"][:, :, 0, 0, 0].long(), batch.rows[:, None] + batch.offsets)


@pytest.mark.parametrize("kind", [EpisodeDataModule, RobotArmDataModule, MazeDataModule])
def test_every_data_module_passes_it_on(store_file, kind):
    for wanted in (False, True):
        data = kind(str(store_file), horizon=2, next_frame=wanted)
        data.setup()
        assert data.spec.next_frame is wanted and data.example().offsets.shape == (2, 3 if wanted else 2)
    data = kind(str(store_file), horizon=2)
    data.setup()
    assert not data.spec.next_frame


SPEC = DataSpec({"x": ArraySpec((3,), "float32")}, ActionSpec("discrete", 4), horizon=5, next_frame=True)


def test_a_spec_survives_as_plain_values_and_old_ones_are_read(tmp_path):
    plain = SPEC.to_dict()
    assert DataSpec.from_dict(plain) == _spec(tmp_path, plain) == SPEC
    old = {name: value for name, value in plain.items() if name != "next_frame"}
    assert not DataSpec.from_dict(old).next_frame and not _spec(tmp_path, old).next_frame
    with pytest.raises(UserError, match=r"'spec\.next_frame' must be true or false, is 1"):
        _spec(tmp_path, plain | {"next_frame": 1})
