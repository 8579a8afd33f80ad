"""Measures what a frozen encoder kept of the state and of every noise source: ``probe BUNDLE DATA``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.devices import resolve_device
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.bundle_data import open_held_out
from repdib_lightning.evaluation.bundles import bundle_of, display_name, protected_files
from repdib_lightning.evaluation.codes import FactorBits, codebook_use, factor_bits
from repdib_lightning.evaluation.decoder import Drawings, check_pictures, measure_pictures
from repdib_lightning.evaluation.features import Encodes, check_compatible, encode_rows
from repdib_lightning.evaluation.group_probe import GroupReport, check_grouped, measure_groups
from repdib_lightning.evaluation.probe_report import FactorReport, ProbeReport
from repdib_lightning.evaluation.probes import (
    DECODER,
    GROUPS,
    PROBES,
    RECOGNITION,
    Half,
    Standardiser,
    as_target,
    chance,
    check_probes,
    measure,
    one_thread,
)
from repdib_lightning.evaluation.samples import MOST, ProbeSamples
from repdib_lightning.evaluation.splits import ProbeSplit, rows_of, split_evaluation
from repdib_lightning.word_lists import words

if TYPE_CHECKING:
    from repdib_lightning.evaluation.recognition import RecognitionReport
    from repdib_lightning.evaluation.recognition_pass import Tells
    from repdib_lightning.export import FrozenEncoder


@dataclass(frozen=True)
class Encoded:
    """Evaluation rows of a store, seen through one frozen encoder, in the order of the store.

    Attributes:
        split: the two halves. latents: (n, M) float32. codes: (n, G) int64 or None. codes_per_group: L.
    """

    split: ProbeSplit
    latents: np.ndarray
    codes: np.ndarray | None
    codes_per_group: int


def probe_bundle(
    bundle: Path,
    data: Path,
    *,
    output: Path | None = None,
    samples: Path | None = None,
    probes: str | Sequence[str] = ",".join(PROBES),
    groups: int | None = None,
    clusters: int | None = None,
    device: str = "auto",
    seed: int = 0,
    progress: bool = True,
) -> ProbeReport:
    """Probe an exported encoder for every factor of a data set, and write the result as JSON.

    What the bundle held out by a factor, such as subjects, are the evaluation episodes here too.

    Args:
        bundle: folder of an exported encoder, or of a run that holds one.
        data: a store with factors and at least two evaluation episodes.
        output: the JSON file (.json); ``probe.json`` in the bundle by default.
        samples: also keep some latents, their factors and drawn pictures in this file (.npz), for figures.
        probes: ``linear``, ``mlp``, ``decoder`` (draws the pictures again from the latent), ``groups`` (what each group
            of codes holds; with the bundle's own decoder also what it draws), ``recognition`` (scores the bundle's own
            classifier, also with modalities missing), or several between commas.
        groups: for ``groups``, how many to cut a latent into that is not quantised.
        clusters: for ``groups``, how many codes k-means gives each part of such a latent; 512 by default, and at most
            one for 8 training rows.
        device: runs the encoder; the probes run on the CPU.
        seed: of the MLP and of the permutation null.
        progress: show progress bars (on a terminal).

    Raises:
        UserError: bad bundle or data, observations or classes that do not match, no factors, too few evaluation
            episodes, or an output that is no .json file, cannot be written or would replace what is read.
    """
    chosen = check_options(probes, seed, groups, clusters)
    folder = bundle_of(Path(bundle))
    target = folder / "probe.json" if output is None else Path(output)
    encoder = load_for_probing(folder, device)
    check_output_file(target, "--output", ".json", [Path(data), *protected_files(folder)])
    if samples is not None:
        check_output_file(Path(samples), "--samples", ".npz", [Path(data)])
    store = open_for_probing(data, chosen, {str(folder): encoder.description})
    check_compatible(encoder, store, str(folder))
    if GROUPS in chosen:
        check_grouped(encoder, groups)
    classifier = load_to_recognise(folder, encoder, store) if RECOGNITION in chosen else None
    encoded = encode_evaluation(encoder, store, device=encoder.device, progress=progress)
    name = display_name(folder)
    report, drawings = probe_encoded(encoded, store, name=name, probes=chosen, seed=seed, progress=progress)
    if GROUPS in chosen:
        grouped = probe_groups(encoder, folder, store, groups=groups, clusters=clusters, seed=seed, progress=progress)
        report = replace(report, grouped=grouped)
    if classifier is not None:
        report = replace(report, recognition=probe_recognition(encoder, classifier, store, progress=progress))
    if samples is not None:
        draw_samples(encoded, store, drawings).write(Path(samples))
    report.write(target)
    return report


def probe_groups(
    encoder: FrozenEncoder,
    bundle: Path,
    store: EpisodeStore,
    *,
    groups: int | None,
    clusters: int | None = None,
    seed: int,
    progress: bool = True,
) -> GroupReport:
    """Measure what the groups hold, and draw if the bundle has a decoder."""
    from repdib_lightning.export import load_decoder

    decoder = load_decoder(bundle, encoder.device) if "decoder" in encoder.description else None
    return measure_groups(encoder, decoder, store, groups=groups, clusters=clusters, seed=seed, progress=progress)


def load_to_recognise(bundle: Path, encoder: FrozenEncoder, store: EpisodeStore) -> Tells:
    """The classifier of a bundle, beside its encoder. Raises UserError if there is none, or it knows other classes."""
    from repdib_lightning.evaluation.recognition import checked_labels
    from repdib_lightning.export import load_classifier

    classifier = load_classifier(bundle, encoder.device)
    checked_labels(classifier, store, rows_of(store, store.episodes("evaluation")), str(bundle))
    return classifier


def probe_recognition(
    encoder: FrozenEncoder, classifier: Tells, store: EpisodeStore, *, progress: bool = True
) -> RecognitionReport:
    """Score the bundle's own classifier; torchmetrics is imported only here."""
    from repdib_lightning.evaluation.recognition import measure_recognition

    return measure_recognition(encoder, classifier, store, device=encoder.device, progress=progress)


