"""Do groups of codes hold different factors: InfoMEC, MIG and DCI, and a plain answer to which group holds what.

Information is that of :mod:`repdib_lightning.evaluation.factor_information`, corrected for chance. It is counted on all
rows, as in the sources below: counting learns nothing, and what is held out of a factorial is none (of 58 species a
fifth of the combinations has each in one or two styles, where a species almost names the style). What is learned
(regressions, forests) reads latents, whether they are quantised or not, is fitted on the fit rows and scored on the
score rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from repdib_lightning.evaluation.factor_information import (
    FactorInformation,
    adjusted_information,
    enough_permutations,
)
from repdib_lightning.evaluation.group_predictors import (
    Task,
    explicitness,
    group_importance,
    latent_features,
    tasks_of,
)

Table = dict[str, list[float | None]]
"""Factor -> one number a group."""

TABLES = ("bits", "adjusted", "normalised", "share", "p")


@dataclass(frozen=True)
class Disentanglement:
    """Every measure of how G groups share out F factors.

    Undefined figures are None, never NaN: all of a factor with one class (in all rows for information, in either
    half for what is learned, or if the halves share fewer than two); ``completeness`` and ``mig`` with one group;
    ``compactness`` with one group that holds anything; ``modularity`` and ``disentanglement`` with one factor that
    varies; ``modularity`` and ``compactness`` where no group holds a factor beyond chance; the three of DCI where no
    forest finds a split. A group with one used code is defined: it holds nothing, all 0.

    Attributes:
        groups: G. fit_rows, score_rows, seed, permutations: of this measurement.
        entropy: factor -> H(f) in all rows, bits.
        bits, adjusted, normalised, share, p: see :class:`FactorInformation`.
        holds: G entries, the factor that each group holds most, None where none is beyond chance (p < 0.05, Holm).
        modularity: InfoM. compactness: InfoC. explicitness: InfoE, the mean of ``explicitness_by_factor``.
        explicitness_by_factor: from all groups together.
        explicitness_by_group: from one group alone.
        mig: mutual information gap.
        disentanglement, completeness, informativeness: DCI, from ``importance``.
        importance: share of each group in the forest of a factor; sums to 1 over groups.
    """

    groups: int
    fit_rows: int
    score_rows: int
    seed: int
    permutations: int
    entropy: dict[str, float]
    bits: Table
    adjusted: Table
    normalised: Table
    share: Table
    p: Table
    holds: list[str | None]
    modularity: float | None
    compactness: float | None
    explicitness: float | None
    explicitness_by_factor: dict[str, float | None]
    explicitness_by_group: Table
    mig: float | None
    disentanglement: float | None
    completeness: float | None
    informativeness: float | None
    importance: Table

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, strings, numbers and None (JSON)."""
        return asdict(self)


def measure_disentanglement(
    codes: np.ndarray,
    latents: np.ndarray,
    factors: Mapping[str, np.ndarray],
    *,
    fit: np.ndarray,
    score: np.ndarray,
    seed: int,
    origins: np.ndarray | None = None,
) -> Disentanglement:
    """Measure how groups share out factors.

    Args:
        codes: (n, P, G) int64, which information is counted of.
        latents: (n, G, D), which regressions and forests learn from; D takes in all positions.
        factors: name -> (n,) int64 classes.
        fit, score: (n,) bool, disjoint rows to learn from and to score on.
        seed: of the shuffles, the inner folds and the forests.
        origins: (n,) int64, rows of one origin, such as the variants of a drawing; each row its own by default.
    """
    from threadpoolctl import threadpool_limits

    assert codes.ndim == latents.ndim == 3, f"codes (n, P, G), latents (n, G, D), are {codes.shape}, {latents.shape}"
    assert codes.shape[::2] == latents.shape[:2], f"other rows or groups: {codes.shape}, {latents.shape}"
    assert fit.dtype == score.dtype == np.bool_ and not (fit & score).any() and fit.any() and score.sum() >= 2
    with threadpool_limits(1):
        names = list(factors)
        blocks = latent_features(latents, fit)
        tasks = tasks_of(factors, fit, score, origins)
        told = _information(codes, factors, fit | score, seed, origins)
        learned = _explicitness(blocks, tasks, names, seed) | _forests(blocks, tasks, names, seed)
    return Disentanglement(
        groups=len(blocks), fit_rows=int(fit.sum()), score_rows=int(score.sum()), seed=seed, **told, **learned
    )


def modularity(information: FactorInformation) -> float | None:
    """InfoM: does each group hold one factor only?

    Hsu et al., "Disentanglement via latent quantization", NeurIPS 2023: mean over groups g of
    max_f R[g, f] / sum_f R[g, f], rescaled as (x - 1/F) / (1 - 1/F), with R the information over the factor's entropy.
    Ours differs in two ways. R is ``share``, where both information and entropy are less what chance gives, because
    I / H(f) of a large codebook is near 1 for any factor. And the groups averaged over are those that hold some factor
    beyond chance, where the paper prunes latents that do not vary: a ratio of noise to noise is no modularity.

    Returns:
        At most 1; None with fewer than 2 factors that vary, or no group that holds any.
    """
    held, share = information.beyond_chance, information.share[:, information.varies]
    return _mean_dominance(share[held.any(1)])


