"""An agent behind the wrapper sees what the encoder makes of stacked frames, and nothing of the last episode."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Space
from gymnasium.utils.env_checker import check_env

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import FrozenEncoder, load_encoder, save_bundle
from repdib_lightning.export.gymnasium_wrapper import EncodeObservation
from repdib_lightning.records import ArraySpec, DataSpec

PICTURE = Box(0, 255, (12, 12, 3), np.uint8)
ONE = DataSpec({"front": ArraySpec((9, 12, 12))}, frame_stack=3)
TWO = DataSpec({"front": ArraySpec((6, 12, 12)), "top": ArraySpec((6, 12, 12))}, frame_stack=2)


class Noise(gymnasium.Env[Any, Any]):
    """Random pictures, rendered again and again into the same array."""

    def __init__(self, space: Space[Any]) -> None:
        self.observation_space, self.action_space = space, Discrete(2)
        self.given: list[Any] = []

    def _draw(self) -> Any:
        observation = self.observation_space.sample()
        keep = {k: v.copy() for k, v in observation.items()} if isinstance(observation, dict) else observation.copy()
        self.given.append(keep)
        if isinstance(observation, dict):
            return observation
        if not hasattr(self, "_canvas"):
            self._canvas = np.empty_like(observation)
        self._canvas[...] = observation
        return self._canvas

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.given.clear()
        return self._draw(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self._draw(), 0.0, False, False, {}


def encoder_for(folder: Path, spec: DataSpec) -> FrozenEncoder:
    encoder = ConvolutionalEncoder(spec, features=8, channels=2, strides=[2])
    return load_encoder(save_bundle(folder, encoder, Identity(8), training={}, data={}))


def expected(encoder: FrozenEncoder, frames: list[np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
    return encoder.encode(np.concatenate([frame.transpose(2, 0, 1) for frame in frames])).numpy()


def test_frames_are_stacked_as_in_training(tmp_path: Path) -> None:
    encoder = encoder_for(tmp_path / "b", ONE)
    env = Noise(PICTURE)
    wrapped = EncodeObservation(env, encoder)
    for seed in (0, 1):
        latent, _ = wrapped.reset(seed=seed)
        a = env.given[0]
        np.testing.assert_array_equal(latent, expected(encoder, [a, a, a]))
        latent = wrapped.step(0)[0]
        np.testing.assert_array_equal(latent, expected(encoder, [a, a, env.given[1]]))
        for _ in range(3):
            latent = wrapped.step(0)[0]
        np.testing.assert_array_equal(latent, expected(encoder, env.given[-3:]))


@pytest.mark.filterwarnings("ignore::UserWarning:gymnasium")
def test_the_wrapped_environment_is_a_valid_one(tmp_path: Path) -> None:
    wrapped = EncodeObservation(Noise(PICTURE), encoder_for(tmp_path / "b", ONE))
    assert wrapped.observation_space == Box(-np.inf, np.inf, (8,), np.float32)
    check_env(wrapped, skip_render_check=True)


def test_views_of_a_dictionary_are_taken_by_name(tmp_path: Path) -> None:
    encoder = encoder_for(tmp_path / "b", TWO)
    first = Box(0, 255, (3, 12, 12), np.uint8)
    env = Noise(Dict({"top": first, "front": PICTURE, "touch": Box(-1, 1, (4,))}))
    wrapped = EncodeObservation(env, encoder)
    wrapped.reset(seed=0)
    latent = wrapped.step(0)[0]
    stacks = {
        "front": np.concatenate([g["front"].transpose(2, 0, 1) for g in env.given]),
        "top": np.concatenate([g["top"] for g in env.given]),
    }
    np.testing.assert_array_equal(latent, encoder.encode(stacks).numpy())


def test_stacks_of_the_environment_are_kept(tmp_path: Path) -> None:
    encoder = encoder_for(tmp_path / "b", ONE)
    env = Noise(Box(0, 255, (9, 12, 12), np.uint8))
    wrapped = EncodeObservation(env, encoder)
    wrapped.reset(seed=0)
    latent = wrapped.step(0)[0]
    np.testing.assert_array_equal(latent, encoder.encode(torch.from_numpy(env.given[-1])).numpy())


def test_an_environment_that_does_not_fit_is_refused_at_once(tmp_path: Path) -> None:
    one, two = encoder_for(tmp_path / "one", ONE), encoder_for(tmp_path / "two", TWO)
    with pytest.raises(UserError, match=r"'front' has shape \(84, 84, 3\), the encoder takes frames of \(3, 12, 12\)"):
        EncodeObservation(Noise(Box(0, 255, (84, 84, 3), np.uint8)), one)
    with pytest.raises(UserError, match=r"gives one observation, the encoder takes front, top"):
        EncodeObservation(Noise(PICTURE), two)
    with pytest.raises(UserError, match=r"no observation 'top'"):
        EncodeObservation(Noise(Dict({"front": PICTURE})), two)


def test_types_are_checked_when_the_wrapper_is_made(tmp_path: Path) -> None:
    encoder = encoder_for(tmp_path / "b", ONE)
    with pytest.raises(UserError, match="'front' is float32, the encoder takes uint8"):
        EncodeObservation(Noise(Box(0, 1, (12, 12, 3), np.float32)), encoder)
    made_by_hand: list[Any] = [tmp_path / "b", encoder.encoder, None]
    for wrong in made_by_hand:
        with pytest.raises(UserError, match="takes what load_encoder returned, got"):
            EncodeObservation(Noise(PICTURE), wrong)
