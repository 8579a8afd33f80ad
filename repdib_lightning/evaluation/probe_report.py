"""The record of one probed encoder, and of each factor in it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from repdib_lightning.data.files import whole_file
from repdib_lightning.evaluation.codes import CodebookUse, FactorBits
from repdib_lightning.evaluation.decoder import PictureReport
from repdib_lightning.evaluation.group_probe import GroupReport
from repdib_lightning.evaluation.probes import ProbeScore
from repdib_lightning.evaluation.tables import report_table

if TYPE_CHECKING:
    from repdib_lightning.evaluation.recognition import RecognitionReport

Kind = Literal["endogenous", "exogenous"]


@dataclass(frozen=True)
class FactorReport:
    """What a representation kept of one factor.

    Attributes:
        kind: ``endogenous`` (state: should be kept) or ``exogenous`` (noise: should be dropped).
        metric: ``accuracy`` or ``R2``.
        chance: score of a predictor that ignores the representation.
        probes: probe name -> score.
        bits: information in each group's code; None where nothing is quantised.
        unseen: share of scored rows whose class the fit half lacks.
    """

    kind: Kind
    metric: Literal["accuracy", "R2"]
    chance: float
    probes: dict[str, ProbeScore]
    bits: FactorBits | None
    unseen: float

    @property
    def best_bits(self) -> float | None:
        """Bits in the most informative group."""
        return max(self.bits.bits) if self.bits else None


@dataclass(frozen=True)
class ProbeReport:
    """Every factor of a data set, read from one frozen encoder.

    Attributes:
        name: of the bundle; of the run where the bundle is runs/<name>/bundle.
        data, fingerprint: the store, by file name and hash of its content.
        features: M. groups: G. seed: of the probes.
        fit_episodes, score_episodes: which evaluation episodes each half holds.
        fit_rows, score_rows: how many rows each half holds.
        factors: name -> report, endogenous first.
        codebook: use of codes on all evaluation rows; None where nothing is quantised.
        pictures: what the decoder probe drew again; None where it was not asked for.
        grouped: what the groups hold and draw; None where it was not asked for.
        recognition: how well the bundle's classifier tells the classes; None where it was not asked for.
    """

    name: str
    data: str
    fingerprint: str
    features: int
    groups: int
    seed: int
    fit_episodes: list[int]
    score_episodes: list[int]
    fit_rows: int
    score_rows: int
    factors: dict[str, FactorReport]
    codebook: CodebookUse | None
    pictures: PictureReport | None = None
    grouped: GroupReport | None = None
    recognition: RecognitionReport | None = None

    def mean_kept(self, kind: Kind, probe: str) -> float | None:
        """Mean *kept* over the factors of a kind; None if there is none, or none that varies."""
        scores = [f.probes[probe].kept for f in self.factors.values() if f.kind == kind and probe in f.probes]
        known = [kept for kept in scores if kept is not None]
        return float(np.mean(known)) if known else None

    @property
    def probes(self) -> list[str]:
        """Names of the probes that were fitted."""
        return list(next(iter(self.factors.values())).probes)

    def summary(self) -> dict[str, dict[str, float | None]]:
        """Kind -> probe -> mean kept."""
        kinds: tuple[Kind, Kind] = ("endogenous", "exogenous")
        return {kind: {probe: self.mean_kept(kind, probe) for probe in self.probes} for kind in kinds}

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, strings, numbers and None (JSON); ``recognition`` only where it was asked for."""
        plain = asdict(replace(self, grouped=None, recognition=None))
        plain |= {"grouped": None if self.grouped is None else self.grouped.to_dict(), "summary": self.summary()}
        del plain["recognition"]
        return plain if self.recognition is None else {**plain, "recognition": self.recognition.to_dict()}

    def write(self, path: Path) -> None:
        """Write JSON; the file is whole or absent. Raises UserError if the folder cannot be written to."""
        with whole_file(path) as aside:
            aside.write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    def table(self) -> str:
        """The plain text table that the terminal shows; a second one of what the classifier recognises."""
        if self.recognition is None:
            return report_table(self)
        from repdib_lightning.evaluation.recognition_tables import recognition_text

        return "\n".join([report_table(self), "", recognition_text(self.recognition)])
