"""What each group of codes says about each factor, beyond what as many codes say by chance.

With hundreds of codes and a few hundred rows, codes drawn at random already share much information with any factor:
the plain estimate counts accidents. So every figure here is held against the same codes with their rows shuffled. The
mean over all shuffles has a closed form, the hypergeometric model of Vinh, Epps and Bailey ("Information theoretic
measures for clusterings comparison", JMLR 2010), and a sample of shuffles gives a p-value.

The price: too few rows hide information. A group that gives almost every row a code of its own cannot be told from one
that numbers the rows, and reads as holding nothing even if its code names every factor. In a factorial with one row for
each combination, a code that names one factor and a part of another shows only the first, so that it looks modular.
Only more rows for each combination can tell.

Shuffled rows are a fair comparison only for rows drawn apart. Several rows of one drawing are not: a code that
recognises drawings, and knows nothing of what they have in common, would seem to know every factor of them. Rows of one
origin are therefore named (``blocks``), and a factor that is the same throughout each block is shuffled by whole blocks
of equal size; its E is then the mean of those shuffles. Factors that change within blocks are shuffled row by row,
which is fair where they were drawn row by row, and not for neighbouring frames of a film.

Where a group has P positions (a grid of codes), bits, adjusted, normalised and share are made of the mean over
positions of the information in one position, and a shuffle moves all positions of a row together. What only the
positions together say is not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from repdib_lightning.evaluation.codes import entropy

PERMUTATIONS = 200
LEVEL = 0.05
"""A factor counts as held where its p-value after Holm's correction is below this."""

ROUNDING = 1e-9
"""Bits below which two informations are the same."""


@dataclass(frozen=True)
class FactorInformation:
    """Information between G groups and F factors; I is the plug-in estimate, E its mean over all shuffles of the rows.

    A group with one used code says nothing: 0 everywhere, p = 1. A factor with one class cannot be told: also 0 and
    p = 1, and ``varies`` is False. Nothing here is NaN.

    Attributes:
        factors: F names, in the order given.
        entropy: (F,) bits, H(f).
        bits: (G, F) bits, max(0, I - E).
        adjusted: (G, F) adjusted mutual information, (I - E) / ((H(g) + H(f)) / 2 - E): 1 where the codes are the
            classes under other names, 0 on average by chance, hence at times below 0.
        normalised: (G, F) plain I / ((H(g) + H(f)) / 2), which grows with the number of codes; to show that bias only.
        share: (G, F) in [0, 1], max(0, I - E) / (H(f) - E): how far from chance to knowing the class. Several codes a
            class cost nothing. 0 where the rows are too few to tell (each has a code of its own, so E = H(f)).
        p: (G, F) (1 + #{shuffles with at least this information}) / (1 + B).
        alive: (G,) bool, more than one code in use.
        permutations: B.
    """

    factors: tuple[str, ...]
    entropy: np.ndarray
    bits: np.ndarray
    adjusted: np.ndarray
    normalised: np.ndarray
    share: np.ndarray
    p: np.ndarray
    alive: np.ndarray
    permutations: int

    @property
    def varies(self) -> np.ndarray:
        """(F,) bool: the factor has more than one class."""
        return self.entropy > 0.0

    @property
    def beyond_chance(self) -> np.ndarray:
        """(G, F) bool: p < 0.05 after Holm's correction over all cells that can be tested."""
        testable = self.alive[:, None] & self.varies[None]
        beyond = np.zeros(self.p.shape, bool)
        beyond[testable] = holm(self.p[testable]) < LEVEL
        return beyond

    @property
    def holds(self) -> list[str | None]:
        """G entries: the factor with the largest share among those held beyond chance, None where there is none."""
        share = np.where(self.beyond_chance, self.share, -1.0)
        best = share.argmax(1)
        return [self.factors[f] if share[g, f] >= 0.0 else None for g, f in enumerate(best)]


