"""Makes data sets of the Control Suite: policies of several ages play, worker processes film them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.behaviour_policy import Network, PolicyFile, packaged_policy, read_policies
from repdib_lightning.environments.control_background import RECORDED_HELD_OUT
from repdib_lightning.environments.control_background import Kind as Distractors
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.environments.control_scene import Place, Quality
from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.environments.episode_workers import evaluation_episodes, recorded_in_order
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ActionSpec, ArraySpec

VIEW = "pixels"
"""Name of the observation, as in imported V-D4RL."""

Behaviour = Literal["random", "medium", "expert", "medium_replay", "medium_expert"]
BEHAVIOURS = ("random", "medium", "expert", "medium_replay", "medium_expert")

_EVALUATION_SHARE = 0.1


@dataclass(frozen=True)
class ControlRecording:
    """What a recording is made of, as :func:`collect_control` names it; together with the renderer it decides every
    byte.

    Attributes:
        policy_digest: of the file of policies; empty for random actions.
    """

    task: str
    behaviour: Behaviour
    samples: int
    image_size: int
    action_repeat: int
    quality: Quality
    distractors: Distractors
    place: Place
    source: str
    seed: int
    policy: str = ""
    policy_digest: str = ""

    @cached_property
    def steps(self) -> int:
        """Actions an episode."""
        return ControlTask(self.task, self.action_repeat).steps

    @property
    def episodes(self) -> int:
        """How many episodes there are: whole ones, so that there may be some more actions than asked for."""
        return -(-self.samples // self.steps)

    def environment(self) -> ControlEnv:
        """The environment that is filmed."""
        return ControlEnv(
            self.task,
            image_size=self.image_size,
            action_repeat=self.action_repeat,
            quality=self.quality,
            distractors=self.distractors,
            place=self.place,
            source=self.source,
            distractor_seed=self.seed,
        )

    def policies(self, task: ControlTask) -> PolicyFile | None:
        """The policies that play; None for random actions."""
        if self.behaviour == "random":
            return None
        state = sum(task.sizes.values())
        return read_policies(
            Path(self.policy), task=self.task, action_repeat=self.action_repeat, state=state, actions=task.actions
        )

    def network_of(self, episode: int, policies: PolicyFile) -> Network:
        """Who plays an episode: the older half of ``medium_expert`` is the medium one's, as in V-D4RL's files."""
        share = episode / self.episodes
        if self.behaviour == "medium_replay":
            replay = policies.replay or ["replay_0"]
            name = replay[int(share * len(replay))]
        elif self.behaviour == "medium_expert":
            name = "medium" if share < 0.5 else "expert"
        else:
            name = self.behaviour
        return policies.network(name)

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the simulator in this process: a function that plays and films an episode."""
        environment = self.environment()
        return partial(record_episode, self, environment=environment, policies=self.policies(environment.task))

    def evaluation_episodes(self) -> set[int]:
        """Which episodes are never trained on: a tenth of them, spread evenly."""
        return evaluation_episodes(self.episodes, _EVALUATION_SHARE)


