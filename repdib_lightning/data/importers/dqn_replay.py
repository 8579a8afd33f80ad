"""DQN Replay Dataset (Agarwal, Schuurmans, Norouzi, An Optimistic Perspective on Offline RL, ICML 2020), game by game.

All that a DQN played while it learned, with sticky actions, as the replay memory of Dopamine logged it: for each run 50
checkpoints of a million rows, in gzip files that are streamed here. The paper's offline Atari experiment takes them.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.importers.dqn_replay_arrays import ArrayStream
from repdib_lightning.data.importers.dqn_replay_files import ReplayLogs, Steps
from repdib_lightning.data.importers.dqn_replay_padding import check_black
from repdib_lightning.data.importers.dqn_replay_plan import Options, Plan, make_plan
from repdib_lightning.data.importers.dqn_replay_report import summary
from repdib_lightning.data.importers.dqn_replay_selection import Piece, Rule
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.atari_games import action_meanings, arcade, game_name
from repdib_lightning.environments.control_background import RECORDED_HELD_OUT
from repdib_lightning.environments.episode_workers import evaluation_episodes
from repdib_lightning.environments.side_image import Side, SideImage
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

VIEW = "frame"
"""Name of the observation."""

_PUBLISHER = "https://offline-rl.github.io"
_EVALUATION_SHARE = 0.1
_CHUNK = 256


def import_dqn_replay(
    source: Path,
    output: Path,
    *,
    game: str = "",
    selection: Rule = "decision_transformer",
    transitions: int = 500_000,
    checkpoints: list[int] | None = None,
    per_visit: int = 10,
    read_up_to: int = 100_000,
    partial: Literal["drop", "keep"] = "drop",
    padding: Literal["drop", "keep"] = "drop",
    side: Side = "none",
    side_width: int = 42,
    side_source: str = "",
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Convert DQN-replay logs of one Atari game into a store, with an image on the side if wanted.

    Observation ``frame``, (1, H, W) uint8 grey, un-stacked; the game's minimal actions; rewards as recorded, which in
    the published logs are clipped to [-1, 1]. Frames are read once, from the front of their file and no further than
    needed; memory holds one episode. Episodes are in the order of the files, not of drawing; every tenth is for
    evaluation and shows held-out images. What was left out is told at the end, and is in the attribute ``left_out``.

    The log has no observation after an episode's last action: the store's last row repeats the last frame. An episode
    that a checkpoint holds from the middle on is kept, as in the Decision Transformer's data: its returns are right,
    its steps count from there. The logs were played with sticky actions (``recorded_sticky`` of the configuration),
    agents are evaluated without (``sticky``).

    Args:
        source: the folder ``<Game>/<run>/replay_logs``, or ``<Game>/<run>``.
        output: the store to write (.h5).
        game: such as Breakout; by default the name of the folder two above replay_logs.
        selection: ``decision_transformer``, the 1 % of Chen et al. 2021: visits to checkpoints drawn at random, each of
            which reads on where the last one stopped; ``first``, episodes from the first checkpoint on; ``all``.
        transitions: whole episodes are taken until there are so many in the log; of no meaning for ``all``.
        checkpoints: their numbers; by default all that are there, and those below 50 for decision_transformer.
        per_visit: a visit takes one episode more than this, as in the published code, where the default is 10, too.
        read_up_to: a visit that would reach this row of a checkpoint is given up, with all that it has passed.
        partial: of a piece whose end is not in its checkpoint: left out, or kept as a truncated episode, also at
            read_up_to.
        padding: the black rows that Dopamine writes before each episode: left out where they are found, or kept.
        side: where an image is added: ``none``, ``left``, ``right``, ``top`` or ``bottom``.
        side_width: pixels that the frames grow by.
        side_source: of the images: a folder of pictures, or of CIFAR-10; built-in ones by default.
        seed: of the draws and of the images.
        overwrite: replace an existing output.
        progress: show a progress bar on a terminal.

    Returns:
        The output.

    Raises:
        UserError: naming file or option: no logs, an array that is missing, truncated, no array or of another form,
            arrays that disagree, NaN, an action that the game lacks, nothing to take. No output is left then.
    """
    source, output = Path(source), Path(output)
    options = Options(
        selection, transitions, per_visit, read_up_to, partial, padding, side, side_width, side_source, seed
    )
    if output.exists() and not overwrite:
        raise UserError(f"{output}: exists already; choose another file or pass --overwrite")
    logs = ReplayLogs(source)
    name = _game(game, logs)
    meanings = action_meanings(name)
    plan = make_plan(logs, checkpoints, options, meanings)
    images = SideImage(side, side_width, side_source, seed, plan.size)
    evaluation = evaluation_episodes(len(plan.pieces), _EVALUATION_SHARE)
    attributes = _describe(logs, name, meanings, plan, options)
    _write(logs, plan, images, evaluation, output, attributes, options, overwrite=overwrite, progress=progress)
    wanted = None if selection == "all" else transitions
    for line in summary(
        output, plan.pieces, name, len(evaluation), wanted=wanted, mid_episode=plan.mid_episode, left_out=plan.left_out
    ):
        print(line, file=sys.stderr)
    return output


