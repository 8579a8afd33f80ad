"""THE LightningModule: an encoder, a bottleneck and an objective."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import lightning.pytorch as pl
import torch
from lightning.pytorch.cli import LRSchedulerCallable, OptimizerCallable
from torch import Tensor
from torchmetrics import MetricCollection

from repdib_lightning.bottlenecks import Bottleneck, for_positions
from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.loss_weights import DEFAULT_LOSS_WEIGHTS
from repdib_lightning.means import SampleMeans
from repdib_lightning.objectives.base import Objective
from repdib_lightning.records import Batch, BottleneckOutput, DataSpec, ObjectiveOutput
from repdib_lightning.target_network import TargetNetwork


class RepresentationModule(pl.LightningModule):
    """Learns a representation from a data module that offers a ``spec``.

    The parts are built in :meth:`configure_model`, once the data is known and the process group stands, so that a
    configuration states each width once.

    Args:
        encoder: builds the encoder from the data's spec.
        bottleneck: builds the bottleneck from the width M, or from that of one position where the encoder gives a grid.
        objective: builds the objective from M and the spec.
        optimizer: builds the optimiser from the parameters.
        scheduler: builds a learning-rate scheduler from the optimiser; none by default.
        loss_weights: weight of each named loss term; unnamed ones keep their default
            (``repdib_lightning.loss_weights``: kl 0.01, commitment 0.25, ...; 1 where none is listed).
        warmup: term -> steps over which its weight rises linearly from 0.
        shift: random shift of the pictures while training, in pixels (DrQ-v2: 4 at 84 px), the same for all frames of a
            video; 0 turns it off.
        scheduler_interval: when the scheduler advances, after every ``step`` or every ``epoch``.
        encode_once: encode a frame that a batch has several times, such as a future that was drawn twice, once; its
            copies then share one draw of a bottleneck's noise, and a codebook counts it once. Faster where many futures
            are drawn of a short horizon. It needs ``shift`` 0, which would make the copies differ.

    Attributes:
        target: the slowly following copy of encoder and bottleneck, where the objective has a ``target_rate``.
        tables: what the last evaluation gave beside numbers, such as ``confusion``, over all processes.
    """

    encoder: Encoder
    bottleneck: Bottleneck
    objective: Objective
    target: TargetNetwork | None

    def __init__(
        self,
        encoder: Callable[[DataSpec], Encoder],
        bottleneck: Callable[[int], Bottleneck],
        objective: Callable[[int, DataSpec], Objective],
        optimizer: OptimizerCallable = torch.optim.Adam,
        scheduler: LRSchedulerCallable | None = None,
        loss_weights: dict[str, float] | None = None,
        warmup: dict[str, int] | None = None,
        shift: int = 4,
        scheduler_interval: Literal["step", "epoch"] = "step",
        encode_once: bool = False,
    ) -> None:
        super().__init__()
        self.build_encoder, self.build_bottleneck, self.build_objective = encoder, bottleneck, objective
        self.build_optimizer, self.build_scheduler = optimizer, scheduler
        self.loss_weights = {**DEFAULT_LOSS_WEIGHTS, **(loss_weights or {})}
        self.named_weights = sorted({*(loss_weights or {}), *(warmup or {})})
        self.warmup = warmup or {}
        self.shift = shift
        self.scheduler_interval = scheduler_interval
        self.encode_once = encode_once
        self.target = None
        self.tables: dict[str, Tensor] = {}
        self._held_out = SampleMeans()
        self._held_out_metrics: dict[str, MetricCollection] = {}
        if shift < 0:
            raise UserError(f"model.shift must not be negative, is {shift}")
        if shift and encode_once:
            raise UserError(
                f"model.encode_once: the copies of a frame differ by model.shift, which is {shift}; set it to 0"
            )

    def configure_model(self) -> None:
        """Build encoder, bottleneck and objective from the data module's spec (once)."""
        if hasattr(self, "encoder"):
            return
        self.build(self.trainer.datamodule.spec)  # type: ignore[attr-defined]

    def build(self, spec: DataSpec) -> RepresentationModule:
        """Build the parts for data of this spec; for use without a trainer."""
        self.encoder = self.build_encoder(spec)
        self.bottleneck = for_positions(self.build_bottleneck, self.encoder.features, self.encoder.positions)
        self.objective = self.build_objective(self.encoder.features, spec)
        self._check_drawing()
        rate = self.objective.target_rate
        self.target = TargetNetwork(self.encoder, self.bottleneck, rate) if rate > 0 else None
        return self

    def _check_drawing(self) -> None:
        """Refuse what would train and could not be drawn: shifted pictures, or one that the encoder does not see."""
        found = self.objective.find_decoder()
        if found is None:
            return
        if self.shift:
            raise UserError(
                f"model.shift is {self.shift}: {self.objective.label} would have to guess the shift; set it to 0"
            )
        seen, view = self.encoder.spec.observations, found[1].view
        if view not in seen:
            raise UserError(f"model.objective: draws '{view}', the encoder sees {', '.join(seen)}; choose one of these")

    @torch.no_grad()
    def rehearse(self, batch: Batch) -> None:
        """Pass one batch through everything without training, so that what does not fit shows before a run begins.

        Raises:
            UserError: loss weights for terms that this run does not have, or what a part complains of.
        """
        training = self.training
        with torch.random.fork_rng():
            self.eval()
            output = self._evaluate(batch)
        self.train(training)
        for name in self.named_weights:
            if name not in output.losses:
                raise UserError(
                    f"model.loss_weights: no loss is called '{name}' in this run, {nearest(name, output.losses)}"
                )

    def configure_optimizers(self) -> Any:
        """One optimiser over all parameters but the target's, and its scheduler."""
        averages = set() if self.target is None else set(self.target.parameters())
        optimizer = self.build_optimizer([weight for weight in self.parameters() if weight not in averages])
        if self.build_scheduler is None:
            return optimizer
        scheduler = {"scheduler": self.build_scheduler(optimizer), "interval": self.scheduler_interval}
        return {"optimizer": optimizer, "lr_scheduler": scheduler}

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Step, then let the target follow. Not called under manual optimisation: see :meth:`follow_target`."""
        super().optimizer_step(*args, **kwargs)
        self.follow_target()

    def follow_target(self) -> None:
        """Take the target, and the objective's own, one step towards what they follow; without one, do nothing.

        Once after each optimiser step, by whoever steps the optimiser.
        """
        if self.target is not None:
            self.target.follow(self.encoder, self.bottleneck)
            self.objective.follow()

    def forward(self, observations: dict[str, Tensor]) -> BottleneckOutput:
        """Pass name -> (N, *shape) through encoder and bottleneck, without augmentation."""
        seen = self.encoder.detailed(observations)
        output: BottleneckOutput = self.bottleneck(seen.features)
        losses, metrics = seen.losses | output.losses, seen.metrics | output.metrics
        return replace(output, losses=losses, metrics=metrics, codes_inside=seen.codes)

    def training_step(self, batch: Batch, batch_index: int) -> dict[str, Any]:
        """Return the weighted sum as ``loss`` and the raw terms as ``terms``.

        The loss and the accuracy are logged at every step, all else at those that loggers write.
        """
        output = self._evaluate(batch)
        terms = {name: value * self._weight(name) for name, value in output.losses.items()}
        loss = torch.stack(list(terms.values())).sum()
        values = named_values("train", loss, output, terms)
        self._log(values if self._writes_this_step() else {name: values[name] for name in values if _shown(name)})
        return {"loss": loss, "terms": {name: value.detach() for name, value in output.losses.items()}}

    def on_validation_epoch_start(self) -> None:
        """Begin to collect."""
        self._begin_held_out()

    def on_test_epoch_start(self) -> None:
        """Begin to collect."""
        self._begin_held_out()

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        """Collect the same terms for held-out episodes."""
        self._add_held_out("val", batch)

    def test_step(self, batch: Batch, batch_index: int) -> None:
        """Collect the same terms for held-out episodes."""
        self._add_held_out("test", batch)

    def on_validation_epoch_end(self) -> None:
        """Log their means over all samples of all processes, and the objective's metrics of the whole set."""
        self._end_held_out("val")

    def on_test_epoch_end(self) -> None:
        """Log their means over all samples of all processes, and the objective's metrics of the whole set."""
        self._end_held_out("test")

    def _begin_held_out(self) -> None:
        self._held_out = SampleMeans()
        built = self.objective.held_out_metrics()
        self._held_out_metrics = {name: metrics.to(self.device) for name, metrics in built.items()}

    def _add_held_out(self, stage: str, batch: Batch) -> None:
        output = self._evaluate(batch)
        terms = {name: value * self.loss_weights.get(name, 1.0) for name, value in output.losses.items()}
        self._held_out.add(named_values(stage, torch.stack(list(terms.values())).sum(), output, terms), len(batch))
        for name, metrics in self._held_out_metrics.items():
            metrics.update(*output.updates[name])

    def _end_held_out(self, stage: str) -> None:
        values, self.tables = self._held_out.take(), {}
        for metrics in self._held_out_metrics.values():
            for name, value in metrics.compute().items():
                if value.ndim:
                    self.tables[name] = value
                else:
                    values[f"{stage}/{name}"] = value
        self._log(values, sync_dist=True)

    def _evaluate(self, batch: Batch) -> ObjectiveOutput:
        """All unweighted losses and metrics of one batch; the objective encodes exactly once."""
        bottlenecks: list[BottleneckOutput] = []

        def encode(observations: dict[str, Tensor]) -> Tensor:
            assert not bottlenecks, "an objective encodes all its frames in one pass"
            flat, lead = self._frames(observations)
            if not self.encode_once or lead != batch.offsets.shape:
                bottlenecks.append(self(flat))
                return bottlenecks[0].latent.unflatten(0, lead)
            first, place = distinct_frames(batch)
            bottlenecks.append(self({name: frames[first] for name, frames in flat.items()}))
            return bottlenecks[0].latent[place].unflatten(0, lead)

        targets = () if self.target is None else (self._encode_by_target,)
        objective: ObjectiveOutput = self.objective(batch, encode, *targets)
        for output in bottlenecks:
            objective.losses |= output.losses
            objective.metrics |= output.metrics
        return objective

    def _encode_by_target(self, observations: dict[str, Tensor]) -> Tensor:
        """Name -> (B, F, *shape) to the target's latents (B, F, M), with shifts of their own in training."""
        assert self.target is not None
        flat, lead = self._frames(observations)
        latents: Tensor = self.target(flat)
        return latents.unflatten(0, lead)

    def _frames(self, observations: dict[str, Tensor]) -> tuple[dict[str, Tensor], torch.Size]:
        """Augmented frames, name -> (B * F, *shape), and (B, F)."""
        lead = next(iter(observations.values())).shape[:2]
        return {name: self._augment(array.flatten(0, 1)) for name, array in observations.items()}, lead

    def _augment(self, observation: Tensor) -> Tensor:
        picture = observation.dtype == torch.uint8 and observation.ndim in (4, 5)
        return random_shift(observation, self.shift) if self.training and picture else observation

    def _weight(self, name: str) -> float:
        steps = self.warmup.get(name, 0)
        share = min(1.0, (self.global_step + 1) / steps) if steps else 1.0
        return self.loss_weights.get(name, 1.0) * share

    def _writes_this_step(self) -> bool:
        """Whether loggers write this step; in between, metrics that nobody reads would cost time."""
        if self._trainer is None:
            return True
        every: int = self._trainer.log_every_n_steps  # type: ignore[attr-defined]
        return bool(every) and (self.global_step + 1) % every == 0

    def _log(self, values: dict[str, Tensor], sync_dist: bool = False) -> None:
        for name, value in values.items():
            self.log(name, value, prog_bar=_shown(name), sync_dist=sync_dist)


