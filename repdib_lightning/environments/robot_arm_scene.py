"""The robot arm's scene: a Jaco arm over a table with a 3x3 grid, a TV, three lamps, a flash and drifting daylight.

Kinematic only: the arm is posed by inverse kinematics, once a cell. The meshes come with dm-control (Kinova Jaco).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from repdib_lightning.environments.rendering import SceneRenderer, fast_quality, prepare_rendering

CAMERAS = ("front", "top")
CELLS = 9
LAMPS = 3
TV_SIZE = 64
REACH = np.array([0.33, 0.50, 0.67])
SIDES = np.array([0.22, 0.0, -0.22])
HAND_HEIGHT = 0.17
"""Grid: metres in front of the base (row 0 is nearest), metres to its left, height of the fingertips."""

_REST_POSE = np.array([4.71, 2.9, 1.2, 4.3, 1.6, 1.0])
_SCENE = """
<mujoco model="robot_arm">
  <visual>
    <headlight ambient="0.3 0.3 0.3" diffuse="0.3 0.3 0.3" specular="0 0 0"/>
    <map znear="0.02" zfar="20"/>
    <quality numslices="12" numstacks="8" numquads="6"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.55 0.6 0.65" rgb2="0.3 0.32 0.36"
             width="32" height="32"/>
    <texture name="tv" type="2d" builtin="flat" rgb1="0 0 0" width="{tv}" height="{tv}"/>
    <material name="tv" texture="tv" emission="0.75" specular="0" texuniform="false"/>
    <material name="bulb" emission="0.85" specular="0"/>
    <material name="table" rgba="0.42 0.36 0.30 1" specular="0"/>
    <material name="floor" rgba="0.5 0.5 0.5 1" specular="0"/>
    <material name="frame" rgba="0.08 0.08 0.08 1" specular="0"/>
  </asset>
  <worldbody>
    <light name="daylight" directional="true" pos="0 0 3" dir="-0.3 0.2 -1" diffuse="0.4 0.4 0.4" specular="0 0 0"/>
    <light name="flash" pos="1.0 0.9 1.3" dir="-0.5 -0.9 -1.0" diffuse="0 0 0" specular="0 0 0" attenuation="1 0 0"/>
    <light name="lamp_light_0" pos="0.3 0.62 0.35" dir="0 -1 0"
           cutoff="90" diffuse="0 0 0" specular="0 0 0" attenuation="0.5 0 2"/>
    <light name="lamp_light_1" pos="0.3 -0.62 0.35" dir="0 1 0"
           cutoff="90" diffuse="0 0 0" specular="0 0 0" attenuation="0.5 0 2"/>
    <light name="lamp_light_2" pos="0.85 0.5 0.35" dir="-0.5 -0.8 0"
           cutoff="90" diffuse="0 0 0" specular="0 0 0" attenuation="0.5 0 2"/>
    <camera name="front" pos="1.6 0 1.0" xyaxes="0 1 0 -0.5 0 0.866" fovy="46"/>
    <camera name="top" pos="0.27 0 1.7" xyaxes="0 -1 0 1 0 0" fovy="50"/>
    <geom name="floor" type="plane" size="4 4 1" pos="0 0 -0.5" material="floor"/>
    <geom name="table" type="box" size="0.5 0.52 0.02" pos="0.45 0 -0.02" material="table"/>
    <body name="screen" pos="-0.33 0 0.36" xyaxes="0 1 0 -0.707 0 0.707">
      <geom name="bezel" type="box" size="0.63 0.34 0.02" pos="0 0 -0.012" material="frame"/>
      <geom name="tv" type="box" size="0.60 0.31 0.02" material="tv"/>
    </body>
    <geom name="lamp_0" type="sphere" size="0.075" pos="0.30 0.50 0.08" material="bulb"/>
    <geom name="lamp_1" type="sphere" size="0.075" pos="0.30 -0.50 0.08" material="bulb"/>
    <geom name="lamp_2" type="sphere" size="0.075" pos="0.72 0.48 0.08" material="bulb"/>
    <geom name="flash" type="sphere" size="0.06" pos="0.72 -0.48 0.08" material="bulb"/>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class Moment:
    """Everything that one picture of the scene depends on.

    Attributes:
        cell: 0..8, row-major: ``3 * row + column``, row 0 nearest to the base, column 0 left.
        joint_noise: (6,) radians added to the joints of the cell's pose.
        tv: (64, 64, 3) uint8, the TV's picture.
        lamps: (3, 3) rgb of the lamps in [0, 1].
        flash: whether the flash is on.
        ambient: daylight, 0 (dusk) to 1 (noon).
        warmth: tint of the daylight, 0 (blue) to 1 (orange).
    """

    cell: int
    joint_noise: np.ndarray
    tv: np.ndarray
    lamps: np.ndarray
    flash: bool
    ambient: float
    warmth: float


