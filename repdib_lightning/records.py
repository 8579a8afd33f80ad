"""The axis legend and every record that crosses a seam of the package.

Axes, used in every docstring:

====  =========================================  ====  ===================================
``B``  batch (samples)                            ``M``  latent width
``F``  frames of a sample (anchor, then futures)  ``G``  groups of the quantiser
``N``  rows of a store, or ``B * F`` flattened     ``L``  codes per group
``T``  time (rows of an episode)                  ``D``  width of a group, ``M / G``
``C H W``  channels, height, width of a picture   ``A``  width of a continuous action
``S``  frames stacked into one observation        ``K``  horizon (largest time offset)
====  =========================================  ====  ===================================
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:  # collecting and reading data must not pay for importing torch
    from torch import Tensor

Split = Literal["train", "evaluation"]


@dataclass(frozen=True)
class ArraySpec:
    """Shape (without B, F, N) and dtype of one observation.

    A picture is ``(S * C, H, W)`` uint8, a vector ``(X,)`` float32. A row that holds a whole clip has a video,
    ``(T, C, H, W)`` uint8, or a sequence of readings, ``(T, X)`` float32. What is missing of a clip, or lies beyond its
    end, is stored as frames of zeros only, and as NaN.

    Attributes:
        mean, std: X numbers each, of every channel of a sequence over the observed steps of the training rows; None
            where nothing was measured.
    """

    shape: tuple[int, ...]
    dtype: Literal["uint8", "float32"] = "uint8"
    mean: tuple[float, ...] | None = None
    std: tuple[float, ...] | None = None

    @property
    def is_image(self) -> bool:
        """Whether this is a channels-first uint8 picture."""
        return self.dtype == "uint8" and len(self.shape) == 3

    @property
    def is_video(self) -> bool:
        """Whether this is a clip of channels-first uint8 frames."""
        return self.dtype == "uint8" and len(self.shape) == 4

    @property
    def is_sequence(self) -> bool:
        """Whether this is a clip of float32 readings."""
        return self.dtype == "float32" and len(self.shape) == 2

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, strings and numbers; without what was not measured."""
        return {name: list(part) if isinstance(part, tuple) else part for name, part in vars(self).items() if part}

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> ArraySpec:
        """Inverse of :meth:`to_dict`. Raises KeyError or TypeError on missing or unknown fields."""
        measured = {name: tuple(plain[name]) for name in plain if name not in ("shape", "dtype")}
        return cls(tuple(plain["shape"]), plain["dtype"], **measured)


@dataclass(frozen=True)
class ActionSpec:
    """``discrete`` with ``size`` choices (stored as integers), or ``continuous`` with ``size`` = A dimensions."""

    kind: Literal["discrete", "continuous"]
    size: int


@dataclass(frozen=True)
class DataSpec:
    """What a model must know of its data: every width in the package is derived from here.

    ``horizon`` is 0 where samples are drawn without futures. ``next_frame`` says that the first future of every sample
    is the frame after the anchor (``offsets[:, 1] == 1``), in front of those that are drawn. ``target`` is the factor
    that is to be recognised, and ``classes`` are the names of its values; both empty where nothing is.
    """

    observations: dict[str, ArraySpec]
    actions: ActionSpec | None = None
    frame_stack: int = 1
    horizon: int = 1
    next_frame: bool = False
    target: str = ""
    classes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, strings and numbers only (JSON)."""
        observations = {name: spec.to_dict() for name, spec in self.observations.items()}
        return {**asdict(self), "observations": observations, "classes": list(self.classes)}

    @classmethod
    def from_dict(cls, plain: dict[str, Any]) -> DataSpec:
        """Inverse of :meth:`to_dict`. Raises KeyError or TypeError on missing or unknown fields.

        Bundles written before there was a ``next_frame``, or a ``target``, lack it.
        """
        observations = {name: ArraySpec.from_dict(spec) for name, spec in plain["observations"].items()}
        actions = None if plain["actions"] is None else ActionSpec(**plain["actions"])
        return cls(
            observations,
            actions,
            plain["frame_stack"],
            plain["horizon"],
            plain.get("next_frame", False),
            plain.get("target", ""),
            tuple(plain.get("classes", ())),
        )


@dataclass
class Batch:
    """Samples of B anchors: each anchor row t and F - 1 later rows t + k of the same episode.

    Attributes:
        observations: name -> (B, F, *shape); ``[:, 0]`` is the anchor o_t, ``[:, i]`` is o_{t+k_i}.
        actions: (B,) int64 or (B, A) float32, the action taken at the anchor; None in stores without actions.
        offsets: (B, F) int64, time offsets k in steps; ``offsets[:, 0] == 0``, and ``offsets[:, 1] == 1`` where the
            spec has ``next_frame``.
        rows: (B,) int64, the anchor's row in the store.
        targets: (B,) int64, class of the anchor in the spec's ``target``; None where nothing is to be recognised.
    """

    observations: dict[str, Tensor]
    actions: Tensor | None
    offsets: Tensor
    rows: Tensor
    targets: Tensor | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def pin_memory(self) -> Batch:
        """Called by torch's DataLoader when ``pin_memory`` is on."""
        observations = {name: array.pin_memory() for name, array in self.observations.items()}
        actions, targets = (None if part is None else part.pin_memory() for part in (self.actions, self.targets))
        return Batch(observations, actions, self.offsets.pin_memory(), self.rows.pin_memory(), targets)


@dataclass
class BottleneckOutput:
    """What a bottleneck returns.

    Attributes:
        latent: (N, M), what objectives, probes and agents use.
        losses: named scalars, unweighted (weights live in one map, ``loss_weights``).
        codes: (N, G) int64 indices in [0, L), or None where nothing is quantised.
        metrics: named detached scalars worth logging.
        codes_inside: modality -> (N, G) int64, of the bottlenecks inside an encoder, -1 where a sample lacks the
            modality; only a representation has them.
    """

    latent: Tensor
    losses: dict[str, Tensor] = field(default_factory=dict)
    codes: Tensor | None = None
    metrics: dict[str, Tensor] = field(default_factory=dict)
    codes_inside: dict[str, Tensor] = field(default_factory=dict)


@dataclass
class ObjectiveOutput:
    """What an objective returns.

    Attributes:
        losses: named unweighted scalars to minimise.
        metrics: named detached scalars to log.
        updates: name of a metric of the whole held-out set -> what its ``update`` takes of this batch.
    """

    losses: dict[str, Tensor]
    metrics: dict[str, Tensor] = field(default_factory=dict)
    updates: dict[str, tuple[Tensor, ...]] = field(default_factory=dict)
