"""How much of a training step of ``fit`` is arithmetic?

``fit`` runs as a user runs it: loader, Lightning, logging, callbacks, checkpoints. Every few steps it pauses, and a
bare loop makes as many steps of the same forward pass, backward pass and optimiser on a batch that it keeps. Then
single steps of the bare loop show what number formats, memory layout, compilation and the allocator give.
"""

from __future__ import annotations

import argparse
import copy
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn

from benchmarks import stores
from benchmarks.measuring import Times, alternate, wait
from benchmarks.reporting import claim, machine, table
from repdib_lightning import __main__ as command_line
from repdib_lightning.allocation import keep_freed_memory
from repdib_lightning.encoders import convolutional, views
from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.records import ActionSpec, Batch

HERE = Path(__file__).parent
SETTINGS: dict[str, tuple[list[str], dict[str, tuple[int, ...]], ActionSpec]] = {
    "arm (2 x 64 px, B 128, M 128)": (["--config", "robot_arm"], stores.ARM, ActionSpec("discrete", 5)),
    "offline (84 px x 3, B 256, M 256)": (
        ["--config", str(HERE / "offline.yaml")],
        stores.OFFLINE,
        ActionSpec("continuous", 6),
    ),
}


class BareStep:
    """Forward pass, backward pass and optimiser on one batch, without Lightning."""

    def __init__(self, module: Any, batch: Batch) -> None:
        parts = nn.ModuleList([module.encoder, module.bottleneck, module.objective])
        self.encoder, self.bottleneck, self.objective = copy.deepcopy(parts).to(batch.rows.device)
        self.encode: Callable[..., Tensor] = self.encoder
        self.optimizer = module.build_optimizer([p for part in self.parts for p in part.parameters()])
        self.weights, self.shift, self.batch = module.loss_weights, module.shift, batch

    @property
    def parts(self) -> list[nn.Module]:
        """Everything that is trained."""
        return [self.encoder, self.bottleneck, self.objective]

    def __call__(self) -> None:
        """One step."""
        losses: dict[str, Tensor] = {}

        def encode(observations: dict[str, Tensor]) -> Tensor:
            lead = next(iter(observations.values())).shape[:2]
            flat = {name: random_shift(array.flatten(0, 1), self.shift) for name, array in observations.items()}
            output = self.bottleneck(self.encode(flat))
            losses.update(output.losses)
            return output.latent.unflatten(0, lead)

        losses.update(self.objective(self.batch, encode).losses)
        loss = torch.stack([value * self.weights.get(name, 1.0) for name, value in losses.items()]).sum()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


class CapturedStep:
    """A bare step recorded as a CUDA graph: nothing is left but the kernels. The limit on a GPU."""

    def __init__(self, step: BareStep) -> None:
        parameters = [p for part in step.parts for p in part.parameters()]
        step.optimizer = torch.optim.Adam(parameters, lr=3e-4, fused=True, capturable=True)
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(3):
                step()
        torch.cuda.current_stream().wait_stream(aside)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            step()

    def __call__(self) -> None:
        """One step."""
        self.graph.replay()


class Alternate(Callback):
    """Stops ``fit`` every few steps for as many bare steps; what ``fit`` took is all the time in between.

    Args:
        steps: of a window.
        warmup: steps of the run before the first window; the quantiser should have started.
    """

    def __init__(self, steps: int, warmup: int) -> None:
        self.steps, self.warmup = steps, warmup
        self.fit: list[float] = []
        self.bare: list[float] = []
        self.step: BareStep | None = None
        self._since = 0.0

    def on_train_batch_end(self, trainer: Any, module: Any, outputs: Any, batch: Batch, batch_index: int) -> None:
        """Close a window."""
        done = trainer.global_step - self.warmup
        if done < 0 or done % self.steps:
            return
        device = trainer.strategy.root_device.type
        wait(device)
        if self.step is None:
            self.step = BareStep(module, batch)
        elif self._since:
            self.fit.append((time.perf_counter() - self._since) / self.steps)
            start = time.perf_counter()
            for _ in range(self.steps):
                self.step()
            wait(device)
            self.bare.append((time.perf_counter() - start) / self.steps)
        self._since = time.perf_counter()


