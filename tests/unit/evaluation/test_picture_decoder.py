"""What the decoder probe says that a latent kept of small pictures whose content is known."""

import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import decoder
from repdib_lightning.evaluation.decoder import SHOWN, check_pictures, measure_pictures
from repdib_lightning.evaluation.probe import open_for_probing
from repdib_lightning.evaluation.probes import Standardiser
from repdib_lightning.evaluation.splits import episode_folds
from repdib_lightning.records import ArraySpec

SIZE, EPISODES, LENGTH, PLACES = 12, 16, 24, 12
ROWS = EPISODES * LENGTH
ALL_ROWS = np.arange(ROWS)
IN_FIT = ALL_ROWS // LENGTH % 2 == 0


class Scene:
    """A background of three patterns with random weights, and an agent of 2 x 3 pixels at one of twelve places."""

    def __init__(self, seed=0, *, static=False, agent=120, place=None):
        generator = np.random.default_rng(seed)
        self.weights = generator.uniform(0, 1, (ROWS, 3))
        patterns = generator.uniform(0, 80, (3, 3 * SIZE * SIZE))
        background = np.full((ROWS, 3 * SIZE * SIZE), 83.0) if static else self.weights @ patterns
        self.place = generator.integers(PLACES, size=ROWS) if place is None else place
        self.pixels = background.round().astype(np.uint8).reshape(ROWS, 3, SIZE, SIZE)
        self.mask = np.zeros((ROWS, SIZE, SIZE), bool)
        for row, place_now in enumerate(self.place):
            y, x = divmod(int(place_now), 4)
            self.mask[row, 4 * y : 4 * y + 2, 3 * x : 3 * x + 3] = True
        self.pixels[np.broadcast_to(self.mask[:, None], self.pixels.shape)] = agent

    def write(self, path, masks=True, views=("front",)):
        observations = {view: ArraySpec((3, SIZE, SIZE)) for view in views}
        drawn = {"front": (SIZE, SIZE)} if masks else None
        with EpisodeWriter(
            path, rows=ROWS, episodes=EPISODES, observations=observations, actions=None, masks=drawn
        ) as writer:
            for first in range(0, ROWS, LENGTH):
                rows = slice(first, first + LENGTH)
                writer.add_episode(
                    observations=dict.fromkeys(views, self.pixels[rows]),
                    masks={"front": self.mask[rows]} if masks else None,
                )
        return EpisodeStore(path)

    def where(self):
        """(N, 12) one-hot place of the agent."""
        return np.eye(PLACES)[self.place]


def measured(latent, store):
    return measure_pictures(Standardiser(latent[IN_FIT])(latent), store, ALL_ROWS, IN_FIT)


def kept(latent, store):
    return {name: score.kept for name, score in measured(latent, store)[0].regions.items()}


def references(scene):
    """The mean picture of the fit half, and its mean background; the former too where a pixel is never free."""
    fit = scene.pixels[IN_FIT].astype(float)
    free = np.broadcast_to(~scene.mask[IN_FIT][:, None], fit.shape)
    return fit.mean(0), np.where(free.any(0), (fit * free).sum(0) / np.maximum(free.sum(0), 1), fit.mean(0))


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def store(scene, tmp_path_factory):
    return scene.write(tmp_path_factory.mktemp("decoder") / "scene.h5")


def test_a_latent_of_the_background_and_the_place_keeps_both(scene, store):
    report, _ = measured(np.hstack([scene.weights, scene.where()]), store)
    assert report.regions["background"].kept > 0.98 and report.regions["agent"].kept > 0.98
    assert report.regions["picture"].kept > 0.98
    assert report.regions["background"].rmse < 4.0  # grey levels; the background's deviation is about 23
    assert report.fit_rows == IN_FIT.sum()


def test_a_latent_of_the_background_alone_keeps_it_and_not_the_agent(scene, store):
    found = kept(scene.weights, store)
    assert found["background"] > 0.9 and found["agent"] < 0.1


def test_a_latent_of_the_place_alone_keeps_the_agent_and_not_the_background(scene, store):
    found = kept(scene.where(), store)
    assert found["agent"] > 0.9 and found["background"] < 0.05


@pytest.mark.parametrize("make", [lambda g: g.normal(size=(ROWS, 6)), lambda g: np.ones((ROWS, 6))])
def test_a_latent_of_noise_or_of_nothing_keeps_nothing(store, make):
    report, _ = measured(make(np.random.default_rng(7)), store)
    assert set(report.regions) == {"picture", "background", "agent"}
    for score in report.regions.values():
        assert score.kept < 0.03 and 0.95 < score.error < 1.15


