"""Pictures of a Control Suite task, and where in them a distractor shows through."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.environments.rendering import SceneRenderer, fast_quality, prepare_rendering
from repdib_lightning.errors import UserError, nearest

Quality = Literal["fast", "paper"]
Place = Literal["sky", "sky_floor", "side"]
QUALITIES, PLACES = ("fast", "paper"), ("sky", "sky_floor", "side")

_KEYS = ((255, 0, 255), (0, 255, 0))
"""Colours of the sky that is looked through. Only the first is used where pixels are not mixed by multi-sampling."""

_ROUND = {"fast": (12, 8), "paper": (28, 16)}
"""Slices and stacks that round geoms are drawn with; the second pair is MuJoCo's default."""


@dataclass(frozen=True)
class Seen:
    """What the camera sees.

    Attributes:
        picture: (H, W, 3), 0 to 255; black where it is seen through. uint8; float32 where pixels are mixed.
        through: (H, W, 1) share of each pixel, 0 to 1, that shows what is behind, float32; bool where nothing is mixed.
    """

    picture: np.ndarray
    through: np.ndarray

    def before(self, background: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8: this in front of a picture of the same size."""
        if self.through.dtype == bool:
            return np.where(self.through, background, self.picture)
        return np.clip(self.picture + self.through * background + 0.5, 0, 255).astype(np.uint8)


class ControlCamera:
    """Films a task with its own camera, as it is or with the sky (or sky and floor) cut out.

    The sky is painted in a key colour before the model is handed to the graphics driver. Without multi-sampling
    (``fast``) the pixels of that colour are the sky, exactly. With it (``paper``) the scene is drawn before two skies
    of opposite colours, and what differs is the share of the sky in each pixel.

    Args:
        task: any task of the kind that is filmed; its model is edited.
        size: height and width in pixels.
        quality: ``fast`` (no multi-sampling, no shadows, no reflections, coarser round shapes; 20-50 times cheaper than
            MuJoCo's default), or ``paper`` (four samples a pixel, shadows, reflections, as in V-D4RL's files).
        through: "", or what is seen through: ``sky`` or ``sky_floor``.

    Raises:
        UserError: unknown choices, a size out of range, a task without a sky, or no renderer.
    """

    def __init__(self, task: ControlTask, size: int, quality: Quality = "fast", through: str = "") -> None:
        check_picture(size, quality)
        self._quality, self._size, self._through = quality, size, through
        self._number = task.camera
        model = task.model
        self.dress(task)
        sky = self._sky(model) if through else -1
        keys = (_KEYS if quality == "paper" else _KEYS[:1]) if through else ((),)
        self._renderers = []
        for key in keys:
            if key:
                _paint(model, sky, key)
            self._renderers.append(SceneRenderer(model, size, size, effects=quality == "paper"))
        self._agent = model.body_weldid[model.geom_bodyid] != 0
        self._terrain = model.hfield_data.copy()

    def dress(self, task: ControlTask) -> None:
        """Set a task's model to this camera's quality; needed once for every task that it films."""
        model, quality = task.model, self._quality
        if quality == "fast":
            fast_quality(model, self._size, self._size)
        else:
            model.vis.quality.offsamples, model.vis.quality.shadowsize = 4, 256
            model.vis.global_.offwidth = model.vis.global_.offheight = self._size
        model.vis.quality.numslices, model.vis.quality.numstacks = _ROUND[quality]
        if self._through == "sky_floor":
            floors = _floors(model)
            model.geom_matid[floors] = -1
            model.geom_rgba[floors] = 0.0

    def see(self, task: ControlTask) -> Seen:
        """Film the task as it stands."""
        self._follow_terrain(task.model)
        pictures = [renderer.picture(task.data, self._number, task.model) for renderer in self._renderers]
        if not self._through:
            return Seen(pictures[0], np.zeros((self._size, self._size, 1), bool))
        if len(pictures) == 1:
            through = (pictures[0] == np.array(_KEYS[0], np.uint8)).all(-1, keepdims=True)
            return Seen(np.where(through, np.uint8(0), pictures[0]), through)
        first, second = (picture.astype(np.float32) for picture in pictures)
        share = np.abs(first - second).mean(-1, keepdims=True) / 255.0
        return Seen(np.clip(first - share * np.array(_KEYS[0], np.float32), 0, 255), share)

    def agent_mask(self, task: ControlTask) -> np.ndarray:
        """(H, W) bool: pixels of whatever can move."""
        self._follow_terrain(task.model)
        _, geoms = self._renderers[0].picture_and_geoms(task.data, self._number, task.model)
        return np.where(geoms >= 0, self._agent[geoms], False)

    def _follow_terrain(self, model: Any) -> None:
        """Some tasks draw another terrain for every episode; it lies in the graphics memory."""
        if not np.array_equal(model.hfield_data, self._terrain):
            self._terrain = model.hfield_data.copy()
            for renderer in self._renderers:
                renderer.upload_terrain(model)

    def close(self) -> None:
        """Free the graphics memory."""
        for renderer in self._renderers:
            renderer.close()

    @staticmethod
    def _sky(model: Any) -> int:
        kind = prepare_rendering().mjtTexture.mjTEXTURE_SKYBOX.value
        found = np.flatnonzero(model.tex_type == kind)
        if not len(found):
            raise UserError("place: this task has no sky; put the distractor at its side (place side)")
        return int(found[0])


def check_picture(size: int, quality: str) -> None:
    """Raise UserError for a size in pixels that is out of range, or an unknown quality."""
    if quality not in QUALITIES:
        raise UserError(f"quality={quality}: unknown, {nearest(quality, QUALITIES)}")
    if not 16 <= size <= 512:
        raise UserError(f"image_size={size}: must be from 16 to 512")


def _paint(model: Any, texture: int, colour: tuple[int, ...]) -> None:
    size = model.tex_width[texture] * model.tex_height[texture]
    channels = model.tex_nchannel[texture]
    start = model.tex_adr[texture]
    model.tex_data[start : start + size * channels].reshape(-1, channels)[:, :3] = colour


def _floors(model: Any) -> np.ndarray:
    """Numbers of the geoms that never move and have no end: planes and height fields of the world."""
    kinds = prepare_rendering().mjtGeom
    endless = np.isin(model.geom_type, [kinds.mjGEOM_PLANE.value, kinds.mjGEOM_HFIELD.value])
    return np.flatnonzero(endless & (model.geom_bodyid == 0))
