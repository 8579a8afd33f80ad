"""What the scene's pictures show: the arm where it should be, every noise source, and masks that fit."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from repdib_lightning.environments.robot_arm_scene import CAMERAS, CELLS, Moment, RobotArmScene, cell_target

DARK = np.zeros((64, 64, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def scene():
    scene = RobotArmScene(64)
    yield scene
    scene.close()


@pytest.fixture
def moment():
    return Moment(4, np.zeros(6), DARK, np.full((3, 3), 0.2), False, 0.5, 0.5)


def changed(scene: RobotArmScene, one: Moment, other: Moment) -> dict[str, np.ndarray]:
    """Camera -> (H, W): the largest change of a channel."""
    before, after = scene.pictures(one), scene.pictures(other)
    return {name: np.abs(before[name].astype(int) - after[name]).max(axis=0) for name in CAMERAS}


def test_the_hand_reaches_every_cell(scene):
    assert all(np.linalg.norm(scene.fingertips(cell) - cell_target(cell)) < 1e-4 for cell in range(CELLS))
    targets = np.array([cell_target(cell) for cell in range(CELLS)])
    assert (np.diff(targets.reshape(3, 3, 3)[:, :, 0], axis=0) > 0.1).all(), "rows go forward, away from the base"
    assert (np.diff(targets.reshape(3, 3, 3)[:, :, 1], axis=1) < -0.1).all(), "columns go from left to right"


def test_pictures_are_a_function_of_the_moment(scene, moment):
    first = scene.pictures(moment)
    scene.pictures(Moment(0, np.full(6, 0.1), ~DARK, np.ones((3, 3)), True, 1.0, 0.0))
    again, _ = scene.pictures_and_masks(moment)
    assert all(np.array_equal(first[name], again[name]) for name in CAMERAS)
    assert all(first[name].shape == (3, 64, 64) and first[name].dtype == np.uint8 for name in CAMERAS)


def test_the_arm_is_visible_in_every_cell_and_the_mask_finds_it(scene, moment):
    masks = [scene.pictures_and_masks(dataclasses.replace(moment, cell=cell))[1] for cell in range(CELLS)]
    for name in CAMERAS:
        assert all(mask[name].mean() > 0.015 for mask in masks)
    for cell in range(CELLS):
        other = (cell + 4) % CELLS
        difference = changed(scene, dataclasses.replace(moment, cell=cell), dataclasses.replace(moment, cell=other))
        for name in CAMERAS:
            union = masks[cell][name] | masks[other][name]
            moved = masks[cell][name] ^ masks[other][name]
            assert (difference[name][~union] == 0).all(), "only pixels of the arm change with the cell"
            assert (difference[name][moved] > 4).mean() > 0.9, "pixels under one mask only show it or what is behind"


def test_each_noise_source_is_visible_and_in_its_place(scene, moment):
    masks = scene.pictures_and_masks(moment)[1]
    replaced = {
        "tv": ~DARK,
        "lamps": np.array([[1.0, 0.0, 0.0]] * 3),
        "flash": True,
        "ambient": 1.0,
        "warmth": 1.0,
    }
    seen = {key: changed(scene, moment, dataclasses.replace(moment, **{key: new})) for key, new in replaced.items()}
    for name in CAMERAS:
        tv = seen["tv"][name]
        assert 0.1 < (tv > 50).mean() < 0.4, "the TV is large enough to matter, and bounded"
        assert (tv[masks[name]] == 0).all(), "the TV shows behind the arm"
        assert (seen["lamps"][name] > 50).sum() > 20
        assert (seen["flash"][name] > 20).mean() > 0.2
        assert (seen["ambient"][name] > 20).mean() > 0.4
        assert (seen["warmth"][name] > 5).mean() > 0.4


def test_the_tv_faces_the_front_camera_the_right_way_round(scene, moment):
    """Red at the left, green at the right, blue along the bottom; the top camera stands on its head for the TV."""
    picture = DARK.copy()
    picture[:40, :32, 0] = picture[:40, 32:, 1] = picture[40:, :, 2] = 255
    columns, rows = np.arange(64), np.arange(64)[:, None]
    for name, upright in (("front", 1), ("top", -1)):
        shown = scene.pictures(dataclasses.replace(moment, tv=picture))[name].astype(int)
        lit = shown - scene.pictures(moment)[name] > 80
        across, down = ((positions * lit).sum(axis=(1, 2)) / lit.sum(axis=(1, 2)) for positions in (columns, rows))
        assert upright * (across[1] - across[0]) > 8, "red left of green"
        assert upright * (down[2] - down[0]) > 3, "blue below red"


def test_joint_noise_moves_the_arm_a_little(scene, moment):
    noisy = dataclasses.replace(moment, joint_noise=np.full(6, 0.03))
    plain, shaken = scene.pictures_and_masks(moment)[1], scene.pictures_and_masks(noisy)[1]
    overlap = [(plain[n] & shaken[n]).sum() / (plain[n] | shaken[n]).sum() for n in CAMERAS]
    assert all(0.4 < share < 1.0 for share in overlap)
