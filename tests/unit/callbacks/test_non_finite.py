"""When losses are looked at, and what is said of broken ones."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from repdib_lightning.callbacks.non_finite import StopOnNonFinite
from repdib_lightning.errors import UserError

NAN, INF = float("nan"), float("inf")


class OneProcess:
    def reduce_boolean_decision(self, decision: bool, all: bool) -> bool:
        return decision


class OtherProcessBroke(OneProcess):
    def reduce_boolean_decision(self, decision: bool, all: bool) -> bool:
        return True


def batch_end(guard: StopOnNonFinite, step: int, outputs: Any, strategy: Any = None) -> None:
    trainer: Any = SimpleNamespace(global_step=step, callbacks=[], strategy=strategy or OneProcess())
    guard.on_train_batch_end(trainer, None, outputs, None, step)  # type: ignore[arg-type]


def losses(fit: float, kl: float) -> dict[str, Any]:
    terms = {"fit": torch.tensor(fit), "kl": torch.tensor(kl, dtype=torch.bfloat16)}
    return {"loss": torch.tensor(fit) + kl, "terms": terms}


def test_nothing_waits_for_the_device_between_two_looks() -> None:
    unreadable: dict[str, Tensor] = {"loss": torch.zeros((), device="meta")}
    guard = StopOnNonFinite(every_n_steps=10)
    for step in range(9):
        batch_end(guard, step, unreadable)
    with pytest.raises(NotImplementedError):
        batch_end(guard, 9, unreadable)


def test_the_first_broken_step_and_its_terms_are_named() -> None:
    guard = StopOnNonFinite(every_n_steps=4)
    batch_end(guard, 1, losses(1.0, 2.0))
    batch_end(guard, 2, losses(1.0, INF))
    batch_end(guard, 3, losses(NAN, NAN))
    with pytest.raises(UserError, match=r"^the loss is not finite at step 2: kl is inf, loss is inf; there is no"):
        batch_end(guard, 4, losses(NAN, NAN))


def test_finite_losses_pass_and_are_forgotten() -> None:
    guard = StopOnNonFinite(every_n_steps=2)
    for step in range(20):
        batch_end(guard, step, losses(3e38, -1.0))
    with pytest.raises(UserError, match="at step 21: fit is nan"):
        batch_end(guard, 20, losses(0.0, 0.0))
        batch_end(guard, 21, losses(NAN, 0.0))


@pytest.mark.parametrize("outputs", [None, {}, {"loss": None}])
def test_a_skipped_batch_is_no_error(outputs: Any) -> None:
    batch_end(StopOnNonFinite(every_n_steps=1), 1, outputs)


def test_a_bare_loss_will_do() -> None:
    with pytest.raises(UserError, match="at step 1: loss is inf"):
        batch_end(StopOnNonFinite(every_n_steps=1), 1, torch.tensor(INF))


def test_all_processes_stop_together() -> None:
    with pytest.raises(UserError, match="by step 5: of another process"):
        batch_end(StopOnNonFinite(every_n_steps=1), 5, losses(0.0, 0.0), OtherProcessBroke())


def test_every_n_steps_must_be_positive() -> None:
    with pytest.raises(UserError, match="every_n_steps must be at least 1, is 0"):
        StopOnNonFinite(every_n_steps=0)
