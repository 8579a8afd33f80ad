"""One source of distracting pictures and videos for every environment.

Everything is a *clip*: a few frames in order, or a single still. A source is named by one string:

- ``procedural``: moving scenes, made on the spot from drifting textures with natural-image (1/f) spectra and shapes
  that move across; needs no file.
- ``procedural_images``: stills with natural-image spectra; needs no file.
- a folder: each picture in it is a still, each sub-folder of pictures is one clip (frames in the order of their
  names), each video file is one clip.
- a folder that is, or holds, torchvision's ``cifar-10-batches-py``: stills, training and evaluation from
  CIFAR-10's own split.

Training and evaluation never share a clip; which is which depends on (source, seed) alone.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import Split

PICTURES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".webp"})
VIDEOS = frozenset({".mp4", ".avi", ".mov", ".mkv", ".webm"})
BUILT_IN = ("procedural", "procedural_images")
CIFAR_FOLDER = "cifar-10-batches-py"
EVALUATION_SHARE = 0.25
"""Share of a folder's clips that is kept for evaluation."""

MOST_FRAMES = 300
"""Frames read from a video file or a folder of frames; the rest of a long video is not played."""

_CACHED_BYTES = 2**28
_SPLITS: dict[Split, int] = {"train": 0, "evaluation": 1}


class _Source(Protocol):
    def keys(self, split: Split) -> list[Any]:
        """What identifies each clip of a split."""
        ...

    def load(self, key: Any, height: int, width: int) -> np.ndarray:
        """(T, H, W, 3) uint8."""
        ...


class Distractors:
    """The clips of one split of a source, scaled to one size; use :meth:`from_spec`.

    Attributes:
        keys: what identifies each clip (a path, or numbers); disjoint between splits.
    """

    def __init__(self, source: _Source, split: Split, height: int, width: int, limit: int | None, seed: int) -> None:
        self._source, self._height, self._width = source, height, width
        keys = source.keys(split)
        if limit is not None and limit < len(keys):
            chosen = np.random.default_rng([seed, 17]).permutation(len(keys))[:limit]
            keys = [keys[i] for i in np.sort(chosen)]
        self.keys = keys
        self._cache: OrderedDict[int, np.ndarray] = OrderedDict()

    @classmethod
    def from_spec(
        cls,
        source: str,
        split: Split,
        *,
        seed: int = 0,
        size: int | tuple[int, int] = 64,
        limit: int | None = None,
        frames: int = 48,
    ) -> Distractors:
        """Open a source.

        Args:
            source: ``procedural``, ``procedural_images``, or a path (see the module's text).
            split: ``train`` or ``evaluation``.
            seed: decides which clips of a folder are for evaluation, and what procedural clips look like.
            size: height and width in pixels, or one number for both. Pictures are cropped at the centre to the wanted
                proportions, then scaled.
            limit: how many clips to use at most; None for all.
            frames: length of procedural clips.

        Raises:
            UserError: unknown source, missing or empty folder, too few clips for two splits, unreadable CIFAR-10.
        """
        height, width = (size, size) if isinstance(size, int) else size
        if split not in _SPLITS:
            raise UserError(f"distractors: unknown split '{split}', {nearest(split, _SPLITS)}")
        if frames < 1 or height < 1 or width < 1 or (limit is not None and limit < 1):
            raise UserError(f"distractors: size {size}, frames {frames} and limit {limit} must be at least 1")
        return cls(_open_source(source, seed, frames), split, height, width, limit, seed)

    def __len__(self) -> int:
        return len(self.keys)

    def clip(self, index: int) -> np.ndarray:
        """(T, H, W, 3) uint8: one clip; T is 1 for a still. The latest ones are kept in memory.

        Raises:
            UserError: the clip's file cannot be read.
        """
        if index not in self._cache:
            clip = self._source.load(self.keys[index], self._height, self._width)
            assert clip.dtype == np.uint8 and clip.shape[1:] == (self._height, self._width, 3)
            self._cache[index] = clip
            while len(self._cache) > 1 and sum(c.nbytes for c in self._cache.values()) > _CACHED_BYTES:
                self._cache.popitem(last=False)
        self._cache.move_to_end(index)
        return self._cache[index]


