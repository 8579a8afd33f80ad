"""What each group of codes says about each factor, and how much of its codebook it uses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BINS = 10
PERMUTATIONS = 20


@dataclass(frozen=True)
class FactorBits:
    """Information in each group's code about one factor.

    Attributes:
        bits: G numbers, mutual information in bits, less the mean of a permutation null, at least 0.
        entropy: bits of the (binned) factor itself: the most that a code can say.
    """

    bits: list[float]
    entropy: float


@dataclass(frozen=True)
class CodebookUse:
    """How much of its codebook each group uses on the evaluation rows.

    Attributes:
        codes_per_group: L.
        used: G counts of distinct codes.
        perplexity: G numbers, 2^H of the code frequencies; L where all codes are equally frequent.
    """

    codes_per_group: int
    used: list[int]
    perplexity: list[float]


def codebook_use(codes: np.ndarray, codes_per_group: int) -> CodebookUse:
    """Count the codes of (n, G) int64 indices in [0, L)."""
    groups = range(codes.shape[1])
    used = [len(np.unique(codes[:, g])) for g in groups]
    perplexity = [float(2.0 ** entropy(codes[:, g])) for g in groups]
    return CodebookUse(codes_per_group, used, perplexity)


def factor_bits(codes: np.ndarray, target: np.ndarray, seed: int) -> FactorBits:
    """Mutual information between each group's code and a factor, in bits.

    A continuous factor is cut into about ten bins of equal counts; for a vector the figures are means over its
    dimensions. With hundreds of codes and few rows the plain estimate is far too high, so the mean over 20 random
    permutations of the rows is subtracted (and the result is at least 0).

    Args:
        codes: (n, G) int64.
        target: (n,) int64 classes, or (n, K) float.
        seed: of the permutations.
    """
    columns = [target] if target.ndim == 1 else [quantile_bins(target[:, k]) for k in range(target.shape[1])]
    generator = np.random.default_rng(seed)
    bits = np.zeros(codes.shape[1])
    for column in columns:
        shuffled = [generator.permutation(column) for _ in range(PERMUTATIONS)]
        for g in range(codes.shape[1]):
            null = np.mean([mutual_information(codes[:, g], labels) for labels in shuffled])
            bits[g] += max(0.0, mutual_information(codes[:, g], column) - null)
    return FactorBits([float(b) for b in bits / len(columns)], float(np.mean([entropy(c) for c in columns])))


def quantile_bins(values: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Cut (n,) numbers into at most ``bins`` classes of about equal counts; few distinct numbers stay as they are."""
    distinct, index = np.unique(values, return_inverse=True)
    if len(distinct) <= bins:
        return index
    edges = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)[1:-1]))
    return np.searchsorted(edges, values, side="right")


def entropy(labels: np.ndarray) -> float:
    """Entropy of (n,) labels in bits (plug-in estimate)."""
    counts = np.unique(labels, return_counts=True)[1]
    return _bits(counts)


def mutual_information(first: np.ndarray, second: np.ndarray) -> float:
    """Mutual information of two (n,) label arrays with non-negative integers in bits (plug-in estimate)."""
    joint = first.astype(np.int64) * (int(second.max()) + 1) + second
    information = _bits(_counts(first)) + _bits(_counts(second)) - _bits(_counts(joint))
    return max(0.0, information)


def _counts(labels: np.ndarray) -> np.ndarray:
    """Occurrences of each label; sorting bounds the memory where labels are sparse."""
    highest = int(labels.max())
    counts = np.bincount(labels) if highest < 16 * len(labels) else np.unique(labels, return_counts=True)[1]
    return counts[counts > 0]


def _bits(counts: np.ndarray) -> float:
    share = counts / counts.sum()
    return float(-(share * np.log2(share)).sum()) + 0.0
