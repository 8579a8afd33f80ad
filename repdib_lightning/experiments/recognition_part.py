"""Pictures of what is recognised, and by which modality, from the bundles of finished points."""

from __future__ import annotations

from repdib_lightning.evaluation.recognition_figures import recognition_figures
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid, Setting

CLIPS = 2
"""As many are drawn of a setting."""


def recognition_parts(results: Results) -> list[Part]:
    """One part with the pictures of the settings that the suite names, of each one's first finished seed."""
    suite = results.suite
    found: dict[str, bytes] = {}
    for grid in suite.grids:
        for setting in grid.settings:
            if setting.place in suite.recognised:
                found |= _drawings(results, grid, setting)
    if not found:
        return []
    sentence = (
        "Held-out clips and the classifier of the first finished seed of a setting: which class is taken for which, "
        "what is lost where a modality is missing, and a few clips with what was told of them and what was attended to."
    )
    return [Part("What is recognised", [sentence], [], found)]


def _drawings(results: Results, grid: Grid, setting: Setting) -> dict[str, bytes]:
    point = next((p for seed in results.seeds if (p := results.point(setting, seed))), None)
    if point is None or not setting.pretrained or setting.probed_on is None:
        return {}
    drawn, _ = recognition_figures(
        point.folder / "bundle",
        setting.probed_on,
        f"{setting.place}, seed {point.seed}",
        clips=CLIPS,
        split="evaluation",
        device="cpu",
        progress=False,
    )
    return {f"recognised-{grid.name}-{setting.name}-{figure}": content for figure, content in drawn.items()}
