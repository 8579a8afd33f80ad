"""The body of a simulated person, and the room: a jointed figure of few polygons that is posed, never simulated.

With all joints at zero it stands upright, arms hanging, and faces +x; its left is +y. Joints are named by what a
positive angle does. Those of a left limb are mirrored, so that the same angles give the mirrored pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from repdib_lightning.environments.rendering import fast_quality, prepare_rendering

TRUNK = ("bend", "twist", "lean", "nod", "look")
"""Forward at the waist, to the left about the vertical, to the right; the head forward, and to the left."""

LIMB = ("raise", "spread", "turn", "elbow", "hip", "splay", "knee", "ankle")
"""Upper arm forward, outward, inward about itself; forearm up; thigh forward, outward; shin back; toes up."""

SIDES = ("left", "right")
CAMERAS = ("cam1", "cam2")
PROPS = ("cup", "phone", "ball", "load")

_ROOM = """
<mujoco model="activities">
  <visual>
    <headlight ambient="0.3 0.3 0.3" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
    <map znear="0.02" zfar="30"/>
    <quality numslices="9" numstacks="5" numquads="4"/>
  </visual>
  <asset>
    <texture name="tiles" type="2d" builtin="checker" rgb1="1 1 1" rgb2="0.72 0.72 0.72" width="32" height="32"/>
    <material name="tiles" texture="tiles" texrepeat="6 6" specular="0"/>
    <material name="plain" specular="0"/>
  </asset>
  <worldbody>
    <light name="lamp" directional="true" pos="0 0 4" dir="0 0 -1" diffuse="0.6 0.6 0.6" specular="0 0 0"/>
    <camera name="cam1"/>
    <camera name="cam2"/>
    <geom name="floor" type="plane" size="7 7 1" material="tiles"/>
    <geom name="wall_0" type="box" size="0.05 7 2.5" pos="7 0 2.5" material="plain"/>
    <geom name="wall_1" type="box" size="0.05 7 2.5" pos="-7 0 2.5" material="plain"/>
    <geom name="wall_2" type="box" size="7 0.05 2.5" pos="0 7 2.5" material="plain"/>
    <geom name="wall_3" type="box" size="7 0.05 2.5" pos="0 -7 2.5" material="plain"/>
    <geom name="ceiling" type="box" size="7 7 0.05" pos="0 0 5" material="plain"/>
    <geom name="stool" type="cylinder" size="0.17 0.2" pos="1 0 0.2" material="plain"/>
    <geom name="pillar" type="box" size="0.1 0.1 2.5" pos="1 1 2.5" material="plain" rgba="0 0 0 0"/>
    {figure}
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class Figure:
    """Proportions of a person.

    Attributes:
        height: metres.
        girth, legs, arms: thickness, and lengths relative to the height; 1 is average.
    """

    height: float = 1.72
    girth: float = 1.0
    legs: float = 1.0
    arms: float = 1.0


class Body:
    """A compiled room with one person in it.

    Attributes:
        model, data: of MuJoCo.
        columns: joint -> its place in ``qpos``; all angles in radians, ``x``, ``y`` and ``z`` in metres.
        solid: geoms that cannot sink into the floor.
    """

    def __init__(self, figure: Figure, size: int) -> None:
        self._mujoco = prepare_rendering()
        self.model = self._mujoco.MjModel.from_xml_string(_ROOM.format(figure=_figure(figure)))
        fast_quality(self.model, size, size)
        self.data = self._mujoco.MjData(self.model)
        joints = [self.model.joint(number) for number in range(self.model.njnt)]
        self.columns = {joint.name: int(joint.qposadr[0]) for joint in joints}
        worn = [self.model.geom(number).name.split(" ")[0] for number in range(self.model.ngeom)]
        self.solid = np.array([number for number, name in enumerate(worn) if name == "body"])
        self._feet = [self.model.body(f"{side}_foot").id for side in SIDES]

    def pose(self, qpos: np.ndarray) -> None:
        """Take a pose, (nq,), and place cameras and lights, so that it can be drawn."""
        self.data.qpos[:] = qpos
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_comPos(self.model, self.data)
        self._mujoco.mj_camlight(self.model, self.data)

    def track(self, qpos: np.ndarray, sites: tuple[str, str]) -> Track:
        """Take one pose after the other.

        Args:
            qpos: (n, nq).
            sites: what is followed.
        """
        chosen = [self.model.site(name).id for name in sites]
        data, count = self.data, len(qpos)
        centres, axes = np.empty((count, len(self.solid))), np.empty((count, len(self.solid)))
        feet, places, turns = np.empty((count, 2, 3)), np.empty((count, 2, 3)), np.empty((count, 2, 9))
        for moment in range(count):
            data.qpos[:] = qpos[moment]
            self._mujoco.mj_kinematics(self.model, data)
            centres[moment], axes[moment] = data.geom_xpos[self.solid, 2], data.geom_xmat[self.solid, 8]
            feet[moment] = data.xpos[self._feet]
            places[moment], turns[moment] = data.site_xpos[chosen], data.site_xmat[chosen]
        radius, half = self.model.geom_size[self.solid, :2].T
        lowest = (centres - np.abs(axes) * half - radius).min(axis=1)
        return Track(lowest, feet, places, turns.reshape(count, 2, 3, 3))


@dataclass(frozen=True)
class Track:
    """Where parts of a body are over n moments.

    Attributes:
        lowest: (n,) height of its lowest point.
        feet: (n, 2, 3) left and right ankle.
        places: (n, 2, 3) of the followed sites.
        turns: (n, 2, 3, 3) their axes, as columns.
    """

    lowest: np.ndarray
    feet: np.ndarray
    places: np.ndarray
    turns: np.ndarray


