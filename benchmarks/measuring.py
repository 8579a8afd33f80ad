"""Timing contenders alternately, and the memory of one call."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

Contenders = dict[str, Callable[[], object]]


def seconds(call: Callable[[], object], device: str = "cpu") -> float:
    """Wall time of one call, with the device's queue empty before and after."""
    wait(device)
    start = time.perf_counter()
    call()
    wait(device)
    return time.perf_counter() - start


def wait(device: str) -> None:
    """Until a GPU has done what it was given."""
    if device != "cpu":
        torch.cuda.synchronize()


class Times(dict[str, float]):
    """Median seconds of each contender, and the times of every round.

    Attributes:
        rounds: name -> seconds of each round; the same place is the same round.
    """

    def __init__(self, rounds: dict[str, list[float]]) -> None:
        super().__init__({name: statistics.median(values) for name, values in rounds.items()})
        self.rounds = rounds

    def ratio(self, over: str, under: str) -> float:
        """Median over rounds of the ratio within a round: what slows a whole round down cancels."""
        pairs = zip(self.rounds[over], self.rounds[under], strict=True)
        return statistics.median(top / bottom for top, bottom in pairs)


def alternate(contenders: Contenders, rounds: int = 20, warmup: int = 2, device: str = "cpu") -> Times:
    """Time each contender once a round, in turn, in an order that rotates."""
    names = list(contenders)
    times: dict[str, list[float]] = {name: [] for name in names}
    for name in names:
        for _ in range(warmup):
            seconds(contenders[name], device)
    for number in range(rounds):
        for name in names[number % len(names) :] + names[: number % len(names)]:
            times[name].append(seconds(contenders[name], device))
    return Times(times)


def peak_growth(call: Callable[[], object], device: str = "cpu") -> int:
    """Bytes by which one call raises the peak memory of this process (Linux), or of the GPU."""
    gc.collect()
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        call()
        wait(device)
        return torch.cuda.max_memory_allocated() - before
    Path("/proc/self/clear_refs").write_text("5")  # the high-water mark starts anew
    before = resident("VmRSS")
    call()
    return max(0, resident("VmHWM") - before)


def resident(kind: str) -> int:
    """Bytes of one line of /proc/self/status, such as VmRSS, VmHWM or RssAnon."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(kind + ":"):
            return int(line.split()[1]) * 1024
    raise ValueError(f"/proc/self/status has no line {kind}")
