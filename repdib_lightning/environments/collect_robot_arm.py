"""Makes data sets of the robot arm: plays a random policy in worker processes and writes one store."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.episode_workers import evaluation_episodes, recorded_in_order
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

if TYPE_CHECKING:
    from repdib_lightning.environments.robot_arm import Television
    from repdib_lightning.environments.robot_arm_scene import RobotArmScene

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

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the scene in this process: a function that renders an episode."""
        from repdib_lightning.environments.robot_arm import Television
        from repdib_lightning.environments.robot_arm_scene import RobotArmScene

        scene, television = RobotArmScene(self.image_size), Television(self.distractors, self.seed)
        return partial(record_episode, self, scene=scene, television=television)

    def evaluation_episodes(self) -> set[int]:
        """Which episodes are never trained on; see :func:`evaluation_episodes`."""
        return evaluation_episodes(self.episodes)


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
            "classes": {"actions": list(ACTIONS)},
            "licence": "generated; Kinova Jaco meshes from dm-control (Apache-2.0)",
        },
        overwrite=overwrite,
    )
    with writer, _progress_bar(samples, progress) as bar:
        for episode in recorded_in_order(recording, range(recording.episodes), workers):
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


def _progress_bar(samples: int, shown: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=samples, unit=" samples", desc="robot arm", disable=not shown)
