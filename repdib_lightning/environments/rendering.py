"""Headless MuJoCo rendering: which OpenGL is used, fast settings, pictures and agent masks.

Pictures come from ``MUJOCO_GL=egl`` unless the variable is set already (``egl`` and ``osmesa`` are supported). It is
set by :func:`prepare_rendering`, when something is about to be rendered, never by importing this package.
"""

from __future__ import annotations

import atexit
import importlib
import os
import weakref
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from repdib_lightning.errors import UserError, nearest

DEFAULT_BACKEND = "egl"
BACKENDS = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa"}
SOFTWARE_HINT = (
    "a software renderer comes with `apt-get install libegl1 libgl1-mesa-dri` (MUJOCO_GL=egl) "
    "or `apt-get install libosmesa6` (MUJOCO_GL=osmesa)"
)


def prepare_rendering(*, threads: int | None = None) -> Any:
    """Choose the OpenGL backend and import MuJoCo.

    Args:
        threads: threads of the software rasteriser (0 draws in the calling thread, fastest at 64-84 px with one process
            a core); None leaves ``LP_NUM_THREADS`` as it is. Only effective before the process renders for the first
            time.

    Returns:
        The ``mujoco`` module.

    Raises:
        UserError: ``MUJOCO_GL`` names no headless backend, MuJoCo is missing or is version 4 or later, or the backend's
            library cannot be loaded.
    """
    _backend()
    if threads is not None:
        os.environ.setdefault("LP_NUM_THREADS", str(threads))
    _import_triton_first()
    try:
        mujoco = importlib.import_module("mujoco")
    except (ImportError, AttributeError) as error:
        raise no_renderer(error) from error
    _check_version(mujoco.__version__)
    return mujoco


def _import_triton_first() -> None:
    """Load triton, where it is installed, before any OpenGL driver.

    Mesa's software driver brings its own LLVM. When that is loaded first, triton's binds to it and importing triton
    (torch.compile, torchvision's models) ends the process with a segmentation fault; the other order works.
    """
    with suppress(ImportError):
        importlib.import_module("triton")


def _backend() -> str:
    backend = os.environ.setdefault("MUJOCO_GL", DEFAULT_BACKEND).lower().strip() or DEFAULT_BACKEND
    os.environ["MUJOCO_GL"] = backend
    if backend not in BACKENDS:
        raise UserError(f"MUJOCO_GL={backend}: not a headless renderer, {nearest(backend, BACKENDS)}")
    return backend


def _check_version(version: str) -> None:
    if int(version.split(".")[0]) >= 4:
        raise UserError(
            f"mujoco {version} is installed, but dm-control 1.0.50 works only with mujoco >=3.17,<4; make a fresh "
            "virtual environment with constraints.txt (version 4 leaves files behind that break version 3)"
        )


def no_renderer(error: BaseException) -> UserError:
    """Say that the chosen backend cannot be used, and where to get one."""
    backend = os.environ.get("MUJOCO_GL", DEFAULT_BACKEND)
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return UserError(f"MUJOCO_GL={backend}: cannot render ({reason}); {SOFTWARE_HINT}")


def _open_context(backend: str, height: int, width: int) -> Any:
    """An OpenGL context of the wanted backend, whatever MuJoCo chose when it was first imported."""
    try:
        return importlib.import_module(BACKENDS[backend]).GLContext(width, height)
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise no_renderer(error) from error


def fast_quality(model: Any, height: int, width: int) -> None:
    """Set a model (before its renderer is opened) to the fast look: no multi-sampling, no shadows, no reflections.

    At 64 px this is 20-50 times cheaper than MuJoCo's default, and differs by missing shadows and harder edges only.
    """
    model.vis.quality.offsamples = 0
    model.vis.quality.shadowsize = 0
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.light_castshadow[:] = 0
    model.mat_reflectance[:] = 0


