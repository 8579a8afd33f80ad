"""How fast is the grouped quantiser, forward and backward, against a known library and against a limit?

The library is vector-quantize-pytorch (heads with separate books, straight-through gradient, no revival), the limit the
bare product of rows and codes, then a look-up: no search, no loss, no update, no backward pass. Ours is the layer as
users have it, with its losses, metrics and updates.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

import torch
from torch import Tensor

from benchmarks.measuring import Times, alternate, peak_growth
from benchmarks.reporting import claim, machine, median, table
from repdib_lightning.allocation import keep_freed_memory
from repdib_lightning.bottlenecks import VectorQuantiser

SHAPES = [(128, 8, 50), (256, 8, 512), (256, 32, 512), (1024, 16, 50), (1024, 32, 50), (32, 2, 512)]
BATCHES = [256, 1024, 4096]
RULES = ["ema", "gradient"]
GRADIENTS: dict[torch.Size, Tensor] = {}
LARGE_SCORES = 2**22
"""Cells with more scores than this (16 MB of them) count as large: there arithmetic dominates."""


def backward(latent: Tensor, loss: Tensor) -> None:
    """From a loss and a gradient that arrives at the latent: none of its own is computed."""
    if latent.shape not in GRADIENTS:
        GRADIENTS[latent.shape] = torch.randn_like(latent)
    torch.autograd.backward([latent, loss], [GRADIENTS[latent.shape], None])


class Ours:
    """One training step of our layer, without revival, which the library has switched off too."""

    def __init__(self, width: int, groups: int, codes: int, rule: str, device: str) -> None:
        options = {"start": "random", "start_step": 0, "revive_after": 0}
        self.layer = VectorQuantiser(width, groups=groups, codes=codes, codebook=rule, **options).to(device)

    def step(self, latent: Tensor) -> Tensor:
        """Forward and backward; returns the indices."""
        output = self.layer(latent)
        backward(output.latent, sum(output.losses.values()))
        return output.codes


class Library:
    """One training step of vector-quantize-pytorch."""

    def __init__(self, width: int, groups: int, codes: int, rule: str, device: str) -> None:
        from vector_quantize_pytorch import VectorQuantize

        how = {"decay": 0.99} if rule == "ema" else {"learnable_codebook": True, "ema_update": False}
        self.layer = VectorQuantize(
            width,
            codes,
            codebook_dim=width // groups,
            heads=groups,
            separate_codebook_per_head=groups > 1,
            rotation_trick=False,
            commitment_weight=1.0,
            **how,
        ).to(device)

    def step(self, latent: Tensor) -> Tensor:
        """Forward and backward; returns the indices."""
        quantised, indices, loss = self.layer(latent.unsqueeze(0))
        backward(quantised, loss.sum())
        return indices


class Limit:
    """The product into memory that is there already, and one look-up."""

    def __init__(self, width: int, groups: int, codes: int, device: str) -> None:
        self.vectors = torch.randn(groups, codes, width // groups, device=device)
        self.squares = self.vectors.square().sum(-1).unsqueeze(1)
        self.first = torch.arange(groups, device=device) * codes
        self.groups, self.codes = groups, codes
        self.scores = torch.empty(0, device=device)

    @torch.no_grad()
    def step(self, latent: Tensor) -> Tensor:
        """One product and one look-up of indices that are known."""
        rows = latent.view(len(latent), self.groups, -1)
        if self.scores.shape[1:2] != (len(latent),):
            self.scores = latent.new_empty(self.groups, len(latent), self.codes)
            self.known = torch.randint(self.codes, (len(latent), self.groups), device=latent.device) + self.first
        torch.baddbmm(self.squares, rows.transpose(0, 1), self.vectors.transpose(1, 2), alpha=-2, out=self.scores)
        return self.vectors.flatten(0, 1).index_select(0, self.known.flatten())


def measure(shape: tuple[int, int, int], batch: int, rule: str, rounds: int, device: str) -> Times:
    """Seconds of the three."""
    torch.manual_seed(0)
    width, groups, codes = shape
    latent = torch.randn(batch, width, device=device, requires_grad=True)
    contenders = {
        "ours": Ours(width, groups, codes, rule, device),
        "library": Library(width, groups, codes, rule, device),
        "limit": Limit(width, groups, codes, device),
    }

    def call(name: str) -> None:
        latent.grad = None
        contenders[name].step(latent)

    return alternate({name: lambda name=name: call(name) for name in contenders}, rounds, device=device)


def disagreements(shape: tuple[int, int, int], batch: int, device: str) -> tuple[int, float]:
    """Rows for which a search in float64 finds another code, and by how much that one is nearer at most (relative)."""
    torch.manual_seed(1)
    width, groups, codes = shape
    ours = Ours(width, groups, codes, "gradient", device)
    latent = torch.randn(batch, width, device=device)
    found = ours.layer.eval()(latent).codes
    wrong, worst = 0, 0.0
    for group in range(groups):
        rows = latent.view(batch, groups, -1)[:, group].double()
        for chunk, chosen in zip(rows.split(256), found[:, group].split(256), strict=True):
            distances = (chunk.unsqueeze(1) - ours.layer.codebook[group].detach().double()).square().sum(-1)
            lowest, index = distances.min(-1)
            differs = index != chosen
            wrong += int(differs.sum())
            excess = distances.gather(1, chosen.unsqueeze(1)).squeeze(1) / lowest - 1
            worst = max(worst, float(excess.max()))
    return wrong, worst


def memory(kind: str, rule: str, device: str) -> int:
    """Peak bytes of one step at (256, 32, 512) and batch 4096, after a small step has loaded what is loaded once."""
    contender = {"ours": Ours, "library": Library}[kind](256, 32, 512, rule, device)
    contender.step(torch.randn(64, 256, device=device, requires_grad=True))
    latent = torch.randn(4096, 256, device=device, requires_grad=True)
    return peak_growth(lambda: contender.step(latent), device)


def memory_in_a_new_process(kind: str, rule: str, device: str) -> int:
    """:func:`memory` where no earlier call has left memory to use again."""
    command = [sys.executable, "-m", "benchmarks.quantiser", "--memory", kind, rule, "--device", device]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])


class Codes(torch.nn.Module):
    """What of the layer is exported: a tensor."""

    def __init__(self, layer: VectorQuantiser) -> None:
        super().__init__()
        self.layer = layer.eval()

    def forward(self, latent: Tensor) -> Tensor:
        """Map (N, M) to indices (N, G)."""
        return self.layer(latent).codes


def compiles_and_exports() -> list[str]:
    """Whether torch.compile takes the training step in one graph, and torch.export the evaluation."""
    lines = []
    latent = torch.randn(64, 256)
    for rule in RULES:
        layer = Ours(256, 8, 512, rule, "cpu").layer
        graphs = torch._dynamo.explain(layer)(latent.clone().requires_grad_())
        torch._dynamo.reset()
        compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
        compiled(latent.clone().requires_grad_()).latent.sum().backward()
        exported = torch.export.export(Codes(layer), (latent,)).module()
        same = torch.equal(exported(latent), layer(latent).codes)
        lines.append(
            f"- {'met' if graphs.graph_break_count == 0 and same else '**MISSED**'}: {rule}: torch.compile(fullgraph) "
            f"of the training step with {graphs.graph_break_count} breaks, torch.export with the same codes: {same}"
        )
    return lines


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--keep_memory", action="store_true", help="as the command line does, see allocation.py")
    parser.add_argument("--memory", nargs=2, metavar=("KIND", "RULE"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.keep_memory:
        assert keep_freed_memory(), "needs glibc"
    if options.memory:
        print(memory(*options.memory, options.device))
        return
    rows, gains, at_32, overheads = [], [], [], []
    for rule in RULES:
        for shape in SHAPES:
            for batch in BATCHES:
                took = measure(shape, batch, rule, options.rounds, options.device)
                gain, overhead = took.ratio("library", "ours"), took.ratio("ours", "limit")
                gains.append(gain)
                large = shape[1] * shape[2] * batch > LARGE_SCORES
                if large:
                    overheads.append(overhead)
                if shape == (256, 32, 512) and batch >= 1024:
                    at_32.append(gain)
                times = [1e3 * took[name] for name in ("ours", "library", "limit")]
                rows.append([rule, "x".join(map(str, shape)), batch, *times, gain, overhead, "large" if large else ""])
    allocator = ", freed memory kept (as the command line does)" if options.keep_memory else ""
    print(f"## Grouped quantiser, forward and backward{allocator}\n")
    print(
        f"{machine(options.device)}. Medians of {options.rounds} alternated calls, ratios of the same round. "
        "m x G x L; B rows.\n"
    )
    head = ["codebook", "m x G x L", "B", "ours ms", "library ms", "limit ms", "library / ours", "ours / limit", "cell"]
    print(table(head, rows) + "\n")
    print(claim("library / ours, slowest cell", min(gains), at_least=1.0))
    print(claim("library / ours, median cell", median(gains), at_least=2.0))
    print(claim("library / ours at 256x32x512 from B 1024, lowest", min(at_32), at_least=10.0))
    print(claim("ours / limit, worst large cell", max(overheads), at_most=3.0))
    for rule in RULES:
        ours, library = (memory_in_a_new_process(kind, rule, options.device) for kind in ("ours", "library"))
        what = f"{rule}: peak memory ours / library at 256x32x512, B 4096 ({ours >> 20} / {library >> 20} MiB)"
        print(claim(what, ours / library, at_most=1 / 20))
    wrong, worst = map(max, zip(*(disagreements(shape, 1024, options.device) for shape in SHAPES), strict=True))
    print(
        claim("rows, of 1024 x G, with another code than a search in float64, worst shape", float(wrong), at_most=0.0)
    )
    print(f"  (where it differs, the other code is nearer by a relative {worst:.1e} at most)")
    print("\n".join(compiles_and_exports()))


if __name__ == "__main__":
    main()
