"""The mazes in gymnasium: rules, pictures, goals and starts, backgrounds, and what bad input says."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from repdib_lightning.environments import GYMNASIUM_IDS, register
from repdib_lightning.environments.maze_batch import training_goals
from repdib_lightning.environments.maze_env import MazeEnv
from repdib_lightning.environments.maze_pictures import AGENT, FLOOR, GOAL, WALL, wall_lines
from repdib_lightning.environments.mazes import WORLDS, build_maze
from repdib_lightning.errors import UserError

MAZE_IDS = [name for name in GYMNASIUM_IDS if "World" in name]
CENTRE = build_maze("GridWorld").centre
MIDDLE = [14, 15, 20, 21]
UP, DOWN, LEFT, RIGHT = range(4)


def expected_picture(agent: int, goal: int | None) -> np.ndarray:
    """(3, 30, 30): the picture, pixel by pixel."""
    picture = np.empty((30, 30, 3), np.uint8)
    picture[:] = FLOOR
    for cell, colour, inset in ((goal, GOAL, 0), (agent, AGENT, 1)):
        if cell is not None:
            top, left = 5 * (cell // 6), 5 * (cell % 6)
            picture[top + inset : top + 5 - inset, left + inset : left + 5 - inset] = colour
    return picture.transpose(2, 0, 1)


@pytest.mark.parametrize("name", MAZE_IDS)
@pytest.mark.parametrize("options", [{}, {"goals": "none", "distractors": "procedural_images", "show_walls": True}])
def test_passes_the_checker_through_gymnasium_make(name, options):
    register()
    register()
    made = gymnasium.make(name, render_mode="rgb_array", **options)
    assert made.unwrapped.maze.name == name.removeprefix("repdib/").removesuffix("-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(image|channel|Box observation space).*")
        check_env(made.unwrapped)
    made.close()


@pytest.mark.parametrize("world", WORLDS)
def test_shortest_paths_lead_from_every_cell_to_every_goal(world):
    """Walking down the distances takes as many steps as they say; each picture shows agent and goal in their places."""
    env = MazeEnv(world)
    maze = env.maze
    for goal in training_goals(maze):
        for start in set(range(maze.cells)) - {goal}:
            seen, info = env.reset(options={"start": maze.place(start), "goal": maze.place(goal)})
            cell, steps, ended = start, 0, False
            while not ended:
                assert info["factors"] == {"position": cell, "goal": goal}
                assert np.array_equal(seen, expected_picture(cell, goal))
                action = np.argmin(maze.distances[maze.neighbours[cell], goal])
                seen, reward, ended, truncated, info = env.step(action)
                cell, steps = info["factors"]["position"], steps + 1
                assert (reward, truncated) == (0.0 if ended else -1.0, False)
            assert (cell, steps) == (goal, maze.distances[start, goal])
            assert np.array_equal(seen, expected_picture(goal, goal)), "both show where they meet"


def test_moves_into_walls_cost_a_step_and_stay():
    env = MazeEnv("SpiralWorld", evaluation=True)
    env.reset(options={"start": (2, 0)})
    for action, cell in ((LEFT, 12), (RIGHT, 12), (UP, 6), (UP, 6), (RIGHT, 7), (DOWN, 7)):
        _, reward, terminated, truncated, info = env.step(np.int64(action))
        assert (reward, terminated, truncated, info["factors"]["position"]) == (-1.0, False, False, cell)


def test_truncation_comes_after_the_last_step():
    env = MazeEnv("SpiralWorld", start=(0, 0), evaluation=True, episode_length=3)
    for _ in range(2):
        env.reset()
        assert [env.step(np.int64(UP))[1:4] for _ in range(3)] == [(-1.0, False, False)] * 2 + [(-1.0, False, True)]
        with pytest.raises(AssertionError, match="reset"):
            env.step(np.int64(UP))


def test_a_goal_on_the_last_step_ends_and_truncates():
    env = MazeEnv(start=(3, 1), goals="centre", episode_length=1)
    env.reset()
    assert env.step(np.int64(RIGHT))[1:4] == (0.0, True, True)


def drawn(env: MazeEnv, episodes: int = 400) -> tuple[list[int], list[int]]:
    env.reset(seed=0)
    infos = [env.reset()[1]["factors"] for _ in range(episodes)]
    return [info["position"] for info in infos], [info["goal"] for info in infos]


def test_starts_are_spread_and_never_on_the_goal():
    starts, goals = drawn(MazeEnv("SpiralWorld"))
    assert set(starts) == set(range(36)) and not any(np.equal(starts, goals))
    counts = np.bincount(goals, minlength=36)
    assert np.flatnonzero(counts).tolist() == MIDDLE and counts[counts > 0].min() > 70, "about 100 each"


@pytest.mark.parametrize(
    ("options", "goals"),
    [
        ({"evaluation": True}, {CENTRE}),
        ({"goals": "centre"}, {CENTRE}),
        ({"goals": " 0,0  2,3 2,3"}, {0, 15}),
        ({"goals": [(1, 1), "5,0"]}, {7, 30}),
        ({"goals": np.array([[1, 1]])}, {7}),
        ({"goals": "0,1", "evaluation": True}, {1}),
        ({"size": 9}, {30, 31, 39, build_maze("GridWorld", 9).centre}),
    ],
)
def test_goals_are_those_that_were_named(options, goals):
    assert set(drawn(MazeEnv(**options), 60)[1]) == goals


def test_without_a_goal_nothing_ends_and_nothing_is_drawn():
    env = MazeEnv(goals="none", episode_length=50)
    seen, info = env.reset(seed=3)
    env.action_space.seed(0)
    for step in range(50):
        assert np.array_equal(seen, expected_picture(info["factors"]["position"], None))
        assert list(info["factors"]) == ["position"]
        seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert (reward, terminated, truncated) == (-1.0, False, step == 49)


def test_a_chosen_goal_is_a_factor_where_the_maze_has_none():
    env = MazeEnv(goals="none")
    assert env.reset(options={"start": "0,0", "goal": "0,1"})[1]["factors"] == {"position": 0, "goal": 1}
    assert env.step(np.int64(RIGHT))[1:3] == (0.0, True)


def test_a_chosen_start_leaves_only_the_other_goals():
    env = MazeEnv()
    goals = {env.reset(seed=seed, options={"start": "2,2"})[1]["factors"]["goal"] for seed in range(40)}
    assert goals == set(MIDDLE) - {14}


def test_seeds_decide_everything():
    def play(seed: int) -> list[bytes]:
        env = MazeEnv(distractors="procedural")
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(np.int64(action))[0] for action in (0, 2, 2)]
        return [picture.tobytes() for picture in (*seen, env.reset()[0])]

    assert play(5) == play(5)
    assert play(5)[0] != play(6)[0]


def test_walls_are_drawn_only_where_asked_for():
    plain = {MazeEnv(world, start=(0, 0)).reset(seed=0)[0].tobytes() for world in WORLDS}
    assert len(plain) == 1, "the worlds share their pictures"
    seen, _ = MazeEnv("LoopWorld", start=(0, 0), goals="none", show_walls=True).reset()
    blue = (seen.transpose(1, 2, 0) == WALL).all(-1)
    assert blue[4, 5:25].all() and blue[5, 5:25].all(), "a wall below the first row, on both sides"
    assert blue[15, 24] and not blue[22, 24:26].any(), "beside it, down to the opening at the bottom right"
    assert not blue[[0, 29]].any() and not blue[:, 29].any(), "none around"


def test_walls_are_listed_once_each():
    assert len(wall_lines(build_maze("GridWorld"))) == 24
    assert len(wall_lines(build_maze("SpiralWorld"))) == 24 + 60 - 35
    assert len(wall_lines(build_maze("LoopWorld"))) == 24 + 60 - 37


def test_backgrounds_play_behind_agent_and_goal():
    env = MazeEnv(distractors="procedural")
    agent = (np.array(AGENT)[:, None], np.array(GOAL)[:, None])
    backgrounds = set()
    for _ in range(4):
        seen, info = env.reset()
        before = None
        for _ in range(3):
            at, goal = info["factors"]["position"], info["factors"]["goal"]
            shown = expected_picture(at, goal)
            is_agent = (shown == agent[0][:, :, None]).all(0)
            is_goal = (shown == agent[1][:, :, None]).all(0)
            assert is_agent.sum() == 9 and is_goal.sum() in (25, 16)
            assert np.array_equal(seen[:, is_agent | is_goal], shown[:, is_agent | is_goal])
            behind = seen[:, ~(is_agent | is_goal)]
            assert behind.any() and (before is None or not np.array_equal(before, seen)), "a clip moves on"
            before = seen
            backgrounds.add(info["factors"]["clip"])
            if at == goal:
                break
            seen, _, _, _, info = env.step(np.int64(UP))
    assert len(backgrounds) > 1, "another clip each episode"


def test_stills_stay_for_an_episode():
    env = MazeEnv(distractors="procedural_images", start=(0, 0), evaluation=True)
    stills = []
    for seed in range(3):
        first, _ = env.reset(seed=seed)
        assert np.array_equal(first, env.step(np.int64(UP))[0])
        stills.append(first.tobytes())
    assert len(set(stills)) == 3


def test_evaluation_shows_other_clips_under_other_numbers():
    clips = []
    for evaluation in (False, True):
        env = MazeEnv(distractors="procedural", evaluation=evaluation, cell_pixels=3)
        clips.append({env.reset(seed=seed)[1]["factors"]["clip"] for seed in range(60)})
    assert clips[0] <= set(range(48)) and clips[1] <= set(range(48, 64)) and len(clips[1]) > 5


def test_render_is_for_people():
    env = MazeEnv("SpiralWorld", start="2,2", evaluation=True, render_mode="rgb_array")
    env.reset()
    frame = env.render()
    assert frame.shape == (356, 356, 3) and frame.dtype == np.uint8
    assert tuple(frame[10 + 2 * 56 + 28, 10 + 2 * 56 + 28]) == AGENT
    assert tuple(frame[10 + 3 * 56 + 28, 10 + 2 * 56 + 28]) == GOAL
    assert tuple(frame[10 + 56, 10 + 28]) == WALL and tuple(frame[10 + 56, 10 + 5 * 56 + 28]) != WALL
    assert MazeEnv().render() is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"world": "Grid"}, r"unknown maze 'Grid', did you mean 'GridWorld'"),
        ({"goals": "6,2"}, r"goals=6,2: lies outside of GridWorld.* nearest is 5,2"),
        ({"goals": "centre 2.5,2"}, r"goals=2.5,2: lies in a wall .* nearest is 2,2"),
        ({"goals": "inf,-1"}, r"goals=inf,-1: lies outside .* nearest is 5,0"),
        ({"goals": "nan,1"}, r"goals=nan,1: lies outside .* nearest is 0,1"),
        ({"goals": "middle"}, r"goals=middle: expected row,column such as 3,2, or centre"),
        ({"goals": (3, 2)}, r"goals=3: expected row,column"),
        ({"goals": 3}, r"goals=3: expected cells"),
        ({"goals": " "}, r"goals: names no cell"),
        ({"goals": "none 1,1"}, r"goals=none: expected row,column"),
        ({"start": "1,2,3"}, r"start=1,2,3: expected row,column"),
        ({"start": np.array([0, 7])}, r"start=0,7: lies outside .* nearest is 0,5"),
        ({"start": "2,2"}, r"start=2,2: is also a goal"),
        ({"size": 2}, r"size=2"),
        ({"cell_pixels": 2}, r"cell_pixels=2: must be from 3 to 64"),
        ({"episode_length": 0}, r"episode_length=0: must be at least 1"),
        ({"distractors": "procedurl"}, r"distractors: .*did you mean 'procedural'"),
        ({"render_mode": "human"}, r"render_mode=human"),
    ],
)
def test_bad_arguments_are_named(arguments, said):
    with pytest.raises(UserError, match=said) as caught:
        MazeEnv(**arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"start": "0,0", "goal": (0, 0)}, "start=0,0: is also the goal"),
        ({"start": "0,9"}, "start=0,9: lies outside .* nearest is 0,5"),
        ({"goal": 7}, "goal=7: expected row,column"),
        ({"goal": "none"}, "goal=none: expected row,column"),
        ({"start": ["0,0", "0,1"]}, "start: names 2 cells for 1 mazes"),
        ({"strat": "0,0"}, "unknown option 'strat', did you mean 'start'"),
    ],
)
def test_bad_options_of_reset_are_named_and_change_nothing(options, said):
    env = MazeEnv()
    env.reset(seed=0)
    before = env.batch.factors()
    with pytest.raises(UserError, match=said):
        env.reset(options=options)
    assert env.batch.factors() == before


def test_a_fixed_start_does_not_give_way_to_a_chosen_goal():
    env = MazeEnv(start="0,0")
    with pytest.raises(UserError, match="start=0,0: is also the goal"):
        env.reset(options={"goal": "0,0"})


@pytest.mark.parametrize("action", [-1, 4])
def test_actions_that_do_not_exist_are_refused(action):
    env = MazeEnv()
    env.reset(seed=0)
    with pytest.raises(UserError, match=rf"action {action}: must be from 0 to 3 \(up, down, left, right\)"):
        env.step(np.int64(action))
