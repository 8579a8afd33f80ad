"""inspect: counts and ranges are right, warnings say what to run, the contact sheet shows the pictures."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from PIL import Image

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection import inspect_store
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec


def row_of(text: str, key: str) -> list[str]:
    """The words of the line that starts with a key."""
    return next(line.split() for line in text.splitlines() if line.split()[:1] == [key])


def test_counts_ranges_and_factors(store_file: Path) -> None:
    text = str(inspect_store(store_file))
    store = EpisodeStore(store_file)
    assert row_of(text, "rows")[:4] == ["rows", "45", "(41", "with"]
    assert "4; length: min 9, median 11.5, max 13" in text
    assert row_of(text, "evaluation")[1:] == ["2", "episodes,", "as", "stored"]
    assert " ".join(row_of(text, "observations/front")[1:10]) == "45 x 3 x 24 x 24 uint8 contiguous"
    assert row_of(text, "fingerprint") == ["fingerprint", store.fingerprint]
    assert " ".join(row_of(text, "cell")) == "cell endogenous categorical 4 of 4 classes occur"
    assert row_of(text, "light")[:3] == ["light", "exogenous", "continuous"]
    actions = store.array("actions")[:]
    shares = np.bincount(actions[actions >= 0]) / 41
    for action, share in enumerate(shares):
        assert row_of(text, str(action))[1] == f"{share:.1%}"
    assert "rewards: none" in text and "warning" not in text


def test_continuous_actions_and_rewards(tmp_path: Path) -> None:
    path = tmp_path / "store.h5"
    with EpisodeWriter(
        path,
        rows=7,
        episodes=2,
        observations={"joints": ArraySpec((3,), "float32")},
        actions=ActionSpec("continuous", 2),
        rewards=True,
    ) as writer:
        for length, action, end in ((4, -0.5, True), (3, 0.75, False)):
            writer.add_episode(
                observations={"joints": np.full((length, 3), action)},
                actions=np.full((length - 1, 2), [action, 3]),
                rewards=np.full(length - 1, action),
                terminations=np.arange(length - 1) == (length - 2 if end else -1),
                truncations=np.arange(length - 1) == (-1 if end else length - 2),
            )
    report = inspect_store(path)
    assert row_of(report.text, "0") == ["0", "-0.5", "0", "0.75", "0.612"]
    assert "a step: -0.5 to 0.75" in report.text
    assert "sum: min -1.5, median 0, max 1.5" in report.text
    assert "1 terminations, 1 truncations" in report.text
    assert "action dimensions that never change: 1" in report.warnings
    assert report.contact_sheet is not None and report.contact_sheet.exists()


def test_contact_sheet_shows_the_frames(store_file: Path, tmp_path: Path) -> None:
    report = inspect_store(store_file, contact_sheet=tmp_path / "sheets" / "sheet.png")
    sheet = np.asarray(Image.open(tmp_path / "sheets" / "sheet.png")).astype(int)
    assert report.contact_sheet == tmp_path / "sheets" / "sheet.png"
    frame = EpisodeStore(store_file).array("observations/front")[0].transpose(1, 2, 0)
    tile = np.asarray(Image.fromarray(frame).resize((128, 128), Image.Resampling.LANCZOS)).astype(int)
    places = [
        (y, x)
        for y in range(60, 160)
        for x in range(60)
        if (sheet[y : y + 4, x : x + 4] == tile[:4, :4]).all() and (sheet[y : y + 128, x : x + 128] == tile).all()
    ]
    assert len(places) == 1


def test_contact_sheet_stands_beside_the_store_by_default(store_file: Path) -> None:
    assert inspect_store(store_file).contact_sheet == store_file.with_suffix(".png")
    assert sorted(path.name for path in store_file.parent.iterdir()) == ["small.h5", "small.png"]


@pytest.mark.parametrize("shape", [(1, 8, 8), (2, 8, 8), (9, 8, 12), (3, 200, 150)])
def test_contact_sheet_of_other_pictures(tmp_path: Path, shape: tuple[int, ...]) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, *shape), dtype=np.uint8)
    with EpisodeWriter(
        tmp_path / "s.h5", rows=3, episodes=1, observations={"x": ArraySpec(shape)}, actions=None
    ) as writer:
        writer.add_episode(observations={"x": frames})
    report = inspect_store(tmp_path / "s.h5")
    assert report.contact_sheet is not None
    shown = np.asarray(Image.open(report.contact_sheet))[64:200, 20:150]
    assert len(np.unique(shown)) > 60
    assert any("no actions" in warning for warning in report.warnings)


@pytest.mark.parametrize(
    ("chunks", "compression", "words"),
    [
        ((20, 3, 24, 24), "gzip", ["gzip", "33.8 KiB", "thousands of times"]),
        ((1, 3, 24, 24), "lzf", ["lzf", "decodes 1.7 KiB", "about 100 times"]),
    ],
)
def test_slow_layouts_say_what_to_run(
    store_file: Path, chunks: tuple[int, ...], compression: str, words: list[str]
) -> None:
    with h5py.File(store_file, "a") as file:
        frames = file["observations/front"][:]
        del file["observations/front"]
        file.create_dataset("observations/front", data=frames, chunks=chunks, compression=compression)
    report = inspect_store(store_file, verify=True)
    (warning,) = report.warnings
    for word in ["'observations/front'", "import store", *words]:
        assert word in warning, warning
    command = re.search(r"import store (\S+) (\S+)", warning)
    assert command is not None and command[1] == str(store_file) and command[2] != command[1]
    assert "(verified)" in report.text


def test_verify_finds_a_changed_value(store_file: Path) -> None:
    with h5py.File(store_file, "a") as file:
        file["observations/top"][30, 1, 5, 5] ^= 1
    assert "verified" not in str(inspect_store(store_file))
    with pytest.raises(UserError, match=r"small\.h5: the content .* does not match its fingerprint"):
        inspect_store(store_file, verify=True)


def test_suspicious_content(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (8, 3, 4, 4), dtype=np.uint8)
    stacked = np.stack([np.concatenate([frames[max(t - 2, 0)], frames[max(t - 1, 0)], frames[t]]) for t in range(8)])
    specs = {"stacked": ArraySpec((9, 4, 4)), "blank": ArraySpec((3, 4, 4))}
    with EpisodeWriter(
        tmp_path / "s.h5", rows=8, episodes=1, observations=specs, actions=ActionSpec("discrete", 3)
    ) as writer:
        blank = np.zeros((8, 3, 4, 4), np.uint8)
        writer.add_episode(observations={"stacked": stacked, "blank": blank}, actions=np.arange(7) % 2)
    warnings = "\n".join(inspect_store(tmp_path / "s.h5").warnings)
    assert "'observations/stacked' repeats earlier frames" in warnings
    assert "'observations/blank' is 0 everywhere" in warnings
    assert "actions that never occur: 2" in warnings
    assert "'observations/stacked' is" not in warnings


def test_an_unwritable_default_place_is_only_a_warning(store_file: Path) -> None:
    store_file.with_suffix(".png").mkdir()
    report = inspect_store(store_file)
    assert report.contact_sheet is None and any("--contact_sheet" in warning for warning in report.warnings)
    with pytest.raises(UserError, match="cannot be written"):
        inspect_store(store_file, contact_sheet=store_file.with_suffix(".png"))


def test_data_of_other_programs_are_named_with_their_import(tmp_path: Path) -> None:
    shards, episodes, images = tmp_path / "84px", tmp_path / "64px", tmp_path / "arm"
    for folder in (shards, episodes, images):
        folder.mkdir()
    with h5py.File(shards / "0.hdf5", "w") as file:
        for key in ("observation", "action", "reward", "discount", "step_type"):
            file[key] = np.zeros(5)
    np.savez(episodes / "a-5.npz", image=np.zeros(5), action=np.zeros(5), reward=np.zeros(5))
    (images / "run.csv").write_text("image,action\n0.png,1\n")
    convert = "python -m repdib_lightning import"
    for path, words in (
        (shards, f"V-D4RL 84 px shards; convert: {convert} vd4rl {shards}"),
        (
            shards / "0.hdf5",
            f"5 rows (84 px form); convert the whole folder: python -m repdib_lightning import vd4rl {shards}",
        ),
        (episodes, f"V-D4RL 64 px episodes; convert: {convert} vd4rl {episodes}"),
        (episodes / "a-5.npz", f"import vd4rl {episodes}"),
        (images, f"import images {images}"),
        (images / "run.csv", f"import images {images / 'run.csv'}"),
    ):
        report = inspect_store(path)
        assert words in str(report) and report.contact_sheet is None
    with h5py.File(tmp_path / "minari.hdf5", "w") as file:
        file["episode_0/observations"] = np.zeros(3)
    assert "looks like Minari" in str(inspect_store(tmp_path / "minari.hdf5"))


def test_bad_files_are_one_line(store_file: Path, tmp_path: Path, make_store: Callable[..., Path]) -> None:
    (tmp_path / "text.h5").write_text("not hdf5")
    cut = make_store(tmp_path / "cut.h5")
    cut.write_bytes(cut.read_bytes()[:-5000])
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["things"] = np.zeros(3)
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("text.h5", "not a readable HDF5 file"),
        ("cut.h5", "truncated"),
        ("other.h5", "not a store"),
        ("smal.h5", "did you mean 'small.h5'"),
        ("empty", "a folder in which no import finds its files"),
    ):
        with pytest.raises(UserError) as caught:
            inspect_store(tmp_path / name)
        assert words in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


def test_a_contact_sheet_replaces_no_other_file(store_file: Path, tmp_path: Path) -> None:
    content = store_file.read_bytes()
    with pytest.raises(UserError, match=r"--contact_sheet must end in \.png, is '.*small\.h5'"):
        inspect_store(store_file, contact_sheet=store_file)
    named_png = tmp_path / "data.png"
    named_png.write_bytes(content)
    with pytest.raises(UserError, match=r"--contact_sheet would replace .*data\.png"):
        inspect_store(named_png, contact_sheet=tmp_path / "x" / ".." / "data.png")
    report = inspect_store(named_png)
    assert report.contact_sheet is None and "would replace" in report.warnings[-1]
    assert store_file.read_bytes() == content and named_png.read_bytes() == content
