"""The image beside a game: where it is, that it is grey, its factors, its split, and what bad input says."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.environments.side_image import SIDES, SideImage
from repdib_lightning.errors import UserError

SIZE, WIDTH = 20, 9


def made(side: str, width: int = WIDTH, source: str = "", seed: int = 3) -> SideImage:
    return SideImage(side, width, source, seed, SIZE)  # type: ignore[arg-type]


@pytest.mark.parametrize("side", SIDES)
def test_frames_and_image_are_side_by_side(side):
    frames = np.random.default_rng(0).integers(256, size=(2, 3, SIZE, SIZE), dtype=np.uint8)
    given, image = frames.copy(), made(side)
    joined = image.beside(frames, 5)
    assert np.array_equal(frames, given) and joined.dtype == np.uint8 and joined.shape == (2, 3, *image.shape)
    for place in np.ndindex(2, 3):  # the slow way
        if side == "none":
            expected = frames[place]
        else:
            first = image.image(5) if side in ("left", "top") else frames[place]
            second = frames[place] if side in ("left", "top") else image.image(5)
            expected = np.concatenate([first, second], axis=1 if side in ("left", "right") else 0)
        assert np.array_equal(joined[place], expected)


@pytest.mark.parametrize("side", ["right", "top"])
def test_images_are_the_pools_stills_in_grey(side):
    size = (SIZE, WIDTH) if side == "right" else (WIDTH, SIZE)
    pool, image = NumberedClips("procedural_images", 3, size=size), made(side)
    for number in (0, 7, 1003):
        colours = pool.clip(number)[0].astype(float)
        grey = 0.299 * colours[..., 0] + 0.587 * colours[..., 1] + 0.114 * colours[..., 2]
        assert np.abs(image.image(number) - grey).max() <= 0.5 + 1e-9
        assert np.array_equal(image.image(number), made(side).image(number))
    assert not np.array_equal(image.image(0), image.image(1))
    assert not np.array_equal(image.image(0), made(side, seed=4).image(0))


def test_pictures_of_a_folder_are_turned_to_grey_as_pillow_does(tmp_path):
    pixels = np.random.default_rng(0).integers(256, size=(8, SIZE, WIDTH, 3), dtype=np.uint8)
    for number, picture in enumerate(pixels):
        Image.fromarray(picture).save(tmp_path / f"{number}.png")
    image = made("left", source=str(tmp_path))
    known = [np.asarray(Image.fromarray(picture).convert("L")).astype(int) for picture in pixels]
    found = [min(np.abs(image.image(n) - grey).max() for grey in known) for n in range(8)]
    assert max(found) <= 1 and image.factor_specs()["clip"].classes == 8


def test_factors_are_the_number_and_the_mean_of_each_ninth():
    image = made("right")
    assert {n: (s.kind, s.scale, s.classes, s.width) for n, s in image.factor_specs().items()} == {
        "clip": ("exogenous", "categorical", 1250, 1),
        "background": ("exogenous", "continuous", 0, 9),
    }
    for number in (4, 1100, 4):
        factors, pixels = image.factors(number), image.image(number)
        means = [pixels[y, x].mean() / 255 for y in np.array_split(range(SIZE), 3) for x in
                 (slice(0, 3), slice(3, 6), slice(6, 9)) for y in [y]]  # fmt: skip
        assert factors["clip"] == number and factors["background"].dtype == np.float32
        assert np.allclose(factors["background"], means, atol=1e-6)
    assert made("none").factors(0) == {} == made("none").factor_specs()


def test_evaluation_draws_held_out_images():
    image, random = made("right"), np.random.default_rng(0)
    training = {image.draw(random, False) for _ in range(300)}
    held_out = {image.draw(random, True) for _ in range(300)}
    few = {image.draw(random, True, 4) for _ in range(100)}
    assert training < set(range(1000)) and len(training) > 200
    assert held_out < set(range(1000, 1250)) and len(held_out) > 100 and few == {1000, 1001, 1002, 1003}
    assert made("none").draw(random, True) == 0


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"side": "rihgt"}, "side=rihgt: unknown, did you mean 'right'? (choices: bottom, left, none, right, top)"),
        ({"side": "top", "width": 2}, "side_width=2: must be from 3 to 512"),
        ({"side": "top", "width": 513}, "side_width=513: must be from 3 to 512"),
        (
            {"side": "none", "source": "x"},
            "side_source=x: means nothing with side=none; choose left, right, top, bottom",
        ),
        ({"side": "top", "source": "nowhere"}, "side_source=nowhere: 'nowhere' is neither built in nor a folder, "),
    ],
)
def test_bad_input_is_one_line(changed, said):
    with pytest.raises(UserError) as told:
        made(**changed)
    assert str(told.value).startswith(said) and "\n" not in str(told.value)
