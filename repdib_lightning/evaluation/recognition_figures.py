"""``figures recognition BUNDLE DATA``: what is mistaken for what, what is needed for it, and some clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from repdib_lightning.data.files import whole_file
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation.bundle_data import open_held_out
from repdib_lightning.evaluation.bundles import bundle_of, display_name
from repdib_lightning.evaluation.features import check_compatible
from repdib_lightning.evaluation.recognition import checked_labels, report_of
from repdib_lightning.evaluation.recognition_choice import chosen_clips
from repdib_lightning.evaluation.recognition_clips import ShownClip, clip_figure, shown_clip
from repdib_lightning.evaluation.recognition_confusion import confusion_matrix
from repdib_lightning.evaluation.recognition_modalities import modality_bars
from repdib_lightning.evaluation.recognition_pass import recognise
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.export import load_classifier, load_encoder

MOST_CLIPS = 12
_SPLITS = {"evaluation": "held-out", "train": "training", "all": "training and held-out"}
_FILES = ("confusion", "modalities", "clips")


def draw_recognition(
    bundle: Path,
    data: Path,
    *,
    output: Path | None = None,
    clips: int = 4,
    split: str = "evaluation",
    device: str = "auto",
    progress: bool = True,
) -> str:
    """Draw how well the classifier of a bundle recognises clips, into PNG files.

    ``confusion.png``: how often each class is told as each other, and F1 of each. ``modalities.png``: macro F1 with
    each modality missing and with each alone, and attention weights. ``clips.png``: some clips with their frames and
    readings, the three most probable classes, and attention over time and modalities.

    Args:
        bundle: exported, with its classifier, or the run that holds it.
        data: the store; what the bundle held out of it is held out here.
        output: folder of the files; ``recognition`` beside the bundle by default.
        clips: how many are drawn, 1 to 12: of classes spread over the list the first that is recognised, and in the
            last place the first that is not, if there is one.
        split: evaluation, train, or all.
        device: runs encoder and classifier.
        progress: show a progress bar (on a terminal).

    Returns:
        A line of what was written, and of the scores.

    Raises:
        UserError: a bundle without a classifier, data that do not fit it, no clips, a bad option, or files that cannot
            be written; nothing is written then.
    """
    if split not in _SPLITS:
        raise UserError(f"--split {split}: must be evaluation, train or all, {nearest(split, _SPLITS)}")
    if not 1 <= clips <= MOST_CLIPS:
        raise UserError(f"--clips must be from 1 to {MOST_CLIPS}, is {clips}")
    folder = bundle_of(Path(bundle))
    target = folder.parent / "recognition" if output is None else Path(output)
    for figure in _FILES:
        check_output_file(target / f"{figure}.png", "--output", ".png", [Path(data)])
    files, scores = recognition_figures(
        folder, Path(data), display_name(folder), clips=clips, split=split, device=device, progress=progress
    )
    for figure, content in files.items():
        with whole_file(target / f"{figure}.png") as aside:
            aside.write_bytes(content)
    return f"wrote {', '.join(f'{figure}.png' for figure in files)} in {target}    {scores}"


def recognition_figures(
    bundle: Path, data: Path, name: str, *, clips: int, split: str, device: str = "auto", progress: bool = True
) -> tuple[dict[str, bytes], str]:
    """Name of each figure -> PNG, and a line with the scores; of fewer than two modalities ``modalities`` is left out.

    Args:
        name: what the figures call the bundle. bundle, data, clips, split, device, progress: as
            :func:`draw_recognition`, which also says what is raised.
    """
    place = resolve_device(device)
    encoder, classifier = load_encoder(bundle).to(place), load_classifier(bundle, place)
    store = open_held_out(data, {str(bundle): encoder.description})
    check_compatible(encoder, store, str(bundle))
    episodes = np.arange(len(store.starts)) if split == "all" else store.episodes(split)  # type: ignore[arg-type]
    rows = rows_of(store, episodes)
    labels = checked_labels(classifier, store, rows, str(bundle))
    recognised = recognise(encoder, classifier, store, rows, device=place, progress=progress)
    report = report_of(recognised, labels, classifier)
    told = recognised.predicted[()]
    chosen = [shown_clip(store, recognised, labels, index) for index in chosen_clips(labels, told, clips)]
    of_all = f"accuracy {report.scores.accuracy:.2f} on {report.clips} {_SPLITS[split]} clips"
    titled = {f"{name}, {_SPLITS[split]}": report}
    files = {"confusion": confusion_matrix(titled), "modalities": modality_bars(titled)}
    if recognised.modalities:
        files["clips"] = clip_figure(store, chosen, report.classes, f"{name}: {_rule(chosen)} ({of_all})")
    line = f"macro F1 {report.scores.f1_macro:.3f}, {of_all}"
    return {figure: content for figure, content in files.items() if content is not None}, line


def _rule(chosen: list[ShownClip]) -> str:
    """How clips were chosen (:func:`chosen_clips`), for the title."""
    wrong = [not clip.right for clip in chosen]
    if all(wrong):
        return "clips of classes spread over the list, none of them recognised"
    rule = "the first recognised clips of classes spread over the list"
    rule += " (the first, where none was)" if any(wrong[:-1]) else ""
    return rule + ("; last, one that is mistaken" if wrong[-1] else "")
