"""``encode``: a data set as a frozen encoder sees it, for agents that train on vectors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.bundles import bundle_of
from repdib_lightning.evaluation.features import check_compatible, encode_rows, resolve_device
from repdib_lightning.records import ArraySpec

LATENT, CODES = "latent", "codes"
"""Names of the observations."""

_TOLD = ("environment", "configuration", "seed", "licence")
_ENDS = ("rewards", "terminations", "truncations")


def encode_store(
    bundle: Path,
    data: Path,
    output: Path,
    *,
    device: str = "auto",
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Write a data set again with latents and codes in place of its observations; each frame is encoded once.

    Observations: ``latent`` (M,) float32, and ``codes`` (G,), whole numbers as float32, where the bottleneck quantises.
    Actions, rewards, ends of episodes, factors and the choice of evaluation episodes stay. What was interrupted goes on
    after its last whole episode when the same command is given again.

    Args:
        bundle: folder of an exported encoder, or of a run that holds one.
        data: the store.
        output: the store to make (.h5).
        device: runs the encoder.
        overwrite: replace an existing file.
        progress: show a progress bar.

    Returns:
        The path of the new store.

    Raises:
        UserError: bad bundle or data, observations that do not match, rewards without ends of episodes, an output that
            exists or cannot be written.
    """
    from tqdm import tqdm

    from repdib_lightning.export import load_encoder

    folder = bundle_of(Path(bundle))
    check_output_file(Path(output), "OUTPUT", ".h5", [Path(data)])
    encoder = load_encoder(folder).to(resolve_device(device))
    store = EpisodeStore(data)
    check_compatible(encoder, store, str(folder))
    observations = {LATENT: ArraySpec((encoder.features,), "float32")}
    if encoder.groups:
        observations[CODES] = ArraySpec((encoder.groups,), "float32")
    kept = [name for name in _ENDS if name in store]
    if kept and len(kept) < len(_ENDS):
        missing = next(name for name in _ENDS if name not in store)
        raise UserError(f"{data}: has '{kept[0]}' but no '{missing}'; a store has all of {', '.join(_ENDS)}, or none")
    writer = EpisodeWriter(
        output,
        rows=store.rows,
        episodes=len(store.starts),
        observations=observations,
        actions=store.actions_spec,
        factors=store.factors,
        rewards=bool(kept),
        attributes={
            **{name: store.attributes[name] for name in _TOLD if name in store.attributes},
            "encoded": {"data": store.path.name, "fingerprint": store.fingerprint, "encoder": encoder.description},
        },
        overwrite=overwrite,
        resume=True,
    )
    with writer:
        rest = range(writer.episodes_done, len(store.starts))
        for episode in tqdm(rest, desc="encode", unit="episode", disable=None if progress else True):
            rows = np.arange(store.starts[episode], store.starts[episode] + store.lengths[episode])
            latents, codes = encode_rows(encoder, store, rows, device=encoder.device, progress=False)
            seen = {LATENT: latents} if codes is None else {LATENT: latents, CODES: codes.astype(np.float32)}
            writer.add_episode(observations=seen, evaluation=bool(store.evaluation[episode]), **_rest(store, rows))
    return Path(output)


def _rest(store: EpisodeStore, rows: np.ndarray) -> dict[str, Any]:
    """What an episode holds beside its observations, as the writer takes it."""
    found: dict[str, Any] = {"factors": {name: store.gather(f"factors/{name}", rows) for name in store.factors}}
    if store.actions_spec is not None:
        found["actions"] = store.gather("actions", rows[:-1])
    found |= {name: store.gather(name, rows[:-1]) for name in _ENDS if name in store}
    return found
