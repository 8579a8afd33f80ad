"""Runs a frozen encoder and its classifier over clips, with everything there and with modalities taken away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import gather_stacks
from repdib_lightning.encoders.base import EncoderOutput
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.recognition_without import modalities_of, taken_away, ways_to_miss
from repdib_lightning.records import DataSpec

_BATCH = 64
FUSED = "fused"
"""What the codes of the latent are called beside those of each modality."""


class Looks(Protocol):
    """What recognition asks of an encoder; ``export.load_encoder`` returns one.

    Attributes:
        groups: G of the latent, or 0 where it is not quantised.
        spec: the observations it takes.
    """

    groups: int
    spec: DataSpec

    def detailed(self, observations: dict[str, Tensor], /) -> EncoderOutput:
        """Name -> (N, *shape) to latents (N, M) with attention and the codes of each modality."""
        ...

    def encode_with_codes(self, observations: dict[str, Tensor], /) -> tuple[Tensor, Tensor]:
        """Latents (N, M) and codes (N, G); asked for only where there are groups."""
        ...


class Tells(Protocol):
    """What recognition asks of a classifier; ``export.load_classifier`` returns one.

    Attributes:
        target: the factor that it recognises. classes: names of its values.
    """

    target: str
    classes: tuple[str, ...]

    def __call__(self, latents: Tensor, /) -> Tensor:
        """(N, M) to logits (N, classes)."""
        ...


@dataclass(frozen=True)
class Recognised:
    """Clips as a classifier sees them.

    Attributes:
        rows: (n,) int64 of the store.
        modalities: that may be missing, in the order of the spec.
        probabilities: (n, classes) float32 with everything there.
        predicted: what is missing -> (n,) int64, the class that is told then; ``()`` is nothing.
        attention: ``modalities`` -> (n, number of them), and modality -> (n, steps).
        codes: modality, or ``fused`` for the latent -> (n, G) int64, where it is quantised.
    """

    rows: np.ndarray
    modalities: list[str]
    probabilities: np.ndarray
    predicted: dict[tuple[str, ...], np.ndarray]
    attention: dict[str, np.ndarray]
    codes: dict[str, np.ndarray]


def recognise(
    encoder: Looks,
    classifier: Tells,
    store: EpisodeStore,
    rows: np.ndarray,
    *,
    device: str | torch.device = "cpu",
    progress: bool = True,
) -> Recognised:
    """Encode (n,) rows with everything there, without each modality, and with each alone; 64 at a time.

    Raises:
        UserError: the classifier returns NaN or infinite values.
    """
    names = modalities_of(encoder.spec)
    ways = ways_to_miss(names)
    starts = range(0, len(rows), _BATCH)
    predicted: dict[tuple[str, ...], list[np.ndarray]] = {way: [] for way in ways}
    parts: dict[str, list[np.ndarray]] = {}
    bar = tqdm(
        total=len(starts) * len(ways), desc="recognise", unit="batch", disable=None if progress else True, leave=False
    )
    with torch.inference_mode(), bar:
        for start in starts:
            some = rows[start : start + _BATCH]
            observations = {
                name: torch.from_numpy(gather_stacks(store, name, some, encoder.spec.frame_stack)).to(device)
                for name in encoder.spec.observations
            }
            for way in ways:
                output = encoder.detailed(taken_away(observations, way))
                logits = _checked(classifier(output.features).float(), store, some)
                predicted[way].append(logits.argmax(1).cpu().numpy())
                if not way:
                    for name, array in _kept(encoder, observations, output, logits).items():
                        parts.setdefault(name, []).append(array.cpu().numpy())
                bar.update()
    whole = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    return Recognised(
        rows,
        names,
        whole["probabilities"],
        {way: np.concatenate(arrays) for way, arrays in predicted.items()},
        {name.partition("/")[2]: array for name, array in whole.items() if name.startswith("attention/")},
        {name.partition("/")[2]: array for name, array in whole.items() if name.startswith("codes/")},
    )


def _kept(encoder: Looks, observations: dict[str, Tensor], output: EncoderOutput, logits: Tensor) -> dict[str, Tensor]:
    """What is looked at of a batch with everything there, by one name each."""
    codes = dict(output.codes)
    if encoder.groups and FUSED not in codes:
        codes[FUSED] = encoder.encode_with_codes(observations)[1]
    return {
        "probabilities": logits.softmax(1),
        **{f"attention/{name}": weights for name, weights in output.attention.items()},
        **{f"codes/{name}": indices for name, indices in codes.items()},
    }


def _checked(logits: Tensor, store: EpisodeStore, rows: np.ndarray) -> Tensor:
    finite = torch.isfinite(logits).all(1)
    if not finite.all():
        bad = rows[int((~finite).nonzero()[0])]
        raise UserError(f"{store.path}: the classifier returns NaN or infinite values at row {bad}")
    return logits
