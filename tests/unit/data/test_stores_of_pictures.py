"""Stores whose episodes are single pictures: what inspect says and draws, and what sampling asks for."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image, ImageDraw

from repdib_lightning.__main__ import main
from repdib_lightning.data.contact_sheet import draw_contact_sheet
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection import inspect_store
from repdib_lightning.data.sampling import FutureSampling
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec

KINDS = ["ant", "bat", "cat", "dog", "eel"]
LIGHTS = ["0", "0.25", "0.5", "0.75", "1"]


def colour_of(row: int) -> tuple[int, int, int]:
    return 40 + row % 10 * 20, 30 + row // 10 * 20, 10 + row % 7


def write_pictures(path: Path, count: int, views: tuple[str, ...] = ("pixels",), **attributes: Any) -> EpisodeStore:
    """Flat pictures, each of its own colour, each an episode of one row, every fourth held out."""
    with EpisodeWriter(
        path,
        rows=count,
        episodes=count,
        observations={view: ArraySpec((3, 8, 8)) for view in views},
        actions=None,
        factors={"kind": FactorSpec("endogenous", "categorical", 5), "light": FactorSpec("exogenous", "continuous")},
        attributes={"classes": {"kind": KINDS}, **attributes},
        overwrite=True,
    ) as writer:
        for row in range(count):
            pixels = np.empty((1, 3, 8, 8), np.uint8)
            pixels[:] = np.array(colour_of(row), np.uint8)[:, None, None]
            factors = {"kind": np.array([row % 5]), "light": np.array([row / 4], np.float32)}
            writer.add_episode(observations=dict.fromkeys(views, pixels), factors=factors, evaluation=row % 4 == 3)
    return EpisodeStore(path)


@pytest.fixture
def written(monkeypatch) -> list[str]:
    """Every text that is written on a sheet, in order."""
    texts: list[str] = []
    draw = ImageDraw.ImageDraw.text

    def told(pen: ImageDraw.ImageDraw, place: Any, text: str, *rest: Any, **options: Any) -> None:
        texts.append(text)
        draw(pen, place, text, *rest, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", told)
    return texts


def as_numbers(colours: np.ndarray) -> np.ndarray:
    """(..., 3) -> (...): one number for each colour."""
    return colours.astype(np.int64) @ np.array([65536, 256, 1])


def shown_on(sheet: Path, count: int) -> dict[int, tuple[int, int, int]]:
    """Row -> top, left and number of the pixels of its colour, of each row that is there."""
    with Image.open(sheet) as image:
        pixels = as_numbers(np.asarray(image))
    present = set(np.unique(pixels))
    found = {}
    for row in range(count):
        if as_numbers(np.array(colour_of(row))) in present:
            there = pixels == as_numbers(np.array(colour_of(row)))
            found[row] = int(there.any(1).argmax()), int(there.any(0).argmax()), int(there.sum())
    return found


def test_the_sheet_is_a_grid_of_pictures_spread_over_the_store(tmp_path, written):
    store = write_pictures(tmp_path / "s.h5", 94)
    shown = shown_on(draw_contact_sheet(store, tmp_path / "s.png"), 94)
    assert list(shown) == [3 * number for number in range(32)]
    places = [(top, left) for top, left, _ in shown.values()]
    assert places == sorted(places)
    assert len({top for top, _ in places}) == 4 and len({left for _, left in places}) == 8
    assert {size for _, _, size in shown.values()} == {128 * 128}
    assert "94 pictures; 32 of them" in written
    assert not [text for text in written if "episode" in text or text.startswith("t =")]
    assert written.count("row 3   evaluation") == 1 and written.count("row 6   train") == 1


def test_factors_stand_below_by_the_names_of_their_classes(tmp_path, written):
    draw_contact_sheet(write_pictures(tmp_path / "s.h5", 5), tmp_path / "s.png")
    lines = [text for text in written if text.startswith(("kind", "light"))]
    expected = [[f"kind  {name}", f"light  {value}"] for name, value in zip(KINDS, LIGHTS, strict=True)]
    assert lines == [line for lines in expected for line in lines]
    assert "5 pictures; all of them" in written


@pytest.mark.parametrize("count", [1, 2, 9, 31, 32, 33])
def test_any_number_of_pictures_makes_a_sheet(tmp_path, count):
    store = write_pictures(tmp_path / "s.h5", count, views=("left", "right"))
    shown = shown_on(draw_contact_sheet(store, tmp_path / "s.png"), count)
    assert len(shown) == min(count, 32) and min(shown) == 0 and max(shown) == count - 1
    assert {size for _, _, size in shown.values()} == {2 * 128 * 128}


def test_rows_without_a_picture_are_called_rows(tmp_path, written):
    with EpisodeWriter(
        tmp_path / "s.h5", rows=3, episodes=3, observations={"joints": ArraySpec((2,), "float32")}, actions=None
    ) as writer:
        for row in range(3):
            writer.add_episode(observations={"joints": np.full((1, 2), row, np.float32)})
    draw_contact_sheet(EpisodeStore(tmp_path / "s.h5"), tmp_path / "s.png")
    assert "3 rows; all of them" in written and "max 2" in written


def test_episodes_over_time_name_classes_and_actions_too(make_store: Callable[..., Path], tmp_path, written):
    names = {"cell": ["north", "east", "south", "west"], "actions": ["up", "down", "left", "right"]}
    store = EpisodeStore(make_store(tmp_path / "s.h5", attributes={"classes": names}))
    draw_contact_sheet(store, tmp_path / "s.png")
    first = store.array("actions")[0], store.array("factors/cell")[0]
    start = written.index(f"action  {names['actions'][first[0]]}")
    assert written[start + 1] == f"cell  {names['cell'][first[1]]}"
    assert written.count("action  none (last)") == 4
    assert {text.split("  ")[1] for text in written if text.startswith("cell  ")} <= set(names["cell"])


@pytest.mark.parametrize(
    "classes", ["{no json", "[1, 2]", '{"kind": ["ant"]}', '{"kind": "abcde"}', '{"other": ["a"]}', 7]
)
def test_classes_of_other_programs_that_name_nothing_leave_the_numbers(tmp_path, written, classes):
    path = write_pictures(tmp_path / "s.h5", 5).path
    with h5py.File(path, "a") as file:
        file.attrs["classes"] = classes
    draw_contact_sheet(EpisodeStore(path), tmp_path / "s.png")
    assert [text for text in written if text.startswith("kind")] == [f"kind  {number}" for number in range(5)]


def one_row_warnings(path: Path) -> list[str]:
    return [warning for warning in inspect_store(path).warnings if "one row" in warning]


def test_only_a_mixture_of_pictures_and_episodes_is_warned_of(make_store: Callable[..., Path], tmp_path):
    pictures = write_pictures(tmp_path / "pictures.h5", 6).path
    assert one_row_warnings(pictures) == []
    assert any("no actions" in warning for warning in inspect_store(pictures).warnings)
    assert one_row_warnings(make_store(tmp_path / "none.h5")) == []
    (some,) = one_row_warnings(make_store(tmp_path / "some.h5", lengths=(5, 1, 4, 1), evaluation=(2,)))
    assert some.startswith("2 episodes have one row: sampled only with data.futures 0")
    (one,) = one_row_warnings(make_store(tmp_path / "one.h5", lengths=(5, 1, 4), evaluation=(2,)))
    assert one.startswith("1 episode has one row: ")


def test_the_warning_of_a_mixture_is_true(make_store: Callable[..., Path], tmp_path):
    store = EpisodeStore(make_store(tmp_path / "s.h5", lengths=(5, 1, 4), evaluation=(2,)))
    assert len(FutureSampling(store, "train", horizon=3, futures=0, seed=0)) == 6
    with pytest.raises(UserError, match=r"episode 1 has one row .* set data\.futures to 0, .* or leave this episode"):
        FutureSampling(store, "train", horizon=1, futures=1, seed=0)


@pytest.mark.parametrize(
    ("options", "way_out"),
    [
        ({"futures": 1}, "set data.futures to 0"),
        ({"futures": 2, "next_frame": True}, "set data.futures to 0 and data.next_frame to false"),
        ({"futures": 0, "next_frame": True}, "set data.futures to 0 and data.next_frame to false"),
    ],
)
def test_futures_of_pictures_are_refused_with_the_way_out(tmp_path, options, way_out):
    store = write_pictures(tmp_path / "s.h5", 6)
    with pytest.raises(UserError, match=r"s\.h5: every episode has one row") as caught:
        FutureSampling(store, "train", horizon=1, seed=0, **options)
    assert str(caught.value).endswith(f"; {way_out}") and "\n" not in str(caught.value)
    assert len(FutureSampling(store, "train", horizon=1, seed=0, futures=0)) == 5


def test_recordings_of_people_are_named_with_their_imports(tmp_path):
    (tmp_path / "MMAct" / "gyro_clip" / "subject1").mkdir(parents=True)
    told = str(inspect_store(tmp_path / "MMAct"))
    assert told.endswith(
        f"(gyro_clip/); convert: python -m repdib_lightning import mmact {tmp_path}/MMAct data/NAME.h5"
    )
    (tmp_path / "watch_dataset.npy").write_bytes(b"any")
    told = str(inspect_store(tmp_path / "watch_dataset.npy"))
    assert told.endswith(
        f"convert: python -m repdib_lightning import smartwatch {tmp_path}/watch_dataset.npy data/NAME.h5"
    )


def test_a_folder_of_the_shape_of_pacs_is_named_with_its_import(tmp_path, capsys):
    source = tmp_path / "PACS"
    for domain in ("cartoon", "photo"):
        for label in ("dog", "elephant"):
            (source / domain / label).mkdir(parents=True)
            Image.new("RGB", (9, 9)).save(source / domain / label / "pic_001.JPG", "JPEG")
    report = str(inspect_store(source))
    command = f"python -m repdib_lightning import pacs {source} data/NAME.h5 --domains all --classes all"
    assert report.startswith(f"{source}: pictures two folders down, such as ") and report.endswith(command)
    assert "/pic_001.JPG;" in report and "\n" not in report
    assert (
        main(
            [
                "import",
                "pacs",
                str(source),
                str(tmp_path / "s.h5"),
                "--size",
                "8",
                "--domains",
                "all",
                "--classes",
                "all",
            ]
        )
        == 0
    )
    assert json.loads(EpisodeStore(tmp_path / "s.h5").attributes["classes"])["class"] == ["dog", "elephant"]


@pytest.mark.parametrize("file", ["noto/ant.png", "a/b/notes.txt", "a/.cache/x.png", "_a/b/x.png", "a/b/._x.png"])
def test_other_folders_are_not_taken_for_it(tmp_path, file):
    (tmp_path / "f" / file).parent.mkdir(parents=True)
    (tmp_path / "f" / file).touch()
    with pytest.raises(UserError, match="a folder in which no import finds its files"):
        inspect_store(tmp_path / "f")
