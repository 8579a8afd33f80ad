"""Pictures of what the groups of a latent draw, from the bundles of finished points."""

from __future__ import annotations

from repdib_lightning.evaluation.factor_figures import figures_of, open_redrawing
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid, Setting

PICTURES = 25
"""As many as in the paper's figure."""


def group_parts(results: Results) -> list[Part]:
    """One part with the drawings of the settings that the suite names, of each one's first finished seed."""
    suite = results.suite
    found: dict[str, bytes] = {}
    for grid in suite.grids:
        for setting in grid.settings:
            if setting.place in suite.drawn_groups:
                found |= _drawings(results, grid, setting)
    if not found:
        return []
    sentence = (
        "Held-out pictures drawn by the decoder of the first finished seed of a setting: with each group of the latent "
        "set to 0 (the paper's figure), with one group of another picture, and with each of a group's most used codes."
    )
    return [Part("What the groups draw", [sentence], [], found)]


def _drawings(results: Results, grid: Grid, setting: Setting) -> dict[str, bytes]:
    point = next((p for seed in results.seeds if (p := results.point(setting, seed))), None)
    if point is None or not setting.pretrained or setting.probed_on is None:
        return {}
    own = results.suite.probe_of(setting).get("groups")
    drawn = open_redrawing(
        point.folder / "bundle",
        setting.probed_on,
        groups=None if own is None else int(own),
        count=PICTURES,
        split="evaluation",
        seed=0,
        device="cpu",
    )
    found = figures_of(drawn, f"{setting.place}, seed {point.seed}")
    return {f"groups-{grid.name}-{setting.name}-{figure}": content for figure, content in found.items()}
