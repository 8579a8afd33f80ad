"""What environments are asked for, when, and that a collection which is cut off anywhere goes on as it would have."""

from __future__ import annotations

import io
import math
import signal
import time

import gymnasium
import numpy as np
import pytest
import torch
from small_worlds import collection, plan, policy, schedule
from telling_world import ACTIONS, PICTURE, STEPS, Opener

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec
from repdib_lightning.rl.exploration.collection import Collection
from repdib_lightning.rl.exploration.environment import ControlFactory
from repdib_lightning.rl.exploration.replay import Replay, ReplayPlan
from repdib_lightning.rl.exploration.schedule import Schedule

BATCH = STEPS


def slow_schedule(when):
    """Actions taken when each update is due, by walking through them."""
    due, taken = [], when.seed
    while taken + when.update_every <= when.total:
        due.append(taken)
        taken += when.update_every
    return due


@pytest.mark.parametrize("environments", [1, 2, 3])
@pytest.mark.parametrize("repeat", [1, 2, 7])
@pytest.mark.parametrize("frames", [1, 60, 61, 1000])
@pytest.mark.parametrize(("seed_frames", "update_every"), [(0, 1), (100, 2), (99, 5)])
def test_schedules_count_whole_episodes_and_updates(environments, repeat, frames, seed_frames, update_every):
    when = Schedule.of_frames(
        frames=frames,
        action_repeat=repeat,
        episode=STEPS,
        environments=environments,
        seed_frames=seed_frames,
        update_every=update_every,
    )
    together = environments * STEPS
    assert when.total % together == 0 and 0 <= when.total * repeat - frames < together * repeat
    assert when.episodes * STEPS == when.total
    assert when.seed >= together + environments and when.seed * repeat >= seed_frames
    due = slow_schedule(when)
    assert when.updates == len(due) and [when.actions_before(update) for update in range(len(due))] == due


def run(made, act=policy, numbers=None):
    """Updates that are left, or the given number: (number, actions, episodes, batch) of each."""
    found = []
    for number in made.updates(act):
        found.append((number, made.steps, made.replay.episodes, made.replay.draw(number, BATCH)))
        if numbers is not None and len(found) == numbers:
            break
    return found


def whole(path, when, act=policy, **options):
    made = collection(path, when, **options)
    found = run(made, act)
    made.finish(act)
    made.replay.finish()
    made.close()
    return found, path.read_bytes()


def same(some, others):
    return len(some) == len(others) and all(
        one[:3] == other[:3]
        and torch.equal(one[3].rows, other[3].rows)
        and torch.equal(one[3].observations["pixels"], other[3].observations["pixels"])
        and torch.equal(one[3].returns, other[3].returns)
        for one, other in zip(some, others, strict=True)
    )


@pytest.mark.parametrize("environments", [1, 2, 3])
@pytest.mark.parametrize(("update_every", "seed_frames"), [(1, 0), (2, 20), (5, 21), (7, 23)])
def test_updates_come_when_they_are_due_and_never_before_an_episode(tmp_path, environments, update_every, seed_frames):
    when = schedule(environments, rounds=8, update_every=update_every, seed_frames=seed_frames)
    found, _ = whole(tmp_path / "x.h5", when)
    assert [number for number, *_ in found] == list(range(when.updates)) and found
    assert found[0][2] == when.episodes_at_first
    for number, steps, episodes, _ in found:
        due = when.actions_before(number)
        assert due <= steps < due + environments and steps % environments == 0
        # the step under way is not in yet
        assert episodes == (steps - environments) // (environments * STEPS) * environments >= environments
    assert len(EpisodeStore(tmp_path / "x.h5").lengths) == when.episodes == 8 * environments


def slow_collection(when, seed, act):
    """One environment after the other, without a replay: pictures, actions and rewards of every episode."""
    found, steps = [], 0
    while steps < when.total:
        key = np.array([seed, 2 * steps], np.uint64)
        seeds = np.random.Generator(np.random.Philox(key=key)).integers(2**31, size=when.environments)
        worlds = [Opener()() for _ in seeds]
        frames = [[world.reset(seed=int(seed))[0]] for world, seed in zip(worlds, seeds, strict=True)]
        actions, rewards = [[] for _ in worlds], [[] for _ in worlds]
        for _ in range(STEPS):
            random = np.random.Generator(np.random.Philox(key=np.array([seed, 2 * steps + 1], np.uint64)))
            size = (len(worlds), ACTIONS)
            if steps < when.seed:
                chosen = random.uniform(-1, 1, size)
            else:
                shown = {"pixels": np.stack([rows[-1] for rows in frames])}
                chosen = act(shown, random.standard_normal(size).astype(np.float32))
            for i, world in enumerate(worlds):
                actions[i].append(chosen[i].astype(np.float32))
                picture, reward, *_ = world.step(actions[i][-1])
                frames[i].append(picture)
                rewards[i].append(np.float32(reward))
            steps += len(worlds)
        found += list(zip(frames, actions, rewards, strict=True))
    return found