def adjusted_information(
    codes: np.ndarray,
    factors: Mapping[str, np.ndarray],
    seed: int,
    *,
    permutations: int = PERMUTATIONS,
    blocks: np.ndarray | None = None,
) -> FactorInformation:
    """Measure the information between every group and every factor.

    All cells see the same shuffles, so that renaming codes or classes changes nothing, and reordering groups or factors
    reorders the result.

    Args:
        codes: (n, G) or (n, P, G) int64.
        factors: name -> (n,) int64 classes.
        seed: of the shuffles, which make ``p``, and E of the factors that are shuffled by blocks.
        permutations: B; no p-value is below 1 / (1 + B), see :func:`enough_permutations`.
        blocks: (n,) int64, rows of one origin; each row its own by default.
    """
    assert codes.ndim in (2, 3), f"codes (n, G) or (n, P, G), are {codes.shape}"
    assert len(codes) >= 2 and factors and permutations >= 1
    stacked = codes[:, None] if codes.ndim == 2 else codes
    groups = [[_Labels(stacked[:, p, g]) for p in range(stacked.shape[1])] for g in range(stacked.shape[2])]
    targets = [_Labels(values) for values in factors.values()]
    assert all(len(target.index) == len(codes) for target in targets), "a factor needs one class a row"
    shuffles = [_Shuffle(target.index, blocks) for target in targets]
    cells = [[[_cell(position, target) for position in group] for target in targets] for group in groups]
    found, expected, own = np.moveaxis(np.array(cells), -1, 0)
    p, means = _shuffled(groups, targets, shuffles, found.sum(-1), np.random.default_rng(seed), permutations)
    whole = np.array([shuffle.by_blocks for shuffle in shuffles])
    expected = np.where(whole[None, :, None], means, expected)
    entropies = np.array([target.entropy for target in targets])
    middle = (own + entropies[:, None]) / 2.0
    beyond = np.maximum(0.0, (found - expected).mean(-1))
    return FactorInformation(
        factors=tuple(factors),
        entropy=entropies,
        bits=np.where(beyond > ROUNDING, beyond, 0.0),
        adjusted=_ratio(found - expected, middle - expected).mean(-1),
        normalised=_ratio(found, middle).mean(-1),
        share=np.minimum(1.0, _ratio(beyond, entropies - expected.mean(-1))),
        p=p,
        alive=np.array([any(position.entropy > 0.0 for position in group) for group in groups]),
        permutations=permutations,
    )


def expected_information(first: np.ndarray, second: np.ndarray) -> float:
    """Mean mutual information, in bits, over all ways to shuffle one of two labellings.

    E = sum_ab sum_k k/n log2(n k / (a b)) Hypergeometric(k; n, a, b) over the class sizes a of one and b of the other.
    Classes of equal size give equal terms, so each pair of distinct sizes is summed once.

    Args:
        first, second: counts of the classes of each; both sum to n.
    """
    (a, times_a), (b, times_b) = sorted((np.unique(c, return_counts=True) for c in (first, second)), key=_distinct)
    n = int(first.sum())
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, n + 1)))])
    total = 0.0
    for size, times in zip(a.tolist(), times_a.tolist(), strict=True):
        k = np.arange(1, min(size, int(b.max())) + 1)[None]
        other = b[:, None]
        rest = n - size - other + k
        possible = (k <= other) & (rest >= 0)
        chance = log_factorial[size] + log_factorial[n - size] - log_factorial[n] - log_factorial[k]
        chance = chance + log_factorial[other] + log_factorial[n - other] - log_factorial[size - k]
        chance = chance - log_factorial[np.maximum(other - k, 0)] - log_factorial[np.maximum(rest, 0)]
        bits = k / n * np.log2(n * k / (size * other))
        total += times * float(times_b @ np.where(possible, bits * np.exp(chance), 0.0).sum(1))
    return max(0.0, total)


def enough_permutations(cells: int) -> int:
    """Shuffles that let one of so many cells pass Holm's correction: at the default B, 10 cells never could."""
    return max(PERMUTATIONS, int(np.ceil(2 * cells / LEVEL)))


def holm(p: np.ndarray) -> np.ndarray:
    """(m,) p-values after the step-down correction of Holm (1979) for m tests; at most 1."""
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order])
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(1.0, stepped)
    return corrected


