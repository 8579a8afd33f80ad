"""The contract of an objective, and what several of them ask of a batch."""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor, nn
from torchmetrics import MetricCollection

from repdib_lightning.classifiers import Classifier
from repdib_lightning.decoders import Decoder
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, Batch, DataSpec, ObjectiveOutput

Encode = Callable[[dict[str, Tensor]], Tensor]
"""Observations name -> (B, F, *shape) to latents (B, F, M), in ONE pass of encoder and bottleneck."""


class Objective(nn.Module):
    """Turns a batch into named losses. Subclasses are built as ``Objective(width, spec, *, ...)``.

    Class attributes say what the data must offer; the data module draws the samples accordingly.

    Attributes:
        needs_actions: whether actions are fed to it.
        target_rate: above 0, it is given a third argument, ``target``, an :data:`Encode` without gradient: encoder and
            bottleneck as running averages that follow at this rate after each optimiser step.
    """

    needs_actions: bool = False
    target_rate: float = 0.0

    @property
    def label(self) -> str:
        """What a bundle says its encoder was trained with."""
        return type(self).__name__

    def find_decoder(self) -> tuple[str, Decoder] | None:
        """The decoder among its modules, and its name there; exported with the encoder. None if it draws nothing."""
        return next(((name, part) for name, part in self.named_modules() if isinstance(part, Decoder)), None)

    def find_classifier(self) -> tuple[str, Classifier] | None:
        """The classifier among its modules, and its name there; exported with the encoder. None if it has none."""
        return next(((name, part) for name, part in self.named_modules() if isinstance(part, Classifier)), None)

    def held_out_metrics(self) -> dict[str, MetricCollection]:
        """Build the metrics of a whole held-out set that are no mean over its batches.

        :meth:`forward` puts what their ``update`` takes under their names into ``ObjectiveOutput.updates``. They are
        built anew for every evaluation, and sum up the processes themselves.
        """
        return {}

    def follow(self) -> None:
        """Go a step with a target head of its own, where it has one. Called as often as the target network follows."""

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode what is needed with one call of ``encode``, and return unweighted losses."""
        raise NotImplementedError


def drawn(batch: Batch, latents: Tensor, spec: DataSpec) -> tuple[Tensor, Tensor]:
    """The latents (B, n, M) and offsets (B, n) of the futures drawn from 1..K, without the anchor and a fixed t + 1.

    Args:
        batch: the samples.
        latents: (B, F, M), of all their frames.
        spec: of the data.
    """
    first = 2 if spec.next_frame else 1
    return latents[:, first:], batch.offsets[:, first:]


def require_futures(name: str, spec: DataSpec) -> None:
    """Raise UserError where samples are drawn without futures.

    Args:
        name: of the objective, for the message.
        spec: of the data.
    """
    if spec.horizon < 1:
        raise UserError(f"{name}: compares frames with later ones; set data.futures to at least 1")


def next_latents(latents: Tensor, spec: DataSpec) -> Tensor:
    """The latents (B, M) of the frames after the anchors, out of (B, F, M). Only after :func:`require_transitions`."""
    assert spec.next_frame or spec.horizon == 1
    return latents[:, 1]


def require_transitions(name: str, spec: DataSpec) -> ActionSpec:
    """The actions of data that holds transitions (o_t, a_t, o_{t+1}).

    Args:
        name: of the objective, for the message.
        spec: of the data.

    Raises:
        UserError: no actions, or samples without the frame t + 1.
    """
    if spec.actions is None:
        raise UserError(f"{name}: follows actions to the next frame, but the data has none ('actions' is missing)")
    if not spec.next_frame and spec.horizon != 1:
        raise UserError(f"{name}: needs the frame after the anchor in every sample; set data.next_frame to true")
    return spec.actions


def require_several(objective: Objective, samples: int, does: str) -> None:
    """Raise UserError where a training step has one sample over all processes; a held-out batch may end in one.

    Args:
        objective: who asks.
        samples: of all processes.
        does: what it does with them, for the message.
    """
    if objective.training and samples == 1:
        raise UserError(f"data.batch_size is 1: {type(objective).__name__} {does} and needs at least 2")


def action_vectors(actions: Tensor, spec: ActionSpec, like: Tensor) -> Tensor:
    """Actions (B,) int64 as one-hot vectors, or (B, A) as they are: (B, size) in the dtype of ``like``."""
    vectors = F.one_hot(actions, spec.size) if spec.kind == "discrete" else actions
    return vectors.to(like.dtype)
