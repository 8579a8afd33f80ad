"""What a report says of a grid's fine-tunings beside their numbers."""

from __future__ import annotations

from collections.abc import Mapping

from repdib_lightning.experiments.curves import Band
from repdib_lightning.experiments.figures import learning_curves_figure
from repdib_lightning.experiments.maze_maps import Maps, coverage_figure, topology_figure
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.suite import Finetune, Grid
from repdib_lightning.rl import AGENTS

SENTENCES = {
    "learning": "Learning curves: the mean over seeds and its 95 % bootstrap interval.",
    "coverage": "Coverage: in which share of the steps the agent was in each cell while it trained, mean over seeds; "
    "square-root colour scale, the same for all panels.",
    "topology": "Topology: distance of each cell's latent from the centre's (circle), beside the moves on the shortest "
    "path; each map relative to its largest value, mean over seeds. rho: rank correlation of the two, mean over seeds.",
}


def finetune_parts(grid: Grid, columns: Mapping[str, Mapping[str, Band]], maps: Maps) -> list[Part]:
    """One part with what there is to draw; none without fine-tuning.

    Args:
        grid: whose. columns: its curves. maps: its maps of mazes, empty for other environments.
    """
    finetune = next((setting.finetune for setting in grid.settings if setting.finetune is not None), None)
    if finetune is None:
        return []
    logged = dict.fromkeys(name.split("/", 2)[2] for name in columns if name.startswith(f"{finetune.agent}/"))
    made = {
        **{f"learning-{c.replace('/', '-')}": learning_curves_figure(columns, c, finetune.agent) for c in logged},
        "coverage": coverage_figure(maps),
        "topology": topology_figure(maps),
    }
    drawn = {name: content for name, content in made.items() if content is not None}
    told = dict.fromkeys(SENTENCES[name.partition("-")[0]] for name in drawn)
    sentences = [_told(finetune), *told]
    figures = {f"{grid.name}-{name}": content for name, content in drawn.items()}
    return [Part(f"Fine-tuning: {grid.name}", sentences, [], figures)]


def training_only(columns: Mapping[str, Mapping[str, Band]]) -> dict[str, Mapping[str, Band]]:
    """The columns that are not of a fine-tuning."""
    return {name: settings for name, settings in columns.items() if name.partition("/")[0] not in AGENTS}


def _told(finetune: Finetune) -> str:
    runs = [
        f"{name} ({', '.join(f'{option} {value}' for option, value in options.items())})"
        for name, options in finetune.runs.items()
    ]
    return f"Fine-tuning by {finetune.agent}: {'; '.join(runs)}."
