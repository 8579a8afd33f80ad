"""Checkpoint files: whole or refused."""

from __future__ import annotations

import os
import random
import resource
import subprocess
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from repdib_lightning.callbacks.checkpoint_files import damage, last_good, step_path, sweep_temporaries
from repdib_lightning.callbacks.checkpoint_io import AtomicCheckpointIO
from repdib_lightning.errors import UserError

CONTENT = {"weights": torch.arange(30_000, dtype=torch.float32), "step": 3, "rate": 0.1, "name": "x", "none": None}


def write(path: Path, step: int = 3) -> bytes:
    AtomicCheckpointIO().save_checkpoint({**CONTENT, "step": step}, path)
    return path.read_bytes()


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    write(tmp_path / "a.ckpt")
    return tmp_path / "a.ckpt"


def test_what_is_saved_is_loaded_and_stays_an_ordinary_torch_file(saved: Path) -> None:
    for loaded in (AtomicCheckpointIO().load_checkpoint(saved), torch.load(saved, weights_only=True)):
        assert torch.equal(loaded.pop("weights"), CONTENT["weights"])  # type: ignore[arg-type]
        assert loaded == {"step": 3, "rate": 0.1, "name": "x", "none": None}
    assert zipfile.ZipFile(saved).testzip() is None


def test_every_flipped_bit_is_noticed(saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    drawn = random.Random(0)
    places = [*range(8), *range(len(whole) - 120, len(whole)), *(drawn.randrange(len(whole)) for _ in range(100))]
    for place in places:
        content = bytearray(whole)
        content[place] ^= 1 << drawn.randrange(8)
        (tmp_path / "b.ckpt").write_bytes(content)
        assert damage(tmp_path / "b.ckpt") is not None, f"byte {place} of {len(whole)}"
    assert damage(saved) is None


def test_every_cut_and_every_addition_is_noticed(saved: Path, tmp_path: Path) -> None:
    whole = saved.read_bytes()
    drawn = random.Random(1)
    lengths = [0, 1, 22, 81, 82, 83, len(whole) - 1, len(whole) - 80, *(drawn.randrange(len(whole)) for _ in range(50))]
    for content in [*(whole[:length] for length in lengths), whole + b"\0", whole[1:]]:
        (tmp_path / "b.ckpt").write_bytes(content)
        assert damage(tmp_path / "b.ckpt") is not None, len(content)


def test_a_file_that_another_program_wrote_is_not_good(tmp_path: Path) -> None:
    torch.save(CONTENT, tmp_path / "b.ckpt")
    with pytest.raises(UserError, match=r"b\.ckpt: damaged checkpoint \(it does not end in a digest"):
        AtomicCheckpointIO().load_checkpoint(tmp_path / "b.ckpt")


def test_nothing_is_unpickled_even_when_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("repdib_lightning.callbacks.checkpoint_io.plain", lambda checkpoint: checkpoint)
    AtomicCheckpointIO().save_checkpoint({"call": subprocess.Popen}, tmp_path / "b.ckpt")
    with pytest.raises(Exception, match="Weights only load failed"):
        AtomicCheckpointIO().load_checkpoint(tmp_path / "b.ckpt", weights_only=False)


def test_a_missing_checkpoint_names_the_nearest(tmp_path: Path) -> None:
    write(step_path(tmp_path, 20))
    with pytest.raises(UserError, match=r"step-00000021\.ckpt: no such checkpoint; did you mean 'step-00000020\.ckpt'"):
        AtomicCheckpointIO().load_checkpoint(tmp_path / "step-00000021.ckpt")


def test_the_newest_good_one_is_chosen_and_damage_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "checkpoints"
    paths = [step_path(folder, step) for step in (90, 100, 110, 100_000_000)]
    for path in paths:
        write(path)
    (folder / "notes.ckpt").write_text("not one of ours")
    assert last_good(tmp_path) == last_good(folder) == last_good(paths[3]) == paths[3]
    assert capsys.readouterr().err == ""
    paths[3].write_bytes(b"")
    paths[2].write_bytes(paths[1].read_bytes()[:-1])
    assert last_good(tmp_path) == paths[1]
    warnings = capsys.readouterr().err.splitlines()
    assert [str(path) in line for path, line in zip(paths[:1:-1], warnings, strict=True)] == [True, True]
    with pytest.raises(UserError, match=r"100000000\.ckpt: damaged checkpoint"):
        last_good(paths[3])
    for path in paths[:2]:
        path.write_bytes(b"PK")
    with pytest.raises(UserError, match="all 4 checkpoints are damaged"):
        last_good(tmp_path)


@pytest.mark.parametrize("there", [True, False])
def test_no_checkpoint_at_all(tmp_path: Path, there: bool) -> None:
    with pytest.raises(UserError, match="no checkpoint to resume from"):
        last_good(tmp_path if there else tmp_path / "nowhere")


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Let the kernel refuse to write files beyond ``size`` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [0, 70, 50_000, 121_000])
def test_a_full_disk_leaves_the_previous_file_and_nothing_else(saved: Path, size: int) -> None:
    before = saved.read_bytes()
    assert len(before) > 121_000
    with disk_of(size), pytest.raises(UserError, match=r"a\.ckpt: cannot be written \(File too large\)"):
        AtomicCheckpointIO().save_checkpoint({**CONTENT, "step": 4}, saved)
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == ["a.ckpt"]


