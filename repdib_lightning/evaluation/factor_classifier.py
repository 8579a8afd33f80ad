"""A frozen judge of pictures: which class of each factor they show, told from the training pictures alone.

It is trained on a data set, not on a model, once, and kept beside the store, so that every model is judged alike.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from tqdm import tqdm

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.encoders import ResidualEncoder, random_shift
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.records import DataSpec

STEPS, BATCH, WIDTH, CHANNELS, RATE, DECAY = 1000, 64, 128, 16, 1e-3, 1e-2
_SHIFT = 1
"""Pixels; more would move shapes from one place to the next, where places are a factor."""
_COARSEST = 3
"""Pictures are shown at full, half or a quarter of their resolution: what a decoder draws is blurred."""
_ROWS = 512

SUFFIX = ".judge.safetensors"


class FactorClassifier(nn.Module):
    """Pictures to the logits of every factor, from one encoder.

    Args:
        spec: the one picture. classes: factor -> number of classes.
    """

    def __init__(self, spec: DataSpec, classes: dict[str, int]) -> None:
        super().__init__()
        self.view = next(iter(spec.observations))
        height, width = spec.observations[self.view].shape[1:]
        stages = min(4, max(min(height, width) - 1, 1).bit_length() - 1)
        self.encoder = ResidualEncoder(spec, features=WIDTH, channels=CHANNELS, stages=stages)
        self.heads = nn.ModuleDict({f"of_{name}": nn.Linear(WIDTH, count) for name, count in classes.items()})

    def forward(self, pictures: Tensor) -> dict[str, Tensor]:
        """(N, C, H, W) uint8 to factor -> (N, classes)."""
        seen = F.relu(self.encoder({self.view: pictures}))
        return {name.removeprefix("of_"): head(seen) for name, head in self.heads.items()}


@dataclass(frozen=True)
class Judge:
    """Tells the classes that a picture shows.

    Attributes:
        network: frozen.
        accuracy: factor -> share of held-out pictures told right; the most to expect of a perfect drawing.
    """

    network: FactorClassifier
    accuracy: dict[str, float]

    def tell(self, pictures: np.ndarray) -> dict[str, np.ndarray]:
        """(n, C, H, W) uint8 to factor -> (n,) int64, the most likely class."""
        with torch.inference_mode():
            parts = [self.network(torch.from_numpy(pictures[i : i + 64])) for i in range(0, len(pictures), 64)]
        return {name: torch.cat([part[name] for part in parts]).argmax(1).numpy() for name in parts[0]}


def judge_of(store: EpisodeStore, view: str, factors: list[str], *, steps: int = STEPS, progress: bool = True) -> Judge:
    """The judge of a store's categorical factors: read from beside the store, or trained and kept there (a minute).

    It is the same whatever was drawn from torch's generators before, which stay as they are. Where it cannot be kept, a
    line on stderr says so. A file beside the store that is damaged, or of other data or another recipe, is replaced.

    Args:
        store: with training and held-out pictures. view: the picture. factors: categorical ones.
        steps: of training, with AdamW on batches of 64, randomly shifted and blurred.
        progress: show a progress bar (on a terminal).
    """
    about = {
        "data": store.fingerprint or recompute_fingerprint(store),
        "view": view,
        "factors": ",".join(factors),
        "recipe": f"{STEPS, steps, BATCH, WIDTH, CHANNELS, RATE, DECAY, _SHIFT, _COARSEST}",
    }
    path = store.path.with_suffix(SUFFIX)
    with torch.random.fork_rng(devices=[]):
        kept = _read(path, about, _untrained(store, view, factors), factors)
        if kept is not None:
            return kept
        network = _untrained(store, view, factors)
        _train(network, store, view, factors, steps, progress)
    judge = Judge(network.eval().requires_grad_(False), {})
    judge = Judge(judge.network, _accuracy(judge, store, view, factors))
    try:
        _write(path, judge, about)
    except (UserError, OSError) as error:
        print(f"warning: {error}; the judge of pictures is trained again each time", file=sys.stderr)
    return judge


def _untrained(store: EpisodeStore, view: str, factors: list[str]) -> FactorClassifier:
    """Always the same one, since it sets torch's generator, which the training goes on with."""
    torch.random.default_generator.manual_seed(0)  # torch.manual_seed would also seed every GPU
    spec = DataSpec({view: store.observations[view]})
    return FactorClassifier(spec, {name: store.factors[name].classes for name in factors})


def _train(
    network: FactorClassifier, store: EpisodeStore, view: str, factors: list[str], steps: int, progress: bool
) -> None:
    rows = rows_of(store, store.episodes("train"))
    targets = {name: torch.from_numpy(store.gather(f"factors/{name}", rows)).long() for name in factors}
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in tqdm(range(steps), desc="judge", unit="step", disable=None if progress else True, leave=False):
        chosen = torch.randint(len(rows), (min(BATCH, len(rows)),))
        pictures = torch.from_numpy(store.gather(f"observations/{view}", rows[chosen.numpy()]))
        logits = network(_blurred(random_shift(pictures, _SHIFT)))
        loss = torch.stack([F.cross_entropy(logits[name], targets[name][chosen]) for name in factors]).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        scheduler.step()


def _blurred(pictures: Tensor) -> Tensor:
    """The batch at a resolution drawn at random: (N, C, H, W) uint8 to the same."""
    factor = 2 ** int(torch.randint(_COARSEST, ()))
    if factor == 1:
        return pictures
    coarse = F.avg_pool2d(pictures.float(), factor, ceil_mode=True)
    size = pictures.shape[2:]
    return F.interpolate(coarse, size=size, mode="bilinear").round().clamp(0, 255).to(torch.uint8)


def _accuracy(judge: Judge, store: EpisodeStore, view: str, factors: list[str]) -> dict[str, float]:
    rows = rows_of(store, store.episodes("evaluation"))
    right = dict.fromkeys(factors, 0)
    for start in range(0, len(rows), _ROWS):
        part = rows[start : start + _ROWS]
        told = judge.tell(store.gather(f"observations/{view}", part))
        for name in factors:
            right[name] += int(np.sum(told[name] == store.gather(f"factors/{name}", part)))
    return {name: count / len(rows) for name, count in right.items()}


def _read(path: Path, about: dict[str, str], network: FactorClassifier, factors: list[str]) -> Judge | None:
    """The judge of a file that was made for the same data in the same way; None without one."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, "pt") as file:
            found = file.metadata() or {}
            if {key: found.get(key) for key in about} != about:
                return None
            network.load_state_dict({name: file.get_tensor(name) for name in list(file.keys())})
            told = json.loads(found["accuracy"])
            accuracy = {name: float(told[name]) for name in factors}
    except (SafetensorError, OSError, RuntimeError, KeyError, ValueError, TypeError):
        return None
    if not all(0.0 <= share <= 1.0 for share in accuracy.values()):
        return None
    return Judge(network.eval().requires_grad_(False), accuracy)


def _write(path: Path, judge: Judge, about: dict[str, str]) -> None:
    tensors = {name: value.contiguous().clone() for name, value in judge.network.state_dict().items()}
    with whole_file(path) as aside:
        save_file(tensors, aside, {**about, "accuracy": json.dumps(judge.accuracy)})