def test_error_kept_and_rmse_are_the_ones_of_the_pixels_that_were_drawn(scene, store):
    """All rows of the score half are shown here, so that the scores can be taken again from the drawings."""
    few = np.concatenate([ALL_ROWS[IN_FIT], ALL_ROWS[~IN_FIT][:SHOWN]])
    latent = np.hstack([scene.weights[:, :2], scene.where()])
    report, drawings = measure_pictures(latent[few], store, few, np.isin(few, ALL_ROWS[IN_FIT]))
    truth, drawn = scene.pixels[drawings.rows].astype(float), drawings.drawn["front"].astype(float)
    mean, backdrop = references(scene)
    agent = np.broadcast_to(scene.mask[drawings.rows][:, None], truth.shape)
    everywhere = np.ones_like(agent)
    for name, region, without in (
        ("agent", agent, mean),
        ("background", ~agent, backdrop),
        ("picture", everywhere, mean),
    ):
        squared, plain = np.square(drawn - truth)[region], np.square(without - truth)[region]
        score = report.regions[name]
        assert score.error == pytest.approx(squared.sum() / plain.sum(), rel=0.03)  # drawings are rounded
        assert score.rmse == pytest.approx(np.sqrt(squared.mean()), rel=0.03)
        assert score.kept == pytest.approx(1.0 - score.error)


@pytest.mark.parametrize(("at_another", "least"), [(ALL_ROWS % 10 == 0, 1.3), (ALL_ROWS < 0, 1.0)])
def test_what_the_agent_covers_is_no_part_of_the_mean_background(tmp_path, at_another, least):
    """A latent of nothing draws the mean picture, in which an agent that mostly or always stands still is seen."""
    place = np.where(IN_FIT & ~at_another, 0, 5)
    scene = Scene(agent=230, place=place)
    report, _ = measured(np.ones((ROWS, 2)), scene.write(tmp_path / "standing.h5"))
    mean, backdrop = references(scene)
    truth = scene.pixels[~IN_FIT].astype(float)
    free = np.broadcast_to(~scene.mask[~IN_FIT][:, None], truth.shape)
    expected = np.square(mean - truth)[free].sum() / np.square(backdrop - truth)[free].sum()
    assert report.regions["background"].error == pytest.approx(expected, rel=1e-3)
    assert expected >= least


def test_a_background_or_an_agent_that_never_changes_is_not_kept(tmp_path):
    """Rounding of its mean must not pass for a picture that was drawn again."""
    scene = Scene(static=True)
    store = scene.write(tmp_path / "static.h5")
    score = measured(scene.where(), store)[0].regions["background"]
    assert (score.error, score.kept) == (1.0, 0.0)
    still = Scene(place=np.zeros(ROWS))
    regions = measured(still.weights, still.write(tmp_path / "still.h5"))[0].regions
    assert (regions["agent"].error, regions["agent"].kept) == (1.0, 0.0)
    assert regions["background"].kept > 0.9


def test_pictures_without_masks_have_one_region(scene, tmp_path):
    bare = scene.write(tmp_path / "bare.h5", masks=False)
    assert list(measured(scene.where(), bare)[0].regions) == ["picture"]


def test_a_view_without_masks_counts_for_the_picture_only(scene, store, tmp_path):
    both = scene.write(tmp_path / "both.h5", views=("front", "top"))
    one, two = (measured(scene.weights, s)[0].regions for s in (store, both))
    for region in ("background", "agent", "picture"):  # the views are equal, so twice the pixels changes no score
        assert two[region].error == pytest.approx(one[region].error, rel=1e-4)
    _, drawings = measured(scene.weights, both)
    assert list(drawings.drawn) == list(drawings.frames) == ["front", "top"]


def test_the_score_half_never_influences_the_fit(scene, tmp_path):
    latent = np.hstack([scene.weights, scene.where()])
    store = scene.write(tmp_path / "one.h5")
    other = Scene()
    other.pixels[~IN_FIT] = 255 - other.pixels[~IN_FIT]
    other.mask[~IN_FIT] = False
    changed = other.write(tmp_path / "other.h5")
    (first, drawings), (second, again) = measured(latent, store), measured(latent, changed)
    assert first.choice == second.choice
    np.testing.assert_array_equal(drawings.drawn["front"], again.drawn["front"])
    assert not np.array_equal(drawings.frames["front"], again.frames["front"])
    assert second.regions["picture"].kept == 0.0 < first.regions["picture"].kept


