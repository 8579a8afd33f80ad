"""The numbers of one finished point, by name: logged last, read by the probes, and what came of fine-tuning."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.curves import read_curves
from repdib_lightning.evaluation.tables import KINDS
from repdib_lightning.experiments.suite import explores
from repdib_lightning.experiments.suite_measures import RECOGNITION_PARTS, RECOGNITION_SCORES

REPLAY = "replay.h5"
"""What an exploration records, in the run's folder."""


@dataclass(frozen=True)
class Facts:
    """What a point's record takes over from its run's folder.

    Attributes:
        configuration: config.yaml as a tree, and under ``finetune`` what each fine-tuning used.
        versions, data: of environment.json; without pre-training the versions of the first fine-tuning, and no data. Of
            an exploration the data are its replay.
        probed: the store that it was probed on, by file and fingerprint, where that is not its data; else empty.
        factors: name -> ``state`` or ``noise``.
        metrics: name -> number; see :func:`collect_measures`.
    """

    configuration: dict[str, Any]
    versions: dict[str, str]
    data: dict[str, str]
    factors: dict[str, str]
    metrics: dict[str, float]
    probed: dict[str, str] = field(default_factory=dict)


def collect_measures(run: Path, probe: Path | None, outcomes: Mapping[str, Path] | None = None) -> Facts:
    """Read a finished run's folder.

    Args:
        run: the folder. probe: what probing wrote; None for a run without pre-training.
        outcomes: name of each fine-tuning -> what it wrote.

    The measures are

    - ``PROBE/FACTOR/kept``: (score - chance) / (1 - chance) of a probe on held-out episodes, between 0 and 1;
    - ``PROBE/FACTOR/error``: 1 - accuracy, or 1 - R2, of the same probe;
    - ``PROBE/state/kept``, ``PROBE/noise/kept``: means over the factors of that kind;
    - ``decoder/background/kept``, ``.../error``, and the same for ``agent``: of the pictures
      (:mod:`repdib_lightning.evaluation.decoder`);
    - ``groups/...``: what the groups hold and draw (:mod:`repdib_lightning.evaluation.group_probe`);
    - ``recognition/f1_macro``, ``.../f1_micro``, ``.../f1_weighted``, ``.../accuracy``: of the classifier, on all
      held-out clips; ``recognition/f1/CLASS``; ``recognition/without/MODALITY`` and ``.../only/MODALITY``: macro F1
      with it, or all others, missing; ``recognition/weight/MODALITY``: its mean weight;
      ``recognition/perplexity/MODALITY``, or ``.../fused``: of its codes
      (:mod:`repdib_lightning.evaluation.recognition`);
    - ``codes/used``, ``codes/perplexity``: means over the groups, on held-out episodes;
    - ``val/...``: what the last validation logged; ``explore/coverage``, ``.../coverage_share``: how far an
      exploration got;
    - ``AGENT/NAME/...``: of each fine-tuning; what it says null of is left out.

    What follows from several fine-tunings of a point is added when results are read
    (:mod:`repdib_lightning.experiments.snapshot_measures`).

    Raises:
        UserError: a file is missing or is not what this package writes.
    """
    facts = Facts({}, {}, {}, {}, {}) if probe is None else _pretrained(run, probe)
    for name, path in (outcomes or {}).items():
        facts = _with_outcome(facts, name, path, run)
    return facts


def _pretrained(run: Path, probe: Path) -> Facts:
    try:
        configuration = yaml.safe_load((run / "config.yaml").read_text())
        environment = json.loads((run / "environment.json").read_text())
        report = json.loads(probe.read_text())
        factors = {name: KINDS[content["kind"]] for name, content in report["factors"].items()}
        metrics = {**_trained(run), **_probed(report)}
        explored = explores(configuration)
        data = _replay(run, environment["data"]) if explored else environment["data"]
        read = {"file": report["data"], "fingerprint": report["fingerprint"]}
        probed = read if explored or read["fingerprint"] != data["fingerprint"] else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise UserError(f"{run}: not a finished and probed run ({type(error).__name__}: {error})") from error
    return Facts(configuration, environment["versions"], data, factors, metrics, probed)


def _replay(run: Path, recorded: dict[str, str]) -> dict[str, str]:
    """The replay as it is now: when environment.json was written it was still to be recorded."""
    path = run / REPLAY
    return {"file": REPLAY, "fingerprint": EpisodeStore(path).fingerprint} if path.is_file() else recorded


def _with_outcome(facts: Facts, name: str, path: Path, run: Path) -> Facts:
    try:
        outcome = json.loads(path.read_text())
        metrics = dict(facts.metrics)
        for measure, value in outcome["measures"].items():
            _add(metrics, f"{outcome['agent']}/{name}/{measure}", value)
        options = _without_folder(outcome["configuration"], run)
        used = {**facts.configuration.get("finetune", {}), name: options}
        versions, data = facts.versions or outcome["versions"], facts.data or outcome.get("data", {})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: not the outcome of a fine-tuning ({type(error).__name__}: {error})") from error
    configuration = {**facts.configuration, "finetune": used}
    return replace(facts, configuration=configuration, versions=versions, data=data, metrics=metrics)


def _without_folder(options: dict[str, Any], run: Path) -> dict[str, Any]:
    """The encoder's path, within the run's folder: a record says nothing of the machine it was made on."""
    encoder = options.get("encoder")
    if not encoder or not Path(encoder).is_relative_to(run):
        return options
    return {**options, "encoder": str(Path(encoder).relative_to(run))}


def _trained(run: Path) -> dict[str, float]:
    curves = read_curves(run / "metrics.csv")
    wanted = [name for name in curves if name.startswith(("val/", "explore/coverage")) and "/group_" not in name]
    return {name: float(curves[name][-1, 1]) for name in wanted}


def _probed(report: dict[str, Any]) -> dict[str, float]:
    found: dict[str, float] = {}
    for factor, content in report["factors"].items():
        for probe, score in content["probes"].items():
            _add(found, f"{probe}/{factor}/kept", score["kept"])
            if score["score"] is not None:
                _add(found, f"{probe}/{factor}/error", 1.0 - score["score"])
    for kind, by_probe in report["summary"].items():
        for probe, kept in by_probe.items():
            _add(found, f"{probe}/{KINDS[kind]}/kept", kept)
    for region, score in (report.get("pictures") or {}).get("regions", {}).items():
        for name in ("kept", "error", "rmse"):
            _add(found, f"decoder/{region}/{name}", score[name])
    for name, value in ((report.get("grouped") or {}).get("figures") or {}).items():
        _add(found, f"groups/{name}", value)
    if report.get("recognition") is not None:
        _add_recognition(found, report["recognition"])
    if report["codebook"] is not None:
        _add(found, "codes/used", float(np.mean(report["codebook"]["used"])))
        _add(found, "codes/perplexity", float(np.mean(report["codebook"]["perplexity"])))
    return found


def _add_recognition(found: dict[str, float], record: dict[str, Any]) -> None:
    without = {name: scores["f1_macro"] for name, scores in record["without"].items()}
    read = (record["f1"], without, record["only"], record["attention"], record["perplexity"])
    for score in RECOGNITION_SCORES:
        _add(found, f"recognition/{score}", record[score])
    for part, values in zip(RECOGNITION_PARTS, read, strict=True):
        for name, value in values.items():
            _add(found, f"recognition/{part}/{name}", value)


def _add(found: dict[str, float], name: str, value: float | None) -> None:
    """A measure that means nothing (a factor that does not vary) is left out."""
    if value is not None:
        found[name] = float(value)
