"""A video is shifted as one, and what is missing of it stays missing."""

from __future__ import annotations

import torch

from repdib_lightning.encoders.augmentation import random_shift


def test_all_frames_of_a_video_move_alike_and_each_video_by_itself():
    frame = torch.arange(12 * 12, dtype=torch.uint8).view(1, 1, 1, 12, 12)
    videos = frame.expand(40, 3, 2, 12, 12).contiguous()
    shifted = random_shift(videos, 3)
    assert shifted.shape == videos.shape and shifted.dtype == torch.uint8
    assert torch.equal(shifted, shifted[:, :1, :1].expand_as(shifted))
    assert len({tuple(video[0, 0].flatten().tolist()) for video in shifted}) > 20


def test_a_video_moves_as_a_picture_of_its_frames():
    videos = torch.randint(0, 256, (5, 4, 3, 9, 7), dtype=torch.uint8)
    torch.manual_seed(0)
    shifted = random_shift(videos, 2)
    torch.manual_seed(0)
    assert torch.equal(shifted.flatten(1, 2), random_shift(videos.flatten(1, 2), 2))


def test_frames_of_zeros_stay_so_and_others_never_become_so():
    videos = torch.randint(1, 256, (6, 4, 3, 8, 8), dtype=torch.uint8)
    videos[:, 2:] = 0
    shifted = random_shift(videos, 4)
    assert not shifted[:, 2:].any() and shifted[:, :2].all()
