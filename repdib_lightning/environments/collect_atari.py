"""Makes data sets of Atari games: players of several qualities play, worker processes film them."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.atari_casting import Casting
from repdib_lightning.environments.atari_games import action_meanings, game_name
from repdib_lightning.environments.atari_players import check_mixture, default_mixture
from repdib_lightning.environments.atari_recording import VIEW, AtariFilm, AtariRecording, PlayedGame
from repdib_lightning.environments.episode_workers import recorded_in_order
from repdib_lightning.environments.side_image import Side
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

MAX_FRAMES = 27_000
"""Emulator frames of a game (7.5 minutes), so that an episode fits into memory."""


def collect_atari(
    path: str | Path,
    *,
    game: str = "breakout",
    samples: int = 100_000,
    mixture: dict[str, float] | None = None,
    policy: Path | None = None,
    sticky: float = 0.0,
    frame_skip: int = 4,
    image_size: int = 84,
    max_frames: int = MAX_FRAMES,
    side: Side = "right",
    side_width: int = 42,
    side_source: str = "",
    seed: int = 0,
    workers: int = 2,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Record an Atari game amid an image on the side, by players of several qualities (paper, offline Atari).

    Observation ``frame``, (1, H, W) uint8 grey, not stacked; the game's minimal set of actions; its rewards, not
    clipped; an episode is a whole game. Factors: variables of the console's memory (Breakout, Pong, Qbert, Seaquest),
    and the image, another one each episode. A tenth of the episodes, of all players, are marked for evaluation; beside
    these are other images. The same seed gives the same games whatever is beside them.

    The games are played twice: at first without pictures, by their players, until there are enough samples; then from
    their actions, to be filmed. What was interrupted goes on after its last whole episode when the same command is
    given again; the first part is done again then.

    Args:
        path: the file to make.
        game: such as ``breakout``, ``pong`` or ``MsPacman``: all that ale-py ships.
        samples: actions in all, rounded up to whole games.
        mixture: who plays which share of the samples, such as ``'{random: 0.2, scripted-0.3: 0.8}'``. ``random``;
            ``scripted-EPSILON`` (Breakout, Pong, Qbert and Seaquest: reads the console's memory, that share of its
            actions is random); ``dqn`` or ``dqn-STEPS`` (the newest network of the policy, or that of an age; 0.05 of
            its actions are random). By default ``random: 0.1, scripted-0.3: 0.2, scripted-0.1: 0.3, scripted-0.02:
            0.4``; random alone where there is no script; all networks of the policy where there is one.
        policy: file of networks (``collect atari_policy``).
        sticky: probability that the console repeats the action before, each emulator frame.
        frame_skip: emulator frames an action is held for.
        image_size: height and width of the game's picture in pixels, 16 to 210.
        max_frames: emulator frames after which a game is cut off.
        side: where the image is: ``none``, ``left``, ``right``, ``top`` or ``bottom``.
        side_width: pixels that the picture grows by, 3 to 512.
        side_source: a folder of pictures, or of CIFAR-10; built-in images by default.
        seed: of everything.
        workers: playing processes, one a core is best.
        overwrite: replace an existing file, and what an interrupted recording left.
        progress: show progress bars, and what each player reached.

    Returns:
        The path.

    Raises:
        UserError: an option out of range, an unknown game or player, rates that do not sum to 1, a policy of another
            game, a file that exists or cannot be written, the rest of another recording, unreadable images, ale-py or
            OpenCV are missing.
    """
    for option, value, least in (("samples", samples, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if value < least:
            raise UserError(f"{option}={value}: must be at least {least}")
    name = game_name(game)
    chosen = _mixture(mixture, name, policy, {"frame_skip": frame_skip, "image_size": image_size})
    recording = AtariRecording(
        name,
        samples,
        chosen,
        sticky,
        frame_skip,
        image_size,
        max_frames,
        side,
        side_width,
        side_source,
        seed,
        "" if policy is None else str(policy),
        "" if policy is None else hashlib.sha256(policy.read_bytes()).hexdigest()[:16],
    )
    recording.console()  # what is wrong with it shows here and not in a worker
    recording.side_image()
    _check_free(Path(path), overwrite)
    films = AtariFilm(recording, _played(recording, workers, progress))
    if progress:
        _report(recording, films.games)
    writer = _writer(path, films, overwrite)
    rest = range(writer.episodes_done, len(films.games))
    begun = sum(len(game.actions) for game in films.games[: writer.episodes_done])
    with writer, _bar(f"filming {name}", films.rows - len(films.games), begun, progress) as bar:
        for episode in recorded_in_order(films, rest, workers):
            writer.add_episode(**episode)
            bar.update(len(episode["actions"]))
    return Path(path)


def _mixture(
    mixture: dict[str, float] | None, game: str, policy: Path | None, size: dict[str, int]
) -> dict[str, float]:
    """Who plays which share, checked."""
    networks = None
    if policy is not None:
        from repdib_lightning.environments.atari_network import read_atari_policy

        networks = read_atari_policy(policy, game=game, **size)
    chosen = default_mixture(game, networks) if mixture is None else mixture
    check_mixture(chosen, game, networks)
    return {name: float(rate) for name, rate in sorted(chosen.items())}  # as the file states them


def _check_free(path: Path, overwrite: bool) -> None:
    """Refuse before anything is played what the writer would refuse afterwards."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file, such as {path / 'NAME.h5'}")
    if path.exists() and not overwrite:
        raise UserError(f"{path}: exists already; choose another file or pass --overwrite")


def _played(recording: AtariRecording, workers: int, progress: bool) -> list[PlayedGame]:
    """The games of the recording, in order."""
    casting = Casting(list(recording.mixture.values()), recording.samples)
    games: dict[int, PlayedGame] = {}
    results: Any = recorded_in_order(recording, casting, workers)
    with closing(results), _bar(f"playing {recording.game}", recording.samples, 0, progress) as bar:
        for number, played in zip(casting, results, strict=False):
            games[number] = PlayedGame(number, **played)
            casting.played(number, len(played["actions"]))
            bar.update(min(casting.total, recording.samples) - bar.n)
            if casting.complete:
                break
    return [games[number] for number in casting.kept]


def _report(recording: AtariRecording, games: Sequence[PlayedGame]) -> None:
    """Say what each player reached."""
    for who in recording.players:
        theirs = [game for game in games if recording.who(game.number) == who]
        if theirs:
            scores = [float(game.rewards.sum()) for game in theirs]
            counted = sum(len(game.actions) for game in theirs)
            print(
                f"{recording.game}: {who} played {len(theirs)} games, {counted} samples; return "
                f"{sum(scores) / len(scores):.1f} ({min(scores):g} to {max(scores):g})",
                file=sys.stderr,
            )


def _writer(path: str | Path, films: AtariFilm, overwrite: bool) -> EpisodeWriter:
    recording = films.recording
    meanings = action_meanings(recording.game)
    return EpisodeWriter(
        path,
        rows=films.rows,
        episodes=len(films.games),
        observations={VIEW: ArraySpec((1, *recording.side_image().shape))},
        actions=ActionSpec("discrete", len(meanings)),
        factors=films.factor_specs(),
        rewards=True,
        attributes={
            "environment": "atari",
            "configuration": recording.configuration(),
            "seed": recording.seed,
            "classes": {"actions": meanings},
            "licence": "generated; pictures of the Atari 2600 games that ale-py ships",
        },
        overwrite=overwrite,
        resume=True,
    )


def _bar(task: str, samples: int, begun: int, shown: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=samples, initial=begun, unit=" samples", desc=task, disable=not shown)
