"""A folder of images with a CSV: columns, timing of actions, episodes, and what is refused."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.importers.image_folder import import_images
from repdib_lightning.errors import UserError

ROWS = 12


def write_images(folder: Path, prefix: str = "", rows: int = ROWS, size: tuple[int, int] = (10, 8)) -> list[str]:
    """PNG files (lossless), whose red channel holds the row's number everywhere."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    names = []
    for row in range(rows):
        pixels = np.random.default_rng(row).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        pixels[..., 0] = row % 256
        names.append(f"{prefix}{row:03d}.png")
        Image.fromarray(pixels).save(folder / "images" / names[-1])
    return names


def write_csv(folder: Path, columns: dict[str, list[Any]], name: str = "run.csv", delimiter: str = ",") -> None:
    with open(folder / name, "w", newline="") as stream:
        writer = csv.writer(stream, delimiter=delimiter)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def published(folder: Path) -> dict[str, list[Any]]:
    """file name, action, true cell, time index: as the robot arm's recordings are described."""
    generator = np.random.default_rng(0)
    return {
        "image": write_images(folder),
        "action": generator.integers(0, 5, ROWS).tolist(),
        "cell": generator.integers(0, 9, ROWS).tolist(),
        "time": list(range(100, 100 + ROWS)),
    }


def convert(folder: Path, **options: Any) -> EpisodeStore:
    return EpisodeStore(import_images(folder, folder.parent / "out" / "store.h5", progress=False, **options))


