"""One training of an offline agent, from a store to its outcome."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.callbacks import exit_codes
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.evaluation.features import check_compatible, stacked
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.records import DataSpec
from repdib_lightning.rl.devices import check_device
from repdib_lightning.rl.episodes_at_once import EpisodesAtOnce
from repdib_lightning.rl.given_bundle import checked_bundle
from repdib_lightning.rl.networks import ShiftedPictures, StandardisedLatents
from repdib_lightning.rl.offline_environment import evaluated_environment
from repdib_lightning.rl.offline_evaluation import open_episodes
from repdib_lightning.rl.offline_options import OfflineOptions
from repdib_lightning.rl.offline_progress import OfflineProgress
from repdib_lightning.rl.one_pass import one_pass_trainer
from repdib_lightning.rl.options import CONFIGURATION, plain
from repdib_lightning.rl.outcome import write_outcome
from repdib_lightning.rl.policy_file import save_policy
from repdib_lightning.rl.row_sources import Latents, Pictures
from repdib_lightning.rl.td3_bc import TD3BC, BehaviourCloning
from repdib_lightning.rl.transitions import TransitionBatches, Transitions
from repdib_lightning.versions import versions


class OfflineTraining:
    """Builds everything, so that whatever does not fit shows before a folder is made.

    Args:
        options: of the verb.

    Raises:
        UserError: a store without what is needed, a bundle that does not fit it, an environment that is not there or
            does not fit, a device that is not there.
    """

    def __init__(self, options: OfflineOptions) -> None:
        self.options = options
        check_device(options.device)
        self.device = resolve_device(options.device)
        self.store = EpisodeStore(options.data)
        rewarded = options.agent != "bc"
        self.transitions = Transitions(self.store, n_steps=options.n_steps, gamma=options.gamma, rewarded=rewarded)
        self.transitions.check_batch(options.batch_size)
        bundle = checked_bundle(options.encoder)
        self.encoder: FrozenEncoder | Encoder
        if bundle is None:
            torch.manual_seed(options.seed)
            self.encoder = self._fresh_encoder()
        else:
            self.encoder = load_encoder(bundle).to(self.device)
            check_compatible(self.encoder, self.store, str(options.encoder))
        self.films: list[np.ndarray] = []
        self.evaluation = self._open_evaluation()
        try:
            self.source, self.agent = self._build()
        except BaseException:
            self.close()
            raise

    def _fresh_encoder(self) -> Encoder:
        stack = self.options.fresh("frame_stack")
        pictures = {name: stacked(a, stack) for name, a in self.store.observations.items() if a.is_image}
        sizes = {name: self.options.fresh(name) for name in ("features", "channels", "strides")}
        return ConvolutionalEncoder(DataSpec(pictures, self.store.actions_spec, stack), **sizes)

    def _open_evaluation(self) -> EpisodesAtOnce | None:
        options = self.options
        self.evaluated_in = chosen = evaluated_environment(self.store, options.env, options.env_options or {})
        if chosen is None:
            return None
        assert self.store.actions_spec is not None
        whose = f"--data {options.data}" if options.encoder is None else f"--encoder {options.encoder}"
        asked: dict[str, Any] = {"count": options.episodes, "seed": options.seed + 1, "whose": whose}
        return open_episodes(EpisodesAtOnce, chosen, self.store.actions_spec, self.encoder.spec, **asked)

    def _build(self) -> tuple[Latents | Pictures, BehaviourCloning]:
        """What is seen of the data, encoded where the encoder is frozen; and the agent that sees it."""
        options = self.options
        source: Latents | Pictures
        features: StandardisedLatents | ShiftedPictures
        if isinstance(self.encoder, FrozenEncoder):
            shifts = {"copies": options.copies, "shift": options.pixels, "seed": options.seed}
            source = latents = Latents(self.store, self.encoder, **shifts, progress=sys.stderr.isatty())
            features = StandardisedLatents(latents.mean, latents.deviation)
        else:
            source, features = Pictures(self.store, self.encoder.spec), ShiftedPictures(self.encoder, options.pixels)
        assert self.store.actions_spec is not None
        width, actions = self.encoder.features, self.store.actions_spec.size
        sizes: dict[str, Any] = {"hidden": options.hidden, "learning_rate": options.learning_rate}
        torch.manual_seed(options.seed)
        if options.agent == "bc":
            return source, BehaviourCloning(features, width, actions, **sizes)
        sizes |= options.values or {}
        return source, TD3BC(features, width, actions, **sizes)

    def act(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        """Actions (n, A) of the mean policy for name -> (n, *shape)."""
        with torch.inference_mode():
            if isinstance(self.encoder, FrozenEncoder):
                seen: Any = self.encoder.encode(observations)
            else:
                seen = {name: torch.from_numpy(array).to(self.agent.device) for name, array in observations.items()}
            acted: np.ndarray = self.agent.act(seen).cpu().numpy()
        return acted

    def train(self, folder: Path) -> None:
        """Learn; progress goes into the folder."""
        options = self.options
        with whole_file(folder / CONFIGURATION) as path:
            path.write_text(json.dumps(plain(asdict(options)), indent=1) + "\n")
        batches = TransitionBatches(
            self.store, self.transitions, self.source, options.batch_size, options.steps, options.seed
        )
        evaluate = None if self.evaluation is None else partial(self._evaluate, self.evaluation)
        self.progress = OfflineProgress(folder, options.evaluate_every, options.steps, evaluate)
        logger = TensorBoardLogger(folder, name="", version="")
        every = min(50, options.steps)
        trainer = one_pass_trainer(
            folder, self.device, batches=options.steps, callback=self.progress, logger=logger, log_every=every
        )
        with exit_codes():
            trainer.fit(self.agent, train_dataloaders=batches)
        (folder / TensorBoardLogger.NAME_HPARAMS_FILE).unlink(missing_ok=True)  # says nothing
        self.agent.eval().to(self.device)

    def _evaluate(self, evaluation: EpisodesAtOnce, last: bool) -> np.ndarray:
        """Returns (n,); the last time, some of the episodes are filmed."""
        returns, self.films = evaluation.run(self.act, min(self.options.film, self.options.episodes) if last else 0)
        return returns

    def finish(self, folder: Path) -> dict[str, Any]:
        """Save the trained policy, and write what was reached; returns it."""
        save_policy(folder, self.agent.actor, self.agent.features, self.options)
        if not isinstance(self.encoder, FrozenEncoder):
            training = {"agent": self.options.agent, "steps": self.options.steps}
            bottleneck = Identity(self.encoder.features)
            save_bundle(folder / "bundle", self.encoder.cpu(), bottleneck, training=training, data={})
            self.encoder.to(self.device)
        measures: dict[str, float] = {}
        if self.evaluation is not None:
            returns, curve = self.progress.returns, self.progress.curve("eval/return")
            measures = {
                "return": float(returns.mean()),
                "normalised": float(returns.mean() / 10.0),
                "return_deviation": float(returns.std()),
                "mean_return": float(curve.mean()),
            }
        measures["clone_error"] = float(self.progress.curve("train/clone")[-1])
        outcome = {
            "agent": self.options.agent,
            "environment": "none" if self.evaluated_in is None else self.evaluated_in[0],
            "environment_options": {} if self.evaluated_in is None else self.evaluated_in[1],
            "versions": versions(),
            "configuration": plain(asdict(self.options)),
            "data": {"file": self.store.path.name, "fingerprint": self.store.fingerprint},
            "measures": measures,
            "maps": {},
        }
        write_outcome(folder, outcome, self.films)
        return outcome

    def close(self) -> None:
        """Close the environments."""
        if self.evaluation is not None:
            self.evaluation.close()