@pytest.mark.parametrize("environments", [1, 2])
def test_the_store_holds_what_a_slow_loop_sees_and_does(tmp_path, environments):
    when = schedule(environments)
    whole(tmp_path / "x.h5", when, seed=4)
    store = EpisodeStore(tmp_path / "x.h5")
    wanted = slow_collection(when, 4, policy)
    assert len(wanted) == len(store.lengths)
    for number, (frames, actions, rewards) in enumerate(wanted):
        first = number * (STEPS + 1)
        np.testing.assert_array_equal(store.array("observations/pixels")[first : first + STEPS + 1], np.stack(frames))
        np.testing.assert_array_equal(store.array("actions")[first : first + STEPS], np.stack(actions))
        np.testing.assert_array_equal(store.array("rewards")[first : first + STEPS], rewards)
        assert store.array("factors/clock")[first : first + STEPS + 1].ravel().tolist() == list(range(STEPS + 1))
    seeds = store.array("observations/pixels")[:, 0, 0]
    assert len({tuple(row) for row in seeds}) == when.episodes  # every episode starts elsewhere


class Asked:
    """Notes what a policy is asked."""

    def __init__(self):
        self.shown, self.noise = [], []

    def __call__(self, observations, noise):
        self.shown.append(observations["pixels"].copy())
        self.noise.append(noise.copy())
        return policy(observations, noise)


@pytest.mark.parametrize("stack", [1, 3])
def test_the_policy_is_asked_after_the_seed_actions_and_sees_stacks(tmp_path, stack):
    asked, when = Asked(), schedule(2, seed_frames=17)
    whole(tmp_path / "x.h5", when, asked, frame_stack=stack)
    taken = math.ceil(when.seed / 2)  # by each of both
    assert len(asked.shown) == when.total // 2 - taken
    pixels = EpisodeStore(tmp_path / "x.h5").array("observations/pixels").reshape(when.episodes, STEPS + 1, *PICTURE)
    for call, (shown, noise) in enumerate(zip(asked.shown, asked.noise, strict=True)):
        turn, step = divmod(taken + call, STEPS)
        places = [max(step - back, 0) for back in range(stack - 1, -1, -1)]
        wanted = pixels[2 * turn : 2 * turn + 2][:, places].reshape(2, 3 * stack, *PICTURE[1:])
        np.testing.assert_array_equal(shown, wanted)
        assert noise.shape == (2, ACTIONS) and noise.dtype == np.float32
    noises = np.concatenate(asked.noise)
    assert len(np.unique(noises)) == noises.size and abs(noises.mean()) < 0.5 and 0.7 < noises.std() < 1.3


def test_noise_is_a_function_of_seed_and_step_alone(tmp_path):
    when = schedule(2)
    kinds = {}
    for name, seed, act in (("a", 0, policy), ("b", 0, lambda seen, noise: 0 * noise), ("c", 1, policy)):
        asked = Asked()
        whole(tmp_path / f"{name}.h5", when, lambda seen, noise, a=asked, p=act: (a(seen, noise), p(seen, noise))[1],
              seed=seed)  # fmt: skip
        kinds[name] = np.stack(asked.noise)
    assert np.array_equal(kinds["a"], kinds["b"]) and not np.isin(kinds["a"], kinds["c"]).any()
    stores = {name: EpisodeStore(tmp_path / f"{name}.h5").array("actions")[:STEPS] for name in kinds}
    assert np.array_equal(stores["a"], stores["b"]) and not np.array_equal(stores["a"], stores["c"])
    assert np.abs(stores["a"]).max() <= 1


