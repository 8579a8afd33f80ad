"""Keeps Lightning from telling a user what is of no use to them."""

from __future__ import annotations

import logging
import warnings

_HARMLESS = (
    ".*does not have many workers.*",
    ".*LightningCLI's args parameter.*",
    ".*exists and is not empty.*",
    ".*treespec.*",
    ".*defined a `validation_step` but have no `val_dataloader`.*",
    ".*module\\(s\\) in eval mode at the start of training.*",
)


def quieten_lightning() -> None:
    """Leave warnings and errors of Lightning's own log, and drop the warnings that mean nothing here."""
    for chatty in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    for harmless in _HARMLESS:
        warnings.filterwarnings("ignore", message=harmless)
