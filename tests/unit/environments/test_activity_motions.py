"""Simulated people move as their activities say, stand on the floor, and differ as they should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from repdib_lightning.environments.activity_body import Body, Figure
from repdib_lightning.environments.activity_motions import SCRIPTS, Manner, Script, Wave, perform
from repdib_lightning.environments.activity_people import manner, person, session
from repdib_lightning.environments.activity_performance import Performance, rehearse

TRAVELLING = {"walking", "running", "carrying"}


@pytest.fixture(scope="module")
def body() -> Body:
    return Body(Figure(), 16)


@pytest.fixture(scope="module")
def somebody():
    return replace(person(0, 0), sites=("right_watch", "right_phone"), mounts=np.stack([np.eye(3)] * 2))


@pytest.fixture(scope="module")
def played(body, somebody) -> dict[str, Performance]:
    """Every activity in the average manner, facing +x."""
    return {name: rehearse(body, name, somebody, Manner(turning=script.turning)) for name, script in SCRIPTS.items()}


def pelvis(body: Body, performance: Performance) -> np.ndarray:
    """(n, 3) where the pelvis is."""
    return performance.qpos[:, [body.columns[name] for name in "xyz"]]


def spread(values: np.ndarray) -> float:
    """How far apart the moments of a path are: over (n, ...)."""
    return float(np.linalg.norm(values - values.mean(axis=0), axis=-1).max())


def test_there_are_sixteen_activities_of_at_most_four_seconds():
    assert len(SCRIPTS) == 16
    assert all(2 <= script.seconds <= 4 for script in SCRIPTS.values())


@pytest.mark.parametrize("name", SCRIPTS)
def test_nothing_sinks_into_the_floor_and_only_leaps_leave_it(body, somebody, played, name):
    lowest = body.track(played[name].qpos, somebody.sites).lowest
    assert lowest.min() > -0.02
    leaves = {"jumping": 0.12, "running": 0.02}
    assert (lowest.max() > leaves[name]) if name in leaves else (lowest.max() < 0.02)


@pytest.mark.parametrize("name", SCRIPTS)
def test_who_travels_goes_through_the_room_and_nobody_else_does(body, played, name):
    path = np.linalg.norm(np.diff(pelvis(body, played[name])[:, :2], axis=0), axis=1).sum()
    assert (path > 2) if name in TRAVELLING else (path < 1.2)
    assert np.allclose(pelvis(body, played[name])[:, :2].mean(axis=0), 0, atol=0.01), "in the middle of the room"


@pytest.mark.parametrize("name", ["standing", "pointing", "drinking", "sitting_down", "crouching"])
def test_feet_on_the_floor_stay_where_they_are(body, somebody, played, name):
    assert spread(body.track(played[name].qpos, somebody.sites).feet[:, 0]) < 0.05


def test_running_is_faster_than_walking(body, played):
    speed = {
        name: np.linalg.norm(np.diff(pelvis(body, played[name])[:, :2], axis=0), axis=1).mean() * 100
        for name in ("walking", "running")
    }
    assert 0.6 < speed["walking"] < 1.8 and speed["running"] > 1.2 * speed["walking"]


def test_the_body_goes_down_and_up_as_the_activity_says(body, played):
    height = {name: pelvis(body, performance)[:, 2] for name, performance in played.items()}
    assert height["sitting_down"][0] - height["sitting_down"][-1] > 0.3
    assert height["standing_up"][-1] - height["standing_up"][0] > 0.3
    middle = len(height["crouching"]) // 2
    assert height["crouching"][0] - height["crouching"][middle] > 0.35
    assert abs(height["crouching"][0] - height["crouching"][-1]) < 0.02
    assert np.ptp(height["standing"]) < 0.01


def test_who_sits_sits_on_the_stool(body, played):
    for name, moment in (("sitting_down", -1), ("standing_up", 0)):
        seat = played[name].stool - pelvis(body, played[name])[moment, :2]
        assert np.linalg.norm(seat) < 0.15, name
    assert played["pointing"].stool[0] < -0.2, "behind who stands"


def test_hands_and_feet_do_what_the_activity_says(body, somebody, played):
    hands, feet = {}, {}
    for name, performance in played.items():
        track = body.track(performance.qpos, ("right_watch", "left_watch"))
        hands[name] = track.places - pelvis(body, performance)[:, None]
        feet[name] = track.feet
    for name in ("waving_hand", "pointing", "throwing", "drinking", "talking_on_phone"):
        assert spread(hands[name][:, 0]) > 0.15, f"{name}: the main hand moves"
        assert spread(hands[name][:, 1]) < spread(hands[name][:, 0]) / 1.5, f"{name}: more than the other one"
    assert spread(hands["checking_time"][:, 1]) > 2 * spread(hands["checking_time"][:, 0]), "the wrist with the watch"
    assert hands["pointing"][:, 0, 0].max() > 0.4, "straight ahead"
    mouth = np.array([0.1, 0.0, 0.65])
    assert np.linalg.norm(hands["drinking"][:, 0] - mouth, axis=1).min() < 0.2
    assert hands["talking_on_phone"][-1, 0, 2] > 0.5, "at the ear until the end"
    assert (hands["picking_up"][:, 0, 2] + pelvis(body, played["picking_up"])[:, 2]).min() < 0.35
    held = np.linalg.norm(hands["carrying"][..., :2], axis=-1)
    assert held.min() > 0.25 and held.max() < 0.5 and held.std() < 0.03, "both hands hold the load before the body"
    assert feet["kicking"][:, 1, 2].max() > 0.3 and feet["kicking"][:, 0, 2].max() < 0.2


def test_left_handed_people_mirror_it(body, somebody):
    wrists = ("right_watch", "left_watch")
    here, there = (
        body.track(rehearse(body, "throwing", somebody, Manner(left_handed=left)).qpos, sites).places
        for left, sites in ((False, wrists), (True, wrists[::-1]))
    )
    assert np.allclose(here, there * [1, -1, 1], atol=1e-6)


def test_a_faster_manner_is_the_same_movement_in_less_time():
    script = SCRIPTS["kicking"]
    slow = perform(script, Manner(), np.linspace(0, script.seconds, 50))[0]
    fast = perform(script, Manner(tempo=2.0), np.linspace(0, script.seconds / 2, 50))[0]
    assert all(np.allclose(slow[name], fast[name]) for name in slow)


def test_poses_are_reached_at_their_moments_and_held_beyond_the_ends():
    script = Script(2.0, ((0, {"nod": 10}), (0.5, {"nod": 30}), (1, {})), (Wave("look", 8, 1.0),))
    angles, flight = perform(script, Manner(), np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 9.0]))
    assert np.allclose(angles["nod"], [10, 10, 20, 30, 0, 0])
    assert np.allclose(angles["look"], [8, 8, -8, 8, 8, 8])
    assert not flight.any()


def test_a_leap_is_a_free_fall(body):
    """Acceleration of the body while it is off the floor."""
    seconds = np.arange(0, SCRIPTS["jumping"].seconds, 0.01)
    flight = perform(SCRIPTS["jumping"], Manner(), seconds)[1]
    inside = (flight[2:] > 0) & (flight[1:-1] > 0) & (flight[:-2] > 0)
    assert inside.sum() > 40
    assert np.allclose((flight[2:] - 2 * flight[1:-1] + flight[:-2])[inside] / 0.01**2, -9.81)


def test_people_differ_and_stay_themselves():
    people = [person(3, number) for number in range(20)]
    assert len({p.figure.height for p in people}) == 20
    assert person(3, 7).figure == people[7].figure and person(4, 7).figure != people[7].figure
    assert sum(p.left_handed for p in people) == 4
    for trait in (lambda p: p.left_handed == p.watch_on_the_right, lambda p: p.sites[1] == "left_phone"):
        shares = [np.mean([trait(p) for p in people[part]]) for part in (slice(0, 16), slice(16, 20))]
        assert 0 < shares[0] < 1 and 0 < shares[1] < 1, "neither all nor none, in training and in evaluation"


def test_a_person_has_habits_and_every_clip_is_a_little_different():
    def scales(subject: int, activity: int, clip: int) -> np.ndarray:
        script = SCRIPTS["waving_hand"]
        how = manner(0, subject, activity, person(0, subject), script, np.random.default_rng(clip))
        return np.log(list((how.scales or {}).values()))

    means = [
        [np.mean([scales(subject, activity, clip) for clip in range(30)], axis=0) for subject in range(4)]
        for activity in range(2)
    ]
    within = np.std([scales(0, 0, clip) for clip in range(30)], axis=0).mean()
    assert 0.03 < within < 0.07
    assert np.std(means, axis=1).mean() > 1.5 * within, "people differ more than a person's clips do"
    assert np.abs(means[0][0] - means[1][0]).mean() > within, "habits are of one activity"


def test_sessions_look_different_and_alike_for_everybody():
    first, again, other = session(0, 0, 0), session(0, 0, 1), session(0, 1, 0)
    assert np.array_equal(first.wall, again.wall) and not np.array_equal(first.wall, other.wall)
    assert 0 < abs(first.direction - again.direction) < 15