class RobotArmScene:
    """The compiled scene and its renderer; a function from a :class:`Moment` to pictures and arm masks.

    Args:
        image_size: height and width of the pictures in pixels.

    Raises:
        UserError: nothing can be rendered here (see :func:`prepare_rendering`).
    """

    def __init__(self, image_size: int = 64) -> None:
        self._mujoco = prepare_rendering()
        self.image_size = image_size
        self._model = _compile_scene(self._mujoco)
        fast_quality(self._model, image_size, image_size)
        self._data = self._mujoco.MjData(self._model)
        self._poses = _solve_poses(self._mujoco, self._model)
        self._cameras = [self._model.camera(name).id for name in CAMERAS]
        self._tv = self._model.texture("tv").id
        self._arm = np.array(
            [self._model.body(body).name.startswith("jaco_arm/") for body in self._model.geom_bodyid] + [False]
        )
        self._renderer = SceneRenderer(self._model, image_size, image_size)

    def _show(self, moment: Moment) -> None:
        model, data = self._model, self._data
        data.qpos[:] = self._poses[moment.cell]
        data.qpos[:6] += moment.joint_noise
        self._mujoco.mj_kinematics(model, data)
        self._mujoco.mj_comPos(model, data)
        tint = np.array([0.75 + 0.5 * moment.warmth, 1.0, 1.25 - 0.5 * moment.warmth])
        model.vis.headlight.ambient[:] = tint * (0.16 + 0.30 * moment.ambient)
        model.vis.headlight.diffuse[:] = tint * (0.15 + 0.15 * moment.ambient)
        model.light("daylight").diffuse[:] = tint * (0.1 + 0.5 * moment.ambient)
        for lamp in range(LAMPS):
            model.geom(f"lamp_{lamp}").rgba[:3] = moment.lamps[lamp]
            model.light(f"lamp_light_{lamp}").diffuse[:] = 0.9 * moment.lamps[lamp]
        model.geom("flash").rgba[:3] = 1.0 if moment.flash else 0.1
        model.light("flash").diffuse[:] = 0.55 if moment.flash else 0.0
        self._mujoco.mj_camlight(model, data)
        texture = model.texture("tv")
        start = int(texture.adr[0])
        model.tex_data[start : start + moment.tv.size] = moment.tv.reshape(-1)
        self._renderer.upload_texture(self._tv)

    def pictures(self, moment: Moment) -> dict[str, np.ndarray]:
        """Camera name -> (3, H, W) uint8."""
        self._show(moment)
        views = (self._renderer.picture(self._data, camera) for camera in self._cameras)
        return {name: _channels_first(view) for name, view in zip(CAMERAS, views, strict=True)}

    def pictures_and_masks(self, moment: Moment) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Camera name -> (3, H, W) uint8, and camera name -> (H, W) bool: the pixels that show the arm."""
        self._show(moment)
        pictures, masks = {}, {}
        for name, camera in zip(CAMERAS, self._cameras, strict=True):
            picture, geoms = self._renderer.picture_and_geoms(self._data, camera)
            pictures[name], masks[name] = _channels_first(picture), self._arm[geoms]
        return pictures, masks

    def fingertips(self, cell: int) -> np.ndarray:
        """(3,) metres: where the hand is in a cell, without joint noise."""
        self._data.qpos[:] = self._poses[cell]
        self._mujoco.mj_kinematics(self._model, self._data)
        return self._data.site_xpos[_hand_site(self._model)].copy()

    def close(self) -> None:
        """Free the graphics memory."""
        self._renderer.close()


def _channels_first(picture: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(picture.transpose(2, 0, 1))


def _compile_scene(mujoco: Any) -> Any:
    from dm_control import mjcf
    from dm_control.entities.manipulators.kinova import JacoArm, JacoHand

    scene = mjcf.from_xml_string(_SCENE.format(tv=TV_SIZE))
    arm = JacoArm()
    arm.attach(JacoHand())
    for shade, rgba in (("dark_gray", (0.85, 0.85, 0.85, 1)), ("light_gray", (0.9, 0.45, 0.1, 1))):
        for material in arm.mjcf_model.find_all("material"):
            if material.name == shade:
                material.rgba = rgba
    scene.attach(arm.mjcf_model)
    return mujoco.MjModel.from_xml_string(scene.to_xml_string(), scene.get_assets())


def _hand_site(model: Any) -> int:
    return next(i for i in range(model.nsite) if model.site(i).name.endswith("pinchsite"))


def cell_target(cell: int) -> np.ndarray:
    """(3,) metres: where the fingertips belong in a cell."""
    return np.array([REACH[cell // 3], SIDES[cell % 3], HAND_HEIGHT])


def _solve_poses(mujoco: Any, model: Any) -> np.ndarray:
    """(9, nq): joint angles of each cell, fingers pointing down, by damped least squares from a rest pose."""
    data = mujoco.MjData(model)
    site = _hand_site(model)
    down = np.array([0.0, 0.0, -1.0])
    poses = np.empty((CELLS, model.nq))
    for cell in range(CELLS):
        data.qpos[:] = 0.6
        data.qpos[:6] = _REST_POSE
        for _ in range(300):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            move, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jacSite(model, data, move, turn, site)
            pointing = data.site_xmat[site].reshape(3, 3)[:, 2]
            error = np.concatenate([cell_target(cell) - data.site_xpos[site], 0.3 * np.cross(pointing, down)])
            jacobian = np.concatenate([move, 0.3 * turn])[:, :6]
            step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), error)
            data.qpos[:6] += np.clip(step, -0.2, 0.2)
        poses[cell] = data.qpos
    return poses
