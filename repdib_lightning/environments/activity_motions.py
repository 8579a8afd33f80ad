"""What simulated people do: every activity is a short table of key poses, waves and leaps.

Angles are in degrees and named as in :mod:`repdib_lightning.environments.activity_body`; limbs are ``main_`` (of the
hand that the person prefers) or ``other_``. Moments are shares of the activity, waves count in cycles a second. Where
the body stands follows from the feet and is no part of a script.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.environments.activity_body import LIMB, TRUNK

ANGLES = ("spin", "tip", *TRUNK, *(f"{limb}_{joint}" for limb in ("main", "other") for joint in LIMB))
"""Everything that a script may move: about the vertical (to the left), forward as a whole, then the joints."""

GRAVITY = 9.81

_HINGES = ("elbow", "knee")
_FOLDED = 150.0  # degrees that elbows and knees go to, from straight

Pose = dict[str, float]


@dataclass(frozen=True)
class Wave:
    """``degrees * cos(2 pi (cycles * time + phase))`` on an angle, between two moments.

    Attributes:
        phase: in cycles.
        during: moments; at both it fades over a tenth of the activity unless it lasts all of it.
    """

    angle: str
    degrees: float
    cycles: float
    phase: float = 0.0
    during: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Leap:
    """A flight of both feet, as gravity has it.

    Attributes:
        height: metres.
        at: moment of the highest point; not used where there are ``cycles``.
        cycles: flights a second; 0 for a single one.
        phase: of the highest point, in cycles.
    """

    height: float
    at: float = 0.0
    cycles: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True)
class Script:
    """One activity.

    Attributes:
        seconds: how long it takes at a tempo of 1.
        poses: (moment, pose) in order; an angle that a pose does not name is 0.
        waves, leaps: on top of the poses.
        turning: degrees a second of the circle that the person goes on; 0 where it stays in its place.
        prop: what the main hand holds (a load: both), until the moment ``released``.
        watch: the other limb is the one that wears the watch, whichever hand the person prefers.
    """

    seconds: float
    poses: tuple[tuple[float, Pose], ...] = ((0.0, {}),)
    waves: tuple[Wave, ...] = ()
    leaps: tuple[Leap, ...] = ()
    turning: float = 0.0
    prop: str = ""
    released: float = 1.0
    watch: bool = False


def _gait(cycles: float, stride: float, lift: float, swing: float) -> tuple[Wave, ...]:
    """Legs that step and arms that swing against them; ``lift`` is how far the swinging shin goes back."""
    waves = []
    for limb, phase in (("main", 0.0), ("other", 0.5)):
        waves += [
            Wave(f"{limb}_hip", stride, cycles, phase - 0.25),
            Wave(f"{limb}_knee", 0.42 * lift, cycles, phase),
            Wave(f"{limb}_knee", 0.25 * lift, 2 * cycles, 2 * phase),
            Wave(f"{limb}_raise", swing, cycles, phase + 0.25),
            Wave(f"{limb}_elbow", 0.4 * swing, cycles, phase + 0.25),
        ]
    return (*waves, Wave("twist", 0.25 * swing, cycles, 0.25))


def _both(**angles: float) -> Pose:
    return {f"{limb}_{joint.rstrip('_')}": angle for joint, angle in angles.items() for limb in ("main", "other")}


_WALK: Pose = _both(elbow=15, hip=4, knee=14)
_RUN: Pose = {"tip": 9, **_both(elbow=85, hip=14, knee=34)}
_SQUAT: Pose = {"tip": 30, "bend": 18, **_both(hip=118, knee=122, splay=8, raise_=55, elbow=25)}
_SEATED: Pose = {"tip": 4, **_both(hip=90, knee=88, raise_=28, elbow=55)}
_RISING: Pose = {"tip": 26, "bend": 22, **_both(hip=80, knee=84, raise_=30, elbow=30)}
_WAVE: Pose = {"main_raise": 60, "main_spread": 55, "main_turn": -40, "main_elbow": 95}
_POINT: Pose = {"main_raise": 82, "main_spread": 8, "main_elbow": 6}
_REACH_DOWN: Pose = {"tip": 40, "bend": 48, "nod": 10, **_both(hip=95, knee=88), "main_raise": 84, "other_raise": 25}
_SIP: Pose = {"main_raise": 82, "main_turn": 38, "main_elbow": 115}
_GULP: Pose = _SIP | {"main_raise": 98, "nod": -22}
_HOLD: Pose = {"main_elbow": 60}
_AT_EAR: Pose = {"main_raise": 78, "main_spread": 30, "main_turn": 24, "main_elbow": 138, "look": -6}
_CARRY: Pose = _both(raise_=8, spread=8, turn=14, elbow=88)
_COCKED: Pose = {"main_raise": 85, "main_spread": 75, "main_turn": -60, "main_elbow": 95, "twist": -28, "bend": -6}
_THROWN: Pose = {"main_raise": 95, "main_turn": 15, "main_elbow": 12, "twist": 24, "bend": 16, "other_raise": -20}
_CROUCH: Pose = {"tip": 14, "bend": 14, **_both(hip=55, knee=68, raise_=-35)}
_BACKSWING: Pose = {"main_hip": -32, "main_knee": 70, "tip": 6, "other_raise": 25, "other_knee": 8}
_KICK: Pose = {"main_hip": 72, "main_knee": 8, "tip": -10, "main_raise": -25, "other_raise": 40, "other_knee": 8}
_WATCH: Pose = {"other_raise": 38, "other_turn": 55, "other_elbow": 104, "nod": 24}


def _jump(top: float) -> tuple[tuple[float, Pose], ...]:
    return (top - 0.16, _CROUCH), (top - 0.06, _both(raise_=70)), (top + 0.08, _CROUCH)


SCRIPTS: dict[str, Script] = {
    "walking": Script(3.4, ((0, _WALK),), _gait(0.95, 24, 50, 24), turning=80),
    "running": Script(3.0, ((0, _RUN),), _gait(1.45, 36, 80, 38), (Leap(0.035, cycles=2.9, phase=0.5),), turning=130),
    "carrying": Script(3.4, ((0, _WALK | _CARRY),), _gait(0.85, 20, 44, 3), turning=75, prop="load"),
    "jumping": Script(
        2.8,
        ((0, {}), *_jump(0.36), *_jump(0.76), (1, {})),
        leaps=(Leap(0.2, 0.36), Leap(0.2, 0.76)),
    ),
    "crouching": Script(3.2, ((0, {}), (0.05, {}), (0.4, _SQUAT), (0.7, _SQUAT), (1, {}))),
    "sitting_down": Script(2.8, ((0, {}), (0.2, {}), (0.6, _RISING), (0.8, _SEATED), (1, _SEATED))),
    "standing_up": Script(2.8, ((0, _SEATED), (0.2, _SEATED), (0.4, _RISING), (0.8, {}), (1, {}))),
    "standing": Script(3.0, waves=(Wave("look", 22, 0.3, 0.2), Wave("lean", 3, 0.4))),
    "picking_up": Script(3.2, ((0, {}), (0.08, {}), (0.45, _REACH_DOWN), (0.58, _REACH_DOWN), (1, {"main_elbow": 50}))),
    "waving_hand": Script(
        2.8,
        ((0, {}), (0.25, _WAVE), (0.8, _WAVE), (1, {})),
        (Wave("main_turn", 26, 1.7, during=(0.2, 0.85)), Wave("main_elbow", 12, 1.7, 0.2, during=(0.2, 0.85))),
    ),
    "pointing": Script(2.8, ((0, {}), (0.3, _POINT), (0.75, _POINT), (1, {}))),
    "throwing": Script(
        2.6,
        ((0, {}), (0.4, _COCKED), (0.55, _THROWN), (0.68, _THROWN | {"main_raise": 50}), (1, {})),
        prop="ball",
        released=0.52,
    ),
    "kicking": Script(2.6, ((0, {}), (0.35, _BACKSWING), (0.52, _KICK), (0.66, _KICK | {"main_hip": 30}), (1, {}))),
    "drinking": Script(
        3.4,
        ((0, _HOLD), (0.3, _SIP), (0.5, _GULP), (0.72, _GULP), (1, _HOLD)),
        prop="cup",
    ),
    "talking_on_phone": Script(
        3.4,
        ((0, _HOLD), (0.3, _AT_EAR), (1, _AT_EAR)),
        (Wave("nod", 5, 0.9, during=(0.3, 1)), Wave("lean", 3, 0.4)),
        prop="phone",
    ),
    "checking_time": Script(2.8, ((0, {}), (0.35, _WATCH), (0.75, _WATCH), (1, {})), watch=True),
}
"""Activity -> script; the names are MMAct's."""