def saved(state):
    """As it comes back from a checkpoint."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


@pytest.mark.parametrize(
    ("environments", "options"),
    [(1, {"seed_frames": 9}), (2, {"update_every": 1}), (2, {"seed_frames": 17}), (3, {"update_every": 5})],
)
@pytest.mark.parametrize("beyond", [0, 7])
def test_a_state_of_any_update_goes_on_as_it_would_have(tmp_path, environments, options, beyond):
    """``beyond``: updates after the state was taken, before the end came."""
    when = schedule(environments, **options)
    shared = {"hold_out_every": 3, "frame_stack": 2, "seed": 9}
    wanted, content = whole(tmp_path / "x.h5", when, **shared)
    kinds = set()
    for update in range(when.updates + 1):
        first = collection(tmp_path / "y.h5", when, **shared)
        found = run(first, numbers=update) if update else []
        state = saved(first.state_dict())
        run(first, numbers=beyond) if beyond else None
        first.close()
        second = collection(tmp_path / "y.h5", when, keep=state["episodes"] if state["steps"] else None, **shared)
        second.load_state_dict(state)
        again = second.state_dict()
        assert {k: v for k, v in again.items() if k != "actions"} == {k: v for k, v in state.items() if k != "actions"}
        assert torch.equal(again["actions"], state["actions"])
        found += run(second)
        second.finish(policy)
        second.replay.finish()
        second.close()
        assert same(found, wanted), update
        assert (tmp_path / "y.h5").read_bytes() == content, update
        (tmp_path / "y.h5").unlink()
        kinds.add(state["actions"].shape[1] if state["actions"].ndim > 1 else 0)
    assert kinds >= {1, STEPS}, "states right before and after the end of an episode are among them"


def test_a_state_of_a_finished_collection_has_nothing_left(tmp_path):
    when = schedule(2)
    first = collection(tmp_path / "x.h5", when)
    run(first)
    first.finish(policy)
    state = saved(first.state_dict())
    first.close()
    assert state["seeds"] == [] and state["episodes"] == when.episodes
    second = collection(tmp_path / "x.h5", when, keep=state["episodes"])
    second.load_state_dict(state)
    assert run(second) == []
    second.finish(policy)
    second.replay.finish()
    assert len(EpisodeStore(tmp_path / "x.h5").lengths) == when.episodes


def test_a_state_cannot_be_put_on_another_number_of_episodes(tmp_path):
    when = schedule(2)
    first = collection(tmp_path / "x.h5", when)
    run(first, numbers=1)
    with pytest.raises(AssertionError):
        collection(tmp_path / "y.h5", when).load_state_dict(first.state_dict())


def test_returns_are_those_of_the_episodes_that_ended(tmp_path):
    made = collection(tmp_path / "x.h5", schedule(2))
    taken = []
    for _ in made.updates(policy):
        taken += made.returns
        made.returns.clear()
    made.finish(policy)
    taken += made.returns
    made.replay.finish()
    rewards = EpisodeStore(tmp_path / "x.h5").array("rewards")
    np.testing.assert_allclose(taken, rewards.reshape(-1, STEPS + 1)[:, :STEPS].sum(1), rtol=1e-5)


@pytest.mark.parametrize("ends", ["early", "late", "terminated"])
def test_episodes_of_another_length_are_one_line(tmp_path, ends):
    made = collection(tmp_path / "x.h5", schedule(2), ends=ends)
    with pytest.raises(UserError, match=rf"after {STEPS - 2 * (ends == 'early')} actions.*time limit alone$") as caught:
        run(made)
    made.close()
    assert "\n" not in str(caught.value)


def test_workers_do_what_one_process_does_and_go_on_with_its_states(tmp_path):
    when = schedule(2, seed_frames=13)
    wanted, content = whole(tmp_path / "x.h5", when)
    found, theirs = whole(tmp_path / "y.h5", when, processes=True)
    assert same(found, wanted) and theirs == content
    first = collection(tmp_path / "z.h5", when)
    found = run(first, numbers=5)  # amid an episode
    state = saved(first.state_dict())
    first.close()
    second = collection(tmp_path / "z.h5", when, keep=state["episodes"], processes=True)
    second.load_state_dict(state)
    found += run(second, numbers=2)
    state = saved(second.state_dict())  # the step is under way in the workers
    second.close()
    third = collection(tmp_path / "z.h5", when, keep=state["episodes"])
    third.load_state_dict(state)
    found += run(third)
    third.finish(policy)
    third.replay.finish()
    assert same(found, wanted) and (tmp_path / "z.h5").read_bytes() == content


def test_a_worker_that_is_killed_is_one_line_and_all_are_cleared_away(tmp_path):
    made = collection(tmp_path / "x.h5", schedule(2), ends="killed", processes=True)
    workers = made._environments.processes
    with pytest.raises(UserError, match=r"^a worker process .* has ended; was it killed, or out of memory\?$"):
        run(made)
    made.close()
    assert not any(worker.is_alive() for worker in workers)
    collection(tmp_path / "x.h5", schedule(2), keep=0).close()  # the file is free


@pytest.mark.parametrize("processes", [False, True])
def test_an_error_inside_an_environment_is_itself_and_leaves_nothing_behind(tmp_path, processes):
    made = collection(tmp_path / "x.h5", schedule(2), ends="error", processes=processes)
    workers = made._environments.processes if processes else []
    with pytest.raises(ZeroDivisionError, match="the floor is gone"):
        run(made)
    made.close()
    assert not any(worker.is_alive() for worker in workers)
    collection(tmp_path / "x.h5", schedule(2), keep=0).close()


def test_closing_waits_for_nothing_where_workers_were_killed_from_outside(tmp_path):
    made = collection(tmp_path / "x.h5", schedule(2), processes=True)
    run(made, numbers=1)
    for worker in made._environments.processes:
        worker.kill()
    begun = time.monotonic()
    made.close()
    assert time.monotonic() - begun < 5
    assert {worker.exitcode for worker in made._environments.processes} == {-signal.SIGKILL}
    assert collection(tmp_path / "x.h5", schedule(2), keep=2).replay.episodes == 2


@pytest.mark.parametrize(
    ("task", "distractors"),
    [("walker-stand", "none"), ("quadruped-walk", "none"), ("jaco-reach_top_left", "none"), ("walker-run", "video")],
)
def test_bodies_repeat_themselves_in_a_new_process_amid_an_episode(tmp_path, task, distractors):
    """What an environment went through before an episode leaves no trace in it."""
    opener = ControlFactory(task, 16, 50, distractors=distractors)
    opened = opener()
    steps = opened.task.steps
    sizes, shape = opened.task.sizes, opened.observation_space.shape
    opened.close()
    factors = {name: FactorSpec("endogenous", "continuous", width=width) for name, width in sizes.items()}
    when = Schedule.of_frames(
        frames=150 * steps, action_repeat=50, episode=steps, environments=1, seed_frames=0, update_every=1
    )
    stated = ReplayPlan({"pixels": ArraySpec(shape)}, opened.task.actions, when.episodes, steps, factors)

    def made(name, keep=None):
        return Collection([opener], Replay(tmp_path / name, stated, keep=keep), when, seed=1)

    first = made("x.h5")
    state = None
    for number in first.updates(policy):
        state = saved(first.state_dict()) if number == when.updates - 2 else state
    first.finish(policy)
    first.replay.finish()
    first.close()
    cut = made("y.h5")
    for number in cut.updates(policy):
        if number == when.updates - 2:
            break
    cut.close()
    second = made("y.h5", keep=state["episodes"])
    second.load_state_dict(state)
    list(second.updates(policy))
    second.finish(policy)
    second.replay.finish()
    second.close()
    assert state["actions"].shape[1] not in (1, steps)
    assert (tmp_path / "x.h5").read_bytes() == (tmp_path / "y.h5").read_bytes()


def test_another_plan_of_observations_is_kept_by_name(tmp_path):
    """An environment that shows more than is kept."""

    class Both(gymnasium.Wrapper):
        def __init__(self):
            super().__init__(Opener()())
            spaces = {"eye": self.env.observation_space, "pixels": self.env.observation_space}
            self.observation_space = gymnasium.spaces.Dict(spaces)

        def reset(self, **options):
            seen, info = self.env.reset(**options)
            return {"eye": 0 * seen, "pixels": seen}, info

        def step(self, action):
            seen, *rest = self.env.step(action)
            return {"eye": 0 * seen, "pixels": seen}, *rest

    when = schedule(2)
    _, content = whole(tmp_path / "x.h5", when)
    made = Collection([Both] * 2, Replay(tmp_path / "y.h5", plan(when.episodes)), when, seed=0)
    run(made)
    made.finish(policy)
    made.replay.finish()
    assert (tmp_path / "y.h5").read_bytes() == content
