"""Which observations of a store of clips an encoder uses."""

from __future__ import annotations

from torch import nn

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import DataSpec


def clip_modalities(spec: DataSpec, names: list[str] | None) -> list[str]:
    """Names of the videos and sequences to use: the given ones, or all in the spec.

    Raises:
        UserError: an unknown name, one that is no clip, one given twice, or none at all.
    """
    clips = [name for name, array in spec.observations.items() if array.is_video or array.is_sequence]
    chosen = clips if names is None else names
    if not chosen:
        raise UserError(
            f"MultimodalEncoder: needs at least one video (T, C, H, W) or sequence (T, X) in a row; the data has "
            f"{', '.join(clips) or 'none'}"
        )
    for name in chosen:
        if name not in clips:
            raise UserError(
                f"MultimodalEncoder: modalities has '{name}', which is no clip in the data, {nearest(name, clips)}"
            )
        if chosen.count(name) > 1:
            raise UserError(f"MultimodalEncoder: modalities has '{name}' twice")
        if "." in name or hasattr(nn.ModuleDict, name):
            raise UserError(f"MultimodalEncoder: an observation cannot be called '{name}'; rename it in the data")
    return list(chosen)


def sequences_among(spec: DataSpec, option: str, names: list[str] | None) -> list[str]:
    """The sequences that an option names, checked against the spec of those it may name; none for None.

    Raises:
        UserError: a name that is no sequence among the modalities used.
    """
    sequences = [name for name, array in spec.observations.items() if array.is_sequence]
    for name in names or []:
        if name not in sequences:
            raise UserError(
                f"MultimodalEncoder: {option} has '{name}', which is none of the sequences it can name, "
                f"{nearest(name, sequences) or 'there is none'}"
            )
    return list(names or [])
