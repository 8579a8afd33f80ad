"""Pictures of any shape and mode as small squares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from deep_pictures import sixteen_bit_rgb
from picture_trees import convert, refuse, write_tree
from PIL import Image

from repdib_lightning.data.importers.square_picture import read_square


@pytest.fixture
def source(tmp_path) -> Path:
    return write_tree(tmp_path / "PACS", each=3)


def test_more_than_eight_bits_a_channel_are_refused(source):
    file = source / "cartoon" / "horse" / "deep.png"
    Image.fromarray(np.full((4, 4), 40_000, np.uint16)).save(file)
    refuse(source, "cartoon/horse/deep.png: has more than 8 bits a channel")
    sixteen_bit_rgb(file)
    with Image.open(file) as opened:
        assert opened.mode == "RGB"  # as Pillow reads it, cutting the lower bits off
    refuse(source, "cartoon/horse/deep.png: has more than 8 bits a channel")


def test_other_modes_are_converted_and_counted_in_one_line(source, capsys):
    folder = source / "art" / "dog"
    Image.new("L", (9, 9), 77).save(folder / "pic_000.png")
    Image.new("L", (9, 9), 99).save(folder / "pic_001.png")
    half = Image.new("RGBA", (9, 9), (200, 0, 100, 0))
    half.paste((0, 0, 0, 255), (0, 0, 9, 4))
    half.save(folder / "pic_002.png")
    palette = Image.new("P", (9, 9), 1)
    palette.putpalette([1, 2, 3, 250, 10, 20])
    palette.save(folder / "pic_003.png")
    palette.save(folder / "pic_004.png", transparency=1)
    Image.new("RGB", (9, 9), (5, 6, 7)).save(folder / "pic_005.png", transparency=(5, 6, 7))
    Image.new("CMYK", (9, 9)).save(folder / "pic_006.jpg", quality=100)
    pixels = convert(source, size=9, domains="art").array("observations/pixels")
    assert (pixels[0] == 77).all() and (pixels[1] == 99).all()
    assert (pixels[2, :, :4] == 0).all() and (pixels[2, :, 4:] == 255).all()
    assert (pixels[3] == np.array([250, 10, 20])[:, None, None]).all()
    assert all((pixels[row] == 255).all() for row in (4, 5, 6))
    told = [line for line in capsys.readouterr().err.splitlines() if "converted to RGB" in line]
    counts = "1 CMYK, 2 L, 1 P, 1 P with transparency, 1 RGB with transparency, 1 RGBA"
    assert len(told) == 1 and told[0].endswith(f"converted to RGB: {counts}")


def test_transparent_edges_do_not_show_the_hidden_colour(tmp_path):
    """White must be laid below before resizing, or what is hidden bleeds into the edge."""
    picture = np.zeros((8, 8, 4), np.uint8)
    picture[:, 4:] = (255, 255, 255, 255)  # the other half: black, but transparent
    Image.fromarray(picture).save(tmp_path / "a.png")
    assert (read_square(tmp_path / "a.png", 3)[0] == 255).all()


@pytest.mark.parametrize(("width", "height"), [(20, 8), (8, 20), (21, 8)])
def test_the_middle_square_is_cut_out_first(tmp_path, width, height):
    picture = np.zeros((height, width, 3), np.uint8)
    left, top = (width - 8) // 2, (height - 8) // 2
    picture[top : top + 8, left : left + 8] = np.random.default_rng(0).integers(1, 256, (8, 8, 3))
    Image.fromarray(picture).save(tmp_path / "a.png")
    square = picture[top : top + 8, left : left + 8].transpose(2, 0, 1)
    assert (read_square(tmp_path / "a.png", 8)[0] == square).all()
    Image.new("RGB", (width, height), "black").save(tmp_path / "b.png")
    frame = Image.new("RGB", (width, height), "black")
    frame.paste((255, 255, 255), (left, top, left + 8, top + 8))
    frame.save(tmp_path / "b.png")
    assert (read_square(tmp_path / "b.png", 4)[0] == 255).all()  # nothing from outside of the square


def test_shrinking_averages(tmp_path):
    stripes = np.zeros((64, 64, 3), np.uint8)
    stripes[:, ::2] = 255
    Image.fromarray(stripes).save(tmp_path / "a.png")
    shrunk = read_square(tmp_path / "a.png", 8)[0]
    assert np.abs(shrunk.astype(int) - 127).max() <= 8
