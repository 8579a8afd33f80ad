"""Several objectives at once, on one encoding."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn
from torchmetrics import MetricCollection

from repdib_lightning.errors import UserError
from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput


class SeveralObjectives(Objective):
    """Runs its parts on the same latents and joins their losses and metrics; ``loss_weights`` weighs them.

    In a configuration::

        objective:
          class_path: SeveralObjectives
          init_args:
            parts:
            - class_path: InverseDynamics
            - class_path: ForwardPrediction
              init_args: {hidden: 512}

    Args:
        width: M.
        spec: of the data, for every part.
        parts: the objectives, in order.

    Raises:
        UserError: no parts; at the first batch, two parts that give a loss or a metric of the same name.
    """

    def __init__(self, width: int, spec: DataSpec, *, parts: list[Callable[[int, DataSpec], Objective]]) -> None:
        super().__init__()
        if not parts:
            raise UserError("SeveralObjectives: parts is empty; list at least one objective")
        self.parts = nn.ModuleList(build(width, spec) for build in parts)
        self.needs_actions = any(bool(part.needs_actions) for part in self.parts)

    @property
    def label(self) -> str:
        """The labels of all parts."""
        return " + ".join(str(part.label) for part in self.parts)

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames once and hand the latents to every part."""
        latents: list[Tensor] = []

        def encode_once(observations: dict[str, Tensor]) -> Tensor:
            assert observations is batch.observations, "parts share one encoding of the whole batch"
            if not latents:
                latents.append(encode(observations))
            return latents[0]

        joined, owners = ObjectiveOutput({}), dict[str, str]()
        for part in self.parts:
            output: ObjectiveOutput = part(batch, encode_once)
            for name in [*output.losses, *output.metrics]:
                _check_free(name, type(part).__name__, owners)
            joined.losses |= output.losses
            joined.metrics |= output.metrics
            joined.updates |= output.updates
        return joined

    def held_out_metrics(self) -> dict[str, MetricCollection]:
        """Those of all parts."""
        joined: dict[str, MetricCollection] = {}
        for part in self.parts:
            assert isinstance(part, Objective)
            joined |= part.held_out_metrics()
        return joined


def _check_free(name: str, part: str, owners: dict[str, str]) -> None:
    if name in owners:
        raise UserError(f"SeveralObjectives: {owners[name]} and {part} both give '{name}'; leave one of them out")
    owners[name] = part
