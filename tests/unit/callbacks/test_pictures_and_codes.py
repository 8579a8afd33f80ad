"""What TensorBoard gets: the right pixels in the right tile, and code counts over the whole validation."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.bottlenecks.codebook import perplexity
from repdib_lightning.callbacks.codebook_use import CodeHistogram
from repdib_lightning.callbacks.pictures import picture_grid, video_grid


def test_the_grid_puts_each_frame_into_its_tile():
    frames = torch.randint(0, 256, (2, 3, 6, 4, 5), dtype=torch.uint8)
    grid = picture_grid(frames, shift=0)
    assert grid.shape == (3, 2 * 4, 3 * 5)
    for row in range(2):
        for column in range(3):
            tile = grid[:, row * 4 : row * 4 + 4, column * 5 : column * 5 + 5]
            assert torch.equal(tile, frames[row, column, -3:]), "the newest frame of the stack"


def test_grey_pictures_become_three_channels():
    assert picture_grid(torch.zeros(1, 2, 4, 3, 3, dtype=torch.uint8), 0).shape == (3, 3, 6)


def test_a_video_becomes_a_row_of_its_frames():
    videos = torch.randint(0, 256, (2, 2, 17, 3, 4, 5), dtype=torch.uint8)
    grid = video_grid(videos, shift=0)
    assert grid.shape == (3, 2 * 4, 6 * 5)
    assert torch.equal(grid[:, 4:, 5:10], videos[1, 0, 3])
    assert torch.equal(video_grid(videos[:, :, :4], 0)[:, :4, 15:], videos[0, 0, 3])


def test_histogram_adds_batches_and_perplexity_is_the_effective_number():
    histogram = CodeHistogram(groups=2, codes=4)
    histogram.update(torch.tensor([[0, 3], [1, 3]]))
    histogram.update(torch.tensor([[2, 3], [3, 3]]))
    counts = histogram.compute()
    assert counts.tolist() == [[1, 1, 1, 1], [0, 0, 0, 4]]
    assert perplexity(counts).tolist() == pytest.approx([4.0, 1.0])
