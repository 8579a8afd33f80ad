"""``figures factors BUNDLE DATA``: what the lines of each picture hold, and that files are whole or absent."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from scene_fakes import scene_model, write_scenes

from repdib_lightning.__main__ import main
from repdib_lightning.bottlenecks import Identity, RepDIB
from repdib_lightning.bottlenecks.group_edits import most_used
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.decoders import ResidualDecoder
from repdib_lightning.encoders import ResidualEncoder
from repdib_lightning.evaluation import factor_figures, picture_grid
from repdib_lightning.evaluation.factor_figures import (
    FIGURES,
    open_redrawing,
    swapped_figure,
    traversed_figure,
    zeroed_figure,
)
from repdib_lightning.evaluation.picture_grid import picture_lines
from repdib_lightning.evaluation.redrawing import Redrawing, psnr, redraw
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.export import load_decoder, load_encoder, save_bundle
from repdib_lightning.records import ArraySpec, DataSpec

SMALL = {"channels": 2, "stages": 2}


def save(folder, groups=2, codes=5, size=16, decoder=True, spread=1.0):
    """A bundle with 4 numbers a latent; without groups it is not quantised. Latents spread over more codes if asked."""
    torch.manual_seed(0)
    encoder = ResidualEncoder(DataSpec({"pixels": ArraySpec((3, size, size))}), features=4, **SMALL)
    encoder.head.weight.data *= spread
    quantised = {"groups": groups, "codes": codes, "start": "random", "start_step": 0}
    bottleneck = RepDIB(4, **quantised) if groups else Identity(4)
    drawing = ResidualDecoder(encoder.spec, 4, **SMALL) if decoder else None
    save_bundle(Path(folder), encoder.eval(), bottleneck.eval(), training={}, data={}, decoder=drawing)
    return Path(folder)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scenes(Path("scenes.h5"), train=2, held_out=2)
    save("runs/a/bundle")
    return tmp_path


def draw(*options, bundle="runs/a", data="scenes.h5"):
    return main(["figures", "factors", bundle, data, "--pictures", "5", *options])


def sizes(folder):
    found = {}
    for file in sorted(Path(folder).iterdir()):
        with Image.open(file) as picture:
            picture.load()
            assert picture.format == "PNG"
            found[file.stem] = picture.size
    return found


def test_three_pictures_are_written_beside_the_bundle_the_same_each_time(here, capsys):
    assert draw() == 0
    assert "wrote zeroed.png, swapped.png, traversed.png in runs/a/factors" in capsys.readouterr().out
    assert set(sizes("runs/a/factors")) == set(FIGURES)
    content = {file.name: file.read_bytes() for file in Path("runs/a/factors").iterdir()}
    assert draw("--output", "elsewhere/deep", bundle="runs/a/bundle") == 0
    assert {file.name: file.read_bytes() for file in Path("elsewhere/deep").iterdir()} == content
    assert draw("--seed", "1", "--output", "other") == 0
    assert {file.name: file.read_bytes() for file in Path("other").iterdir()} != content


@pytest.mark.parametrize(("split", "name"), [("train", "training"), ("evaluation", "held-out")])
def test_the_last_words_say_how_well_a_split_is_drawn_beside_the_mean_picture(here, capsys, split, name):
    assert draw("--split", split, "--which", "zeroed") == 0
    store = EpisodeStore(Path("scenes.h5"))
    bundle = Path("runs/a/bundle")
    encoder, decoder = load_encoder(bundle), load_decoder(bundle)
    rows, training = rows_of(store, store.episodes(split)), rows_of(store, store.episodes("train"))
    pictures = store.gather("observations/pixels", rows) / 255.0
    with torch.no_grad():
        drawn = decoder(encoder.encode({"pixels": store.gather("observations/pixels", rows)})).clamp(0, 1).numpy()
    mean = (store.gather("observations/pixels", training) / 255.0).mean(0)
    reached, least = (-10 * np.log10(np.mean((guess - pictures) ** 2)) for guess in (drawn, mean))
    said = re.search(r"(\d+) (\S+) pictures: (\S+) dB, (\S+) above the mean training picture", capsys.readouterr().out)
    assert said is not None and said[1] == str(len(rows)) and said[2] == name
    assert float(said[3]) == pytest.approx(reached, abs=0.11) and float(said[4]) == pytest.approx(
        reached - least, abs=0.11
    )


def test_pictures_grow_with_the_groups(here):
    save("runs/b/bundle", groups=4)
    assert draw() == draw(bundle="runs/b") == 0
    two, four = sizes("runs/a/factors"), sizes("runs/b/factors")
    assert all(four[figure][1] > two[figure][1] for figure in FIGURES)
    assert draw("--pictures", "12", "--output", "wide") == 0
    assert sizes("wide")["zeroed"][0] > two["zeroed"][0]


def test_only_the_pictures_asked_for_are_written_and_older_ones_stay(here):
    assert draw("--which", "swapped") == 0
    assert set(sizes("runs/a/factors")) == {"swapped"}
    before = Path("runs/a/factors/swapped.png").read_bytes()
    assert draw("--which", "[traversed, zeroed]", "--seed", "3") == 0
    assert set(sizes("runs/a/factors")) == set(FIGURES)
    assert Path("runs/a/factors/swapped.png").read_bytes() == before


def test_a_latent_that_is_not_quantised_is_cut_as_asked(here, capsys):
    save("plain", groups=0)
    assert draw("--groups", "4", "--output", "cut", bundle="plain") == 0
    assert set(sizes("cut")) == set(FIGURES)
    capsys.readouterr()
    assert draw(bundle="plain") == 2
    assert "quantises nothing, so that it has no groups; cut its latent with --groups" in capsys.readouterr().err


def write_empty(path, split):
    with EpisodeWriter(
        Path(path), rows=6, episodes=6, observations={"pixels": ArraySpec((3, 16, 16))}, actions=None
    ) as writer:
        for _ in range(6):
            writer.add_episode(observations={"pixels": np.zeros((1, 3, 16, 16), np.uint8)}, evaluation=split == "all")


@pytest.mark.parametrize(
    ("options", "places", "message"),
    [
        (["--which", "zeroing"], {}, "--which: unknown figure 'zeroing', did you mean 'zeroed'?"),
        (["--which", ","], {}, "which: expected a word or words between commas"),
        (["--groups", "3"], {}, "--groups 3: this encoder quantises 2 groups; leave the option out"),
        (["--groups", "3"], {"bundle": "plain"}, "--groups 3: must divide the latent's width, 4 (1, 2, 4)"),
        (["--groups", "0"], {"bundle": "plain"}, "--groups 0: must divide the latent's width, 4"),
        ([], {"bundle": "plain"}, "no groups; cut its latent with --groups"),
        ([], {"bundle": "silent"}, "silent/config.json: has no decoder; only an objective that draws pictures"),
        ([], {"bundle": "missing"}, "missing: no such bundle"),
        ([], {"data": "scene.h5"}, "scene.h5: no such data file, did you mean 'scenes.h5'?"),
        ([], {"data": "rename.h5"}, "rename.h5: has no observation 'pixels', which runs/a/bundle was trained on"),
        ([], {"bundle": "large"}, "observation 'pixels' is 3x16x16 uint8, large was trained on 3x20x20 uint8"),
        (["--split", "eval"], {}, "--split eval: must be evaluation, train or all"),
        (["--split", "train"], {"data": "untrained.h5"}, "untrained.h5: has 0 pictures to draw in split train"),
        ([], {"data": "short.h5"}, "short.h5: has 1 pictures to draw in split evaluation; choose another --split"),
        (["--pictures", "1"], {}, "--pictures must be from 2 to 100, is 1"),
        (["--pictures", "101"], {}, "--pictures must be from 2 to 100, is 101"),
        (["--seed", "-1"], {}, "--seed must be at least 0, is -1"),
        (["--device", "gpu"], {}, "device 'gpu' cannot be used here"),
        (["--output", "scenes.h5"], {}, "--output scenes.h5/zeroed.png: cannot be written (Not a directory)"),
        (["--picture", "3"], {}, "--picture"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(here, capsys, options, places, message):
    save("plain", groups=0)
    save("silent", decoder=False)
    save("large", size=20)
    write_scenes(Path("rename.h5"), train=1, held_out=1)
    with h5py.File("rename.h5", "r+") as file:
        file.move("observations/pixels", "observations/picture")
    write_empty("untrained.h5", "all")
    write_empty("short.h5", "none")
    before = set(here.rglob("*"))
    capsys.readouterr()
    assert draw(*options, **places) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1 and message in error[0], error
    assert set(here.rglob("*")) == before


def test_where_a_picture_cannot_be_drawn_none_is_written(here, monkeypatch):
    monkeypatch.setattr(factor_figures, "traversed_figure", lambda *_: pytest.fail("as if it broke"))
    with pytest.raises(pytest.fail.Exception):
        draw()
    assert not Path("runs/a/factors").exists()


def test_a_picture_that_cannot_be_written_leaves_the_one_before_it_whole(here, monkeypatch, capsys):
    assert draw() == 0
    before = {file.name: file.read_bytes() for file in Path("runs/a/factors").iterdir()}
    write = Path.write_bytes

    def full_disk(path, content):
        if "swapped" in path.name:
            write(path, content[:100])
            raise OSError(28, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    capsys.readouterr()
    assert draw("--seed", "2") == 2
    assert "swapped.png: cannot be written (No space left on device)" in capsys.readouterr().err
    after = {file.name: file.read_bytes() for file in Path("runs/a/factors").iterdir()}
    assert set(after) == set(before) and after["swapped.png"] == before["swapped.png"]
    assert after["zeroed.png"] != before["zeroed.png"] and after["traversed.png"] == before["traversed.png"]


@pytest.fixture
def lines(monkeypatch):
    """What would be drawn: label -> pictures, of the latest figure."""
    seen: dict[str, np.ndarray] = {}

    def keep(given, title, **_):
        seen.clear()
        seen.update(given)
        return title.encode()

    monkeypatch.setattr(factor_figures, "picture_lines", keep)
    return seen


def redrawn(tmp_path, count=8, **options):
    store = write_scenes(tmp_path / "some.h5", train=2, held_out=2)
    encoder, decoder = scene_model(**options)
    rows = rows_of(store, store.episodes("evaluation"))[:count]
    groups = None if encoder.groups else 2
    return redraw(encoder, decoder, store, rows, groups), store.gather("observations/pixels", rows)


def drawn_by_hand(drawn, latents):
    with torch.no_grad():
        return (drawn.decoder(torch.from_numpy(latents)).clamp(0, 1) * 255).round().byte().numpy()


def test_zeroed_shows_pictures_drawings_and_each_group_missing(tmp_path, lines):
    drawn, pictures = redrawn(tmp_path)
    assert zeroed_figure(drawn, "ours").startswith(b"ours: ")
    labels = list(lines)
    assert labels[0] == "original" and labels[1] == "all groups\n100.0 dB"
    np.testing.assert_array_equal(lines["original"], pictures)
    np.testing.assert_array_equal(lines[labels[1]], pictures)
    for group in (0, 1):
        latents = drawn.latents.copy()
        latents[:, 2 * group : 2 * group + 2] = 0
        wanted = drawn_by_hand(drawn, latents)
        label = f"group {group} zeroed\n{psnr(wanted, pictures):.1f} dB"
        assert labels[2 + group] == label
        np.testing.assert_array_equal(lines[label], wanted)
    assert not lines[labels[2]].any() and len(labels) == 4


def test_swapped_shows_the_first_half_with_each_group_of_the_second(tmp_path, lines):
    drawn, pictures = redrawn(tmp_path, count=9)
    swapped_figure(drawn, "ours")
    np.testing.assert_array_equal(lines["A"], pictures[:4])
    np.testing.assert_array_equal(lines["B"], pictures[4:8])
    np.testing.assert_array_equal(lines["A drawn"], pictures[:4])
    np.testing.assert_array_equal(lines["B drawn"], pictures[4:8])
    level = [lines[f"A with group {g} of B"].max((1, 2, 3)).tolist() for g in (0, 1)]
    assert level == [pictures[4:8].max((1, 2, 3)).tolist(), pictures[:4].max((1, 2, 3)).tolist()]
    places = [(lines[f"A with group {g} of B"] > 0).tolist() for g in (0, 1)]
    assert places == [(pictures[:4] > 0).tolist(), (pictures[4:8] > 0).tolist()]
    assert len(lines) == 6


def test_traversed_sets_one_group_to_the_most_used_codes_first(tmp_path):
    """With a real quantiser, since codes are turned back into latents."""
    store = write_scenes(tmp_path / "some.h5", train=1, held_out=3)
    drawn = open_redrawing(
        save(tmp_path / "bundle", codes=20, spread=100.0),
        store.path,
        groups=None,
        count=30,
        split="evaluation",
        seed=0,
        device="cpu",
    )
    seen: dict[str, np.ndarray] = {}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(factor_figures, "picture_lines", lambda given, title: seen.update(given) or b"")
        traversed_figure(drawn, "ours", examples=2)
    assert list(seen) == [f"group {g}, picture {e}" for g in (0, 1) for e in (0, 1)]
    for group in (0, 1):
        used = most_used(drawn.codes[:, group], 12)
        assert len(used) > 1
        for number, example in enumerate((0, len(drawn.pictures) - 1)):
            line = seen[f"group {group}, picture {number}"]
            assert len(line) == 1 + len(used)
            np.testing.assert_array_equal(line[0], drawn.pictures[example])
            for place, code in enumerate(used, start=1):
                codes = drawn.codes[[example]].copy()
                codes[0, group] = code
                wanted = drawn_by_hand(drawn, drawn.encoder.decode(codes).numpy())[0]
                assert np.abs(line[place].astype(int) - wanted).max() <= 1


def test_an_unquantised_latent_takes_the_groups_of_other_pictures(tmp_path, lines):
    drawn, pictures = redrawn(tmp_path, count=5, quantised=False)
    traversed_figure(drawn, "ours")
    assert len(lines) == 2 * 3
    for number, example in enumerate((0, 2, 4)):
        line = lines[f"group 0, picture {number}"]
        np.testing.assert_array_equal(line[0], pictures[example])
        assert line[1:].max((1, 2, 3)).tolist() == pictures.max((1, 2, 3)).tolist()  # each picture once
        assert ((line[1:] > 0) == (pictures[example] > 0)).all()


@pytest.mark.parametrize(("stack", "channels", "shown"), [(1, 3, 3), (2, 3, 3), (1, 1, 1), (3, 1, 1), (4, 1, 1)])
def test_of_a_stack_the_newest_frame_is_shown(tmp_path, lines, stack, channels, shown):
    drawn, _ = redrawn(tmp_path, count=4, frame_stack=stack)
    pictures = np.random.default_rng(0).integers(0, 256, (4, stack * channels, 16, 16), np.uint8)
    odd = Redrawing(pictures, drawn.latents, drawn.codes, drawn.layout, drawn.encoder, drawn.decoder)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Redrawing, "draw", lambda self, latents=None: pictures if latents is None else pictures[:2])
        swapped_figure(odd, "ours")
    np.testing.assert_array_equal(lines["A"], pictures[:2, -shown:])


def test_pictures_stand_in_lines_and_a_grey_one_is_grey():
    """The pixels that are drawn, read back from the axis."""
    figures = []
    colour = np.random.default_rng(0).integers(0, 256, (3, 3, 4, 5), np.uint8)
    grey = np.random.default_rng(1).integers(0, 256, (2, 1, 4, 5), np.uint8)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(picture_grid, "png", lambda figure: figures.append(figure) or b"")
        picture_lines({"first": colour, "second": grey}, "what to look for")
    axis = figures[0].axes[0]
    canvas = np.asarray(axis.images[0].get_array())
    gap = picture_grid._GAP
    assert canvas.shape == (2 * 4 + gap, 3 * 5 + 2 * gap, 3)
    np.testing.assert_array_equal(canvas[:4, 5 + gap : 10 + gap], colour[1].transpose(1, 2, 0))
    np.testing.assert_array_equal(canvas[4 + gap :, :5], np.repeat(grey[0].transpose(1, 2, 0), 3, 2))
    assert (canvas[4 + gap :, 10 + 2 * gap :] == 255).all()  # the shorter line ends early
    assert [label.get_text() for label in axis.get_yticklabels()] == ["first", "second"]


@pytest.mark.parametrize("shape", [(1, 900), (900, 1)])
def test_many_pictures_are_drawn_smaller_before_they_cannot_be_drawn(shape):
    figures = []
    count, rows = shape
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(picture_grid, "png", lambda figure: figures.append(figure) or b"")
        picture_lines({str(row): np.zeros((count, 1, 4, 4), np.uint8) for row in range(rows)}, "many")
        picture_lines({str(row): np.zeros((5, 1, 4, 4), np.uint8) for row in range(5)}, "few")
    assert max(figures[0].get_size_inches()) * 110 < 2**16
    axis = figures[1].axes[0].get_position()
    assert axis.width * figures[1].get_size_inches()[0] == pytest.approx(5 * 6 * 0.62 / 4)


@pytest.mark.parametrize("label", ["A", "A with group 12 of B", "group 10 zeroed\n12.3 dB"])
def test_no_label_leaves_the_picture(label):
    figures = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(picture_grid, "png", lambda figure: figures.append(figure) or b"")
        picture_lines({label: np.zeros((8, 3, 64, 64), np.uint8), "b": np.zeros((8, 3, 64, 64), np.uint8)}, "title")
    renderer = FigureCanvasAgg(figures[0]).get_renderer()
    boxes = [text.get_window_extent(renderer) for text in figures[0].axes[0].get_yticklabels()]
    assert min(box.x0 for box in boxes) >= 0.0


def test_a_figure_is_a_png_that_says_what_to_look_for(tmp_path):
    drawn, _ = redrawn(tmp_path, count=4)
    with Image.open(io.BytesIO(zeroed_figure(drawn, "ours"))) as picture:
        assert picture.format == "PNG" and min(picture.size) > 100


def test_the_codes_of_the_whole_split_are_counted_not_of_the_few_that_are_drawn(tmp_path):
    """One code is on nearly all pictures but on none of those drawn."""
    drawn, _ = redrawn(tmp_path, count=4)
    common = np.zeros((50, drawn.codes.shape[1]), np.int64) + drawn.codes.max() + 1
    counted = replace(drawn, counted=np.concatenate([drawn.codes, common]))
    asked: list[int] = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Redrawing, "with_code", lambda self, group, code: asked.append(code) or self.latents)
        traversed_figure(counted, "ours", examples=1)
    groups = drawn.layout.groups
    assert [asked[group * len(asked) // groups] for group in range(groups)] == [drawn.codes.max() + 1] * groups


def test_as_many_codes_are_counted_as_the_split_has_pictures(tmp_path):
    store = write_scenes(tmp_path / "some.h5", train=1, held_out=3)
    options = {"groups": None, "count": 4, "split": "evaluation", "seed": 0, "device": "cpu"}
    drawn = open_redrawing(save(tmp_path / "bundle", codes=20, spread=100.0), store.path, **options)
    assert len(drawn.pictures) == 4 and len(drawn.counted) == store.lengths[store.evaluation].sum()
