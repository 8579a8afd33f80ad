"""inspect of clips: what is missing is counted as a slow loop counts it, and the sheet shows frames and readings."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from clip_stores import MODALITIES, SENSORS, VIEWS, write_clips
from PIL import Image, ImageDraw

from repdib_lightning.data.clip_picture import draw_clip
from repdib_lightning.data.clips import observed_steps
from repdib_lightning.data.contact_sheet import draw_contact_sheet
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection import inspect_store
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.traces import COLOURS, draw_traces
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ArraySpec


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_clips(tmp_path / "clips.h5", evaluation=["4"])


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every text that is drawn."""
    texts: list[str] = []
    draw = ImageDraw.ImageDraw.text

    def told(pen: ImageDraw.ImageDraw, place: tuple[float, float], text: str, *rest: object, **options: object) -> None:
        texts.append(text)
        draw(pen, place, text, *rest, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", told)
    return texts


def line_of(text: str, key: str) -> str:
    """The only line that begins with a word."""
    (line,) = [line.strip() for line in text.splitlines() if line.split()[:1] == [key]]
    return line


def slowly_observed(store: EpisodeStore, name: str) -> list[list[bool]]:
    """Clip by clip, step by step."""
    clips = store.array(f"observations/{name}")
    nothing = (lambda step: not step.any()) if name in VIEWS else (lambda step: np.isnan(step).all())
    return [[not nothing(step) for step in clip] for clip in clips]


def test_missing_clips_and_observed_steps_are_those_of_a_slow_loop(path: Path) -> None:
    store, text = EpisodeStore(path), inspect_store(path).text
    for name in MODALITIES:
        observed = slowly_observed(store, name)
        assert observed_steps(store, name).tolist() == observed
        steps = [sum(clip) for clip in observed if any(clip)]
        missing = 48 - len(steps)
        line = line_of(text, f"{name}:")
        assert missing > 0 and line.startswith(f"{name}: {missing} of 48 clips missing; observed steps: min ")
        assert f"min {min(steps)}, median {int(np.median(steps))}, max {max(steps)}" in line
        clips = store.array(f"observations/{name}")
        if name in SENSORS:
            lacking = sum(bool(np.isnan(clip).all(0).any() and not np.isnan(clip).all()) for clip in clips)
            assert lacking and line.endswith(f"some channels missing in {lacking}")


def test_a_frame_whose_middle_is_black_is_there(tmp_path: Path) -> None:
    video = np.zeros((3, 4, 3, 8, 8), np.uint8)
    video[0, :, 2, 7, 7] = 1
    video[1, 2, 0, 4, 0] = 1
    with EpisodeWriter(
        tmp_path / "s.h5", rows=3, episodes=3, observations={"cam": ArraySpec((4, 3, 8, 8))}, actions=None
    ) as writer:
        for clip in video:
            writer.add_episode(observations={"cam": clip[None]})
    observed = observed_steps(EpisodeStore(tmp_path / "s.h5"), "cam")
    assert observed.tolist() == [[True] * 4, [False, False, True, False], [False] * 4]
    assert "cam: 1 of 3 clips missing; observed steps: min 1" in inspect_store(tmp_path / "s.h5").text


def test_ranges_pass_over_what_was_not_observed(path: Path) -> None:
    text = inspect_store(path).text
    values = EpisodeStore(path).array("observations/gyroscope")[:]
    line = line_of(text, "observations/gyroscope")
    assert "nan" not in text
    assert line.endswith(
        f"{np.nanmin(values):.3g} to {np.nanmax(values):.3g}, mean {np.nanmean(values, dtype=np.float64):.3g}"
    )


def test_clips_of_each_class_are_counted(path: Path, tmp_path: Path) -> None:
    text = inspect_store(path).text
    assert "clips: 48\n" in text
    assert line_of(text.partition("clips of each class")[2], "activity") == (
        "activity  waving: 16 (4), walking: 16 (4), sitting: 16 (4)"
    )
    assert line_of(text.partition("clips of each class")[2], "subject") == (
        "subject  1: 12 (0), 2: 12 (0), 3: 12 (0), 4: 12 (12)"
    )
    several = write_clips(tmp_path / "several.h5", per_recording=2)
    assert "clips: 48 of 24 recordings" in inspect_store(several).text


def test_a_stream_that_is_nowhere_is_told_of(tmp_path: Path) -> None:
    observations = {"wrist": ArraySpec((5, 2), "float32"), "hip": ArraySpec((5, 2), "float32")}
    factors = {"activity": FactorSpec("endogenous", "categorical", 2)}
    with EpisodeWriter(
        tmp_path / "s.h5", rows=4, episodes=4, observations=observations, actions=None, factors=factors
    ) as writer:
        for clip in range(4):
            nothing, still = np.full((1, 5, 2), np.nan, np.float32), np.full((1, 5, 2), 3, np.float32)
            still[:, clip + 1 :] = np.nan
            writer.add_episode(
                observations={"wrist": nothing, "hip": still}, factors={"activity": np.array([clip % 2])}
            )
    report = inspect_store(tmp_path / "s.h5")
    assert line_of(report.text, "wrist:") == "wrist: 4 of 4 clips missing"
    assert line_of(report.text, "hip:") == "hip: no clip missing; observed steps: min 1, median 2.5, max 4"
    assert line_of(report.text, "observations/wrist").endswith("nothing observed")
    assert "'observations/wrist' is missing in all of 4 sampled clips" in report.warnings
    assert "'observations/hip' is 3.0 wherever observed in 4 sampled clips: blank" in report.warnings


def test_other_stores_have_no_lines_about_clips(store_file: Path) -> None:
    assert "clip" not in str(inspect_store(store_file))


def test_the_sheet_shows_eight_frames_of_every_view_and_the_names(
    path: Path, tmp_path: Path, written: list[str]
) -> None:
    store = EpisodeStore(write_clips(tmp_path / "long.h5", frames=12, size=32, clips=4, missing=False))
    with Image.open(draw_contact_sheet(store, tmp_path / "s.png")) as image:
        sheet = np.asarray(image)
    assert "4 clips; all of them" in written
    assert [text for text in written if text.startswith("clip ")][1] == "clip 1   train"
    assert "activity  walking     session  1     subject  1" in written
    shown = np.unique(np.linspace(0, 11, 8).round().astype(int))
    assert written.count(f"12 of 12 frames; here {', '.join(map(str, shown))}") == 8
    for place, frame in enumerate(shown):
        picture = store.array("observations/cam2")[0, frame].transpose(1, 2, 0)
        tile = np.asarray(Image.fromarray(picture).resize((128, 128), Image.Resampling.NEAREST))
        left = 20 + 136 * place
        columns = sheet[:, left : left + 128]
        tops = np.flatnonzero((columns[:, :8] == tile[0, :8]).all(axis=(1, 2)))
        assert any(np.array_equal(columns[top : top + 128], tile) for top in tops)


def test_what_is_missing_of_a_clip_is_said_on_the_sheet(path: Path, tmp_path: Path, written: list[str]) -> None:
    store = EpisodeStore(path)
    draw_contact_sheet(store, tmp_path / "s.png")
    chosen = [0, 16, 31, 47]
    lacking = sum(not observed_steps(store, name)[clip].any() for name in MODALITIES for clip in chosen)
    assert written.count("missing") == lacking
    assert [text for text in written if text.startswith("clip ")][-1] == "clip 47   evaluation"


def test_frames_are_spread_over_those_that_were_observed(path: Path, written: list[str]) -> None:
    draw_clip(EpisodeStore(path), 1, "train", 8)
    assert written.count("3 of 4 frames; here 0, 1, 2") == 2


def test_a_slow_layout_speaks_of_clips(path: Path) -> None:
    with h5py.File(path, "a") as file:
        videos = file["observations/cam1"][:]
        del file["observations/cam1"]
        file.create_dataset("observations/cam1", data=videos, chunks=(1, 4, 3, 16, 16), compression="gzip")
    report = inspect_store(path)
    assert any("one clip of 3.0 KiB decodes 3.0 KiB" in warning for warning in report.warnings)
    assert line_of(report.text, "cam1:").startswith("cam1: 2 of 48 clips missing")


def test_sensors_alone_make_a_sheet_of_traces(tmp_path: Path, written: list[str]) -> None:
    spec, attributes = {"wrist": ArraySpec((30, 2), "float32")}, {"channels": {"wrist": ["east", "up"]}}
    with EpisodeWriter(
        tmp_path / "s.h5",
        rows=2,
        episodes=2,
        observations=spec,
        actions=None,
        attributes={**attributes, "rate": {"wrist": 20}},
    ) as writer:
        for clip in range(2):
            writer.add_episode(observations={"wrist": np.random.default_rng(clip).random((1, 30, 2), np.float32)})
    draw_contact_sheet(EpisodeStore(tmp_path / "s.h5"), tmp_path / "s.png")
    assert written.count("east") == written.count("up") == 2 and written.count("1.5 s") == 2
    assert not [text for text in written if "frame" in text or text == "missing"]


def near(panel: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return (np.abs(panel.astype(int) - colour) < 12).all(axis=2)


def test_a_trace_rises_with_its_values_and_stops_where_nothing_was_observed() -> None:
    values = np.stack([np.arange(40), np.full(40, np.nan)], axis=1).astype(np.float32)
    values[10:20, 0] = np.nan
    panel = np.asarray(draw_traces(values, ["up", "none"], (936, 80)))[:, :800]
    line = near(panel, COLOURS[0])
    height = [float(np.flatnonzero(column).mean()) if column.any() else np.nan for column in line.T]
    left, gap, right = np.array(height[:180]), height[200:380], np.array(height[420:])
    assert np.nanmean(left[:60]) > np.nanmean(left[120:]) > np.nanmean(right[:100]) > np.nanmean(right[-100:])
    assert np.isnan(gap).all()
    assert not near(panel, COLOURS[1]).any()


def test_only_the_first_of_many_channels_are_drawn(written: list[str]) -> None:
    draw_traces(np.random.default_rng(0).random((8, 40)), [f"c{number}" for number in range(40)], (936, 80))
    assert [text for text in written if text.startswith("c")] == [f"c{number}" for number in range(len(COLOURS))]
    assert f"the first {len(COLOURS)} of 40 channels" in written
