import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from evaluation_fakes import cell_and_video_codes, random_encoder, time_encoder, write_store
from PIL import Image

from repdib_lightning.bottlenecks import Identity, VectorQuantiser
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import figures
from repdib_lightning.evaluation import probe as probe_module
from repdib_lightning.evaluation.bundles import named_bundles
from repdib_lightning.evaluation.curves import read_curves, training_curves
from repdib_lightning.evaluation.probe import encode_evaluation, probe_encoded
from repdib_lightning.evaluation.report import RunResult, Section, compare, render_page, write_comparison, write_report
from repdib_lightning.evaluation.tables import comparison_table
from repdib_lightning.export import save_bundle
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("compare") / "arm.h5")


@pytest.fixture(scope="module")
def runs(store):
    encoders = {"none": time_encoder(), "rep<dib>": cell_and_video_codes()}
    runs = {}
    for name, encoder in encoders.items():
        encoded = encode_evaluation(encoder, store, progress=False)
        report, _ = probe_encoded(encoded, store, name=name, probes=("linear",), progress=False)
        runs[name] = RunResult(report, encoded, {"encoder": {"class": "A & B"}})
    return runs


@pytest.fixture(scope="module")
def reports(runs):
    return {name: run.report for name, run in runs.items()}


def cells(table, start):
    return next(row for row in table.rows if row[0].startswith(start))


def test_the_table_puts_runs_side_by_side_and_ratios_are_to_the_first(reports):
    table = comparison_table(reports)
    assert table.header == ["factor", "chance", "none: linear", "linear kept", "rep<dib>: linear", "linear kept"]
    time_step, cell = cells(table, "noise: time_step (R2)"), cells(table, "state: cell (accuracy)")
    assert time_step[3] == "1.000" and float(time_step[5]) < 0.1
    assert cell[4:] == ["1.000", "1.000"]
    ratio = cells(table, "noise: relative to none")
    first, second = (reports[name].mean_kept("exogenous", "linear") for name in reports)
    assert ratio[3] == "1.00" and float(ratio[5]) == pytest.approx(second / first, abs=0.005)
    assert cells(table, "codes used per group")[2:] == ["-", "", "2.7 of 8", ""]
    assert len({len(row) for row in [table.header, *table.rows]}) == 1


def export(folder, bottleneck):
    torch.manual_seed(0)
    spec = DataSpec({"front": ArraySpec((3, 16, 16))}, ActionSpec("discrete", 5))
    encoder = ConvolutionalEncoder(spec, features=8, channels=4, strides=[2, 2])
    return save_bundle(folder, encoder, bottleneck, training={"steps": 0}, data={})


def test_bundles_are_compared_end_to_end(tmp_path, store):
    quantiser = VectorQuantiser(8, groups=2, codes=4, start="random", start_step=0)
    bundles = {"none": export(tmp_path / "a", Identity(8)), "vq": export(tmp_path / "b", quantiser)}
    output = tmp_path / "out" / "report.html"
    text = compare(bundles, store.path, output, probes=("linear",), device="cpu", progress=False)
    assert "noise: relative to none" in text and "of 4 codes used per group" in text
    written = json.loads(output.with_suffix(".json").read_text())
    assert [run["groups"] for run in written.values()] == [0, 2]
    assert [run["name"] for run in written.values()] == ["none", "vq"]
    assert sorted(p.name for p in output.parent.iterdir()) == ["report-kept.png", "report.html", "report.json"]
    page = output.read_text()
    assert "VectorQuantiser" in page and "encoder.codes(observations)" in page
    with pytest.raises(UserError, match="no such bundle"):
        compare({"none": bundles["none"], "x": tmp_path / "x"}, store.path, tmp_path / "no.html", progress=False)
    assert not (tmp_path / "no.html").exists()
    with pytest.raises(UserError, match="at least one bundle"):
        compare({}, store.path, output)


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.sources, self.headings, self.tags = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.sources += [value for key, value in attributes if key in ("src", "href")]

    def handle_data(self, data):
        if self.tags and self.tags[-1] == "h2" and data.strip():
            self.headings.append(data.strip())


def test_the_page_stands_alone_and_escapes_what_it_shows(tmp_path, runs, store):
    write_comparison(tmp_path / "report.html", runs, store, title="Kept & dropped")
    text = (tmp_path / "report.html").read_text()
    page = Page(text)
    assert page.sources and all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert not {"script", "link", "iframe", "dib"} & set(page.tags)
    assert "<title>Kept &amp; dropped</title>" in text and "A &amp; B" in text and "rep<dib>" not in text
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    for heading in ("What was kept and dropped", "What the encoder sees", "Use the encoder", "What was trained"):
        assert heading in page.headings
    assert "Training" not in page.headings, "no metrics were given"


def test_the_same_runs_give_the_same_page_and_the_numbers_lie_beside_it(tmp_path, runs, store):
    for name in ("a", "b"):
        write_comparison(tmp_path / f"{name}.html", runs, store, title="t")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    written = json.loads((tmp_path / "a.json").read_text())
    assert written["none"]["factors"]["time_step"]["probes"]["linear"]["kept"] > 0.99


def test_a_page_of_own_sections_is_written_whole(tmp_path):
    write_report(tmp_path / "deep" / "page.html", "T", [Section("One & two", "<p>x</p>")])
    assert (tmp_path / "deep" / "page.html").read_text() == render_page("T", [Section("One & two", "<p>x</p>")])
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["page.html"]
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"):
        write_report(tmp_path / "file" / "page.html", "T", [])


def opened(content):
    return Image.open(io.BytesIO(content))


