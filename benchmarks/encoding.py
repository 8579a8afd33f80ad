"""Does an exported encoder read a data set as fast as its arithmetic allows?

``encode_rows``, which probes and agents use, runs over the rows of a store; beside it a bare loop passes one batch,
which lies in memory already, through the same layers without gradients.
"""

from __future__ import annotations

import argparse
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks import stores
from benchmarks.measuring import alternate
from benchmarks.reporting import claim, machine, table
from repdib_lightning.allocation import keep_freed_memory
from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import gather_stacks
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.evaluation.features import encode_rows, stacked
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.records import ActionSpec, DataSpec

SETTINGS = {
    "arm (2 x 64 px, M 128)": (stores.ARM, 1, 128, [2, 2, 1, 1]),
    "offline (84 px x 3, M 256)": (stores.OFFLINE, 3, 256, [2, 1, 1, 1]),
}
BATCH = 256


def bundle(folder: Path, store: EpisodeStore, frame_stack: int, features: int, strides: list[int]) -> FrozenEncoder:
    """Export an untrained encoder with RepDIB and load it again, as probes and agents do."""
    observations = {name: stacked(spec, frame_stack) for name, spec in store.observations.items()}
    spec = DataSpec(observations, store.actions_spec, frame_stack, 1)
    encoder = ConvolutionalEncoder(spec, features=features, strides=strides)
    bottleneck = RepDIB(features, groups=8, codes=50, start="random", start_step=0)
    save_bundle(folder, encoder, bottleneck, training={}, data={})
    return load_encoder(folder)


def bare_loop(encoder: FrozenEncoder, batch: dict[str, torch.Tensor], batches: int) -> None:
    """The layers alone, on one batch, several times."""
    with torch.inference_mode():
        for _ in range(batches):
            encoder.bottleneck(encoder.encoder(batch))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--batches", type=int, default=4, help="of one call")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    rows, claims = [], []
    frames = BATCH * options.batches
    for name, (pictures, frame_stack, features, strides) in SETTINGS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = stores.write(Path(folder) / "store.h5", pictures, ActionSpec("discrete", 5), rows=4000)
            store = EpisodeStore(path)
            encoder = bundle(Path(folder) / "bundle", store, frame_stack, features, strides).to(options.device)
            some = np.random.default_rng(0).permutation(store.rows)[:frames]
            batch = {
                view: torch.from_numpy(gather_stacks(store, view, some[:BATCH], frame_stack)).to(options.device)
                for view in pictures
            }
            read = partial(encode_rows, encoder, store, some, batch_size=BATCH, device=options.device, progress=False)
            contenders = {"bundle": read, "bare": partial(bare_loop, encoder, batch, options.batches)}
            took = alternate(contenders, options.rounds, device=options.device)
        share = took.ratio("bare", "bundle")
        rows.append([name, frames / took["bundle"], frames / took["bare"], share])
        claims.append(claim(f"{name}: frames/s of the bundle over the store / bare loop", share, at_least=0.95))
    print("## Encoding a data set\n")
    print(
        f"{machine(options.device)}. Median of {options.rounds} alternated calls of {frames} random rows, B {BATCH}.\n"
    )
    print(table(["setting", "bundle frames/s", "bare frames/s", "bundle / bare"], rows) + "\n")
    print("\n".join(claims))


if __name__ == "__main__":
    main()
