"""Pictures of the Control Suite: what is cut out is the sky, exactly; edges are mixed right; nothing is stale."""

from __future__ import annotations

import numpy as np
import pytest

from repdib_lightning.environments import control_scene
from repdib_lightning.environments.control_scene import ControlCamera, Seen
from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.environments.rendering import SceneRenderer
from repdib_lightning.errors import UserError

SIZE = 32


def moved(name: str, seed: int = 0, steps: int = 3) -> ControlTask:
    """A task some steps into an episode."""
    task, random = ControlTask(name, 5), np.random.default_rng(seed)
    task.reset(random)
    for _ in range(steps):
        task.step(random.uniform(-1, 1, task.actions))
    return task


def constant(colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((SIZE, SIZE, 3), colour, np.uint8)


def geoms_seen(task: ControlTask) -> np.ndarray:
    """(H, W): the geom at each pixel of a camera that cuts nothing out."""
    camera = ControlCamera(task, SIZE)
    _, geoms = camera._renderers[0].picture_and_geoms(task.data, task.camera, task.model)
    camera.close()
    return geoms


@pytest.mark.parametrize("name", ["walker-walk", "cheetah-run", "hopper-hop"])
def test_the_sky_is_what_no_geom_covers(name):
    task = moved(name)
    geoms = geoms_seen(task)
    camera = ControlCamera(task, SIZE, "fast", "sky")
    seen, mask = camera.see(task), camera.agent_mask(task)
    assert seen.through.dtype == bool and np.array_equal(seen.through[..., 0], geoms < 0)
    assert np.array_equal(mask, np.isin(geoms, np.flatnonzero(task.model.geom_bodyid != 0)))
    assert 0.1 < seen.through.mean() < 0.95 and mask.any() and not (mask & seen.through[..., 0]).any()
    camera.close()


@pytest.mark.parametrize("name", ["walker-walk", "humanoid-walk"])
def test_sky_and_floor_are_what_is_not_the_agent(name):
    task = moved(name)
    moving = geoms_seen(task) > 0
    camera = ControlCamera(task, SIZE, "fast", "sky_floor")
    assert np.array_equal(camera.see(task).through[..., 0], ~moving)
    assert np.array_equal(camera.agent_mask(task), moving) and moving.any()
    camera.close()


@pytest.mark.parametrize(
    ("name", "quality", "through"),
    [
        ("walker-walk", "fast", "sky_floor"),
        ("walker-walk", "paper", "sky"),
        ("walker-walk", "paper", "sky_floor"),
        ("ball_in_cup-catch", "paper", "sky"),
    ],
)
def test_a_composite_is_the_scene_under_a_sky_of_that_colour(monkeypatch, name, quality, through):
    """Antialiased edges and reflections included, up to rounding."""
    task = moved(name)
    camera = ControlCamera(task, SIZE, quality, through)
    seen = camera.see(task)
    camera.close()
    for colour in ((90, 200, 40), (255, 255, 0)):
        same = moved(name)
        monkeypatch.setattr(control_scene, "_KEYS", (colour,))
        under = ControlCamera(same, SIZE, quality, through)
        expected = under._renderers[0].picture(same.data, same.camera, same.model)
        under.close()
        difference = np.abs(seen.before(constant(colour)).astype(int) - expected)
        assert difference.max() <= (1 if quality == "paper" else 0), colour
    mixed = (seen.through > 0.1) & (seen.through < 0.9)
    assert (mixed.sum() > 10) == (quality == "paper")


def test_nothing_is_cut_out_unless_asked_for():
    task = moved("walker-walk")
    camera = ControlCamera(task, SIZE)
    seen = camera.see(task)
    assert not seen.through.any() and seen.picture.dtype == np.uint8
    assert np.array_equal(seen.before(constant((255, 0, 0))), seen.picture)
    camera.close()


def test_the_two_qualities_show_the_same_scene():
    fast_task, paper_task = moved("walker-walk"), moved("walker-walk")
    fast, paper = ControlCamera(fast_task, SIZE, "fast"), ControlCamera(paper_task, SIZE, "paper")
    one, other = fast.see(fast_task).picture.astype(int), paper.see(paper_task).picture.astype(int)
    apart = np.abs(one - other).max(-1)
    plain = SceneRenderer(paper_task.model, SIZE, SIZE)
    flat = plain.picture(paper_task.data, paper_task.camera).astype(int)
    assert (np.abs(other - flat).max(-1) > 10).sum() > 10, "the agent has a shadow, and is reflected"
    plain.close()
    assert (apart > 2).any() and np.median(apart) < 25 and np.array_equal(fast_task.state(), paper_task.state())
    masks = fast.agent_mask(fast_task), paper.agent_mask(paper_task)
    assert (masks[0] & masks[1]).sum() > 0.8 * (masks[0] | masks[1]).sum()
    fast.close()
    paper.close()


def test_an_agent_within_a_skin_has_a_mask():
    task = moved("dog-run")
    camera = ControlCamera(task, SIZE, "fast", "sky_floor")
    mask = camera.agent_mask(task)
    assert mask.mean() > 0.03 and np.array_equal(mask, ~camera.see(task).through[..., 0])
    camera.close()


def test_goals_that_stand_still_are_not_the_agent():
    task = moved("manipulator-bring_ball")
    camera = ControlCamera(task, SIZE, "fast", "sky_floor")
    cut = ~camera.see(task).through[..., 0]
    target = task.model.geom("target_ball").id
    geoms = geoms_seen(task)
    assert (geoms == target).any() and not camera.agent_mask(task)[geoms == target].any()
    assert cut[geoms == target].all(), "it is seen all the same"
    camera.close()


def test_terrain_is_that_of_the_episode():
    task = ControlTask("quadruped-escape", 5)
    camera = ControlCamera(task, SIZE)
    pictures = []
    for seed in (1, 2):
        task.reset(np.random.default_rng(seed))
        fresh = ControlCamera(task, SIZE)
        pictures.append(camera.see(task).picture)
        assert np.array_equal(pictures[-1], fresh.see(task).picture)
        fresh.close()
    assert not np.array_equal(*pictures)
    camera.close()


def test_one_camera_films_several_tasks():
    one, other = moved("walker-walk", 0), moved("walker-walk", 1)
    camera = ControlCamera(one, SIZE, "paper", "sky_floor")
    camera.dress(other)
    first = camera.see(one)
    same = moved("walker-walk", 1)
    own = ControlCamera(same, SIZE, "paper", "sky_floor")
    filmed, expected = camera.see(other), own.see(same)
    assert np.array_equal(filmed.picture, expected.picture) and np.array_equal(filmed.through, expected.through)
    assert not np.array_equal(first.picture, filmed.picture)
    camera.close()
    own.close()


def test_shares_are_rounded_to_the_nearest_value():
    seen = Seen(np.full((1, 1, 3), 10.0, np.float32), np.full((1, 1, 1), 0.5, np.float32))
    assert seen.before(np.array([[[1, 2, 255]]], np.uint8)).tolist() == [[[11, 11, 138]]]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"size": 15}, r"image_size=15: must be from 16 to 512"),
        ({"size": 513}, r"image_size=513: must be from 16 to 512"),
        ({"quality": "papr"}, r"quality=papr: unknown, did you mean 'paper'\? \(choices: fast, paper\)"),
    ],
)
def test_bad_input(options, said):
    with pytest.raises(UserError, match=said):
        ControlCamera(ControlTask("pendulum-swingup"), **{"size": SIZE, **options})
