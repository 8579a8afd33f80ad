"""Makes data sets: plays a random policy in worker processes and writes one store."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments import COLLECTORS as COLLECTORS
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

if TYPE_CHECKING:
    from repdib_lightning.environments.robot_arm import Television
    from repdib_lightning.environments.robot_arm_scene import RobotArmScene

EVALUATION_SHARE = 0.3
_CAMERAS = ("front", "top")


@dataclass(frozen=True)
class RobotArmRecording:
    """What a recording is made of; together with the renderer it decides every byte.

    Attributes:
        samples: actions over all episodes.
        episode_length: actions an episode, after which the arm goes home; the last episode takes what is left.
        image_size: height and width of the pictures in pixels.
        seed: of everything.
        distractors: what the TV plays; see :mod:`repdib_lightning.environments.distractors`.
    """

    samples: int
    episode_length: int
    image_size: int
    seed: int
    distractors: str

    def __post_init__(self) -> None:
        least = {"samples": 1, "episode_length": 1, "image_size": 16, "seed": 0}
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise UserError(f"{name}={getattr(self, name)}: must be at least {bound}")
        if self.image_size > 512:
            raise UserError(f"image_size={self.image_size}: must be at most 512")

    @property
    def episodes(self) -> int:
        """How many episodes there are."""
        return -(-self.samples // self.episode_length)

    @property
    def rows(self) -> int:
        """Rows of the store: one more than actions in every episode."""
        return self.samples + self.episodes

    def actions_of(self, episode: int) -> int:
        """How many actions an episode has."""
        return min(self.episode_length, self.samples - episode * self.episode_length)

    def evaluation_episodes(self) -> set[int]:
        """Which episodes are never trained on; see :func:`evaluation_episodes`."""
        return evaluation_episodes(self.episodes)


def evaluation_episodes(episodes: int) -> set[int]:
    """Which of the episodes of a recording are never trained on: about 30 %, spread evenly.

    Of few episodes up to half, so that there are 4 where possible: probes are fitted on half of them and scored on the
    other half.
    """
    count = max(min(4, episodes // 2), round(EVALUATION_SHARE * episodes)) if episodes > 1 else 0
    return {int((i + 0.5) * episodes / count) for i in range(count)}


def collect_robot_arm(
    path: str | Path,
    *,
    samples: int = 14_000,
    episode_length: int = 500,
    image_size: int = 64,
    seed: int = 0,
    distractors: str = "procedural",
    workers: int = 2,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Record the robot arm under a uniform random policy (paper, robot experiment: 500-step episodes, 14,000 samples).

    Observations ``front`` and ``top``, (3, H, W) uint8; 5 discrete actions; every factor of the picture and the arm's
    mask in both views. About 30 % of the episodes, spread over the recording, are marked for evaluation; in these the
    TV plays other videos. The same arguments and renderer give the same bytes, whatever ``workers`` is.

    Args:
        path: the file to make.
        samples: actions over all episodes; the last episode is shorter where they do not divide.
        episode_length: actions an episode.
        image_size: height and width in pixels, 16 to 512.
        seed: of policy, noise and videos.
        distractors: ``procedural``, ``procedural_images``, a folder of pictures or videos, or of CIFAR-10.
        workers: rendering processes, one a core is best.
        overwrite: replace an existing file.
        progress: show a progress bar.

    Returns:
        The path.

    Raises:
        UserError: an option out of range, a file that exists or cannot be written, no renderer, unreadable distractors.
    """
    from repdib_lightning.environments.robot_arm import ACTIONS, Television, factor_specs

    recording = RobotArmRecording(samples, episode_length, image_size, seed, str(distractors))
    if workers < 1:
        raise UserError(f"workers={workers}: must be at least 1")
    videos = len(Television(recording.distractors, seed))
    picture = ArraySpec((3, image_size, image_size))
    writer = EpisodeWriter(
        path,
        rows=recording.rows,
        episodes=recording.episodes,
        observations=dict.fromkeys(_CAMERAS, picture),
        actions=ActionSpec("discrete", len(ACTIONS)),
        factors=factor_specs(videos),
        masks=dict.fromkeys(_CAMERAS, (image_size, image_size)),
        attributes={
            "environment": "robot_arm",
            "configuration": asdict(recording),
            "seed": seed,
            "action_names": list(ACTIONS),
            "licence": "generated; Kinova Jaco meshes from dm-control (Apache-2.0)",
        },
        overwrite=overwrite,
    )
    with writer, _progress_bar(samples, progress) as bar:
        for episode in _rendered_in_order(recording, min(workers, recording.episodes)):
            writer.add_episode(**episode)
            bar.update(len(episode["actions"]))
    return Path(path)