class _Labels:
    """(n,) labels as indices in order of name, how often each occurs, and their entropy in bits."""

    def __init__(self, values: np.ndarray) -> None:
        assert values.ndim == 1 and np.issubdtype(values.dtype, np.integer), "labels are (n,) integers"
        _, index, self.counts = np.unique(values, return_inverse=True, return_counts=True)
        self.index = index.reshape(-1).astype(np.int64)
        self.entropy = entropy(self.index)


def _cell(codes: _Labels, target: _Labels) -> tuple[float, float, float]:
    """Information found, information expected, entropy of the codes; bits."""
    if min(len(codes.counts), len(target.counts)) == 1:
        return 0.0, 0.0, codes.entropy
    agreement = _agreement(codes.index * len(target.counts) + target.index, _log_counts(len(codes.index)))
    found = codes.entropy + target.entropy - np.log2(len(codes.index)) + agreement
    return max(0.0, found), expected_information(codes.counts, target.counts), codes.entropy


def _agreement(joint: np.ndarray, log_counts: np.ndarray) -> float:
    """Mean over rows of log2 of how many rows share both labels: the only part of I that a shuffle changes."""
    return float(log_counts[np.bincount(joint)[joint]].sum()) / len(joint)


def _log_counts(n: int) -> np.ndarray:
    return np.log2(np.maximum(1, np.arange(n + 1)))


class _Shuffle:
    """Ways to shuffle (n,) labels: row by row, or by whole blocks of equal size where each has one label.

    Attributes:
        by_blocks: which of both.
    """

    def __init__(self, index: np.ndarray, blocks: np.ndarray | None) -> None:
        self._index = index
        self.by_blocks = False
        if blocks is None:
            return
        _, first, block_of, size = np.unique(blocks, return_index=True, return_inverse=True, return_counts=True)
        block_of = block_of.reshape(-1)
        if size.max() == 1 or (index != index[first][block_of]).any():
            return
        self.by_blocks = True
        self._block_of, self._label, self._alike = (
            block_of,
            index[first],
            [np.flatnonzero(size == s) for s in set(size)],
        )

    def draw(self, generator: np.random.Generator, order: np.ndarray) -> np.ndarray:
        """Shuffled labels; rows in the order given, which all factors that are shuffled by rows share."""
        if not self.by_blocks:
            return self._index[order]
        label = self._label.copy()
        for alike in self._alike:
            label[alike] = generator.permutation(label[alike])
        return label[self._block_of]


def _shuffled(
    groups: list[list[_Labels]],
    targets: list[_Labels],
    shuffles: list[_Shuffle],
    found: np.ndarray,
    generator: np.random.Generator,
    draws: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Shares of shuffles that reach the information found ((G, F) bits, summed over positions); means (G, F, P)."""
    n, log_counts = len(targets[0].index), _log_counts(len(targets[0].index))
    reached = np.zeros(found.shape)
    fixed = np.array([[[p.entropy + t.entropy - np.log2(n) for p in group] for t in targets] for group in groups])
    needed = found - fixed.sum(-1) - ROUNDING
    rows = [[[p.index * len(target.counts) for p in group] for target in targets] for group in groups]
    total = np.zeros(fixed.shape)
    for _ in range(draws):
        order = generator.permutation(n)
        for f, shuffle in enumerate(shuffles):
            shuffled = shuffle.draw(generator, order)
            for g in range(len(groups)):
                drawn = np.array([_agreement(position + shuffled, log_counts) for position in rows[g][f]])
                total[g, f] += drawn
                reached[g, f] += drawn.sum() >= needed[g, f]
    return (1.0 + reached) / (1.0 + draws), np.maximum(0.0, fixed + total / draws)


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """part / whole, and 0 where the whole is 0 up to rounding."""
    defined = whole > ROUNDING
    return np.where(defined, part / np.where(defined, whole, 1.0), 0.0)


def _distinct(sizes: tuple[np.ndarray, np.ndarray]) -> int:
    return len(sizes[0])
