"""Checks the device that an agent is to be trained on."""

from __future__ import annotations

from repdib_lightning.errors import UserError, nearest

DEVICES = ("auto", "cpu", "cuda")


def check_device_name(name: str) -> None:
    """Raise UserError unless ``--device`` is one of :data:`DEVICES` or ``cuda:N``; this machine need not have it."""
    kind, _, number = name.partition(":")
    if kind not in DEVICES or (name != kind and not (kind == "cuda" and number.isdecimal())):
        raise UserError(f"--device {name}: there is no such device, {nearest(name, DEVICES)}")


def check_device(name: str) -> None:
    """Raise UserError unless this machine has the device.

    Stable-Baselines3 would take the CPU in place of a GPU that is not there, and say nothing.
    """
    from repdib_lightning.devices import resolve_device  # not needed where only a name is checked

    check_device_name(name)
    try:
        resolve_device(name)
    except UserError as error:
        raise UserError(f"--{error}") from error