def run_fit(options: list[str], alternation: Alternate, windows: int, folder: Path, device: str) -> None:
    """Run the command line's ``fit`` with the callback in it."""
    steps = alternation.warmup + windows * alternation.steps
    accelerator = "cpu" if device == "cpu" else "gpu"
    arguments = ["fit", *options, "--run", str(folder / "run"), "--trainer.max_steps", str(steps)]
    arguments += ["--trainer.accelerator", accelerator, "--trainer.devices", "1"]
    arguments += ["--model.bottleneck.init_args.start_step", str(max(1, alternation.warmup // 2))]
    arguments += ["--trainer.callbacks", "benchmarks.training_step.Lent"]
    Lent.alternation = alternation
    with redirect_stdout(sys.stderr):
        code = command_line.run(arguments)
    assert code == 0, f"fit ended with {code}"


class Lent(Callback):
    """Hands the hooks to an :class:`Alternate` that this process keeps: a configuration can only name a class."""

    alternation: Alternate

    def on_train_batch_end(self, *arguments: Any) -> None:
        """See :class:`Alternate`."""
        Lent.alternation.on_train_batch_end(*arguments)


def variants(step: BareStep, rounds: int, device: str, compiled: bool) -> Times:
    """Single bare steps, each with one thing changed."""

    def bf16() -> Any:
        return torch.autocast(device, torch.bfloat16)

    settings: dict[str, list[Callable[[], Any]]] = {
        "as shipped": [],
        "bf16 (autocast)": [bf16],
        "pictures as (N, C, H, W)": [contiguous_pictures],
    }
    if compiled:
        quick = torch.compile(step.encoder)
        settings["encoder compiled"] = [lambda: encoding_with(step, quick)]
        settings["encoder compiled, bf16"] = [lambda: encoding_with(step, quick), bf16]

    def call(contexts: list[Callable[[], Any]]) -> None:
        with ExitStack() as stack:
            for context in contexts:
                stack.enter_context(context())
            step()

    contenders = {name: lambda contexts=contexts: call(contexts) for name, contexts in settings.items()}
    return alternate(contenders, rounds, device=device)


@contextmanager
def encoding_with(step: BareStep, encoder: Callable[..., Tensor]) -> Iterator[None]:
    """Another encoder, or the same in another form."""
    step.encode = encoder
    try:
        yield
    finally:
        step.encode = step.encoder


@contextmanager
def contiguous_pictures() -> Iterator[None]:
    """Encode pictures that lie channels first in memory."""

    def channels_first(image: Tensor) -> Tensor:
        return views.centred(image).contiguous()

    convolutional.centred = channels_first
    try:
        yield
    finally:
        convolutional.centred = views.centred


def step_in_a_new_process(setting: str, keep: bool, threads: int) -> float:
    """Median seconds of a bare step where the allocator was told, or not told, to keep what is freed."""
    environment = os.environ if keep else {**os.environ, "MALLOC_TRIM_THRESHOLD_": str(128 << 10)}
    command = [sys.executable, "-m", "benchmarks.training_step", "--only", setting, "--threads", str(threads)]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return float(done.stdout.split()[-1])


def alternated(setting: str, steps: int, windows: int, device: str) -> Alternate:
    """Run ``fit`` in a setting, on data of noise, with windows of bare steps in it."""
    arguments, pictures, actions = SETTINGS[setting]
    alternation = Alternate(steps, warmup=4)
    with tempfile.TemporaryDirectory() as folder:
        store = stores.write(Path(folder) / "store.h5", pictures, actions, rows=4000)
        run_fit([*arguments, "--data.path", str(store)], alternation, windows, Path(folder), device)
    return alternation


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--windows", type=int, default=20)
    parser.add_argument("--steps", type=int, default=5, help="of a window")
    parser.add_argument("--rounds", type=int, default=20, help="of the variants; 0 leaves them out")
    parser.add_argument("--no_compile", action="store_true", help="leave torch.compile out (it needs a C++ compiler)")
    parser.add_argument("--only", choices=list(SETTINGS), help="print the seconds of a bare step and nothing else")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    if options.only:
        step = alternated(options.only, 1, 1, options.device).step
        assert step is not None
        print(alternate({"step": step}, options.rounds)["step"])
        return
    rows, shares, gains, captured = [], {}, [], {}
    for name in SETTINGS:
        alternation = alternated(name, options.steps, options.windows, options.device)
        step = alternation.step
        assert step is not None
        times = Times({"fit": alternation.fit, "bare": alternation.bare})
        shares[name] = sum(alternation.bare) / sum(alternation.fit)
        rows.append([name, 1 / times["fit"], 1 / times["bare"], times.ratio("bare", "fit"), shares[name]])
        if options.device != "cpu":
            graph = CapturedStep(copy.deepcopy(step))
            took = alternate({"bare": step, "graph": graph}, options.rounds or 20, device=options.device)
            captured[name] = shares[name] * took.ratio("graph", "bare")
        if options.rounds:
            took = variants(step, options.rounds, options.device, not options.no_compile)
            gains += [[name, kind, 1e3 * took[kind], took.ratio("as shipped", kind)] for kind in took]
            if options.device == "cpu":
                kept, given = (step_in_a_new_process(name, keep, options.threads) for keep in (True, False))
                gains.append([name, "freed memory given back (new processes)", 1e3 * given, kept / given])
    print("## Training step\n")
    print(
        f"{machine(options.device)}. {options.windows} windows of {options.steps} steps each, fit and bare loop in "
        f"turn; checkpoints, logging and pictures on, no validation within the windows.\n"
    )
    print(table(["setting", "fit steps/s", "bare steps/s", "fit / bare, median window", "fit / bare, in all"], rows))
    print()
    for name, share in shares.items():
        print(claim(f"{name}: steps/s of fit / bare loop, in all", share, at_least=0.95))
    for name, share in captured.items():
        print(claim(f"{name}: steps/s of fit / bare step captured as a CUDA graph", share, at_least=0.9))
    if gains:
        print(
            "\nOne bare step with one thing changed (shipped: float32, pictures in memory as (N, H, W, C), freed "
            "memory kept, nothing compiled):\n"
        )
        print(table(["setting", "variant", "ms", "times as fast as shipped"], gains))


if __name__ == "__main__":
    from benchmarks import training_step  # the module that the configuration names, not a second copy of it

    training_step.main()
