"""Which OpenGL is used, and that several renderers live side by side."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from repdib_lightning.environments import rendering
from repdib_lightning.errors import UserError

SCENE = """<mujoco><worldbody><light pos="0 0 3"/><camera name="above" pos="0 0 2"/>
<geom name="ball" type="sphere" size="{size}" rgba="1 0 0 1"/></worldbody></mujoco>"""


@pytest.fixture
def ball():
    mujoco = rendering.prepare_rendering()

    def build(size: float):
        model = mujoco.MjModel.from_xml_string(SCENE.format(size=size))
        rendering.fast_quality(model, 24, 32)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return rendering.SceneRenderer(model, 24, 32), data

    return build


def run_python(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")} | variables
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


def test_importing_the_package_loads_no_simulator_and_sets_no_variable():
    done = run_python(
        "import os, sys, repdib_lightning.environments, repdib_lightning.environments.collect_robot_arm\n"
        "print([name for name in ('mujoco', 'dm_control', 'gymnasium', 'triton') if name in sys.modules])\n"
        "print('MUJOCO_GL' in os.environ)"
    )
    assert done.stdout.splitlines() == ["[]", "False"], done.stderr


def test_works_where_mujoco_was_imported_first_and_leaves_quietly():
    done = run_python(
        "import mujoco\n"
        "from repdib_lightning.environments import rendering\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        "renderer = rendering.SceneRenderer(model, 16, 16)\n"
        "print('drawn')"
    )
    assert (done.stdout.strip(), done.stderr) == ("drawn", "")


def test_triton_can_be_imported_after_a_picture_was_drawn():
    pytest.importorskip("triton")
    done = run_python(
        "from repdib_lightning.environments.rendering import SceneRenderer, prepare_rendering\n"
        "renderer = SceneRenderer(prepare_rendering().MjModel.from_xml_string('<mujoco/>'), 16, 16)\n"
        "import triton._C.libtriton\n"
        "print('alive')"
    )
    assert (done.returncode, done.stdout.strip()) == (0, "alive"), done.stderr


def test_backend_that_cannot_be_loaded_says_how_to_get_a_software_renderer():
    code = (
        "from repdib_lightning.environments.rendering import SceneRenderer, prepare_rendering\n"
        "from repdib_lightning.errors import UserError\n"
        "try:\n"
        "    mujoco = prepare_rendering()\n"
        "    SceneRenderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16)\n"
        "except UserError as error:\n"
        "    print(error)"
    )
    message = run_python(code, PYOPENGL_PLATFORM="glx").stdout
    assert "MUJOCO_GL=egl: cannot render" in message and "apt-get install libegl1" in message


def test_unknown_backend_names_the_nearest(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "elg")
    with pytest.raises(UserError, match=r"MUJOCO_GL=elg.*did you mean 'egl'"):
        rendering.prepare_rendering()


def test_mujoco_4_is_refused(monkeypatch):
    mujoco = rendering.prepare_rendering()
    monkeypatch.setattr(mujoco, "__version__", "4.0.1")
    with pytest.raises(UserError, match=r"mujoco 4.0.1 is installed.*>=3.17,<4"):
        rendering.prepare_rendering()


def test_closing_one_renderer_leaves_another_intact(ball):
    small, small_data = ball(0.2)
    before = small.picture(small_data, 0)
    large, large_data = ball(0.5)
    large_before = large.picture(large_data, 0)
    small.close()
    assert np.array_equal(large.picture(large_data, 0), large_before)
    del large
    again, again_data = ball(0.2)
    assert np.array_equal(again.picture(again_data, 0), before)


def test_geoms_are_where_their_colour_is(ball):
    renderer, data = ball(0.3)
    picture, geoms = renderer.picture_and_geoms(data, 0)
    assert picture.shape == (24, 32, 3) and geoms.shape == (24, 32)
    red = (picture[..., 0] > 40) & (picture[..., 1] < 40)
    assert set(np.unique(geoms)) == {-1, 0}
    assert ((geoms == 0) == red).mean() > 0.98
    assert np.array_equal(renderer.picture(data, 0), picture), "segmentation must not leave its flags behind"
