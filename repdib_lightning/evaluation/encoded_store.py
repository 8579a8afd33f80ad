"""``encode``: a data set as a frozen encoder sees it, for agents that train on vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from repdib_lightning.data.copies import episode_rows, kept_attributes, kept_of_episode, kept_statement
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.devices import resolve_device
from repdib_lightning.evaluation.bundle_data import open_held_out
from repdib_lightning.evaluation.bundles import bundle_of
from repdib_lightning.evaluation.features import check_compatible, encode_rows
from repdib_lightning.records import ArraySpec

LATENT, CODES = "latent", "codes"
"""Names of the observations."""

_OF_OBSERVATIONS = ("channels", "rate")


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
    Actions, rewards, ends of episodes, factors, recordings and the attributes stay. Marked for evaluation are the
    episodes of the values that the encoder's training held out (``data.held_out``), else those that the data mark.
    What was interrupted goes on after its last whole episode when the same command is given again.

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
    store = open_held_out(Path(data), {str(folder): encoder.description})
    check_compatible(encoder, store, str(folder))
    observations = {LATENT: ArraySpec((encoder.features,), "float32")}
    if encoder.groups:
        observations[CODES] = ArraySpec((encoder.groups,), "float32")
    writer = EpisodeWriter(
        output,
        **kept_statement(store),
        observations=observations,
        attributes={
            **kept_attributes(store, without=_OF_OBSERVATIONS),
            "encoded": {"data": store.path.name, "fingerprint": store.fingerprint, "encoder": encoder.description},
        },
        overwrite=overwrite,
        resume=True,
    )
    with writer:
        rest = range(writer.episodes_done, len(store.starts))
        for episode in tqdm(rest, desc="encode", unit="episode", disable=None if progress else True):
            rows = episode_rows(store, episode)
            latents, codes = encode_rows(encoder, store, rows, device=encoder.device, progress=False)
            seen = {LATENT: latents} if codes is None else {LATENT: latents, CODES: codes.astype(np.float32)}
            writer.add_episode(observations=seen, **kept_of_episode(store, episode))
            store.let_go()  # else the process would hold all that was read of the data
    return Path(output)
