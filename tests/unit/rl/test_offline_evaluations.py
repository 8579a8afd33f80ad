"""Episodes that are played at once against single ones; films of them; the record of a training."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import av
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict

from repdib_lightning.errors import UserError
from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.episodes_at_once import EpisodesAtOnce
from repdib_lightning.rl.film import side_by_side, write_film
from repdib_lightning.rl.offline_progress import OfflineProgress
from repdib_lightning.rl.td3_bc import BehaviourCloning

PIXELS = 4


class Wandering(gymnasium.Env):
    """Colours and a grey view that hang on all actions so far; episodes of 2 to 9 steps, by the seed."""

    observation_space = Dict(
        {"colours": Box(0, 255, (3, PIXELS, 2 * PIXELS), np.uint8), "grey": Box(0, 255, (1, 6, 6), np.uint8)}
    )
    action_space = Box(np.array([-1.0, -0.5]), np.array([1.0, 0.5]), dtype=np.float64)

    def __init__(self):
        self.taken, self.closed = [], False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.length, self.state = int(self.np_random.integers(2, 10)), self.np_random.random(2)
        self.steps = 0
        return self._seen(), {}

    def _seen(self):
        colours = np.zeros((3, PIXELS, 2 * PIXELS), np.uint8)
        colours[:, 0, 0] = (self.steps, *(int(255 * part) for part in self.state))
        return {"colours": colours, "grey": np.full((1, 6, 6), 10 * self.steps, np.uint8)}

    def step(self, action):
        self.taken.append(action)
        self.state = (self.state + 0.3 * np.abs(action)) % 1.0
        self.steps += 1
        ended = self.steps == self.length
        return self._seen(), float(self.state.sum()), ended and self.length % 2 == 0, ended and self.length % 2 == 1, {}

    def close(self):
        self.closed = True


def spec(stack):
    names = {"colours": ArraySpec((3 * stack, PIXELS, 2 * PIXELS)), "grey": ArraySpec((stack, 6, 6))}
    return DataSpec(names, frame_stack=stack)


def act(seen):
    """Hangs on all frames, and asks for more than is allowed."""
    colours = seen["colours"].reshape(len(seen["colours"]), -1).astype(np.float64)
    return np.stack([np.cos(colours.sum(1)), np.sin(colours @ np.arange(colours.shape[1]))], axis=1)


def looped(stack, seeds):
    returns, lengths, shown = [], [], []
    for seed in seeds:
        env = PrepareObservation(Wandering(), spec(stack))
        seen, _ = env.reset(seed=seed)
        total, frames, ended = 0.0, [], False
        while not ended:
            frames.append(seen)
            action = act({name: array[None] for name, array in seen.items()})[0]
            seen, reward, terminated, truncated, _ = env.step(np.clip(action, [-1.0, -0.5], [1.0, 0.5]))
            total, ended = total + reward, terminated or truncated
        returns.append(total)
        lengths.append(len(frames))
        shown.append(frames)
    return returns, lengths, shown


def seeds(seed, count):
    return np.random.default_rng(seed).integers(2**31, size=count).tolist()


@pytest.mark.parametrize("stack", [1, 3])
def test_episodes_at_once_are_single_episodes(stack):
    evaluation = EpisodesAtOnce([Wandering() for _ in range(6)], spec(stack), seed=4)
    counts = []

    def counting(seen):
        counts.append(len(seen["colours"]))
        return act(seen)

    returns, films = evaluation.run(counting)
    wanted, lengths, _ = looped(stack, seeds(4, 6))
    assert returns == pytest.approx(wanted) and films == [] and len(set(lengths)) > 2
    assert counts == [sum(length > step for length in lengths) for step in range(max(lengths))]


def test_they_are_the_same_every_time_and_hang_on_the_seed():
    def run(evaluation):
        return evaluation.run(act)[0].tolist()

    one, other = (EpisodesAtOnce([Wandering() for _ in range(3)], spec(1), seed=s) for s in (1, 2))
    assert run(one) == run(one) != run(other)


def test_actions_are_clipped_to_what_the_environment_takes():
    env = Wandering()
    EpisodesAtOnce([env], spec(1), seed=0).run(lambda seen: np.full((len(seen["grey"]), 2), 9.0))
    assert len(env.taken) >= 2 and all(action.tolist() == [1.0, 0.5] for action in env.taken)


def test_films_show_the_newest_frame_of_every_view():
    evaluation = EpisodesAtOnce([Wandering() for _ in range(4)], spec(3), seed=4)
    _, films = evaluation.run(act, 2)
    _, lengths, shown = looped(3, seeds(4, 4))
    assert [len(film) for film in films] == lengths[:2]
    for film, frames in zip(films, shown, strict=False):
        assert film.dtype == np.uint8 and film.shape[1:] == (6, 2 * PIXELS + 6, 3)
        for picture, seen in zip(film, frames, strict=True):
            np.testing.assert_array_equal(picture[:PIXELS, : 2 * PIXELS], seen["colours"][-3:].transpose(1, 2, 0))
            assert not picture[PIXELS:, : 2 * PIXELS].any()
            assert (picture[:, 2 * PIXELS :] == seen["grey"][-1][..., None]).all()
    assert films[0][1, 0, 0, 0] == 1 and films[0][1, 5, -1].tolist() == [10, 10, 10]


def test_environments_are_closed():
    environments = [Wandering(), Wandering()]
    EpisodesAtOnce(environments, spec(1), seed=0).close()
    assert all(environment.closed for environment in environments)


def test_films_stand_side_by_side_and_wait_for_each_other():
    first, second = np.full((2, 4, 3, 3), 7, np.uint8), np.arange(5 * 4 * 6 * 3, dtype=np.uint8).reshape(5, 4, 6, 3)
    first[1] = 9
    joined = side_by_side([first, second])
    assert joined.shape == (5, 4, 3 + 4 + 6, 3) and joined.dtype == np.uint8
    assert [int(value) for value in joined[:, 0, 0, 0]] == [7, 9, 9, 9, 9]
    assert (joined[:, :, 3:7] == 255).all()
    np.testing.assert_array_equal(joined[:, :, 7:], second)
    np.testing.assert_array_equal(side_by_side([second]), second)


@pytest.mark.parametrize(
    ("height", "width", "shown"), [(16, 21, (128, 168)), (131, 77, (130, 76)), (64, 201, (128, 402))]
)
def test_a_film_is_a_readable_mp4(tmp_path, height, width, shown):
    frames = np.zeros((7, height, width, 3), np.uint8)
    frames[:, :, : width // 2, 0] = 220  # the left half is red, and the right one gets lighter
    frames[:, :, width // 2 :] = (30 * np.arange(7))[:, None, None, None]
    write_film(tmp_path / "film.mp4", frames, rate=10)
    with av.open(str(tmp_path / "film.mp4")) as film:
        stream = film.streams.video[0]
        assert (stream.height, stream.width) == shown and stream.codec_context.name == "h264"
        assert stream.pix_fmt == "yuv420p" and float(stream.average_rate) == 10
        pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(stream)]
    assert len(pictures) == 7 and [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    for number, picture in enumerate(pictures):
        left, right = picture[:, : shown[1] // 3].mean((0, 1)), picture[:, -shown[1] // 3 :].mean((0, 1))
        assert left[0] > 170 and left[1] < 60 and left[2] < 60
        np.testing.assert_allclose(right, 30 * number, atol=12)


def test_a_film_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "taken").touch()
    with pytest.raises(UserError, match=r"taken/film\.mp4: cannot be written"):
        write_film(tmp_path / "taken" / "film.mp4", np.zeros((2, 16, 16, 3), np.uint8))


def progressed(folder, steps, every, losses, evaluate=None):
    """Call the callback as a training does."""
    progress = OfflineProgress(folder, every, steps, evaluate)
    agent = BehaviourCloning(torch.nn.Identity(), 3, 2, hidden=4, learning_rate=0.1)
    logged = []
    logger = SimpleNamespace(log_metrics=lambda values, step: logged.append((step, values)))
    trainer = SimpleNamespace(logger=logger)
    progress.on_train_start(trainer, agent)
    for number in range(steps):
        agent.latest = {"clone": torch.tensor(losses[number])}
        progress.on_train_batch_end(trainer, agent, None, None, number)
        assert agent.training
    progress.on_train_end(trainer, agent)
    return progress, logged


def test_progress_is_written_every_so_often_and_at_the_end(tmp_path):
    asked = []

    def evaluate(last):
        asked.append(last)
        return np.array([100.0, 300.0]) * len(asked)

    progress, logged = progressed(tmp_path, 7, 3, [float(n) for n in range(7)], evaluate)
    assert asked == [False, False, True] and progress.returns.tolist() == [300.0, 900.0]
    with open(tmp_path / "progress.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [list(row.values()) for row in rows] == [
        ["3", "200", "20", "2"], ["6", "400", "40", "5"], ["7", "600", "60", "6"]
    ]  # fmt: skip
    assert list(rows[0]) == ["step", "eval/return", "eval/normalised", "train/clone"]
    assert [step for step, _ in logged] == [3, 6, 7] and logged[0][1]["eval/normalised"] == 20.0
    assert progress.curve("eval/return").tolist() == [200.0, 400.0, 600.0]


def test_progress_without_evaluations_and_with_few_steps(tmp_path):
    progress, _ = progressed(tmp_path, 2, 100, [0.5, 0.25])
    assert (tmp_path / "progress.csv").read_text().splitlines() == ["step,train/clone", "2,0.25"]
    assert not len(progress.returns) and not len(progress.curve("eval/return"))


@pytest.mark.parametrize("lost", [float("nan"), float("inf")])
def test_a_training_that_diverges_ends_with_one_line(tmp_path, lost):
    with pytest.raises(UserError, match=r"^train/clone is (nan|inf) after 4 updates; try a smaller --learning_rate$"):
        progressed(tmp_path, 9, 2, [0.1, 0.1, 0.1, lost, 0.1, 0.1, 0.1, 0.1, 0.1])
