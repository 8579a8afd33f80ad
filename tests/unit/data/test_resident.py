"""Data kept on a device: the same batches bit for bit, loaded once, in parts; and the default keeps nothing."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch

from repdib_lightning.data import resident
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.loading import ResumableLoader
from repdib_lightning.data.robot_arm import RobotArmDataModule
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec, Batch


def module(path, **options) -> EpisodeDataModule:
    data = EpisodeDataModule(str(path), **{"batch_size": 4, "horizon": 2, "futures": 2, **options})
    data.setup("fit")
    return data


def epochs(loader: ResumableLoader, count: int) -> list[Batch]:
    return [batch for _ in range(count) for batch in loader]


def assert_same(one: list[Batch], other: list[Batch]) -> None:
    assert len(one) == len(other) > 0
    for left, right in zip(one, other, strict=True):
        assert list(left.observations) == list(right.observations)
        pairs = [(left.observations[name], right.observations[name]) for name in left.observations]
        pairs += [(left.offsets, right.offsets), (left.rows, right.rows)]
        assert (left.actions is None) == (right.actions is None)
        if left.actions is not None:
            pairs.append((left.actions, right.actions))
        for a, b in pairs:
            assert a.dtype == b.dtype and torch.equal(a, b)


@pytest.mark.parametrize("part", [1, 5000, 2**24])
@pytest.mark.parametrize("stack", [1, 3])
@pytest.mark.parametrize("kind", ["discrete", "continuous", None])
def test_the_same_batches(tmp_path, make_store, monkeypatch, kind, stack, part):
    monkeypatch.setattr(resident, "PART_BYTES", part)
    path = make_store(tmp_path / "small.h5", kind=kind)
    mapped, kept = (module(path, frame_stack=stack, resident=on) for on in (False, True))
    assert_same(epochs(mapped.train_dataloader(), 3), epochs(kept.train_dataloader(), 3))
    assert_same(list(mapped.val_dataloader()), list(kept.val_dataloader()))
    assert_same([mapped.example()], [kept.example()])


def test_vectors_beside_pictures_and_types_that_are_converted(tmp_path):
    path, generator = tmp_path / "mixed.h5", np.random.default_rng(0)
    views = {"arm": ArraySpec((5,), "float32"), "camera": ArraySpec((3, 6, 6))}
    with EpisodeWriter(path, rows=40, episodes=5, observations=views, actions=ActionSpec("continuous", 2)) as writer:
        for _ in range(5):
            observations = {
                "arm": generator.normal(size=(8, 5)).astype(np.float32),
                "camera": generator.integers(0, 256, (8, 3, 6, 6), np.uint8),
            }
            writer.add_episode(observations=observations, actions=generator.normal(size=(7, 2)).astype(np.float32))
    with h5py.File(path, "r+") as file:  # as other programs write: doubles, and compressed pictures in chunks
        actions, pictures = file["actions"][:].astype(np.float64) / 3, file["observations/camera"][:]
        about = dict(file["actions"].attrs)
        del file["actions"], file["observations/camera"]
        file["actions"] = actions
        file["actions"].attrs.update(about)
        file.create_dataset("observations/camera", data=pictures, chunks=(7, 3, 6, 6), compression="gzip")
    mapped, kept = (module(path, frame_stack=3, resident=on) for on in (False, True))
    assert_same(epochs(mapped.train_dataloader(), 2), epochs(kept.train_dataloader(), 2))


def test_resumes_from_either_and_by_ranks(store_file):
    mapped, kept = (module(store_file, resident=on) for on in (False, True))
    wanted = epochs(mapped.train_dataloader(), 3)
    broken = kept.train_dataloader()
    seen = [batch for _, batch in zip(range(3), broken, strict=False)]
    for data in (mapped, kept):
        resumed = data.train_dataloader()
        resumed.load_state_dict(broken.state_dict())
        rest = epochs(resumed, 3)
        assert_same((seen + rest)[: len(wanted)], wanted)
    dataset = kept.train_dataloader().dataset
    shares = [epochs(ResumableLoader(dataset, 4, rank=rank, world_size=2), 1) for rank in range(2)]
    joined = [left.rows.tolist() + right.rows.tolist() for left, right in zip(*shares, strict=True)]
    assert joined == [batch.rows.tolist() for batch in wanted[: len(joined)]]


def test_only_what_is_used_is_loaded_once_by_the_first_batch(store_file, monkeypatch):
    loaded = []
    parts = EpisodeStore.parts

    def watched(store, name, size):
        loaded.append(name)
        return parts(store, name, size)

    monkeypatch.setattr(EpisodeStore, "parts", watched)
    data = module(store_file, views=["top"], resident=True)
    training, validation = data.train_dataloader(), data.val_dataloader()
    data.example()
    assert loaded == []
    epochs(training, 2)
    list(validation)
    next(iter(data.train_dataloader()))
    assert loaded == ["observations/top", "actions"]


def test_the_device_is_the_trainers(store_file):
    data = module(store_file, resident=True)
    data.train_dataloader()
    root = torch.device("meta")  # has shapes and no memory: whatever stayed on the CPU shows
    data.trainer = SimpleNamespace(strategy=SimpleNamespace(root_device=root), global_rank=0, world_size=1)
    batch = next(iter(data.train_dataloader()))
    assert {name: frames.device for name, frames in batch.observations.items()} == {"front": root, "top": root}
    assert batch.observations["top"].shape == (4, 3, 3, 24, 24) and batch.observations["top"].dtype == torch.uint8
    assert batch.actions.device == root and batch.actions.dtype == torch.int64


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_same_batches_on_a_gpu(store_file):
    mapped, kept = (module(store_file, frame_stack=3, resident=on) for on in (False, True))
    device = torch.device("cuda:0")
    kept.trainer = SimpleNamespace(strategy=SimpleNamespace(root_device=device), global_rank=0, world_size=1)
    batches = epochs(kept.train_dataloader(), 2)
    assert all(batch.observations["top"].device == device for batch in batches)
    back = [
        Batch({n: frames.cpu() for n, frames in b.observations.items()}, b.actions.cpu(), b.offsets, b.rows)
        for b in batches
    ]
    assert_same(epochs(mapped.train_dataloader(), 2), back)


@pytest.mark.parametrize("kind", [EpisodeDataModule, RobotArmDataModule])
def test_worker_processes_are_refused(store_file, kind):
    with pytest.raises(UserError, match=r"data.resident .* data.workers is 2: .* set data.workers to 0$"):
        kind(str(store_file), workers=2, resident=True)
    assert kind(str(store_file), resident=True).resident


def test_data_that_do_not_fit_are_refused_at_the_first_batch(store_file, monkeypatch):
    data = module(store_file, views=["top"], resident=True)
    need = 45 * 3 * 24 * 24 + 45 * 8
    monkeypatch.setattr(resident, "free_memory", lambda device: need - 1)
    message = rf"small.h5: .* memory of cpu: .* need {need / 2**30:.3g} GiB, .* are free; leave data.resident off$"
    with pytest.raises(UserError, match=message):
        next(iter(data.train_dataloader()))
    monkeypatch.setattr(resident, "free_memory", lambda device: need)
    assert len(next(iter(data.train_dataloader()))) == 4


def test_free_memory_is_what_the_system_says(tmp_path, monkeypatch):
    told = tmp_path / "meminfo"
    told.write_text("MemTotal:  900 kB\nMemFree:  100 kB\nMemAvailable:   300 kB\n")
    monkeypatch.setattr(resident, "_MEMORY", told)
    assert resident.free_memory(torch.device("cpu")) == 300 * 1024
    monkeypatch.setattr(resident, "_MEMORY", tmp_path / "none")
    assert resident.free_memory(torch.device("cpu")) is None
    assert resident.free_memory(torch.device("meta")) is None


LIMITED = """
    import resource, sys
    from pathlib import Path
    import numpy as np
    from repdib_lightning.data.episodes import EpisodeStore
    from repdib_lightning.data.loading import FutureFrames, ResumableLoader
    from repdib_lightning.data.sampling import FutureSampling

    store = EpisodeStore(sys.argv[1])
    sampling = FutureSampling(store, "train", horizon=1, futures=1, seed=0)
    loader = ResumableLoader(FutureFrames(store, sampling, 1, ["camera"]), 8)
    lines = Path("/proc/self/status").read_text().splitlines()
    used = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData:"))
    resource.setrlimit(resource.RLIMIT_DATA, (used + 32 * 2**20, used + 32 * 2**20))
    seen = set()
    for batch in loader:
        seen |= set((batch.rows[:, None] + batch.offsets).flatten().tolist())
    print(len(seen))
    try:
        np.array(store.array("observations/camera"))
    except MemoryError:
        print("no memory")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_DATA counts what is allocated on Linux only")
def test_the_default_reads_a_store_that_memory_could_not_hold(tmp_path):
    path, block = tmp_path / "large.h5", np.random.default_rng(0).integers(0, 256, (160, 3, 256, 256), np.uint8)
    with EpisodeWriter(
        path, rows=5 * 160, episodes=5, observations={"camera": ArraySpec((3, 256, 256))}, actions=None
    ) as writer:
        for episode in range(5):
            writer.add_episode(observations={"camera": block}, evaluation=episode == 4)
    assert path.stat().st_size > 4 * 32 * 2**20
    command = [sys.executable, "-c", textwrap.dedent(LIMITED), str(path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert ended.returncode == 0, ended.stderr
    count, outcome = ended.stdout.splitlines()
    assert int(count) >= 620 and outcome == "no memory"
