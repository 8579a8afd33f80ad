"""A chunked, compressed store becomes a contiguous one with the same values and the same fingerprint."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.importers.repack import import_store
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec


def compress(source: Path, target: Path) -> Path:
    """Copy a store with gzip chunks that end nowhere near its episodes."""
    with h5py.File(source, "r") as old, h5py.File(target, "w") as new:
        new.attrs.update(old.attrs)

        def copy(name: str, item: h5py.Dataset | h5py.Group) -> None:
            if isinstance(item, h5py.Dataset):
                chunks = (min(7, item.shape[0]), *item.shape[1:])
                made = new.create_dataset(name, data=item[:], chunks=chunks, compression="gzip")
                made.attrs.update(item.attrs)

        old.visititems(copy)
    return target


def contents(path: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(path, "r") as file:
        file.visititems(lambda name, item: found.update({name: item[:]}) if isinstance(item, h5py.Dataset) else None)
    return found


def write_with_everything(path: Path) -> Path:
    """Rewards, ends and masks too."""
    generator = np.random.default_rng(0)
    lengths = (9, 5)
    with EpisodeWriter(
        path,
        rows=sum(lengths),
        episodes=len(lengths),
        observations={"front": ArraySpec((3, 10, 13)), "joints": ArraySpec((4,), "float32")},
        actions=ActionSpec("continuous", 2),
        masks={"front": (10, 13)},
        rewards=True,
        attributes={"environment": "toy", "configuration": {"seed": 3}},
    ) as writer:
        for length in lengths:
            writer.add_episode(
                observations={
                    "front": generator.integers(0, 256, (length, 3, 10, 13), dtype=np.uint8),
                    "joints": generator.normal(size=(length, 4)).astype(np.float32),
                },
                actions=generator.normal(size=(length - 1, 2)),
                rewards=generator.random(length - 1),
                terminations=np.arange(length - 1) == length - 2,
                truncations=np.zeros(length - 1, bool),
                masks={"front": generator.random((length, 10, 13)) > 0.5},
                evaluation=length == 5,
            )
    return path


def test_every_array_attribute_and_the_fingerprint_survive(tmp_path: Path) -> None:
    original = write_with_everything(tmp_path / "original.h5")
    packed = compress(original, tmp_path / "packed.h5")
    store = EpisodeStore(import_store(packed, tmp_path / "again.h5", progress=False))
    before, after = contents(original), contents(store.path)
    assert before.keys() == after.keys()
    for name, values in before.items():
        np.testing.assert_array_equal(after[name], values)
        assert after[name].dtype == values.dtype
    assert isinstance(store.array("observations/front"), np.memmap)
    first = EpisodeStore(original)
    assert store.attributes == first.attributes
    assert recompute_fingerprint(EpisodeStore(packed)) == first.fingerprint == recompute_fingerprint(store)


def test_factors_survive(make_store: Callable[..., Path], tmp_path: Path) -> None:
    original = EpisodeStore(make_store(tmp_path / "original.h5"))
    store = EpisodeStore(import_store(compress(original.path, tmp_path / "p.h5"), tmp_path / "n.h5", progress=False))
    assert store.factors == original.factors
    assert store.fingerprint == original.fingerprint


def test_a_key_that_would_be_lost_is_refused(store_file: Path, tmp_path: Path) -> None:
    with h5py.File(store_file, "a") as file:
        file["infos/speed"] = np.zeros(45)
    with pytest.raises(UserError, match=r"small\.h5: key 'infos/speed' is not part of the schema"):
        import_store(store_file, tmp_path / "out.h5", progress=False)
    assert not (tmp_path / "out.h5").exists()


def test_a_damaged_chunk_leaves_no_output(store_file: Path, tmp_path: Path) -> None:
    packed = compress(store_file, tmp_path / "packed.h5")
    with h5py.File(packed, "r") as file:
        place = file["observations/front"].id.get_chunk_info(2)
    content = bytearray(packed.read_bytes())
    content[place.byte_offset + 50 : place.byte_offset + 400] = bytes(350)
    packed.write_bytes(content)
    out = tmp_path / "out"
    with pytest.raises(UserError, match="'observations/front' rows 14 to 21 cannot be read"):
        import_store(packed, out / "store.h5", progress=False)
    assert list(out.iterdir()) == []


def test_a_changed_value_a_moved_border_and_a_changed_split_change_the_fingerprint(
    make_store: Callable[..., Path], tmp_path: Path
) -> None:
    store_file = make_store(tmp_path / "small.h5", kind=None)
    store = EpisodeStore(store_file)
    assert recompute_fingerprint(store) == store.fingerprint
    for key, index, value in (
        ("factors/light", 3, 0.123),
        ("observations/top", (0, 0, 0, 1), 201),
        ("episodes/evaluation", 0, True),
    ):
        with h5py.File(store_file, "a") as file:
            kept = file[key][index]
            file[key][index] = value
        assert recompute_fingerprint(EpisodeStore(store_file)) != store.fingerprint, key
        with h5py.File(store_file, "a") as file:
            file[key][index] = kept
    with h5py.File(store_file, "a") as file:
        file["episodes/length"][:2] = [12, 10]
        file["episodes/start"][1] = 12
    assert recompute_fingerprint(EpisodeStore(store_file)) != store.fingerprint
