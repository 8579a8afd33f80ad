"""Films performances: a room that looks like its session, seen by two opposing cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from repdib_lightning.environments.activity_body import CAMERAS, PROPS, SIDES, Body
from repdib_lightning.environments.activity_motions import SCRIPTS
from repdib_lightning.environments.activity_people import Person, Session
from repdib_lightning.environments.activity_performance import RATE, Performance
from repdib_lightning.environments.rendering import SceneRenderer

_AIM = 0.85  # metres above the floor that cameras look at
_CLOTHING = {
    "shirt": ("waist", "chest", "left_upper_arm", "right_upper_arm"),
    "trousers": ("pelvis", "left_thigh", "right_thigh", "left_shin", "right_shin"),
    "shoes": ("left_foot", "right_foot"),
    "skin": ("head", "left_forearm", "right_forearm", "left_hand", "right_hand"),
}
_PROP_COLOURS = {
    "cup": (0.9, 0.9, 0.95),
    "phone": (0.05, 0.05, 0.08),
    "ball": (0.85, 0.3, 0.1),
    "load": (0.6, 0.45, 0.25),
}


@dataclass(frozen=True)
class Pillar:
    """Something that stands before a camera for a while.

    Attributes:
        camera: which one.
        during: moments between which it is there, as shares of the clip.
        aside: metres to the right of the middle, where it is seen amid the scene.
        width: of what it hides there, in metres.
        shade: 0 (black) to 1.
    """

    camera: str
    during: tuple[float, float]
    aside: float
    width: float
    shade: float


class Stage:
    """The renderer of this process.

    Args:
        body: any; all bodies that are filmed must have pictures of the same size.
        size: height and width of the pictures in pixels.
    """

    def __init__(self, body: Body, size: int) -> None:
        self._renderer = SceneRenderer(body.model, size, size)

    def film(
        self,
        body: Body,
        performance: Performance,
        look: Session,
        moments: np.ndarray,
        *,
        cameras: tuple[str, ...] = CAMERAS,
        pillars: tuple[Pillar, ...] = (),
    ) -> dict[str, np.ndarray]:
        """Camera -> (frames, 3, H, W) uint8, at some moments of the performance, (frames,) int64."""
        dress(body, performance.person)
        _furnish(body, performance, look)
        seen: dict[str, list[np.ndarray]] = {name: [] for name in cameras}
        for moment in moments:
            body.pose(performance.qpos[moment])
            _hand_over(body, performance, moment)
            for name in cameras:
                _place_pillar(body, look, name, [p for p in pillars if p.camera == name], moment / len(performance))
                picture = self._renderer.picture(body.data, body.model.camera(name).id, body.model)
                seen[name].append(picture.transpose(2, 0, 1))
        return {name: np.stack(pictures) for name, pictures in seen.items()}

    def close(self) -> None:
        """Free the graphics memory."""
        self._renderer.close()


def dress(body: Body, person: Person) -> None:
    """Colour a body as its person is dressed."""
    for clothing, parts in _CLOTHING.items():
        for part in parts:
            body.model.geom(f"body {part}").rgba = [*person.colours[clothing], 1]
    body.model.geom("hair").rgba = [*person.colours["hair"], 1]


def _furnish(body: Body, performance: Performance, look: Session) -> None:
    model, figure = body.model, performance.person.figure
    floor = model.geom("floor")
    floor.rgba, floor.matid = [*look.floor, 1], model.mat("tiles" if look.tiled else "plain").id
    for number in range(4):
        model.geom(f"wall_{number}").rgba = [*(look.wall * (1 - 0.1 * number)), 1]
    model.geom("ceiling").rgba = [*(0.6 + 0.4 * look.wall), 1]
    height = 0.36 * figure.height / 1.72 * figure.legs
    stool = model.geom("stool")
    stool.rgba, stool.pos, stool.size = [*look.stool, 1], [*performance.stool, height / 2], [0.17, height / 2, 0]
    model.light("lamp").dir, model.light("lamp").diffuse = look.lamp / np.linalg.norm(look.lamp), [look.brightness] * 3
    for name in CAMERAS:
        camera = model.camera(name)
        camera.pos, camera.quat, camera.fovy = *_camera_pose(look, name), look.view


def _hand_over(body: Body, performance: Performance, moment: int) -> None:
    """Show what is held at a moment, and hide all else."""
    script = SCRIPTS[performance.activity]
    main, other = SIDES if performance.manner.left_handed else SIDES[::-1]
    passed = (performance.started + moment / RATE) * performance.manner.tempo / script.seconds
    for prop in PROPS:
        held = prop == script.prop and passed < script.released
        sides = {"": held} if prop == "load" else {f"{main}_": held, f"{other}_": False}
        for side, shown in sides.items():
            body.model.geom(f"{side}{prop}").rgba = [*_PROP_COLOURS[prop], float(shown)]


def _place_pillar(body: Body, look: Session, camera: str, pillars: list[Pillar], share: float) -> None:
    geom = body.model.geom("pillar")
    geom.rgba = 0
    for pillar in pillars:
        if pillar.during[0] <= share < pillar.during[1]:
            position, _ = _camera_pose(look, camera)
            ahead = -position[:2] / np.linalg.norm(position[:2])
            nearness = 1 / np.linalg.norm(position[:2])  # it stands a metre before the camera
            beside = np.array([ahead[1], -ahead[0]]) * pillar.aside * nearness
            half = pillar.width / 2 * nearness
            geom.size, geom.rgba = [half, half, 2.4], [pillar.shade] * 3 + [1]
            body.data.geom_xpos[geom.id] = [*(position[:2] + ahead + beside), 2.4]


def _camera_pose(look: Session, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Position, (3,), and orientation, a quaternion, of a camera that looks at the middle of the room."""
    direction = np.radians(look.direction + (180 if name == "cam2" else 0))
    elevation = np.radians(look.elevation)
    back = np.array([np.cos(direction) * np.cos(elevation), np.sin(direction) * np.cos(elevation), np.sin(elevation)])
    right = np.array([-np.sin(direction), np.cos(direction), 0.0])
    axes = np.stack([right, np.cross(back, right), back], axis=1)
    return look.distance * back + [0, 0, _AIM], _quaternion(axes)


def _quaternion(axes: np.ndarray) -> np.ndarray:
    import mujoco

    found: Any = np.empty(4)
    mujoco.mju_mat2Quat(found, axes.ravel())
    return found