def collect_control(
    path: str | Path,
    *,
    task: str = "walker-walk",
    behaviour: Behaviour = "medium_expert",
    samples: int = 100_000,
    image_size: int = 64,
    action_repeat: int = 2,
    quality: Quality = "fast",
    distractors: Distractors = "none",
    place: Place = "sky",
    source: str = "",
    seed: int = 0,
    policy: Path | None = None,
    workers: int = 2,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Record a task of the DeepMind Control Suite from pixels, like V-D4RL's data (paper, offline visual control).

    Observation ``pixels``, (3, H, W) uint8, not stacked, with the agent's mask; continuous actions in [-1, 1]; rewards;
    the state that the task observes and what plays behind as factors. A tenth of the episodes, spread evenly, are
    marked for evaluation; behind these play other clips. The same seed gives the same movements amid any distractors.
    What was interrupted goes on after its last whole episode when the same command is given again.

    Args:
        path: the file to make.
        task: such as ``walker-walk`` or ``cheetah-run``.
        behaviour: ``random`` (uniform actions), ``medium``, ``expert``, ``medium_expert`` (half of each),
            ``medium_replay`` (networks of all ages up to medium). Policies draw their actions.
        samples: actions in all, rounded up to whole episodes.
        image_size: height of the pictures in pixels.
        action_repeat: control steps an action is held for.
        quality: ``fast``, or ``paper`` (shadows, reflections and smooth edges; 10 times slower).
        distractors: ``none``, ``image`` or ``video``: another one each episode.
        place: where they are seen: ``sky``, ``sky_floor``, or ``side``.
        source: of the distractors: a folder of pictures or videos, or of CIFAR-10; built-in ones by default.
        seed: of everything.
        policy: file of policies (``collect policies``); by default the one that ships with the package.
        workers: rendering processes, one a core is best.
        overwrite: replace an existing file, and what an interrupted recording left.
        progress: show a progress bar.

    Returns:
        The path.

    Raises:
        UserError: an option out of range, an unknown task, a policy of another one, a file that exists or cannot be
            written, the rest of another recording, no renderer, MuJoCo 4, unreadable distractors.
    """
    if behaviour not in BEHAVIOURS:
        raise UserError(f"behaviour={behaviour}: unknown, {nearest(behaviour, BEHAVIOURS)}")
    for option, value, least in (("samples", samples, 1), ("seed", seed, 0), ("workers", workers, 1)):
        if value < least:
            raise UserError(f"{option}={value}: must be at least {least}")
    name = ControlTask(task, action_repeat).name
    chosen, digest = _policy(name, behaviour, policy)
    recording = ControlRecording(
        name,
        behaviour,
        samples,
        image_size,
        action_repeat,
        quality,
        distractors,
        place,
        source,
        seed,
        chosen,
        digest,
    )
    writer = _writer(path, recording, overwrite)
    rest = range(writer.episodes_done, recording.episodes)
    with writer, _progress_bar(recording, writer.episodes_done, progress) as bar:
        for episode in recorded_in_order(recording, rest, workers):
            writer.add_episode(**episode)
            bar.update(len(episode["actions"]))
    return Path(path)


def record_episode(
    recording: ControlRecording, episode: int, environment: ControlEnv, policies: PolicyFile | None
) -> dict[str, Any]:
    """Play and film one episode: the arguments of :meth:`EpisodeWriter.add_episode`."""
    random, drawing = (np.random.default_rng([recording.seed, episode, part]) for part in range(2))
    task, camera, backgrounds = environment.task, environment.camera, environment.backgrounds
    network = None if policies is None else recording.network_of(episode, policies)
    evaluation = episode in recording.evaluation_episodes()
    playing = backgrounds.draw(drawing, evaluation, RECORDED_HELD_OUT if evaluation else None)
    task.reset(random)
    rows: list[dict[str, Any]] = []
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    terminations: list[bool] = []
    truncations: list[bool] = []
    ended = False
    while True:
        picture = backgrounds.shown(camera.see(task), playing, len(rows))
        factors = {**task.factors(), **backgrounds.factors(playing, len(rows))}
        rows.append({"picture": picture, "mask": _widened(camera.agent_mask(task), backgrounds.panel), **factors})
        if ended:
            break
        drawn = random.uniform(-1.0, 1.0, task.actions) if network is None else network.act(task.state(), random)
        action = drawn.astype(np.float32)  # before it is played, so that the stored ones lead to the stored states
        reward, terminated, truncated = task.step(action)
        ended = terminated or truncated
        actions.append(action)
        rewards.append(reward)
        terminations.append(terminated)
        truncations.append(truncated)
    joined = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return {
        "observations": {VIEW: joined.pop("picture")},
        "masks": {VIEW: joined.pop("mask")},
        "factors": {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in joined.items()},
        "actions": np.stack(actions),
        "rewards": np.array(rewards, np.float32),
        "terminations": np.array(terminations),
        "truncations": np.array(truncations),
        "evaluation": evaluation,
    }


def _widened(mask: np.ndarray, panel: int) -> np.ndarray:
    return np.pad(mask, ((0, 0), (0, panel)))


def _policy(task: str, behaviour: Behaviour, policy: Path | None) -> tuple[str, str]:
    """Path of the policies that play, and a digest of the file."""
    if behaviour == "random":
        if policy is not None:
            raise UserError(f"--policy {policy}: random actions need none; choose another --behaviour")
        return "", ""
    chosen = packaged_policy(task) if policy is None else policy
    try:
        return str(chosen), hashlib.sha256(chosen.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise UserError(f"--policy {chosen}: cannot be read ({error.strerror or error})") from error


def _writer(path: str | Path, recording: ControlRecording, overwrite: bool) -> EpisodeWriter:
    environment = recording.environment()
    shape = environment.observation_space.shape
    assert shape is not None
    policies = recording.policies(environment.task)  # what is wrong with them shows here and not in a worker
    if policies is not None:
        for episode in (0, recording.episodes - 1):
            recording.network_of(episode, policies)
    states = {name: FactorSpec("endogenous", "continuous", width=n) for name, n in environment.task.sizes.items()}
    actions, factors = environment.task.actions, {**states, **environment.backgrounds.factor_specs()}
    environment.close()
    told = {**asdict(recording), "policy": Path(recording.policy).name}
    return EpisodeWriter(
        path,
        rows=(recording.steps + 1) * recording.episodes,
        episodes=recording.episodes,
        observations={VIEW: ArraySpec(shape)},
        actions=ActionSpec("continuous", actions),
        factors=factors,
        masks={VIEW: (shape[1], shape[2])},
        rewards=True,
        attributes={
            "environment": "control",
            "configuration": told,
            "seed": recording.seed,
            "licence": "generated; models from dm-control (Apache-2.0)",
        },
        overwrite=overwrite,
        resume=True,
    )


def _progress_bar(recording: ControlRecording, done: int, shown: bool) -> Any:
    from tqdm import tqdm

    total, begun = recording.steps * recording.episodes, recording.steps * done
    return tqdm(total=total, initial=begun, unit=" samples", desc=recording.task, disable=not shown)