def refuse(folder: Path, *words: str, **options: Any) -> None:
    with pytest.raises(UserError) as caught:
        convert(folder, **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    out = folder.parent / "out"
    assert not out.exists() or not list(out.iterdir())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "arm"
    path.mkdir()
    return path


def test_published_layout_round_trips(folder: Path) -> None:
    columns = published(folder)
    write_csv(folder, columns)
    store = convert(folder)
    pixels = store.array("observations/pixels")
    assert pixels.shape == (ROWS, 3, 8, 10)
    for row, name in enumerate(columns["image"]):
        expected = np.asarray(Image.open(folder / "images" / name)).transpose(2, 0, 1)
        np.testing.assert_array_equal(pixels[row], expected)
    assert store.array("actions")[:-1].tolist() == columns["action"][:-1]
    assert store.array("actions")[-1] == -1
    assert store.array("factors/cell").tolist() == columns["cell"]
    assert store.array("factors/time").tolist() == columns["time"]
    assert store.factors["cell"].kind == "endogenous"
    assert store.factors["time"].kind == "exogenous"


def test_action_that_led_to_its_image_is_moved_one_row_up(folder: Path) -> None:
    columns = published(folder) | {"episode": [0] * 5 + [1] * 7}
    columns["action"][0] = columns["action"][5] = ""
    write_csv(folder, columns)
    store = convert(folder, action_timing="before")
    assert store.lengths.tolist() == [5, 7]
    assert store.array("actions").tolist() == [*columns["action"][1:5], -1, *columns["action"][6:], -1]


def test_action_at_its_image_may_be_blank_only_in_an_episodes_last_row(folder: Path) -> None:
    columns = published(folder)
    columns["action"][-1] = ""
    write_csv(folder, columns)
    assert convert(folder).array("actions")[:-1].tolist() == columns["action"][:-1]
    columns["action"][3] = "nan"
    write_csv(folder, columns)
    (folder.parent / "out" / "store.h5").unlink()
    refuse(folder, "run.csv", "'action'", "line 5", "NaN")


def test_several_cameras_keep_their_own_sizes(folder: Path) -> None:
    front, top = write_images(folder, "front"), write_images(folder, "top", size=(6, 6))
    write_csv(folder, {"front_image": front, "top_image": top, "action": [0, 1] * 6})
    store = convert(folder)
    assert {name: spec.shape for name, spec in store.observations.items()} == {"front": (3, 8, 10), "top": (3, 6, 6)}
    assert store.array("observations/top")[:, 0, 0, 0].tolist() == list(range(ROWS))


def test_before_images_are_read_where_after_images_stand_beside_them(folder: Path) -> None:
    before, after = write_images(folder, "b"), write_images(folder, "a", size=(4, 4))
    write_csv(folder, {"before_image": before, "after_image": after, "action": [0, 1] * 6})
    store = convert(folder)
    assert {name: spec.shape for name, spec in store.observations.items()} == {"pixels": (3, 8, 10)}


def test_columns_of_any_name_can_be_stated(folder: Path) -> None:
    write_csv(
        folder,
        {
            "bild": write_images(folder),
            "befehl": [0, 1] * 6,
            "feld": [4] * ROWS,
            "lampe": [0.5, 0.25] * 6,
            "uhr": [0] * 12,
        },
    )
    store = convert(
        folder,
        image_columns="kamera=bild",
        action_column="befehl",
        factor_columns="feld:endogenous,lampe:exogenous,uhr:exogenous:continuous",
    )
    assert list(store.observations) == ["kamera"]
    assert store.array("actions")[:-1].tolist() == ([0, 1] * 6)[:-1]
    assert {name: (spec.kind, spec.scale) for name, spec in store.factors.items()} == {
        "feld": ("endogenous", "categorical"),
        "lampe": ("exogenous", "continuous"),
        "uhr": ("exogenous", "continuous"),
    }


def test_text_actions_become_classes_in_alphabetical_order(folder: Path) -> None:
    texts = ["stay", "north", "west", "north"] * 3
    write_csv(folder, {"image": write_images(folder), "action": texts})
    store = convert(folder)
    assert store.actions_spec is not None and (store.actions_spec.kind, store.actions_spec.size) == ("discrete", 3)
    assert store.array("actions")[:-1].tolist() == [["north", "stay", "west"].index(text) for text in texts[:-1]]
    assert '["north", "stay", "west"]' in store.attributes["classes"]


def test_fractions_and_vectors_are_continuous(folder: Path) -> None:
    names, values = write_images(folder), np.random.default_rng(0).normal(size=(ROWS, 11)).astype(np.float32)
    write_csv(folder, {"image": names} | {f"action_{index}": values[:, index].tolist() for index in range(11)})
    store = convert(folder)
    assert store.actions_spec is not None and (store.actions_spec.kind, store.actions_spec.size) == ("continuous", 11)
    np.testing.assert_allclose(store.array("actions")[:-1], values[:-1], rtol=1e-6)


def test_whole_numbers_can_be_continuous(folder: Path) -> None:
    write_csv(folder, {"image": write_images(folder), "action": [-1.0, 1.0] * 6})
    store = convert(folder, action_kind="continuous")
    assert store.array("actions")[:4].tolist() == [[-1.0], [1.0], [-1.0], [1.0]]


def test_negative_integers_are_renumbered_and_recorded(folder: Path) -> None:
    write_csv(folder, {"image": write_images(folder), "action": [-1, 1, 0] * 4})
    store = convert(folder)
    assert store.array("actions")[:3].tolist() == [0, 2, 1]
    assert '["-1", "0", "1"]' in store.attributes["classes"]


def test_images_without_actions_must_be_asked_for(folder: Path) -> None:
    write_csv(folder, {"image": write_images(folder), "light": [1] * ROWS})
    refuse(folder, "run.csv", "--action_column none", "image, light")
    assert convert(folder, action_column="none").actions_spec is None


def test_recording_is_cut_into_episodes_and_a_single_last_row_joins_the_one_before(folder: Path) -> None:
    write_csv(folder, published(folder))
    assert convert(folder, episode_length=4).lengths.tolist() == [4, 4, 4]
    (folder.parent / "out" / "store.h5").unlink()
    assert convert(folder, episode_length=11).lengths.tolist() == [12]


def test_resizing_is_antialiased(folder: Path) -> None:
    names = []
    (folder / "images").mkdir()
    for row in range(2):
        stripes = np.zeros((64, 64, 3), np.uint8)
        stripes[:, ::2] = 255
        names.append(f"{row}.png")
        Image.fromarray(stripes).save(folder / "images" / names[-1])
    write_csv(folder, {"image": names, "action": [0, 1]})
    pixels = convert(folder, size=16).array("observations/pixels")
    assert pixels.shape == (2, 3, 16, 16)
    assert np.abs(pixels.astype(int) - 127).max() < 40


def test_semicolons_and_a_byte_order_mark(folder: Path) -> None:
    write_csv(folder, published(folder), delimiter=";")
    path = folder / "run.csv"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert convert(folder).rows == ROWS


def test_grey_images_become_three_channels(folder: Path) -> None:
    (folder / "images").mkdir()
    for row in range(2):
        Image.fromarray(np.full((4, 4), 7 + row, np.uint8)).save(folder / "images" / f"{row}.png")
    write_csv(folder, {"image": ["0.png", "1.png"], "action": [0, 1]})
    np.testing.assert_array_equal(convert(folder).array("observations/pixels")[1], np.full((3, 4, 4), 8))


def test_unknown_column_names_the_nearest(folder: Path) -> None:
    write_csv(folder, published(folder))
    refuse(folder, "factor_columns", "did you mean 'cell'", factor_columns="cel:endogenous")
    refuse(folder, "action_column", "choices: action, cell, image, time", action_column="qqq")
    refuse(folder, "factor_columns", "cell:inner", factor_columns="cell:inner")


def test_ambiguous_action_columns(folder: Path) -> None:
    write_csv(folder, published(folder) | {"command": [0] * ROWS})
    refuse(folder, "action, command", "--action_column")


def test_no_image_column(folder: Path) -> None:
    write_csv(folder, {"action": [0, 1], "cell": [0, 1]})
    refuse(folder, "image_columns", "action, cell")


def test_missing_image_names_line_and_file(folder: Path) -> None:
    write_csv(folder, published(folder))
    (folder / "images" / "004.png").unlink()
    refuse(folder, "line 6", "004.png")


def test_damaged_image(folder: Path) -> None:
    write_csv(folder, published(folder))
    path = folder / "images" / "004.png"
    path.write_bytes(path.read_bytes()[:60])
    refuse(folder, "004.png", "not a readable image")


def test_images_of_another_size_hint_at_the_option(folder: Path) -> None:
    write_csv(folder, published(folder))
    Image.new("RGB", (5, 5)).save(folder / "images" / "004.png")
    refuse(folder, "004.png", "5 x 5", "10 x 8", "--size")
    assert convert(folder, size=8).rows == ROWS


def test_deep_images_are_not_clipped_in_silence(folder: Path) -> None:
    write_csv(folder, published(folder))
    Image.fromarray(np.full((8, 10), 40_000, np.uint16)).save(folder / "images" / "000.png")
    refuse(folder, "000.png", "8 bits")


def test_time_that_goes_back(folder: Path) -> None:
    columns = published(folder)
    columns["time"][7] = 0
    write_csv(folder, columns)
    refuse(folder, "'time'", "line 9")
    assert convert(folder, time_column="none").rows == ROWS


def test_an_episode_whose_rows_do_not_stand_together(folder: Path) -> None:
    write_csv(folder, published(folder) | {"episode": [0] * 4 + [1] * 4 + [0] * 4})
    refuse(folder, "'episode'", "line 10")


def test_blank_factor(folder: Path) -> None:
    columns = published(folder)
    columns["cell"][3] = ""
    write_csv(folder, columns)
    refuse(folder, "'cell'", "line 5")


def test_ragged_line(folder: Path) -> None:
    write_csv(folder, published(folder))
    with open(folder / "run.csv", "a") as stream:
        stream.write("012.png,3\n")
    refuse(folder, "line 14", "2 cells", "4")


def test_free_text_is_not_taken_for_actions(folder: Path) -> None:
    rows = 300
    names = write_images(folder, rows=rows, size=(2, 2))
    write_csv(folder, {"image": names, "action": [f"[0.{row} 1.0]" for row in range(rows)]})
    refuse(folder, "'action'", "300 distinct values")


def test_which_table(folder: Path, tmp_path: Path) -> None:
    refuse(folder, "no CSV file", "run.csv")
    refuse(tmp_path / "absent", "no such folder")
    columns = published(folder)
    write_csv(folder, columns, "a.csv")
    write_csv(folder, columns, "b.csv")
    refuse(folder, "a.csv, b.csv", "--table")
    refuse(folder, "did you mean 'b.csv'", table="bb.csv")
    assert convert(folder, table="b.csv").rows == ROWS
