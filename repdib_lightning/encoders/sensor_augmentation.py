"""Random changes of raw readings in training: how the device was worn, how strong and fast somebody moved."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.sensor_sequences import channel_statistics
from repdib_lightning.errors import UserError
from repdib_lightning.processes import own_rows, rows_of_all
from repdib_lightning.records import DataSpec

_ROTATED = ("acceleration", "gyroscope")
# In a mirror across the x axis a vector loses the sign of x, and what turns, an axial vector, those of y and z.
_MIRRORED = {"acceleration": (-1.0, 1.0, 1.0), "gyroscope": (1.0, -1.0, -1.0)}


class SensorAugmentation(nn.Module):
    """Mirrors, rotates, scales, blurs and warps the readings of a clip, each clip by its own draw; none in evaluation.

    What is missing stays missing.

    Args:
        spec: of the sequences to change, and nothing else.
        angles: those among them that hold degrees: they are not scaled.
        reflection: chance that a clip is seen in a mirror across the x axes of its devices. Of a watch, whose x axis
            runs along the forearm, it is what the other arm would have measured.
        rotation: degrees; standard deviation of each component of a random rotation vector. Channels 3k to 3k + 2 are
            the axes of device k, and turn alike in every sequence of ``rotated``.
        rotated: names of the sequences that rotate; by default those of acceleration and gyroscope that there are.
        scaling: standard deviation around 1 of the factor of a sensor.
        jitter: standard deviation of what is added to each reading, in those of its channel.
        time_warp: standard deviation around 1 of the speed of a clip, of all its sensors alike.

    Raises:
        UserError: a negative deviation, a chance outside [0, 1], a sequence to rotate or to mirror whose channels are
            no triples, or one that has no known mirror image.
    """

    def __init__(
        self,
        spec: DataSpec,
        angles: list[str],
        *,
        reflection: float,
        rotation: float,
        rotated: list[str] | None,
        scaling: float,
        jitter: float,
        time_warp: float,
    ) -> None:
        super().__init__()
        for option, value in {
            "rotation": rotation,
            "scaling": scaling,
            "jitter": jitter,
            "time_warp": time_warp,
        }.items():
            if value < 0:
                raise UserError(f"MultimodalEncoder: {option} must not be negative, is {value}")
        if not 0 <= reflection <= 1:
            raise UserError(f"MultimodalEncoder: reflection must be in [0, 1], is {reflection}")
        self.sensors = sensors = list(spec.observations)
        self.reflection = reflection
        self.rotation, self.scaling, self.jitter, self.time_warp = rotation, scaling, jitter, time_warp
        self.rotated = [name for name in _ROTATED if name in sensors] if rotated is None else rotated
        self.scaled = [name for name in sensors if name not in angles]
        for name in self.rotated if rotation else []:
            _require_triples("rotated has", name, spec)
        for name in sensors if reflection else []:
            if name not in _MIRRORED:
                known = " and ".join(_MIRRORED)
                raise UserError(f"MultimodalEncoder: reflection knows the mirror images of {known}, not of '{name}'")
            _require_triples("reflection of", name, spec)
            self.register_buffer(f"mirror_{name}", torch.tensor(_MIRRORED[name]), persistent=False)
        for name in sensors:
            self.register_buffer(f"std_{name}", channel_statistics(spec.observations[name])[1], persistent=False)

    def forward(self, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Name -> (N, T, X) float32, and whatever else, to the same."""
        if not self.training or not self.sensors:
            return observations
        changed = dict(observations)
        count, device = changed[self.sensors[0]].shape[0], changed[self.sensors[0]].device
        if self.reflection:
            mirrored = _uniform(count, 1, 1, 1, device=device) < self.reflection
            for name in self.sensors:
                signs = torch.where(mirrored, self.get_buffer(f"mirror_{name}"), 1.0)
                changed[name] = (changed[name].unflatten(-1, (-1, 3)) * signs).flatten(2)
        if self.rotation and self.rotated:
            triples = max(changed[name].shape[-1] for name in self.rotated) // 3
            turns = rotation_matrices(_normal(count, triples, 3, device=device) * math.radians(self.rotation))
            changed |= {name: rotate_triples(changed[name], turns) for name in self.rotated}
        if self.scaling:
            for name in self.scaled:
                changed[name] = changed[name] * (1 + self.scaling * _normal(count, 1, 1, device=device))
        if self.jitter:
            for name in self.sensors:
                noise = _normal(*changed[name].shape, device=device)
                changed[name] = changed[name] + noise * self.jitter * self.get_buffer(f"std_{name}")
        if self.time_warp:
            speed = (1 + self.time_warp * _normal(count, 1, device=device)).clamp(0.5, 2.0)
            changed |= {name: at_speed(changed[name], speed) for name in self.sensors}
        return changed


def rotation_matrices(vectors: Tensor) -> Tensor:
    """Rodrigues' formula: rotation vectors (..., 3) in radians to matrices (..., 3, 3)."""
    angle = vectors.norm(dim=-1).clamp_min(1e-12)[..., None, None]
    x, y, z = (vectors / angle[..., 0]).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return identity + angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)


def rotate_triples(readings: Tensor, turns: Tensor) -> Tensor:
    """Turn channels 3k to 3k + 2 of (N, T, X) by ``turns[:, k]`` of (N, K, 3, 3), where all three are finite."""
    triples = readings.unflatten(-1, (-1, 3))
    turned = torch.einsum("nkij,ntkj->ntki", turns[:, : triples.shape[2]], triples)
    whole = triples.isfinite().all(-1, keepdim=True)
    return torch.where(whole, turned, triples).flatten(2)


def at_speed(readings: Tensor, speed: Tensor) -> Tensor:
    """(N, T, X) as if played at ``speed`` (N, 1), by the nearest reading: NaN beyond what was recorded."""
    recorded = readings.shape[1]
    places = (torch.arange(recorded, device=readings.device) * speed).round().long()
    taken = readings.gather(1, places.clamp(max=recorded - 1).unsqueeze(-1).expand_as(readings))
    return taken.masked_fill((places >= recorded).unsqueeze(-1), torch.nan)


def _require_triples(complaint: str, name: str, spec: DataSpec) -> None:
    channels = spec.observations[name].shape[-1]
    if channels % 3:
        raise UserError(f"MultimodalEncoder: {complaint} '{name}', whose {channels} channels are no triples of axes")


def _uniform(count: int, *shape: int, device: torch.device) -> Tensor:
    return own_rows(torch.rand(rows_of_all(count), *shape, device=device))


def _normal(count: int, *shape: int, device: torch.device) -> Tensor:
    return own_rows(torch.randn(rows_of_all(count), *shape, device=device))
