"""``features``: a data set whose videos are replaced by features of their frames, computed once.

Each frame goes through a ResNet (He et al., "Deep residual learning for image recognition", CVPR 2016) that is never
trained, as torchvision has it, up to its last pooling; models then train on sequences, in minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from repdib_lightning.data.copies import episode_rows, kept_attributes, kept_of_episode, kept_statement
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ArraySpec
from repdib_lightning.word_lists import words

if TYPE_CHECKING:
    from repdib_lightning.data.frame_network import FrameNetwork

Architecture = Literal["resnet18", "resnet34", "resnet50"]


def store_features(
    data: Path,
    output: Path,
    *,
    architecture: Architecture = "resnet18",
    weights: Path | None = None,
    views: str | None = None,
    batch: int = 64,
    device: str = "auto",
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Write a data set again with features of frames in place of its videos; each frame is encoded once.

    A video (T, C, H, W) becomes a sequence (T, 512), or (T, 2048) of a resnet50, of the same name: the last pooling of
    the network, frames shifted and scaled by ImageNet's mean and deviation and not resized. A frame that is missing is
    NaN. All else stays: sensors, factors, recordings, the marked split, names of classes. What was interrupted goes on
    after its last whole episode when the same command is given again.

    Args:
        data: the store.
        output: the store to make (.h5).
        architecture: of the network: resnet18, resnet34 or resnet50.
        weights: a file (.pth, .safetensors) of torchvision's own state dict of it; its last layer is passed over.
            Without one the weights are random.
        views: videos to replace, between commas; all by default. Others stay as they are.
        batch: frames at a time.
        device: runs the network.
        seed: of random weights.
        overwrite: replace an existing file.
        progress: show a progress bar.

    Returns:
        The path of the new store.

    Raises:
        UserError: bad data, no such video, weights of another network, an output that exists or cannot be written.
    """
    data, output = Path(data), Path(output)
    if batch < 1 or seed < 0:
        raise UserError(f"--batch must be at least 1 and --seed at least 0, are {batch} and {seed}")
    check_output_file(output, "OUTPUT", ".h5", [data, *([Path(weights)] if weights else [])])
    store = EpisodeStore(data)
    chosen = _videos(store, views)
    from tqdm import tqdm

    from repdib_lightning.data.frame_network import FrameNetwork
    from repdib_lightning.devices import resolve_device

    weights = None if weights is None else Path(weights)
    network = FrameNetwork(architecture, weights, seed).to(resolve_device(device))
    origin = {"data": store.path.name, "fingerprint": store.fingerprint, "architecture": architecture}
    origin |= {"weights": weights.name if weights else f"random, seed {seed}", "sha256": network.sha256}
    writer = _writer(output, store, chosen, network.width, origin | {"views": ",".join(chosen)}, overwrite)
    if weights is None:
        print(f"features: no --weights, those of the {architecture} are random (seed {seed})", file=sys.stderr)
    with writer, tqdm(total=len(store.starts), desc="features", unit="episode", disable=_off(progress)) as bar:
        bar.update(writer.episodes_done)
        for episode, observations in _episodes(store, network, chosen, batch, writer.episodes_done):
            masks = {name: store.mask(name, episode_rows(store, episode)) for name in store.masks if name not in chosen}
            writer.add_episode(observations=observations, masks=masks, **kept_of_episode(store, episode))
            bar.update()
    return output


def _writer(
    output: Path, store: EpisodeStore, chosen: list[str], width: int, origin: dict[str, str], overwrite: bool
) -> EpisodeWriter:
    features = {name: ArraySpec((store.observations[name].shape[0], width), "float32") for name in chosen}
    heights = {name: store.layout(f"masks/{name}")[0][1] for name in store.masks if name not in chosen}
    return EpisodeWriter(
        output,
        **kept_statement(store),
        observations={**store.observations, **features},
        masks={name: (height, store.masks[name]) for name, height in heights.items()},
        attributes={**kept_attributes(store), "frame_features": origin},
        overwrite=overwrite,
        resume=True,
    )


def _off(progress: bool) -> bool | None:
    return None if progress else True


def _videos(store: EpisodeStore, views: str | None) -> list[str]:
    videos = [name for name, spec in store.observations.items() if spec.is_video]
    if not videos:
        raise UserError(f"{store.path}: has no video (observations: {', '.join(store.observations)})")
    chosen = videos if views is None else list(words(views, "--views"))
    for name in chosen:
        if name not in videos:
            raise UserError(f"{store.path}: --views: has no video '{name}', {nearest(name, videos)}")
        if (channels := store.observations[name].shape[1]) not in (1, 3):
            raise UserError(f"{store.path}: '{name}' has {channels} channels, a picture has 1 or 3")
    return chosen


def _episodes(
    store: EpisodeStore, network: FrameNetwork, chosen: list[str], batch: int, done: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Number and observations of every episode that is not done.

    Episodes are encoded in the same company whether the recording was interrupted or not: a network's last digits
    depend on the size of a batch.
    """
    count = len(store.starts)
    at_a_time = max(1, batch // max(store.observations[name].shape[0] for name in chosen))
    for first in range(done - done % at_a_time, count, at_a_time):
        group = range(first, min(first + at_a_time, count))
        rows = np.concatenate([episode_rows(store, episode) for episode in group])
        found = {name: _encoded(network, store.gather(f"observations/{name}", rows), batch) for name in chosen}
        for episode in group:
            if episode < done:
                continue
            here = episode_rows(store, episode)
            others = (name for name in store.observations if name not in found)
            kept = {name: store.gather(f"observations/{name}", here) for name in others}
            yield episode, kept | {name: features[here - rows[0]] for name, features in found.items()}


def _encoded(network: FrameNetwork, videos: np.ndarray, batch: int) -> np.ndarray:
    """(n, T, C, H, W) uint8 to (n, T, width) float32, NaN for frames of zeros."""
    frames = videos.reshape(-1, *videos.shape[2:])
    seen = frames.reshape(len(frames), -1).any(axis=1)
    filled = np.full((len(frames), network.width), np.nan, np.float32)
    filled[seen] = network.features_of(frames[seen], batch)
    return filled.reshape(*videos.shape[:2], -1)