def test_drawings_are_pictures_of_the_score_half(scene, store):
    _, drawings = measured(np.hstack([scene.weights, scene.where()]), store)
    frames, drawn = drawings.frames["front"], drawings.drawn["front"]
    assert drawings.rows.shape == (SHOWN,) and not IN_FIT[drawings.rows].any()
    assert len(np.unique(drawings.rows)) == SHOWN
    assert frames.shape == drawn.shape == (SHOWN, 3, SIZE, SIZE)
    assert frames.dtype == drawn.dtype == np.uint8
    np.testing.assert_array_equal(frames, scene.pixels[drawings.rows])
    assert np.abs(frames.astype(int) - drawn).mean() < 4.0


def test_what_is_drawn_stays_between_black_and_white(scene, tmp_path):
    """Latents far outside of what was fitted ask for pixels below 0 and above 255."""
    latent = scene.weights.copy()
    bright = ALL_ROWS % 2 == 0
    latent[~IN_FIT] = np.where(bright, 40.0, -40.0)[~IN_FIT, None]
    _, drawings = measured(latent, scene.write(tmp_path / "far.h5", masks=False))
    middle = np.median(drawings.drawn["front"], axis=(1, 2, 3))
    np.testing.assert_array_equal(middle, np.where(bright[drawings.rows], 255, 0))
    assert len(set(middle)) == 2


def test_the_score_half_is_drawn_in_parts_that_leave_no_row_out(monkeypatch, scene, store):
    latent = np.hstack([scene.weights, scene.where()])
    whole = measured(latent, store)[0].regions
    monkeypatch.setattr(decoder, "_CHUNK", 50)
    for name, score in measured(latent, store)[0].regions.items():
        assert score.error == pytest.approx(whole[name].error, rel=1e-4)


def test_inner_folds_hold_out_whole_episodes_of_the_store(monkeypatch, scene, store):
    seen = []
    monkeypatch.setattr(decoder, "episode_folds", lambda episodes: seen.append(episodes) or episode_folds(episodes))
    some = ALL_ROWS[ALL_ROWS >= 3 * LENGTH + 10]
    measure_pictures(scene.weights[some], store, some, IN_FIT[some])
    np.testing.assert_array_equal(seen[0], some[IN_FIT[some]] // LENGTH)


def test_inner_folds_hold_out_whole_recordings(monkeypatch, scene, tmp_path):
    seen = []
    monkeypatch.setattr(decoder, "episode_folds", lambda rows: seen.append(rows) or episode_folds(rows))
    store = scene.write(tmp_path / "cut.h5")
    store.recordings = np.arange(len(store.starts)) // 4
    measure_pictures(scene.weights, store, ALL_ROWS, IN_FIT)
    np.testing.assert_array_equal(seen[0], ALL_ROWS[IN_FIT] // LENGTH // 4)


def test_rows_are_those_of_the_store_and_not_places_in_the_features(scene, store):
    """Probing some rows only gives what a store of these rows alone would give."""
    some = ALL_ROWS[ALL_ROWS // LENGTH >= 4]
    latent = np.hstack([scene.weights, scene.where()])[some]
    report, drawings = measure_pictures(latent, store, some, IN_FIT[some])
    assert report.regions["background"].kept > 0.95 and report.fit_rows == IN_FIT[some].sum()
    np.testing.assert_array_equal(drawings.frames["front"], scene.pixels[drawings.rows])


def test_only_so_many_rows_are_fitted_on(monkeypatch, scene, store):
    monkeypatch.setattr(decoder, "MOST_ROWS", 50)
    report, _ = measured(np.hstack([scene.weights, scene.where()]), store)
    assert report.fit_rows == 50 and report.regions["background"].kept > 0.9


def test_a_store_without_pictures_is_refused_in_one_line(store, tmp_path):
    assert check_pictures(store) == ["front"]
    with EpisodeWriter(
        tmp_path / "numbers.h5", rows=4, episodes=2, observations={"sensor": ArraySpec((3,), "float32")}, actions=None
    ) as writer:
        for _ in range(2):
            writer.add_episode(observations={"sensor": np.zeros((2, 3), np.float32)})
    with pytest.raises(UserError, match=r"numbers\.h5: has no pictures.*leave 'decoder' out of probes") as error:
        open_for_probing(tmp_path / "numbers.h5", ("linear", "decoder"))
    assert "\n" not in str(error.value)