def _shown(name: str) -> bool:
    """Whether the progress bar shows it."""
    return name.partition("/")[2] in ("loss", "accuracy", "f1_macro", "action_accuracy", "contrast_accuracy")


def named_values(stage: str, loss: Tensor, output: ObjectiveOutput, terms: dict[str, Tensor]) -> dict[str, Tensor]:
    """Everything that is logged of one batch, under the same names everywhere.

    Args:
        stage: ``train``, ``val`` or ``test``.
        loss: the weighted sum. output: of the objective. terms: the weighted losses.
    """
    values = {f"{stage}/loss": loss.detach()}
    values |= {f"{stage}/raw/{name}": value.detach() for name, value in output.losses.items()}
    values |= {f"{stage}/weighted/{name}": value.detach() for name, value in terms.items()}
    return values | {f"{stage}/{name}": value for name, value in output.metrics.items()}


def distinct_frames(batch: Batch) -> tuple[Tensor, Tensor]:
    """Where each distinct frame of a batch is met (n,), and which of them each of its B * F frames is (B * F,)."""
    rows = (batch.rows[:, None] + batch.offsets).flatten()
    found, place = rows.unique(return_inverse=True)
    places = torch.arange(len(rows), device=rows.device)
    return places.new_zeros(len(found)).scatter_reduce_(0, place, places, "amin", include_self=False), place