class SceneRenderer:
    """Draws one MuJoCo model off-screen from its fixed cameras.

    Every call makes its own OpenGL context current first, so that closing one renderer never frees the objects of
    another one (MuJoCo's own ``Renderer`` does, silently). Still, one a process is the cheap way.

    Args:
        model: a compiled ``MjModel``; see :func:`fast_quality`.
        height, width: size of the pictures in pixels.
        effects: draw shadows and reflections, where the model has them.

    Raises:
        UserError: no OpenGL backend can be opened.
    """

    def __init__(self, model: Any, height: int, width: int, *, effects: bool = False) -> None:
        self._context: Any = None
        self._resources: Any = None
        self._mujoco = prepare_rendering()
        self.model, self.height, self.width = model, height, width
        self._context = _open_context(_backend(), height, width)
        # Registered after the backend's own exit handler, so run before it: nothing may be freed once EGL is shut down.
        self._at_exit = partial(_close_if_alive, weakref.ref(self))
        atexit.register(self._at_exit)
        self._context.make_current()
        self._resources = self._mujoco.MjrContext(model, self._mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._mujoco.mjr_setBuffer(self._mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._resources)
        self._scene = self._mujoco.MjvScene(model=model, maxgeom=model.ngeom + 100)
        self._options = self._mujoco.MjvOption()
        self._camera = self._mujoco.MjvCamera()
        self._camera.type = self._mujoco.mjtCamera.mjCAMERA_FIXED
        self._rectangle = self._mujoco.MjrRect(0, 0, width, height)
        flags = self._mujoco.mjtRndFlag
        self._scene.flags[flags.mjRND_SHADOW] = self._scene.flags[flags.mjRND_REFLECTION] = int(effects)
        self._geom_of_segment = np.empty(0, dtype=np.int64)
        self._segment_flags = [int(flags.mjRND_SEGMENT), int(flags.mjRND_IDCOLOR)]

    def upload_texture(self, texture: int) -> None:
        """Hand the current pixels (``model.tex_data``) of a texture to the graphics driver."""
        self._context.make_current()
        self._mujoco.mjr_uploadTexture(self.model, self._resources, texture)

    def upload_terrain(self, model: Any) -> None:
        """Hand the current height fields of a model like the renderer's own to the graphics driver."""
        self._context.make_current()
        for field in range(model.nhfield):
            self._mujoco.mjr_uploadHField(model, self._resources, field)

    def picture(self, data: Any, camera: int, model: Any = None) -> np.ndarray:
        """(H, W, 3) uint8: the scene in ``data`` seen from a camera of the model.

        Args:
            data: of the renderer's model, or of ``model``.
            camera: its number.
            model: one that was compiled from the same source, with other values; the renderer's own by default.
        """
        self._aim(data, camera, model)
        return self._draw()

    def picture_and_geoms(self, data: Any, camera: int, model: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) uint8 picture, and (H, W) int64: the geom seen at each pixel, -1 where there is none.

        Where a skin is seen, that is the first geom of the first body that it covers. Takes what :meth:`picture` takes.
        """
        self._aim(data, camera, model)
        picture = self._draw()
        self._scene.flags[self._segment_flags] = 1
        identity = self._draw().astype(np.int64)
        self._scene.flags[self._segment_flags] = 0
        segments = identity[..., 0] + (identity[..., 1] << 8) + (identity[..., 2] << 16)
        if len(self._geom_of_segment) != self._scene.ngeom + 1:
            self._geom_of_segment = self._list_segments()
        return picture, self._geom_of_segment[segments]

    def _list_segments(self) -> np.ndarray:
        """(segments + 1,) int64: geom of each number in a segmented picture; the scene's order of geoms is fixed."""
        kinds, model = self._mujoco.mjtObj, self.model
        lookup = np.full(self._scene.ngeom + 1, -1, dtype=np.int64)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == kinds.mjOBJ_GEOM.value:
                lookup[geom.segid + 1] = geom.objid
            elif geom.segid >= 0 and geom.objtype == kinds.mjOBJ_SKIN.value:
                lookup[geom.segid + 1] = model.body_geomadr[model.skin_bonebodyid[model.skin_boneadr[geom.objid]]]
        return lookup

    def _aim(self, data: Any, camera: int, model: Any) -> None:
        self._camera.fixedcamid = camera
        everything = self._mujoco.mjtCatBit.mjCAT_ALL.value
        model = self.model if model is None else model
        self._mujoco.mjv_updateScene(model, data, self._options, None, self._camera, everything, self._scene)

    def _draw(self) -> np.ndarray:
        pixels = np.empty((self.height, self.width, 3), dtype=np.uint8)
        self._context.make_current()
        self._mujoco.mjr_render(self._rectangle, self._scene, self._resources)
        self._mujoco.mjr_readPixels(pixels, None, self._rectangle, self._resources)
        return pixels[::-1]

    def close(self) -> None:
        """Free the graphics memory; the renderer is of no use afterwards."""
        if self._resources is not None:
            self._context.make_current()
            self._resources.free()
        if self._context is not None:
            self._context.free()
            atexit.unregister(self._at_exit)
        self._resources = self._context = None

    def __del__(self) -> None:
        self.close()


def _close_if_alive(renderer: weakref.ref[SceneRenderer]) -> None:
    alive = renderer()
    if alive is not None:
        alive.close()