def draw_samples(encoded: Encoded, store: EpisodeStore, drawings: Drawings | None) -> ProbeSamples:
    """Evenly spaced evaluation rows, with all factors, for figures."""
    rows = encoded.split.rows
    thin = np.unique(np.linspace(0, len(rows) - 1, min(MOST, len(rows))).astype(int))
    factors = {name: store.gather(f"factors/{name}", rows[thin]) for name in store.factors}
    return ProbeSamples(rows[thin], encoded.latents[thin], factors, drawings)


def check_options(
    probes: str | Sequence[str], seed: int, groups: int | None = None, clusters: int | None = None
) -> tuple[str, ...]:
    """Check what needs no file, and return the names of the probes.

    Raises:
        UserError: an unknown probe, none, a seed that no generator takes, or groups that nothing would use.
    """
    chosen = words(probes, "probes")
    check_probes(chosen)
    if groups is not None and GROUPS not in chosen:
        raise UserError(f"--groups is of the probe '{GROUPS}': add it to --probes, or leave the option out")
    if clusters is not None and GROUPS not in chosen:
        raise UserError(f"--clusters is of the probe '{GROUPS}': add it to --probes, or leave the option out")
    if clusters is not None and clusters < 2:
        raise UserError(f"--clusters must be at least 2, is {clusters}")
    if not 0 <= seed < 2**63:
        raise UserError(f"seed must be at least 0 and below 2^63, is {seed}")
    return chosen


def load_for_probing(bundle: Path, device: str) -> FrozenEncoder:
    """Load a bundle onto a device. Raises UserError if there is no such bundle or device."""
    from repdib_lightning.export import load_encoder

    return load_encoder(bundle).to(resolve_device(device))


