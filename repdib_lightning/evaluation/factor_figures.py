"""``figures factors BUNDLE DATA``: what each group of a latent draws (paper, PACS figure)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from repdib_lightning.bottlenecks.group_edits import most_used
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation.bundle_data import open_held_out
from repdib_lightning.evaluation.bundles import bundle_of, display_name
from repdib_lightning.evaluation.features import check_compatible, encode_rows
from repdib_lightning.evaluation.group_drawing import mean_training_picture
from repdib_lightning.evaluation.picture_grid import picture_lines
from repdib_lightning.evaluation.redrawing import Redrawing, psnr, redraw
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.export import load_decoder, load_encoder
from repdib_lightning.word_lists import words

FIGURES = ("zeroed", "swapped", "traversed")
MOST_PICTURES = 100
_CODES = 12
_COUNTED = 2000
"""Pictures whose codes are counted, and whose drawings are measured."""
_SPLITS = {"evaluation": "held-out", "train": "training", "all": "training and held-out"}


def draw_factors(
    bundle: Path,
    data: Path,
    *,
    output: Path | None = None,
    which: str = ",".join(FIGURES),
    groups: int | None = None,
    pictures: int = 25,
    split: str = "evaluation",
    seed: int = 0,
    device: str = "auto",
) -> str:
    """Draw what each group of a latent holds, into PNG files.

    ``zeroed.png``: pictures, what is drawn of them, and what is drawn with each group set to 0 (the paper's figure).
    ``swapped.png``: pairs of pictures, and the first with each group of the second. ``traversed.png``: pictures with
    one group set to each of its most used codes in turn.

    Args:
        bundle: exported, with its decoder, or the run that holds it.
        data: the store.
        output: folder of the files; ``factors`` beside the bundle by default.
        which: some of zeroed, swapped, traversed, between commas.
        groups: groups to cut a latent into that is not quantised.
        pictures: how many at most, 2 to 100, drawn at random.
        split: evaluation, train, or all.
        seed: of the choice.
        device: runs encoder and decoder.

    Returns:
        A line of what was written, and of how well pictures of the split are drawn beside the mean training picture.

    Raises:
        UserError: a bundle without a decoder or without groups, data that do not fit it, a bad option, or files that
            cannot be written; nothing is written then.
    """
    chosen = words(which, "which")
    unknown = [name for name in chosen if name not in FIGURES]
    if unknown:
        raise UserError(f"--which: unknown figure '{unknown[0]}', {nearest(unknown[0], FIGURES)}")
    folder = bundle_of(Path(bundle))
    target = folder.parent / "factors" if output is None else Path(output)
    for figure in chosen:
        check_output_file(target / f"{figure}.png", "--output", ".png")
    drawn = open_redrawing(folder, data, groups=groups, count=pictures, split=split, seed=seed, device=device)
    files = figures_of(drawn, display_name(folder), chosen)
    quality = _quality(drawn, open_held_out(data, {str(folder): drawn.encoder.description}), split, seed)
    for figure, content in files.items():
        with whole_file(target / f"{figure}.png") as aside:
            aside.write_bytes(content)
    return f"wrote {', '.join(f'{figure}.png' for figure in files)} in {target}    {quality}"


def _quality(drawn: Redrawing, store: EpisodeStore, split: str, seed: int) -> str:
    rows = np.sort(np.random.default_rng(seed).permutation(_rows_of(store, split))[:_COUNTED])
    more = redraw(drawn.encoder, drawn.decoder, store, rows, drawn.layout.groups)
    mean = mean_training_picture(store, drawn.decoder.view)
    blank = np.broadcast_to(np.tile(mean, (drawn.encoder.spec.frame_stack, 1, 1)), more.pictures.shape)
    reached, least = psnr(more.draw(), more.pictures), psnr(blank, more.pictures)
    told = f"{reached:.1f} dB, {reached - least:.1f} above the mean training picture"
    return f"{len(rows)} {_SPLITS[split]} pictures: {told}"


def figures_of(drawn: Redrawing, name: str, which: Sequence[str] = FIGURES) -> dict[str, bytes]:
    """Name of each figure -> PNG."""
    makers = {"zeroed": zeroed_figure, "swapped": swapped_figure, "traversed": traversed_figure}
    return {figure: makers[figure](drawn, name) for figure in which}


def open_redrawing(
    bundle: Path, data: Path, *, groups: int | None, count: int, split: str, seed: int, device: str
) -> Redrawing:
    """Load a bundle, and encode some pictures of a store. Raises UserError as :func:`draw_factors` says."""
    if split not in _SPLITS:
        raise UserError(f"--split {split}: must be evaluation, train or all")
    if not 2 <= count <= MOST_PICTURES:
        raise UserError(f"--pictures must be from 2 to {MOST_PICTURES}, is {count}")
    if seed < 0:
        raise UserError(f"--seed must be at least 0, is {seed}")
    place = resolve_device(device)
    encoder, decoder = load_encoder(bundle).to(place), load_decoder(bundle, place)
    store = open_held_out(data, {str(bundle): encoder.description})
    check_compatible(encoder, store, str(bundle))
    rows = _rows_of(store, split)
    some = np.random.default_rng(seed).permutation(rows)[:count]
    if len(some) < 2:
        raise UserError(f"{data}: has {len(some)} pictures to draw in split {split}; choose another --split")
    drawn = redraw(encoder, decoder, store, np.sort(some), groups)
    if drawn.codes is None:
        return drawn
    counted = np.sort(np.random.default_rng(seed).permutation(rows)[:_COUNTED])
    return replace(drawn, counted=encode_rows(encoder, store, counted, device=place, progress=False)[1])


def _rows_of(store: EpisodeStore, split: str) -> np.ndarray:
    episodes = np.arange(len(store.starts)) if split == "all" else store.episodes(split)  # type: ignore[arg-type]
    return rows_of(store, episodes)


def zeroed_figure(drawn: Redrawing, name: str) -> bytes:
    """Pictures, drawn again, and with each group set to 0."""
    full = drawn.draw()
    lines = {"original": drawn.pictures, f"all groups\n{psnr(full, drawn.pictures):.1f} dB": full}
    for group in range(drawn.layout.groups):
        without = drawn.draw(drawn.layout.zeroed(drawn.latents, group))
        lines[f"group {group} zeroed\n{psnr(without, drawn.pictures):.1f} dB"] = without
    return picture_lines(_shown(drawn, lines), f"{name}: what is lost without a group is what it holds")


def swapped_figure(drawn: Redrawing, name: str) -> bytes:
    """Pairs of pictures; the first with each group of the second."""
    half = len(drawn.latents) // 2
    first, second = np.arange(half), np.arange(half, 2 * half)
    latents, donors = drawn.latents[first], drawn.latents[second]
    lines = {
        "A": drawn.pictures[first],
        "B": drawn.pictures[second],
        "A drawn": drawn.draw(latents),
        "B drawn": drawn.draw(donors),
    }
    for group in range(drawn.layout.groups):
        lines[f"A with group {group} of B"] = drawn.draw(drawn.layout.swapped(latents, donors, group))
    return picture_lines(_shown(drawn, lines), f"{name}: what changes from A to B with a group is what it holds")


def traversed_figure(drawn: Redrawing, name: str, examples: int = 3) -> bytes:
    """Some pictures with one group set to each of its most used codes; of an unquantised latent, to other pictures'."""
    lines: dict[str, np.ndarray] = {}
    # Neighbours in a store are often alike.
    chosen = _spread(len(drawn.latents), examples)
    for group in range(drawn.layout.groups):
        edited = _traversal(drawn, group)
        for number, example in enumerate(chosen):
            drawings = drawn.draw(np.stack([latents[example] for latents in edited]))
            lines[f"group {group}, picture {number}"] = np.concatenate([drawn.pictures[[example]], drawings])
    what = "its most used codes" if drawn.codes is not None else "that of other pictures"
    return picture_lines(_shown(drawn, lines), f"{name}: first the picture, then one group set to {what}")


def _traversal(drawn: Redrawing, group: int) -> list[np.ndarray]:
    """For each value of the group, latents (n, M) that have it."""
    if drawn.codes is None:
        return [
            drawn.layout.swapped(drawn.latents, np.broadcast_to(drawn.latents[other], drawn.latents.shape), group)
            for other in _spread(len(drawn.latents), _CODES)
        ]
    counted = drawn.codes if drawn.counted is None else drawn.counted
    codes = most_used(drawn.layout.codes(counted)[:, :, group].ravel(), _CODES)
    return [drawn.with_code(group, int(code)) for code in codes]


def _spread(count: int, most: int) -> np.ndarray:
    """At most so many of ``count`` indices, evenly spaced from the first to the last."""
    return np.linspace(0, count - 1, min(most, count)).astype(int)


def _shown(drawn: Redrawing, lines: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Colour or grey pictures of the newest frame."""
    channels = drawn.pictures.shape[1] // drawn.encoder.spec.frame_stack
    newest = 3 if channels % 3 == 0 else 1
    return {label: pictures[:, -newest:] for label, pictures in lines.items()}
