"""How Lightning writes and reads checkpoints here: whole or not at all, verified, and never unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import CheckpointIO

from repdib_lightning.callbacks.checkpoint_files import DigestingFile, check
from repdib_lightning.callbacks.plain_values import plain
from repdib_lightning.data.files import whole_file


class AtomicCheckpointIO(CheckpointIO):
    """A Trainer plugin. Lightning's own way goes through memory and $TMPDIR, does not flush, and may tear the file.

    A checkpoint is streamed into a temporary file beside its target, sealed with a digest, flushed to disk and
    renamed; the folder is flushed too. Killed at any moment, it leaves the previous file or the new one, whole.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint.

        Args:
            checkpoint: nested containers of tensors and primitives (numpy values and paths are converted).
            path: target file; its folder is made.
            storage_options: must be None.

        Raises:
            UserError: the folder cannot be written to, the disk is full (nothing half-written stays), or something
                in the checkpoint is neither tensor nor primitive (names its key).
        """
        assert storage_options is None, "files only: there are no storage options"
        content = plain(checkpoint)
        with whole_file(Path(path)) as temporary, open(temporary, "wb") as handle:
            digesting = DigestingFile(handle)
            try:
                torch.save(content, digesting)  # type: ignore[arg-type]
            except RuntimeError:
                if digesting.error is not None:
                    raise digesting.error from None
                raise
            digesting.seal()

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Verify and read a checkpoint, to the CPU unless ``map_location`` says otherwise.

        ``weights_only`` is Lightning's and changes nothing: a file is never unpickled.

        Raises:
            UserError: the file is missing or damaged.
        """
        check(Path(path))
        content: dict[str, Any] = torch.load(path, map_location=map_location or "cpu", weights_only=True)
        return content

    def remove_checkpoint(self, path: str | Path) -> None:
        """Remove a checkpoint if it is there."""
        Path(path).unlink(missing_ok=True)
