"""One training of an agent that plays a task of continuous control, from its options to its outcome."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.data.files import whole_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.rl.devices import check_device
from repdib_lightning.rl.episodes_at_once import EpisodesAtOnce
from repdib_lightning.rl.exploration.schedule import Schedule
from repdib_lightning.rl.last_good import Spoiled, told
from repdib_lightning.rl.offline_environment import CONTROL
from repdib_lightning.rl.offline_options import FRESH
from repdib_lightning.rl.online_encoder import evaluated, given_encoder, trained_parts
from repdib_lightning.rl.online_environment import chosen_options, control_of, open_task
from repdib_lightning.rl.online_options import OnlineOptions
from repdib_lightning.rl.online_progress import OnlineProgress
from repdib_lightning.rl.online_values import VALUES, SeenValues
from repdib_lightning.rl.options import CONFIGURATION, plain
from repdib_lightning.rl.outcome import write_outcome
from repdib_lightning.versions import versions


class OnlineTraining(ABC):
    """Builds everything, so that whatever does not fit shows before a folder is made.

    Args:
        options: of the verb.

    Attributes:
        frozen: the encoder where it stays as it is; None where ``parts``, encoder and bottleneck, are trained.
        spec: of the encoder. width: M. task: its full name. actions: A. action_repeat: frames an action.
        schedule: of actions, in one environment. hidden: width of the agent's layers.
        played: frames so far.

    Raises:
        UserError: an unknown task, a snapshot or a bundle that does not fit it, a device that is not there.
    """

    POLICY: str
    """Name of the file that holds the trained policy."""

    hidden: int

    def __init__(self, options: OnlineOptions) -> None:
        self.options = options
        check_device(options.device)
        self.device = resolve_device(options.device)
        self.given = given_encoder(options)
        spec = None if self.given.encoder is None else self.given.encoder.spec
        self.chosen = chosen_options(options.task, options.env_options or {}, self.given.facts, spec)
        self.opened: list[gymnasium.Env[Any, Any]] = [open_task(self.chosen, evaluation=False)]
        try:
            control = control_of(self.opened[0])
            self.task = control.task.name
            self.actions, self.action_repeat = control.task.actions, control.task.action_repeat
            self.schedule = self._schedule(control.task.steps)
            shape = control.observation_space.shape
            assert shape is not None
            self._take_encoder(shape)
            self._open_evaluation()
            torch.manual_seed(options.seed)
            self._build()
        except BaseException:
            self.close()
            raise
        self.films: list[np.ndarray] = []
        self.seen_values: SeenValues | None = None

    @property
    def environment(self) -> gymnasium.Env[Any, Any]:
        """The one that the agent learns in."""
        return self.opened[0]

    def _schedule(self, episode: int) -> Schedule:
        options = self.options
        return Schedule.of_frames(
            frames=options.frames,
            action_repeat=self.action_repeat,
            episode=episode,
            environments=1,
            seed_frames=options.seed_frames,
            update_every=options.update_every,
        )

    @property
    def frames(self) -> int:
        """Of the whole training: those asked for, and what is left of the last episode."""
        return self.schedule.total * self.action_repeat

    def resolved(self) -> dict[str, Any]:
        """The options as JSON can hold them, with what followed from snapshot, bundle and defaults."""
        options, facts = self.options, self.given.facts
        found = plain(asdict(options)) | {"task": self.task, "frozen": options.is_frozen, "hidden": self.hidden}
        found |= {"n_steps": options.steps_of_returns, "snapshot": facts.get("frames", options.snapshot)}
        if not options.is_frozen:
            found["shift"] = options.pixels
        if options.encoder is None:
            found |= {name: options.fresh(name) for name in FRESH}
        elif not options.is_frozen and options.bottleneck:
            found["bottleneck_losses"] = options.losses_weight
        return found

    def _take_encoder(self, picture: tuple[int, ...]) -> None:
        self.frozen: FrozenEncoder | None = None
        self.parts: tuple[Encoder, Bottleneck] | None = None
        encoder: Encoder
        if self.options.is_frozen:
            assert self.given.encoder is not None
            self.frozen = self.given.encoder.to(self.device)
            encoder = self.frozen.encoder
        else:
            encoder, bottleneck = trained_parts(self.options, self.given, picture)
            self.parts = encoder.to(self.device), bottleneck.to(self.device)
        self.spec, self.width = encoder.spec, encoder.features

    def _open_evaluation(self) -> None:
        options = self.options
        try:
            PrepareObservation(self.environment, self.spec)
        except UserError as error:
            raise UserError(f"--encoder {options.encoder}: does not fit {self.task}: {error}") from error
        copies = []
        for _ in range(options.episodes):
            copies.append(open_task(self.chosen, evaluation=True))
            self.opened.append(copies[-1])
        self.evaluation = EpisodesAtOnce(copies, self.spec, options.seed + 1)

    @abstractmethod
    def _build(self) -> None:
        """Build the agent."""

    @abstractmethod
    def mean_actions(self, features: Tensor) -> Tensor:
        """(n, M) to the actions (n, A) of the mean policy."""

    @abstractmethod
    def values(self, features: Tensor, actions: Tensor) -> Tensor:
        """(n, M) and (n, A) to (n,): the smaller value of the two critics."""

    @abstractmethod
    def learn(self, folder: Path, progress: OnlineProgress) -> None:
        """Play and learn; ask for an evaluation before the first frame, wherever one is due, and after the last."""

    @abstractmethod
    def save(self, folder: Path, encoder: Path | None) -> None:
        """Write the policy; ``encoder`` is the bundle that it sees with, None for the one in the folder."""

    @abstractmethod
    def restore(self) -> None:
        """Go back to the last good policy."""

    def features(self, observations: Mapping[str, np.ndarray]) -> Tensor:
        """Name -> (n, *stacked shape) to (n, M), on the agent's device."""
        if self.frozen is not None:
            return self.frozen.encode(dict(observations))
        assert self.parts is not None
        return evaluated(*self.parts, {n: torch.from_numpy(a).to(self.device) for n, a in observations.items()})

    def act(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        """Actions (n, A) of the mean policy for name -> (n, *stacked shape)."""
        with torch.no_grad():
            features = self.features(observations)
            actions = self.mean_actions(features)
            if self.seen_values is not None:
                self.seen_values.add(features, self.values(features, actions))
        acted: np.ndarray = actions.cpu().numpy()
        if not np.isfinite(acted).all():
            raise Spoiled("an action is no number")
        return acted

    def evaluate(self, last: bool) -> np.ndarray:
        """Returns (n,) of the mean policy; the last time some episodes are filmed, and values are noted."""
        self.seen_values = SeenValues() if last else None
        filmed = min(self.options.film, self.options.episodes) if last else 0
        returns, self.films = self.evaluation.run(self.act, filmed)
        return returns

    def train(self, folder: Path) -> None:
        """Learn; progress goes into the folder, and where the agent diverges its last good policy.

        Raises:
            UserError: a loss, a value or an action that is no number, or a mean value beyond ``--value_limit``.
        """
        with whole_file(folder / CONFIGURATION) as path:
            path.write_text(json.dumps(self.resolved(), indent=1) + "\n")
        self.progress = OnlineProgress(folder, self.options.evaluate_every, self.frames, self.evaluate)
        self.played = 0
        try:
            self.learn(folder, self.progress)
        except Spoiled as spoiled:
            self.restore()
            self._save_policy(folder)
            raise told(spoiled, self.played, folder / self.POLICY) from spoiled
        finally:
            self.progress.close()

    def _save_policy(self, folder: Path) -> None:
        """The policy; and a bundle of what it sees with, unless that is one as it stands."""
        if self.frozen is not None and self.options.bottleneck:
            self.save(folder, self.given.bundle)
            return
        training = {"agent": self.options.algorithm, "task": self.task, "frames": self.played}
        encoder, bottleneck = self.parts or (self.frozen.encoder, self.frozen.bottleneck)  # type: ignore[union-attr]
        save_bundle(folder / "bundle", encoder.eval(), bottleneck.eval(), training=training, data={})
        self.save(folder, None)

    def finish(self, folder: Path) -> dict[str, Any]:
        """Save the trained policy and what was seen of it, and write what was reached; returns it."""
        self._save_policy(folder)
        if self.seen_values is not None:
            self.seen_values.save(folder / VALUES)
        returns, curve = self.progress.returns, self.progress.curve("eval/return")
        outcome = {
            "agent": self.options.algorithm,
            "environment": CONTROL,
            "environment_options": {**self.chosen, "task": self.task, "evaluation": True},
            "versions": versions(),
            "configuration": self.resolved(),
            "measures": {
                "return": float(returns.mean()),
                "return_deviation": float(returns.std()),
                "mean_return": float(curve.mean()),
                "first_return": float(curve[0]),
                "best_return": float(curve.max()),
                "frames": float(self.played),
            },
            "maps": {},
        }
        write_outcome(folder, outcome, self.films)
        return outcome

    def close(self) -> None:
        """Close the environments."""
        for environment in self.opened:
            environment.close()