def compactness(information: FactorInformation) -> float | None:
    """InfoC: is each factor held by one group only?

    Hsu et al. 2023: mean over factors f of max_g R[g, f] / sum_g R[g, f], rescaled as (x - 1/G) / (1 - 1/G), G counting
    active groups. R and the active groups are as in :func:`modularity`; only factors that some group holds beyond
    chance are averaged over.

    Returns:
        At most 1; None with fewer than 2 groups that hold anything.
    """
    held = information.beyond_chance
    return _mean_dominance(information.share[held.any(1)][:, held.any(0)].T)


def mutual_information_gap(information: FactorInformation) -> float | None:
    """MIG (Chen et al., "Isolating sources of disentanglement in VAEs", NeurIPS 2018, equation 6).

    Mean over factors that vary of the largest less the second largest R[g, f] over all groups; R is ``share`` (see
    :func:`modularity`), where the paper has I / H(f). 0 where no group knows anything.

    Returns:
        In [0, 1]; None with one group or no factor that varies.
    """
    ranked = np.sort(information.share[:, information.varies], axis=0)
    return None if len(ranked) < 2 or not ranked.size else float(np.mean(ranked[-1] - ranked[-2]))


def importance_scores(importance: np.ndarray) -> tuple[float | None, float | None]:
    """DCI's disentanglement and completeness (Eastwood and Williams, ICLR 2018, section 2).

    With P the importances normalised over factors for each group: D = sum_g w_g (1 - H_F(P[g])), w_g the share of the
    group in all importance and H_F the entropy to base F. With P normalised over groups for each factor: C = mean over
    factors of 1 - H_G(P[f]).

    Args:
        importance: (G, F), not negative.

    Returns:
        D (None with one factor) and C (None with one group), both None where all is 0.
    """
    groups, factors = importance.shape
    if not importance.any():
        return None, None
    by_group = importance[importance.sum(1) > 0]
    weight = by_group.sum(1) / by_group.sum()
    by_factor = importance[:, importance.sum(0) > 0].T
    disentanglement = float(weight @ _concentration(by_group)) if factors > 1 else None
    return disentanglement, float(_concentration(by_factor).mean()) if groups > 1 else None


def _explicitness(blocks: list[np.ndarray], tasks: Mapping[str, Task], names: list[str], seed: int) -> dict[str, Any]:
    together = np.concatenate(blocks, axis=1)
    whole: dict[str, float | None] = dict.fromkeys(names)
    alone: Table = {name: [None] * len(blocks) for name in names}
    for name, task in tasks.items():
        alone[name] = [explicitness(block, task, seed) for block in blocks]
        whole[name] = explicitness(together, task, seed) if len(blocks) > 1 else alone[name][0]
    return {
        "explicitness": _mean_known(list(whole.values())),
        "explicitness_by_factor": whole,
        "explicitness_by_group": alone,
    }


def _forests(blocks: list[np.ndarray], tasks: Mapping[str, Task], names: list[str], seed: int) -> dict[str, Any]:
    grown = {name: group_importance(blocks, task, seed) for name, task in tasks.items()}
    split = {name: result for name, result in grown.items() if result[0].any()}
    table: Table = {name: split[name][0].tolist() if name in split else [None] * len(blocks) for name in names}
    importance = np.array([by_group for by_group, _ in split.values()]).reshape(len(split), len(blocks)).T
    disentanglement, completeness = importance_scores(importance)
    return {
        "disentanglement": disentanglement,
        "completeness": completeness,
        "informativeness": _mean_known([gain for _, gain in split.values()]),
        "importance": table,
    }


def _information(
    codes: np.ndarray, factors: Mapping[str, np.ndarray], counted: np.ndarray, seed: int, origins: np.ndarray | None
) -> dict[str, Any]:
    chosen = {name: values[counted] for name, values in factors.items()}
    blocks = None if origins is None else origins[counted]
    draws = enough_permutations(codes.shape[-1] * len(chosen))
    found = adjusted_information(codes[counted], chosen, seed, permutations=draws, blocks=blocks)
    return {
        "permutations": draws,
        "entropy": dict(zip(found.factors, found.entropy.tolist(), strict=True)),
        **{name: _table(found, getattr(found, name)) for name in TABLES},
        "holds": found.holds,
        "modularity": modularity(found),
        "compactness": compactness(found),
        "mig": mutual_information_gap(found),
    }


def _table(found: FactorInformation, values: np.ndarray) -> Table:
    """(G, F) to factor -> G numbers; None for factors that do not vary."""
    columns = zip(found.factors, values.T.tolist(), found.varies, strict=True)
    return {name: column if varies else [None] * len(column) for name, column, varies in columns}


def _mean_dominance(information: np.ndarray) -> float | None:
    """Mean over rows of largest / sum, rescaled to 0 where all K entries are equal and 1 where one is all there is."""
    rows = information[information.sum(1) > 0] if information.size else information
    if not len(rows) or rows.shape[1] < 2:
        return None
    chance = 1.0 / rows.shape[1]
    return (float(np.mean(rows.max(1) / rows.sum(1))) - chance) / (1.0 - chance)


def _concentration(weights: np.ndarray) -> np.ndarray:
    """(R, K) rows that sum to more than 0, to (R,): 1 less the entropy to base K of each; 0 where K = 1."""
    p = weights / weights.sum(1, keepdims=True)
    bits = -(p * np.log2(np.where(p > 0, p, 1.0))).sum(1)
    return 1.0 - bits / np.log2(max(2, p.shape[1]))


def _mean_known(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
