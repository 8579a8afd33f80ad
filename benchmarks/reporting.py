"""Tables of results in Markdown, and the statement of what was asked for and what was found."""

from __future__ import annotations

import platform
import statistics
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; numbers are shown with three digits."""
    lines = [head, ["---"] * len(head), *([shown(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def shown(value: object) -> str:
    """Three significant digits of a number, without an exponent; anything else as it is."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def claim(what: str, value: float, *, at_least: float | None = None, at_most: float | None = None) -> str:
    """One line: what was asked for, what was measured, and whether that is enough."""
    met = (at_least is None or value >= at_least) and (at_most is None or value <= at_most)
    bound = f"at least {shown(float(at_least))}" if at_least is not None else f"at most {shown(float(at_most or 0))}"
    return f"- {'met' if met else '**MISSED**'}: {what}: {shown(value)} (wanted: {bound})"


def median(values: Iterable[float]) -> float:
    """The middle one."""
    return statistics.median(list(values))


def machine(device: str = "cpu") -> str:
    """Processor, threads and versions, one line."""
    if device != "cpu":
        what = f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"
    else:
        flags = set(_cpu("flags").split())
        vector = [name for name in ("amx_bf16", "avx512_bf16", "avx512f", "avx2") if name in flags][:1]
        what = f"{_cpu('model name') or platform.processor()} ({', '.join(vector)}), {torch.get_num_threads()} threads"
    versions = ", ".join(f"{name} {_version(name)}" for name in ("torch", "lightning", "numpy"))
    return f"{what}; Python {platform.python_version()}, {versions}"


def _cpu(key: str) -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith(key)), "")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "-"