def test_figures_are_pictures_and_those_of_codes_are_left_out_without_codes(reports, store):
    for draw in (figures.kept_bars, figures.bits_map, figures.codebook_bars):
        assert opened(draw(reports)).width > 300
        assert draw(reports) == draw(reports)
    uncoded = {"none": reports["none"]}
    assert figures.bits_map(uncoded) is None and figures.codebook_bars(uncoded) is None


def test_the_strip_shows_pictures_only(store):
    rows = np.arange(100)
    assert figures.frame_strip(store, rows, ["sensor"]) is None
    one, both = (opened(figures.frame_strip(store, rows, names, 4)) for names in (["front"], ["front", "sensor"]))
    assert one.size == both.size and one.width > one.height


def test_the_principal_plane_holds_most_of_the_variance_and_repeats():
    generator = np.random.default_rng(0)
    hidden = generator.normal(size=(200, 2)) * [5.0, 2.0]
    basis = np.linalg.qr(generator.normal(size=(6, 6)))[0][:2]
    points = hidden @ basis + 0.01 * generator.normal(size=(200, 6)) + 7.0
    plane = figures.principal_plane(points)
    assert plane.var(0).sum() == pytest.approx(points.var(0).sum(), rel=1e-3)
    assert plane.var(0)[0] > plane.var(0)[1]
    assert abs(np.corrcoef(plane[:, 0], hidden[:, 0])[0, 1]) > 0.95
    np.testing.assert_array_equal(plane, figures.principal_plane(points))
    assert figures.principal_plane(points[:, :1]).shape == (200, 2)


def test_a_run_without_codes_beside_one_with_is_scattered_by_state_and_the_worst_noise(store):
    encoded = encode_evaluation(random_encoder(), store, progress=False)
    labels = {"cell": (np.arange(480) % 4, "endogenous"), "time": (np.linspace(0, 1, 480), "exogenous")}
    one = opened(figures.latent_scatter({"a": encoded.latents}, labels))
    two = opened(figures.latent_scatter({"a": encoded.latents, "b": encoded.latents}, labels))
    assert two.height > 1.5 * one.height and two.width == one.width


def test_curves_skip_empty_cells_and_name_what_is_wrong(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("epoch,step,train/loss,val/loss\n0,10,2.0,\n0,20,1.5,\n0,20,,1.7\n")
    curves = read_curves(path)
    assert curves["train/loss"].tolist() == [[10, 2.0], [20, 1.5]] and curves["val/loss"].tolist() == [[20, 1.7]]
    assert set(curves) == {"train/loss", "val/loss"}
    assert opened(training_curves({"a": path, "b": path})).width > 300
    path.write_text("time,loss\n0,1\n")
    with pytest.raises(UserError, match="no column 'step'"):
        read_curves(path)
    with pytest.raises(UserError, match=r"gone\.csv: cannot be read"):
        read_curves(tmp_path / "gone.csv")


def test_everything_cheap_is_checked_before_any_encoder_runs(tmp_path, store, monkeypatch):
    monkeypatch.setattr(probe_module, "encode_rows", lambda *_, **__: pytest.fail("encoded before the checks"))
    good, bundle = {"a": export(tmp_path / "a" / "bundle", Identity(8))}, tmp_path / "a" / "bundle"
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "side.json").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "metrics.csv").write_text("step,loss\n0,much\n")
    data = write_store(tmp_path / "page.json")
    precious = data.path.read_bytes()
    out = tmp_path / "out.html"
    for bundles, path, output, options, words in (
        (good, store.path, data.path.with_suffix(".h5"), {}, r"OUTPUT must end in \.html"),
        (good, data.path, tmp_path / "page.html", {}, r"OUTPUT's side file would replace .*page\.json"),
        (good, store.path, bundle / "config.html", {}, r"would replace .*config\.json"),
        (good, store.path, tmp_path / "folder.html", {}, r"OUTPUT .*folder\.html: cannot be written"),
        (good, store.path, tmp_path / "side.html", {}, r"side file .*side\.json: cannot be written"),
        (good, store.path, tmp_path / "file" / "x.html", {}, r"OUTPUT .*x\.html: cannot be written"),
        (good | {"b": tmp_path / "b"}, store.path, out, {}, "b: no such bundle"),
        (good, store.path, out, {"metrics": {"a": tmp_path / "metrics.csv"}}, r"metrics\.csv: 'much' is no number"),
        (good, store.path, out, {"seed": -3}, "seed must be at least 0"),
        (good, write_store(tmp_path / "one.h5", 2, 1).path, out, {}, "at least 2 evaluation episodes"),
    ):
        with pytest.raises(UserError, match=words):
            compare(bundles, path, output, device="cpu", progress=False, **options)
    assert data.path.read_bytes() == precious and not out.exists()


def test_names_are_the_shortest_ends_that_differ(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for run in ("old/a", "new/a", "x/new/a", "b", "lr=0.1"):
        (tmp_path / run / "bundle").mkdir(parents=True)
    assert list(named_bundles(["old/a", "b", "new/a/bundle"])) == ["old/a", "b", "new/a"]
    assert list(named_bundles(["new/a", "x/new/a", "old/a"])) == [f"{tmp_path.name}/new/a", "x/new/a", "old/a"]
    named = named_bundles(["first=old/a", "new/a", "lr=0.1"])
    assert {name: str(path) for name, path in named.items()} == {
        "first": "old/a/bundle",
        "a": "new/a/bundle",
        "lr=0.1": "lr=0.1/bundle",
    }
    assert list(named_bundles(["a=b", "old/a"])) == ["a", "old/a"]
    for given, words in (
        (["b", "./b/bundle"], "b is given twice; name them: NAME=PATH"),
        (["x=b", "x=old/a"], "two runs are called 'x'"),
        (["=b"], "expected PATH or NAME=PATH, got '=b'"),
    ):
        with pytest.raises(UserError, match=words):
            named_bundles(given)
