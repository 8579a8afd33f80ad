"""What the benchmarks say must follow from what they measured."""

import subprocess
import sys
import time
from pathlib import Path

from benchmarks.measuring import Times, alternate
from benchmarks.reporting import claim, shown, table

ROOT = Path(__file__).parents[2]


def test_a_missed_claim_says_so():
    assert claim("speed", 2.0, at_least=2.0).startswith("- met: speed: 2 ")
    assert claim("speed", 1.99, at_least=2.0).startswith("- **MISSED**")
    assert claim("memory", 0.2, at_most=0.1).startswith("- **MISSED**")
    assert claim("memory", 0.1, at_most=0.1).endswith("(wanted: at most 0.1)")


def test_ratios_are_taken_within_rounds():
    """A round in which everything is ten times as slow changes no ratio."""
    times = Times({"ours": [1.0, 10.0, 1.1], "peer": [2.0, 20.0, 2.2]})
    assert times["ours"] == 1.1
    assert times.ratio("peer", "ours") == 2.0


def test_contenders_take_turns_in_a_rotating_order():
    order = []
    alternate({name: lambda name=name: order.append(name) for name in "abc"}, rounds=3, warmup=1)
    assert "".join(order) == "abc" + "abc" + "bca" + "cab"


def test_the_slower_one_is_found():
    took = alternate({"quick": lambda: None, "slow": lambda: time.sleep(0.002)}, rounds=5)
    assert took.ratio("slow", "quick") > 2 and took["slow"] >= 0.002


def test_peak_memory_of_a_call_counts_what_it_frees():
    """In a process of its own: what other tests freed before would be used again."""
    words = "from benchmarks.measuring import peak_growth; print(peak_growth(lambda: bytearray(b'x') * (64 << 20)))"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True, cwd=ROOT)
    assert 60 << 20 < int(done.stdout) < 80 << 20


def test_three_digits_and_no_exponents():
    assert [shown(value) for value in (1234.5, 12.345, 0.012345, 7, "x")] == ["1234", "12.3", "0.0123", "7", "x"]
    assert table(["a", "b"], [[1, 0.5]]) == "| a | b |\n| --- | --- |\n| 1 | 0.5 |"