def _game(game: str, logs: ReplayLogs) -> str:
    arcade()  # so that what is raised below is about the name
    try:
        return game_name(game or logs.game)
    except UserError as error:
        if game:
            raise
        folder = logs.folder.absolute().parent.parent
        raise UserError(
            f"{folder}: is not named after a game ({error}); pass --game, such as --game Breakout"
        ) from error


def _describe(logs: ReplayLogs, game: str, meanings: list[str], plan: Plan, options: Options) -> dict[str, Any]:
    """Attributes of the store."""
    used = sorted({piece.checkpoint for piece in plan.pieces})
    return {
        "environment": "atari",
        "configuration": {
            "game": game,
            "frame_skip": 4,
            "sticky": 0.0,
            "recorded_sticky": 0.25,
            "image_size": plan.size,
            **asdict(options),
            "checkpoints": used,
        },
        "classes": {"actions": meanings},
        "left_out": asdict(plan.left_out),
        "seed": options.seed,
        "source": f"DQN Replay Dataset ({_PUBLISHER}), {'/'.join(logs.folder.absolute().parts[-3:])}",
        "licence": f"publisher's code: Apache-2.0; terms of the data files: see {_PUBLISHER}",
    }


def _write(
    logs: ReplayLogs,
    plan: Plan,
    images: SideImage,
    evaluation: set[int],
    output: Path,
    attributes: dict[str, Any],
    options: Options,
    *,
    overwrite: bool,
    progress: bool,
) -> None:
    rows = sum(piece.actions + 1 for piece in plan.pieces)
    writer = EpisodeWriter(
        output,
        rows=rows,
        episodes=len(plan.pieces),
        observations={VIEW: ArraySpec((1, *images.shape))},
        actions=ActionSpec("discrete", len(attributes["classes"]["actions"])),
        factors=images.factor_specs(),
        rewards=True,
        attributes=attributes,
        overwrite=overwrite,
    )
    with writer, tqdm(total=rows, desc="import", unit="row", disable=None if progress else True) as bar:
        episode = 0
        for number, group in groupby(plan.pieces, key=lambda piece: piece.checkpoint):
            steps = logs.steps(number)
            with logs.frames(number) as stream:
                for piece in group:
                    held_out = episode in evaluation
                    random = np.random.default_rng([options.seed, episode])
                    image = images.draw(random, held_out, RECORDED_HELD_OUT if held_out else None)
                    # Nothing here keeps the frames: an episode may take 300 MB, and the next one is read after it.
                    writer.add_episode(
                        observations={VIEW: _read_frames(logs, piece, stream, images, image)},
                        factors=_factors(images, image, piece.actions + 1),
                        evaluation=held_out,
                        **_read_steps(piece, steps),
                    )
                    bar.update(piece.actions + 1)
                    episode += 1
                if stream.row == stream.shape[0]:
                    stream.check_end()


def _read_frames(logs: ReplayLogs, piece: Piece, stream: ArrayStream, images: SideImage, image: int) -> np.ndarray:
    """The frames of a piece with their image: (T, 1, H, W) uint8. The last one is repeated where an action ended it."""
    stream.skip(piece.start - stream.row)
    padding = np.empty((piece.padding, *stream.shape[1:]), np.uint8)
    stream.read(padding)
    check_black(logs, piece, padding)
    frames = np.empty((piece.actions + 1, 1, *images.shape), np.uint8)
    seen = piece.logged - piece.padding
    for first in range(0, seen, _CHUNK):
        chunk = np.empty((min(_CHUNK, seen - first), *stream.shape[1:]), np.uint8)
        stream.read(chunk)
        frames[first : first + len(chunk), 0] = images.beside(chunk, image)
    if piece.ended:
        frames[-1] = frames[-2]
    return frames


def _factors(images: SideImage, image: int, rows: int) -> dict[str, np.ndarray]:
    return {name: np.repeat(value[None], rows, axis=0) for name, value in images.factors(image).items()}


def _read_steps(piece: Piece, steps: Steps) -> dict[str, Any]:
    """Actions, rewards and the end of a piece: (T - 1,) each."""
    first = piece.start + piece.padding
    rows = slice(first, first + piece.actions)
    last = np.zeros(piece.actions, bool)
    last[-1] = True
    return {
        "actions": steps.actions[rows],
        "rewards": steps.rewards[rows],
        "terminations": last & piece.ended,
        "truncations": last & (not piece.ended),
    }
