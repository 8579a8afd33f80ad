"""V-D4RL (Lu et al., Challenges and Opportunities in Offline RL from Visual Observations, TMLR 2023).

Two published forms of the same recordings: 64 px, one npz file an episode; 84 px, gzip HDF5 shards.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from repdib_lightning.data.importers.file_order import natural_key
from repdib_lightning.data.importers.recorded import Recording, write_recording
from repdib_lightning.errors import UserError

_PUBLISHER = "https://github.com/conglu1997/v-d4rl"
_SHARD_ENDINGS = (".hdf5", ".h5")


def import_vd4rl(source: Path, output: Path, *, overwrite: bool = False, progress: bool = True) -> Path:
    """Convert V-D4RL into a store with one observation, ``pixels``: (3, 64, 64) or (3, 84, 84) uint8.

    The form is recognised by itself: ``*.npz`` episodes or ``*.hdf5`` shards. In both, ``action[t]`` led to
    ``observation[t]`` and an episode's first row is a placeholder; here, actions and rewards are moved to the
    observation that they were taken at. Frames stay un-stacked. Memory holds one episode at a time.

    Args:
        source: a folder such as ``vd4rl_data/main/walker_walk/expert/84px``, or one file of it.
        output: the store to write (.h5).
        overwrite: replace an existing output.
        progress: show a progress bar.

    Returns:
        The output.

    Raises:
        UserError: naming file and key: nothing to import, an unreadable file, a missing key, lengths that disagree, a
            wrong type, NaN, a shard that starts or ends in the middle of an episode without its neighbour. Nothing is
            skipped, and no output is left.
    """
    source, output = Path(source), Path(output)
    files = _find_files(source)
    recording: Recording
    if files[0].suffix == ".npz":
        from repdib_lightning.data.importers.vd4rl_npz import EpisodeFiles

        recording = EpisodeFiles(files, progress=progress)
    else:
        from repdib_lightning.data.importers.vd4rl_hdf5 import Shards

        recording = Shards(files, progress=progress)
    attributes = _describe(source, files)
    return write_recording(recording, output, attributes=attributes, overwrite=overwrite, progress=progress)


def _find_files(source: Path) -> list[Path]:
    """Files of one form, in the order of the numbers in their names (``2.hdf5`` before ``10.hdf5``)."""
    if not source.exists():
        raise UserError(f"{source}: no such file or folder")
    candidates = [source] if source.is_file() else list(source.iterdir())
    npz = [file for file in candidates if file.suffix == ".npz"]
    shards = [file for file in candidates if file.suffix in _SHARD_ENDINGS]
    if npz and shards:
        raise UserError(f"{source}: holds both *.npz and *.hdf5 files; import one form at a time (64px or 84px)")
    if not npz and not shards:
        below = sorted({file.parent for ending in (".npz", *_SHARD_ENDINGS) for file in source.glob(f"*/*{ending}")})
        hint = f"; did you mean {below[0]}?" if below else ""
        raise UserError(f"{source}: no V-D4RL files here (*.npz episodes or *.hdf5 shards){hint}")
    return sorted(npz or shards, key=lambda file: natural_key(file.name))


def _describe(source: Path, files: list[Path]) -> dict[str, Any]:
    """Environment and origin as far as the published tree shows them: ``.../<set>/<task>/<policy>/<n>px``."""
    folder = (source if source.is_dir() else source.parent).absolute()
    attributes: dict[str, Any] = {
        "environment": "unknown",
        "source": f"V-D4RL ({_PUBLISHER}), {len(files)} {files[0].suffix} files of {source}",
        "licence": f"publisher's repository: MIT; terms of the data files: see {_PUBLISHER}",
    }
    if re.fullmatch(r"\d+px", folder.name) and re.fullmatch(r"[a-z]+(_[a-z]+)+", folder.parts[-3]):
        attributes["environment"] = f"dm_control/{folder.parts[-3]}"
        attributes["policy"] = folder.parts[-2]
        attributes["vd4rl_set"] = "/".join(folder.parts[-4:])
    return attributes