def record_episode(
    recording: RobotArmRecording, episode: int, scene: RobotArmScene, television: Television
) -> dict[str, Any]:
    """Render one episode: the arguments of :meth:`EpisodeWriter.add_episode`."""
    from repdib_lightning.environments.robot_arm import ACTIONS, HOME, move, plan_noise

    rng = np.random.default_rng([recording.seed, episode])
    evaluation = episode in recording.evaluation_episodes()
    actions = rng.integers(len(ACTIONS), size=recording.actions_of(episode))
    first = episode * (recording.episode_length + 1)
    progress = np.arange(first, first + len(actions) + 1) / recording.rows
    noise = plan_noise(rng, progress, television, evaluation)
    cells = [HOME]
    for action in actions:
        cells.append(move(cells[-1], int(action)))
    seen = [scene.pictures_and_masks(noise.moment(t, cell, television)) for t, cell in enumerate(cells)]
    return {
        "observations": {name: np.stack([pictures[name] for pictures, _ in seen]) for name in _CAMERAS},
        "actions": actions,
        "factors": {"cell": np.array(cells), **noise.factors(television)},
        "masks": {name: np.stack([masks[name] for _, masks in seen]) for name in _CAMERAS},
        "evaluation": evaluation,
    }


def _serve(connection: Connection, recording: RobotArmRecording) -> None:
    """A worker: receives episode numbers, sends back (number, episode) or (number, exception)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    try:
        from repdib_lightning.environments.rendering import prepare_rendering
        from repdib_lightning.environments.robot_arm import Television
        from repdib_lightning.environments.robot_arm_scene import RobotArmScene

        prepare_rendering(threads=0)
        scene = RobotArmScene(recording.image_size)
        television = Television(recording.distractors, recording.seed)
        while (episode := connection.recv()) is not None:
            connection.send((episode, record_episode(recording, episode, scene, television)))
    except (EOFError, BrokenPipeError):
        return  # the parent is gone
    except Exception as error:
        connection.send((-1, UserError(str(error)) if isinstance(error, UserError) else RuntimeError(repr(error))))


def _rendered_in_order(recording: RobotArmRecording, workers: int) -> Iterator[dict[str, Any]]:
    """Episodes in order; at most two a worker are under way or waiting, so memory stays bounded."""
    with _worker_connections(recording, workers) as connections:
        waiting: dict[int, dict[str, Any]] = {}
        idle: list[Any] = list(connections)
        given = 0
        for wanted in range(recording.episodes):
            while wanted not in waiting:
                while idle and given < min(recording.episodes, wanted + 2 * workers):
                    idle.pop().send(given)
                    given += 1
                for connection in wait([c for c in connections if c not in idle]):
                    episode, result = _receive(connection)
                    waiting[episode] = result
                    idle.append(connection)
            yield waiting.pop(wanted)


def _receive(connection: Any) -> tuple[int, dict[str, Any]]:
    try:
        episode, result = connection.recv()
    except EOFError as error:
        raise RuntimeError("a rendering process died (out of memory, or a fault of the graphics driver)") from error
    if isinstance(result, Exception):
        raise result
    return episode, result


@contextmanager
def _worker_connections(recording: RobotArmRecording, workers: int) -> Iterator[list[Any]]:
    context = multiprocessing.get_context("spawn")
    connections: list[Any] = []
    processes = []
    try:
        with _main_not_imported_again():
            for _ in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, recording), daemon=True)
                process.start()
                theirs.close()
                connections.append(ours)
                processes.append(process)
        yield connections
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()
        for connection in connections:
            connection.close()


@contextmanager
def _main_not_imported_again() -> Iterator[None]:
    """Hide the main script from spawned processes: they need only this package, and scripts may lack a main guard."""
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {name: vars(main).pop(name) for name in ("__file__", "__spec__") if name in vars(main)}
    main.__spec__ = None
    try:
        yield
    finally:
        vars(main).update(hidden)


def _progress_bar(samples: int, shown: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=samples, unit=" samples", desc="robot arm", disable=not shown)
