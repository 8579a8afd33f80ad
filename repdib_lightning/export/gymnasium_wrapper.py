"""Environments as an encoder sees them; behind a frozen one agents get vectors, each frame encoded once."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import ArraySpec, DataSpec


class PrepareObservation(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Gives an encoder's observations, name -> (S * C, H, W) uint8 or (X,) float32, for an encoder that is trained.

    The environment gives single frames, as a ``Dict`` space with the encoder's names or as one ``Box``; pictures may
    be channels first or last. Frames are stacked as in training: oldest first, the first one repeated after a reset.
    A picture that is stacked already is taken as it is.

    Args:
        env: the environment.
        spec: the observations that the encoder takes.

    Raises:
        UserError: the environment's observations do not fit the spec: names the observation and both shapes or types.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], spec: DataSpec) -> None:
        super().__init__(env)
        self.encoder_spec = spec
        spaces = self._named(env.observation_space)
        fits = {name: _fit(name, spaces[name], array, self._stack) for name, array in spec.observations.items()}
        self._channels_last = {name for name, (last, _) in fits.items() if last}
        lengths = {name: 1 if whole else self._stack for name, (_, whole) in fits.items()}
        self._frames: dict[str, deque[np.ndarray[Any, Any]]] = {name: deque(maxlen=n) for name, n in lengths.items()}
        self.observation_space = gymnasium.spaces.Dict({n: _space(array) for n, array in spec.observations.items()})

    @property
    def _stack(self) -> int:
        return self.encoder_spec.frame_stack

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; no frame of the last one stays in the stack."""
        for frames in self._frames.values():
            frames.clear()
        return super().reset(seed=seed, options=options)

    def observation(self, observation: Any) -> Any:
        """Stack the environment's observation: name -> array."""
        given = observation if isinstance(observation, dict) else {next(iter(self._frames)): observation}
        for name, frames in self._frames.items():
            frame = np.asarray(given[name], self.encoder_spec.observations[name].dtype)
            frame = np.moveaxis(frame, -1, 0) if name in self._channels_last else frame
            # A copy, since some environments render into the same array again.
            frames.extend([frame.copy()] * (1 if frames else frames.maxlen or 1))
        return {name: np.concatenate(list(frames)) for name, frames in self._frames.items()}

    def _named(self, space: gymnasium.Space[Any]) -> dict[str, gymnasium.Space[Any]]:
        names = list(self.encoder_spec.observations)
        if not isinstance(space, gymnasium.spaces.Dict):
            if len(names) > 1:
                raise UserError(f"the environment gives one observation, the encoder takes {', '.join(names)}")
            return {names[0]: space}
        for name in names:
            if name not in space.spaces:
                raise UserError(f"the environment gives no observation '{name}', {nearest(name, space.spaces)}")
        return dict(space.spaces)


class EncodeObservation(PrepareObservation):
    """Replaces observations by latents, a float32 ``Box`` of shape (M,), of a frozen encoder.

    Takes the same environments as :class:`PrepareObservation`.

    Args:
        env: the environment.
        encoder: what :func:`~repdib_lightning.export.load_encoder` returned.

    Raises:
        UserError: something else than a frozen encoder; or the environment's observations do not fit it: names the
            observation and both shapes or types.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], encoder: FrozenEncoder) -> None:
        if not isinstance(encoder, FrozenEncoder):
            what = f"'{encoder}'" if isinstance(encoder, (str, Path)) else f"a {type(encoder).__name__}"
            raise UserError(f"EncodeObservation takes what load_encoder returned, got {what}")
        super().__init__(env, encoder.spec)
        self.encoder = encoder
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (encoder.features,), np.float32)

    def observation(self, observation: Any) -> np.ndarray[Any, Any]:
        """Stack and encode the environment's observation into (M,) float32."""
        latent: np.ndarray[Any, Any] = self.encoder.encode(super().observation(observation)).cpu().numpy()
        return latent


def _space(array: ArraySpec) -> gymnasium.spaces.Box:
    if array.dtype == "uint8":
        return gymnasium.spaces.Box(0, 255, array.shape, np.uint8)
    return gymnasium.spaces.Box(-np.inf, np.inf, array.shape, np.float32)


def _fit(name: str, space: gymnasium.Space[Any], array: ArraySpec, stack: int) -> tuple[bool, bool]:
    """Whether the space's channels are last, and whether it holds whole stacks."""
    given = tuple(space.shape or ())
    _check_type(name, space, array)
    frame = (array.shape[0] // stack, *array.shape[1:])
    for channels_last in (False, True):
        if channels_last and not array.is_image:
            continue
        for whole, shape in ((False, frame), (True, array.shape)):
            if given == ((*shape[1:], shape[0]) if channels_last else shape):
                return channels_last, whole
    raise UserError(f"the environment's observation '{name}' has shape {given}, the encoder takes frames of {frame}")


def _check_type(name: str, space: gymnasium.Space[Any], array: ArraySpec) -> None:
    """Pictures are uint8 and nothing else; sensors may be floats of any precision."""
    fits = space.dtype is not None and (
        np.issubdtype(space.dtype, np.floating) if array.dtype == "float32" else space.dtype == np.dtype(array.dtype)
    )
    if not fits:
        raise UserError(f"the environment's observation '{name}' is {space.dtype}, the encoder takes {array.dtype}")
