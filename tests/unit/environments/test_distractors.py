"""Where distracting clips come from: disjoint, repeatable, of one size, with clear errors."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from repdib_lightning.environments.distractors import Distractors
from repdib_lightning.errors import UserError


def write_picture(path: Path, colour: tuple[int, int, int], size: tuple[int, int] = (40, 30)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, colour).save(path)


def write_video(path: Path, levels: list[int], codec: str = "mpeg4") -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        for level in levels:
            frame = av.VideoFrame.from_ndarray(np.full((32, 48, 3), level, dtype=np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_cifar(folder: Path, images: int = 4) -> None:
    """CIFAR-10's files with our own pictures; torchvision checks sums, so a test must replace them."""
    folder.mkdir(parents=True)
    names = [*(f"data_batch_{i}" for i in range(1, 6)), "test_batch"]
    for value, name in enumerate(names):
        data = np.full((images, 3072), value * 40, dtype=np.uint8)
        (folder / name).write_bytes(pickle.dumps({"data": data, "labels": [0] * images}))
    (folder / "batches.meta").write_bytes(pickle.dumps({"label_names": ["thing"] * 10}))


@pytest.mark.parametrize("source", ["procedural", "procedural_images"])
def test_procedural_clips_depend_on_seed_split_and_number_alone(source):
    train, again = (Distractors.from_spec(source, "train", seed=3, size=(20, 28), limit=4) for _ in range(2))
    again.clip(3)  # the order of use must not matter
    assert all(np.array_equal(train.clip(i), again.clip(i)) for i in range(4))
    others = [
        Distractors.from_spec(source, "evaluation", seed=3, size=(20, 28), limit=4).clip(0),
        Distractors.from_spec(source, "train", seed=4, size=(20, 28), limit=4).clip(0),
        train.clip(1),
    ]
    assert all(np.abs(train.clip(0).astype(int) - other).mean() > 5 for other in others)
    assert train.clip(0).shape == ((48 if source == "procedural" else 1), 20, 28, 3)


def test_scenes_move_smoothly():
    clip = Distractors.from_spec("procedural", "train", size=32, limit=1).clip(0).astype(float)
    step = np.abs(np.diff(clip, axis=0)).mean()
    far = np.abs(clip[24:] - clip[:24]).mean()
    assert 0.5 < step < far / 2


def test_stills_have_natural_spectra():
    """The amplitude of natural pictures falls about as 1/f: a slope near -1 on log axes, white noise has 0."""
    images = Distractors.from_spec("procedural_images", "train", size=64, limit=20)
    grey = np.concatenate([images.clip(i) for i in range(20)]).mean(axis=-1)
    power = np.abs(np.fft.fft2(grey - grey.mean(axis=(1, 2), keepdims=True))).mean(axis=0)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64)))
    used = (frequency > 0.03) & (frequency < 0.4)
    slope = np.polyfit(np.log(frequency[used]), np.log(power[used]), 1)[0]
    assert -1.7 < slope < -0.8


def test_folder_of_pictures_is_split_without_overlap(tmp_path):
    for i in range(8):
        write_picture(tmp_path / f"{i}.png", (i * 30, 0, 0))
    train = Distractors.from_spec(str(tmp_path), "train", seed=1, size=8)
    held_out = Distractors.from_spec(str(tmp_path), "evaluation", seed=1, size=8)
    assert (len(train), len(held_out)) == (6, 2)
    assert set(train.keys).isdisjoint(held_out.keys)
    assert all(d.clip(i)[0, 0, 0, 0] == int(d.keys[i].stem) * 30 for d in (train, held_out) for i in range(len(d)))
    other = {tuple(Distractors.from_spec(str(tmp_path), "evaluation", seed=s).keys) for s in range(8)}
    assert len(other) > 1, "the seed chooses which are held out"


def test_subfolders_and_videos_are_clips(tmp_path):
    for i in (0, 2, 1):
        write_picture(tmp_path / "walk" / f"{i:02d}.jpg", (i * 100,) * 3)
    write_video(tmp_path / "clip.mp4", [0, 60, 120, 180, 240])
    splits = [Distractors.from_spec(str(tmp_path), split, size=16) for split in ("train", "evaluation")]
    clips = {d.keys[0].name: d.clip(0) for d in splits}
    assert np.allclose(clips["walk"].mean(axis=(1, 2, 3)), [0, 100, 200], atol=3)
    assert np.allclose(clips["clip.mp4"].mean(axis=(1, 2, 3)), [0, 60, 120, 180, 240], atol=6)


def test_pictures_are_cropped_not_stretched(tmp_path):
    wide = np.zeros((10, 30, 3), dtype=np.uint8)
    wide[:, 10:20] = 255
    for name in ("a.png", "b.png"):
        Image.fromarray(wide).save(tmp_path / name)
    assert Distractors.from_spec(str(tmp_path), "train", size=10).clip(0).min() == 255


@pytest.mark.parametrize("inner", ["", "cifar-10-batches-py"])
def test_cifar_keeps_its_own_split(tmp_path, monkeypatch, inner):
    from torchvision.datasets import CIFAR10

    write_cifar(tmp_path / "cifar-10-batches-py")
    monkeypatch.setattr("torchvision.datasets.cifar.check_integrity", lambda path, md5=None: Path(path).exists())
    monkeypatch.setattr(CIFAR10, "meta", {**CIFAR10.meta, "md5": None})
    source = str(tmp_path / inner)
    train = Distractors.from_spec(source, "train", size=32)
    held_out = Distractors.from_spec(source, "evaluation", size=32)
    assert (len(train), len(held_out)) == (20, 4)
    assert {int(train.clip(i).max()) for i in range(20)} == {0, 40, 80, 120, 160}
    assert {int(held_out.clip(i).max()) for i in range(4)} == {200}


def test_bad_sources_are_named(tmp_path):
    def message(source: str, clip: bool = False) -> str:
        with pytest.raises(UserError) as caught:
            opened = [Distractors.from_spec(source, split, size=8) for split in ("train", "evaluation")]
            assert clip, "opening should have failed"
            for distractors in opened:
                distractors.clip(0)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "did you mean 'procedural'" in message("proceduralo")
    assert "0 clips found" in message(str(tmp_path))
    write_picture(tmp_path / "one.png", (1, 2, 3))
    assert "1 clips found, at least 2" in message(str(tmp_path))
    (tmp_path / "two.png").write_bytes(b"no picture")
    assert "two.png: not a readable picture" in message(str(tmp_path), clip=True)
    (tmp_path / "two.png").unlink()
    (tmp_path / "two.mp4").write_bytes(b"no video")
    assert "two.mp4: not a readable video" in message(str(tmp_path), clip=True)
    (tmp_path / "cifar-10-batches-py").mkdir()
    assert "not torchvision's CIFAR-10" in message(str(tmp_path))


def test_unknown_split_and_sizes_are_refused():
    with pytest.raises(UserError, match=r"unknown split 'eval'.*did you mean 'evaluation'"):
        Distractors.from_spec("procedural", "eval")
    with pytest.raises(UserError, match="must be at least 1"):
        Distractors.from_spec("procedural", "train", size=0)


def test_limit_keeps_a_subset(tmp_path):
    for i in range(12):
        write_picture(tmp_path / f"{i}.png", (i, 0, 0))
    everything = Distractors.from_spec(str(tmp_path), "train", seed=2)
    few = Distractors.from_spec(str(tmp_path), "train", seed=2, limit=3)
    assert len(few) == 3 and set(few.keys) < set(everything.keys)