def test_a_disk_that_fills_up_while_flushing(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: int) -> None:
        raise OSError(28, "No space left on device")

    before = saved.read_bytes()
    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(UserError, match=r"a\.ckpt: cannot be written \(No space left on device\)"):
        AtomicCheckpointIO().save_checkpoint({**CONTENT, "step": 4}, saved)
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == ["a.ckpt"]


@pytest.mark.parametrize("folder", ["/proc/here", "a.ckpt/under"])
def test_a_folder_that_cannot_be_written_to(saved: Path, folder: str) -> None:
    with pytest.raises(UserError, match=r"b\.ckpt: cannot be written"):
        AtomicCheckpointIO().save_checkpoint(dict(CONTENT), saved.parent / folder / "b.ckpt")


def test_it_is_flushed_before_it_is_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("flush"), fsync(handle))[1])
    monkeypatch.setattr(
        os, "replace", lambda old, new: (done.append(f"rename in {Path(old).parent}"), replace(old, new))
    )
    monkeypatch.setenv("TMPDIR", "/dev/shm")
    write(tmp_path / "a.ckpt")
    assert done == ["flush", f"rename in {tmp_path}", "flush"]


def test_memory_is_not_doubled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    largest = 0
    from repdib_lightning.callbacks.checkpoint_files import DigestingFile

    real = DigestingFile.write

    def write_and_measure(self: DigestingFile, data: bytes) -> int:
        nonlocal largest
        largest = max(largest, len(data))
        return real(self, data)

    monkeypatch.setattr(DigestingFile, "write", write_and_measure)
    AtomicCheckpointIO().save_checkpoint({str(n): torch.ones(10_000) for n in range(50)}, tmp_path / "a.ckpt")
    assert largest == 40_000, "one tensor at a time"


def test_only_dead_writers_leftovers_are_swept(tmp_path: Path) -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    for name in (f".a.ckpt.tmp-{gone.pid}", f".b.ckpt.tmp-{os.getppid()}", "step-00000001.ckpt", ".hidden"):
        (tmp_path / name).touch()
    sweep_temporaries(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [f".b.ckpt.tmp-{os.getppid()}", ".hidden", "step-00000001.ckpt"]


def test_numpy_paths_and_odd_containers_are_made_plain(tmp_path: Path) -> None:
    checkpoint = {
        "array": np.arange(3, dtype=np.float32),
        "scalar": np.float64(1.5),
        "flag": np.bool_(True),
        "path": Path("runs/x"),
        "shape": torch.Size([2, 3]),
        "type": torch.float16,
        "nested": {"tuple": (1, [2, {3}], b"x")},
        "ordered": OrderedDict(a=1),
    }
    AtomicCheckpointIO().save_checkpoint(checkpoint, tmp_path / "a.ckpt")
    loaded = AtomicCheckpointIO().load_checkpoint(tmp_path / "a.ckpt")
    assert loaded.pop("array").tolist() == [0, 1, 2]
    expected = {**checkpoint, "path": "runs/x", "scalar": 1.5, "flag": True}
    expected.pop("array")
    assert loaded == expected
    assert type(loaded["scalar"]) is float


def test_batch_norm_state_keeps_its_versions(tmp_path: Path) -> None:
    state = torch.nn.Sequential(torch.nn.BatchNorm1d(2)).state_dict()
    AtomicCheckpointIO().save_checkpoint({"state_dict": state}, tmp_path / "a.ckpt")
    loaded = AtomicCheckpointIO().load_checkpoint(tmp_path / "a.ckpt")["state_dict"]
    assert loaded._metadata["0"] == {"version": 2}


@pytest.mark.parametrize("value", [lambda: 0, subprocess.Popen, np.array(["text"]), object()])
def test_anything_else_is_refused_by_its_key(tmp_path: Path, value: object) -> None:
    with pytest.raises(UserError, match=r"checkpoint\.hyper_parameters\.list\.1 holds a .*: checkpoints hold tensors"):
        AtomicCheckpointIO().save_checkpoint({"hyper_parameters": {"list": [1, value]}}, tmp_path / "a.ckpt")
    assert os.listdir(tmp_path) == []