def open_for_probing(
    data: Path, probes: Sequence[str] = PROBES, bundles: Mapping[str, Mapping[str, Any]] | None = None
) -> EpisodeStore:
    """Open a store, split as bundles were trained (name -> ``config.json``), and check that it can be probed.

    Raises:
        UserError: it cannot be read, lacks what the bundles held out, has no factors, NaN in one, too few evaluation
            episodes, or (for ``decoder``) no pictures.
    """
    store = open_held_out(data, bundles) if bundles else EpisodeStore(data)
    if DECODER in probes:
        check_pictures(store)
    split_evaluation(store)
    if not store.factors:
        raise UserError(f"{data}: has no 'factors' to probe for (keys: observations, ...); nothing to measure")
    for name, spec in store.factors.items():
        values = np.asarray(store.array(f"factors/{name}")[:])
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(1))
        if len(bad):
            raise UserError(f"{data}: 'factors/{name}' is NaN or infinite at row {bad[0]}; {len(bad)} such rows")
        if spec.scale == "categorical" and values.min() < 0:
            raise UserError(f"{data}: 'factors/{name}' has a negative class {values.min()} at row {values.argmin()}")
    return store


def encode_evaluation(
    encoder: Encodes, store: EpisodeStore, *, device: str | torch.device = "cpu", progress: bool = True
) -> Encoded:
    """Encode all evaluation rows of a store once."""
    assert not (isinstance(encoder, nn.Module) and encoder.training), "probes take a frozen encoder in eval mode"
    split = split_evaluation(store)
    latents, codes = encode_rows(encoder, store, split.rows, device=device, progress=progress)
    return Encoded(split, latents, codes, encoder.codes_per_group)


def probe_encoded(
    encoded: Encoded,
    store: EpisodeStore,
    *,
    name: str,
    probes: tuple[str, ...] = PROBES,
    seed: int = 0,
    progress: bool = True,
) -> tuple[ProbeReport, Drawings | None]:
    """Probe latents for every factor of their store, the state's factors first; with ``decoder``, for the pictures."""
    split = encoded.split
    rows, recordings = split.rows, store.row_recordings[split.rows]
    in_fit = np.isin(store.row_episodes[rows], split.fit)
    features = Standardiser(encoded.latents[in_fit])(encoded.latents)
    reports = {}
    by_factor = tuple(probe for probe in probes if probe in PROBES)
    ordered = sorted(store.factors.items(), key=lambda item: (item[1].kind, item[0]))
    for factor, spec in tqdm(ordered, desc="probe", unit="factor", disable=None if progress else True, leave=False):
        target = as_target(store.gather(f"factors/{factor}", rows), spec)
        fit = Half(features[in_fit], target[in_fit], recordings[in_fit])
        score = Half(features[~in_fit], target[~in_fit], recordings[~in_fit])
        bits = None if encoded.codes is None else factor_bits(encoded.codes, target, seed)
        reports[factor] = _factor_report(spec, fit, score, by_factor, bits, seed)
    pictures, drawings = None, None
    if DECODER in probes:
        with one_thread():
            pictures, drawings = measure_pictures(features, store, rows, in_fit)
    report = ProbeReport(
        name=name,
        data=store.path.name,
        fingerprint=store.fingerprint,
        features=encoded.latents.shape[1],
        groups=0 if encoded.codes is None else encoded.codes.shape[1],
        seed=seed,
        fit_episodes=split.fit.tolist(),
        score_episodes=split.score.tolist(),
        fit_rows=len(split.fit_rows),
        score_rows=len(split.score_rows),
        factors=reports,
        codebook=None if encoded.codes is None else codebook_use(encoded.codes, encoded.codes_per_group),
        pictures=pictures,
    )
    return report, drawings


def _factor_report(
    spec: FactorSpec, fit: Half, score: Half, probes: tuple[str, ...], bits: FactorBits | None, seed: int
) -> FactorReport:
    categorical = spec.scale == "categorical"
    return FactorReport(
        kind=spec.kind,
        metric="accuracy" if categorical else "R2",
        chance=chance(fit, score),
        probes={probe: measure(probe, fit, score, seed) for probe in probes},
        bits=bits,
        unseen=float(np.mean(~np.isin(score.target, fit.target))) if categorical else 0.0,
    )
