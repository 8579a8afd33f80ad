"""PNG files of reports: few colours where nobody sees it, all of them where somebody would."""

from __future__ import annotations

import io

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from repdib_lightning.evaluation.figures import png, small_png


def read(content):
    return Image.open(io.BytesIO(content))


def line_plot():
    figure = Figure(figsize=(4, 3))
    figure.subplots().plot([0, 1, 0, 2], color="#0072B2")
    return figure


def test_a_plot_has_few_colours_and_looks_the_same():
    drawn = io.BytesIO()
    line_plot().savefig(drawn, format="png", dpi=110)
    whole = np.asarray(Image.open(drawn).convert("RGB"), int)
    small = read(png(line_plot()))
    assert small.mode == "P" and np.abs(np.asarray(small.convert("RGB"), int) - whole).mean() <= 0.5
    assert png(line_plot()) == png(line_plot())


def test_a_picture_of_many_colours_keeps_all_of_them():
    noise = np.random.default_rng(0).integers(256, size=(64, 64, 3), dtype=np.uint8)
    kept = read(small_png(Image.fromarray(noise)))
    assert kept.mode == "RGB"
    np.testing.assert_array_equal(np.asarray(kept), noise)


def test_nothing_is_transparent():
    clear = Image.new("RGBA", (8, 8), (255, 0, 0, 255))
    assert np.asarray(read(small_png(clear)).convert("RGB"))[0, 0].tolist() == [255, 0, 0]
