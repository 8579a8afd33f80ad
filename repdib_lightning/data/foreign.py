"""Recognises data of other programs, and says what to do with it."""

from __future__ import annotations

import zipfile
from pathlib import Path

import h5py

from repdib_lightning.data.schema import FORMAT

_IMPORT = "python -m repdib_lightning import"
_PICTURES = (".jpg", ".jpeg", ".png")
_VISIBLE = "[!._]*"
_STREAMS = ("acc_watch_clip", "acc_phone_clip", "gyro_clip", "orientation_clip")
_WATCH = "watch_dataset.npy"


def describe_foreign(path: Path) -> str | None:
    """What a file or folder is, if it is no store of ours but known, and the command that converts it; else None."""
    if path.is_dir():
        return _describe_folder(path)
    if path.suffix == ".npz" and path.is_file():
        return _describe_npz(path)
    if path.suffix.lower() == ".csv" and path.is_file():
        return f"{path}: a table; if it lists image files, convert it: {_IMPORT} images {path} data/NAME.h5"
    if path.name == _WATCH and path.is_file():
        return f"{path}: seglearn's recordings of a smartwatch; convert: {_IMPORT} smartwatch {path} data/NAME.h5"
    if path.is_file() and h5py.is_hdf5(path):
        return _describe_hdf5(path)
    return None


def _describe_folder(folder: Path) -> str | None:
    if streams := [name for name in _STREAMS if (folder / name).is_dir()]:
        return f"{folder}: sensors of MMAct's form ({streams[0]}/); convert: {_IMPORT} mmact {folder} data/NAME.h5"
    for ending, form in (("npz", "64 px episodes"), ("hdf5", "84 px shards")):
        files = sorted(folder.glob(f"*.{ending}"))
        if files and describe_foreign(files[0]) is not None:
            return f"{folder}: {len(files)} *.{ending} files, V-D4RL {form}; convert: {_convert_vd4rl(folder)}"
    if any(folder.glob("*.csv")):
        return f"{folder}: a folder with a table of images; convert: {_IMPORT} images {folder} data/NAME.h5"
    return _describe_picture_tree(folder)


def _describe_picture_tree(folder: Path) -> str | None:
    """Of a folder of the shape of PACS, ``<domain>/<class>/<picture>``; hidden names are none."""
    for file in folder.glob("/".join([_VISIBLE] * 3)):
        if file.suffix.lower() in _PICTURES:
            return (
                f"{folder}: pictures two folders down, such as {file.relative_to(folder)}; if these folders are "
                f"domain and class, as in PACS, convert: {_IMPORT} pacs {folder} data/NAME.h5 "
                "--domains all --classes all"
            )
    return None


def _convert_vd4rl(folder: Path) -> str:
    return f"{_IMPORT} vd4rl {folder} data/NAME.h5"


def _describe_npz(path: Path) -> str | None:
    try:
        with zipfile.ZipFile(path) as archive:
            keys = {name.removesuffix(".npy") for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError):
        return None
    if {"image", "action", "reward"} <= keys:
        return f"{path}: one V-D4RL episode (64 px form); convert the whole folder: {_convert_vd4rl(path.parent)}"
    return f"{path}: an npz archive of {', '.join(sorted(keys)) or 'nothing'}; no import reads this"


def _describe_hdf5(path: Path) -> str | None:
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") == FORMAT:
                return None
            keys = set(file)
            rows = len(file["observation"]) if isinstance(file.get("observation"), h5py.Dataset) else 0
            groups = set(file["data"]) if isinstance(file.get("data"), h5py.Group) else set()
    except OSError:
        return None
    if {"observation", "action", "step_type"} <= keys:
        convert = _convert_vd4rl(path.parent)
        return f"{path}: a V-D4RL shard of {rows:,} rows (84 px form); convert the whole folder: {convert}"
    known = {
        "D4RL": {"observations", "actions", "terminals"} <= keys,
        "robomimic": any(key.startswith("demo_") for key in groups),
        "Minari": any(key.startswith("episode_") for key in keys),
    }
    for name, matches in known.items():
        if matches:
            return f"{path}: looks like {name} (keys: {', '.join(sorted(keys)[:8])}); there is no import for it"
    return None