def _figure(figure: Figure) -> str:
    """The person as MJCF. Every solid part is a capsule or a sphere named ``body ...``."""
    unit = figure.height / 1.72
    thick = unit * figure.girth

    def capsule(name: str, ends: tuple[float, ...], radius: float) -> str:
        return f'<geom name="body {name}" type="capsule" fromto="{_row(ends, unit)}" size="{radius * thick:.4f}"/>'

    legs = "".join(_leg(side, figure.legs, unit, capsule) for side in SIDES)
    arms = "".join(_arm(side, figure.arms, unit, capsule) for side in SIDES)
    return f"""
    <body name="pelvis">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="spin" axis="0 0 1"/><joint name="tip" axis="0 1 0"/>
      {capsule("pelvis", (0, -0.08, 0, 0, 0.08, 0), 0.1)}
      {_site("left_phone", (0.02, 0.17, 0.02), "0 0 -1 -1 0 0", unit)}
      {_site("right_phone", (0.02, -0.17, 0.02), "0 0 -1 1 0 0", unit)}
      {legs}
      <body name="chest" pos="{_row((0, 0, 0.1), unit)}">
        <joint name="lean" axis="1 0 0"/><joint name="bend" axis="0 1 0"/><joint name="twist" axis="0 0 1"/>
        {capsule("waist", (0, -0.06, 0.06, 0, 0.06, 0.06), 0.1)}
        {capsule("chest", (0, -0.1, 0.28, 0, 0.1, 0.28), 0.12)}
        <geom name="load" type="box" size="{_row((0.13, 0.17, 0.12), unit)}" pos="{_row((0.34, 0, 0.12), unit)}"/>
        {arms}
        <body name="head" pos="{_row((0, 0, 0.42), unit)}">
          <joint name="nod" axis="0 1 0"/><joint name="look" axis="0 0 1"/>
          <geom name="body head" type="sphere" size="{0.11 * unit:.4f}" pos="{_row((0.01, 0, 0.16), unit)}"/>
          <geom name="hair" type="sphere" size="{0.11 * unit:.4f}" pos="{_row((-0.025, 0, 0.185), unit)}"/>
        </body>
      </body>
    </body>"""


def _leg(side: str, legs: float, unit: float, capsule: Any) -> str:
    out = 1 if side == "left" else -1
    thigh, shin = 0.42 * legs, 0.4 * legs
    return f"""
    <body name="{side}_thigh" pos="{_row((0, 0.09 * out, -0.04), unit)}">
      <joint name="{side}_hip" axis="0 -1 0"/><joint name="{side}_splay" axis="{out} 0 0"/>
      {capsule(f"{side}_thigh", (0, 0, -0.02, 0, 0, -thigh), 0.075)}
      <body name="{side}_shin" pos="{_row((0, 0, -thigh), unit)}">
        <joint name="{side}_knee" axis="0 1 0"/>
        {capsule(f"{side}_shin", (0, 0, 0, 0, 0, -shin), 0.055)}
        <body name="{side}_foot" pos="{_row((0, 0, -shin), unit)}">
          <joint name="{side}_ankle" axis="0 -1 0"/>
          {capsule(f"{side}_foot", (-0.04, 0, -0.03, 0.15, 0, -0.03), 0.045)}
        </body>
      </body>
    </body>"""


def _arm(side: str, arms: float, unit: float, capsule: Any) -> str:
    out = 1 if side == "left" else -1
    upper, fore = 0.28 * arms, 0.25 * arms
    held = (0.02, 0, -fore - 0.09)
    return f"""
    <body name="{side}_upper_arm" pos="{_row((0, 0.2 * out, 0.34), unit)}">
      <joint name="{side}_raise" axis="0 -1 0"/><joint name="{side}_spread" axis="{out} 0 0"/>
      <joint name="{side}_turn" axis="0 0 {-out}"/>
      {capsule(f"{side}_upper_arm", (0, 0, 0, 0, 0, -upper), 0.05)}
      <body name="{side}_forearm" pos="{_row((0, 0, -upper), unit)}">
        <joint name="{side}_elbow" axis="0 -1 0"/>
        {capsule(f"{side}_forearm", (0, 0, 0, 0, 0, -fore), 0.04)}
        <geom name="body {side}_hand" type="sphere" size="{0.055 * unit:.4f}" pos="{_row((0, 0, -fore - 0.05), unit)}"/>
        {_site(f"{side}_watch", (0, 0.04 * out, -fore + 0.02), f"0 0 -1 {-out} 0 0", unit)}
        <geom name="{side}_cup" type="cylinder" size="{_row((0.04, 0.06), unit)}" pos="{_row(held, unit)}"/>
        <geom name="{side}_phone" type="box" size="{_row((0.02, 0.04, 0.08), unit)}" pos="{_row(held, unit)}"/>
        <geom name="{side}_ball" type="sphere" size="{0.09 * unit:.4f}" pos="{_row((0, 0, -fore - 0.16), unit)}"/>
      </body>
    </body>"""


def _site(name: str, place: tuple[float, ...], axes: str, unit: float) -> str:
    return f'<site name="{name}" pos="{_row(place, unit)}" xyaxes="{axes}"/>'


def _row(numbers: tuple[float, ...], unit: float) -> str:
    return " ".join(f"{number * unit:.4f}" for number in numbers)