@dataclass(frozen=True)
class Manner:
    """How a script is performed this time.

    Attributes:
        tempo: above 1 is faster.
        amplitude: of everything that moves.
        delay: moments that key poses between the first and the last are late by.
        scales: angle -> factor on it.
        offsets: angle -> degrees added throughout.
        ahead: seconds that all waves are ahead by.
        idle: degrees that everybody sways by.
        turning: degrees a second to the left.
        left_handed: whether the main hand is the left one.
    """

    tempo: float = 1.0
    amplitude: float = 1.0
    delay: float = 0.0
    scales: dict[str, float] | None = None
    offsets: dict[str, float] | None = None
    ahead: float = 0.0
    idle: float = 0.0
    turning: float = 0.0
    left_handed: bool = False


def perform(script: Script, manner: Manner, seconds: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The pose at some times.

    Args:
        script: what is done.
        manner: how.
        seconds: (n,) since the beginning, which may lie before it and after the end: there it holds still.

    Returns:
        Joint of the body -> (n,) degrees, ankles left out; and (n,) metres that the body is off the floor.
    """
    moments = seconds * manner.tempo / script.seconds
    angles = _key_poses(script, moments, manner.delay)
    for wave in script.waves:
        angles[wave.angle] = angles[wave.angle] + _faded(wave, moments) * wave.degrees * np.cos(
            2 * np.pi * (wave.cycles * manner.tempo * (seconds + manner.ahead) + wave.phase)
        )
    for name in angles:
        angles[name] = angles[name] * manner.amplitude * (manner.scales or {}).get(name, 1.0)
        angles[name] = angles[name] + (manner.offsets or {}).get(name, 0.0)
    _sway(angles, manner, seconds)
    angles["spin"] = angles["spin"] + manner.turning * seconds
    return _on_the_body(angles, manner.left_handed), _flight(script, manner, seconds)


def _key_poses(script: Script, moments: np.ndarray, delay: float) -> dict[str, np.ndarray]:
    at = np.array([moment + delay * 4 * moment * (1 - moment) for moment, _ in script.poses])
    after = np.clip(np.searchsorted(at, moments, side="right"), 1, max(len(at) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(at) - 1)
    share = np.clip((moments - at[before]) / np.maximum(at[after] - at[before], 1e-9), 0.0, 1.0)
    eased = share**3 * (10 - 15 * share + 6 * share**2)
    angles = {}
    for name in ANGLES:
        keys = np.array([pose.get(name, 0.0) for _, pose in script.poses])
        angles[name] = keys[before] + eased * (keys[after] - keys[before])
    return angles


def _faded(wave: Wave, moments: np.ndarray) -> np.ndarray:
    begin, end = wave.during
    if (begin, end) == (0.0, 1.0):
        return np.ones_like(moments)
    return np.clip((moments - begin) / 0.1, 0, 1) * np.clip((end - moments) / 0.1, 0, 1)


def _sway(angles: dict[str, np.ndarray], manner: Manner, seconds: np.ndarray) -> None:
    for number, name in enumerate(("bend", "lean", "twist", "main_raise", "other_raise", "main_elbow", "other_elbow")):
        cycles = (0.23 + 0.07 * number) * manner.tempo
        angles[name] = angles[name] + manner.idle * np.sin(
            2 * np.pi * (cycles * (seconds + manner.ahead) + 0.3 * number)
        )


def _flight(script: Script, manner: Manner, seconds: np.ndarray) -> np.ndarray:
    """(n,) metres: parabolas, whose length follows from their height."""
    height = np.zeros_like(seconds)
    for leap in script.leaps:
        if leap.cycles:
            period = 1 / (leap.cycles * manner.tempo)
            top = leap.phase * period - manner.ahead
            away = (seconds - top + period / 2) % period - period / 2
        else:
            late = leap.at + manner.delay * 4 * leap.at * (1 - leap.at)
            away = seconds - late * script.seconds / manner.tempo
        height = np.maximum(height, leap.height * manner.amplitude - GRAVITY / 2 * away**2)
    return height


def _on_the_body(angles: dict[str, np.ndarray], left_handed: bool) -> dict[str, np.ndarray]:
    sides = {"main": "left", "other": "right"} if left_handed else {"main": "right", "other": "left"}
    mirrored = -1.0 if left_handed else 1.0
    body = {}
    for name, values in angles.items():
        limb, _, joint = name.partition("_")
        if joint in _HINGES:
            body[f"{sides[limb]}_{joint}"] = np.clip(values, 0.0, _FOLDED)
        elif joint:
            body[f"{sides[limb]}_{joint}"] = values
        else:
            body[name] = values * mirrored if name in ("twist", "lean", "look", "spin") else values
    return body