def _open_source(source: str, seed: int, frames: int) -> _Source:
    if source == "procedural":
        return ProceduralScenes(seed, frames)
    if source == "procedural_images":
        return ProceduralImages(seed)
    folder = Path(source).expanduser()
    if not folder.is_dir():
        known = [*BUILT_IN, "a folder of pictures or videos", "a folder with " + CIFAR_FOLDER]
        raise UserError(f"distractors: '{source}' is neither built in nor a folder, {nearest(source, known)}")
    for root in (folder, folder.parent):
        if (root / CIFAR_FOLDER).is_dir() and (root == folder or folder.name == CIFAR_FOLDER):
            return Cifar10(root)
    return Folder(folder, seed)


def _rng(seed: int, split: int, index: int) -> np.random.Generator:
    return np.random.default_rng([seed, split, index])


def natural_spectrum(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """(3, H, W // 2 + 1) complex Fourier coefficients of a colour texture whose amplitude falls as 1/f.

    Amplitudes of natural pictures fall about as 1/f (Field 1987); the channels are correlated, as theirs are.
    """
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency[0, 0] = np.inf
    noise = rng.standard_normal((2, 3, *frequency.shape))
    colours = 0.6 * rng.standard_normal((3, 3)) + np.full((3, 3), 0.5)
    mixed = np.einsum("ij,jhw->ihw", colours, noise[0] + 1j * noise[1])
    return mixed / frequency ** rng.uniform(1.0, 1.5)


def _texture(spectrum: np.ndarray, mean: np.ndarray, contrast: float, height: int, width: int) -> np.ndarray:
    """(..., 3, H, W) coefficients -> (..., H, W, 3) values around ``mean`` (3,), not yet clipped."""
    picture = np.fft.irfft2(spectrum, s=(height, width))
    picture *= contrast / picture.std()
    return np.moveaxis(picture, -3, -1) + mean


def _as_pixels(values: np.ndarray) -> np.ndarray:
    return (np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)


class ProceduralImages:
    """Endless stills with natural-image spectra: 1,000 for training, 250 for evaluation."""

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def keys(self, split: Split) -> list[tuple[int, int]]:
        """(split, number) pairs."""
        return [(_SPLITS[split], number) for number in range(1000 if split == "train" else 250)]

    def load(self, key: tuple[int, int], height: int, width: int) -> np.ndarray:
        """(1, H, W, 3) uint8."""
        rng = _rng(self._seed, *key)
        mean = rng.uniform(0.25, 0.75, 3)
        return _as_pixels(_texture(natural_spectrum(rng, height, width), mean, 0.22, height, width))[None]


class ProceduralScenes:
    """Moving scenes: a drifting texture, and shapes that cross it; 48 clips for training, 16 for evaluation."""

    def __init__(self, seed: int, frames: int) -> None:
        self._seed, self._frames = seed, frames

    def keys(self, split: Split) -> list[tuple[int, int]]:
        """(split, number) pairs."""
        return [(_SPLITS[split], number) for number in range(48 if split == "train" else 16)]

    def load(self, key: tuple[int, int], height: int, width: int) -> np.ndarray:
        """(T, H, W, 3) uint8."""
        rng = _rng(self._seed, *key)
        time = np.arange(self._frames) / max(self._frames - 1, 1)
        scene = self._drifting_texture(rng, time, height, width)
        for _ in range(rng.integers(2, 5)):
            self._draw_shape(rng, time, scene)
        return _as_pixels(scene)

    @staticmethod
    def _drifting_texture(rng: np.random.Generator, time: np.ndarray, height: int, width: int) -> np.ndarray:
        spectrum = natural_spectrum(rng, height, width)
        mean = rng.uniform(0.15, 0.85, 3)
        shift = rng.uniform(-1, 1, 2) * (height, width)
        turns = np.fft.fftfreq(height)[:, None] * shift[0] + np.fft.rfftfreq(width)[None] * shift[1]
        moved = spectrum * np.exp(-2j * np.pi * turns * time[:, None, None])[:, None]
        return _texture(moved, mean, 0.2, height, width)

    @staticmethod
    def _draw_shape(rng: np.random.Generator, time: np.ndarray, scene: np.ndarray) -> None:
        """Draw, in place, a disc or a box that crosses the (T, H, W, 3) scene on a straight line."""
        height, width = scene.shape[1:3]
        begin, end = rng.uniform(-0.1, 1.1, (2, 2))
        centre = begin + time[:, None] * (end - begin)
        radius = rng.uniform(0.08, 0.25, 2)
        y = (np.arange(height)[None, :] / height - centre[:, :1]) / radius[0]
        x = (np.arange(width)[None, :] / width - centre[:, 1:]) / radius[1]
        if rng.random() < 0.5:
            distance = np.hypot(y[:, :, None], x[:, None, :])
        else:
            distance = np.maximum(np.abs(y)[:, :, None], np.abs(x)[:, None, :])
        cover = np.clip((1.0 - distance) * 6.0, 0.0, 1.0)[..., None]
        scene *= 1.0 - cover
        scene += cover * rng.uniform(0, 1, 3)


class Cifar10:
    """CIFAR-10 as torchvision stores it: 50,000 training and 10,000 evaluation stills; never downloaded.

    Args:
        root: the folder that holds ``cifar-10-batches-py``.
    """

    def __init__(self, root: Path) -> None:
        self._root = root

    def keys(self, split: Split) -> list[tuple[Split, int]]:
        """(split, number) pairs.

        Raises:
            UserError: files are missing or damaged.
        """
        return [(split, number) for number in range(len(_cifar_pixels(self._root, split)))]

    def load(self, key: tuple[Split, int], height: int, width: int) -> np.ndarray:
        """(1, H, W, 3) uint8."""
        from PIL import Image

        return _fitted(Image.fromarray(_cifar_pixels(self._root, key[0])[key[1]]), height, width)[None]


@lru_cache(maxsize=2)
def _cifar_pixels(root: Path, split: Split) -> np.ndarray:
    """(n, 32, 32, 3) uint8: a split of CIFAR-10, in memory once however many environments show it."""
    from torchvision.datasets import CIFAR10

    try:
        pixels: np.ndarray = CIFAR10(str(root), train=split == "train", download=False).data
    except Exception as error:  # torchvision raises RuntimeError, pickle nearly anything, on damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{root / CIFAR_FOLDER}: not torchvision's CIFAR-10 ({reason})") from error
    return pixels


class Folder:
    """A folder of pictures, of folders of pictures, and of video files."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._clips = _find_clips(folder)
        if len(self._clips) < 2:
            kinds = ", ".join(sorted(PICTURES | VIDEOS))
            raise UserError(
                f"{folder}: {len(self._clips)} clips found, at least 2 are needed (one for training, one for "
                f"evaluation); files read: {kinds}"
            )
        self._order = np.random.default_rng([seed, 23]).permutation(len(self._clips))

    def keys(self, split: Split) -> list[Path]:
        """Path of each clip: a picture, a video, or a folder of frames."""
        held_out = max(1, round(EVALUATION_SHARE * len(self._clips)))
        order = self._order[:held_out] if split == "evaluation" else self._order[held_out:]
        return [self._clips[i] for i in np.sort(order)]

    def load(self, key: Path, height: int, width: int) -> np.ndarray:
        """(T, H, W, 3) uint8; long ones are cut after ``MOST_FRAMES``."""
        if key.is_dir():
            paths = sorted(p for p in key.iterdir() if p.suffix.lower() in PICTURES)[:MOST_FRAMES]
            return np.stack([_read_picture(path, height, width) for path in paths])
        if key.suffix.lower() in PICTURES:
            return _read_picture(key, height, width)[None]
        return _read_video(key, height, width)


def _find_clips(folder: Path) -> list[Path]:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    videos = [p for p in files if p.suffix.lower() in VIDEOS]
    pictures = [p for p in files if p.suffix.lower() in PICTURES]
    stills = [p for p in pictures if p.parent == folder]
    return sorted({*videos, *stills, *(p.parent for p in pictures if p.parent != folder)})


def _read_picture(path: Path, height: int, width: int) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return _fitted(picture, height, width)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{path}: not a readable picture ({str(error).splitlines()[0]})") from error


def _read_video(path: Path, height: int, width: int) -> np.ndarray:
    import av

    frames: list[np.ndarray] = []
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                frames.append(_fitted(frame.to_image(), height, width))
                if len(frames) == MOST_FRAMES:
                    break
    except (OSError, ValueError, IndexError) as error:  # av's own errors derive from these
        raise UserError(f"{path}: not a readable video ({str(error).splitlines()[0]})") from error
    if not frames:
        raise UserError(f"{path}: the video holds no frames")
    return np.stack(frames)


def _fitted(picture: Any, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8 of a Pillow image: cropped at the centre to the wanted proportions, then scaled."""
    from PIL import Image, ImageOps

    fitted = ImageOps.fit(picture.convert("RGB"), (width, height), method=Image.Resampling.BILINEAR)
    return np.asarray(fitted, dtype=np.uint8)
