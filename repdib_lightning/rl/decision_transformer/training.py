"""One training of a Decision Transformer, from a store to its outcome."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.callbacks import exit_codes
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.encoded_store import CODES, LATENT, encode_store
from repdib_lightning.evaluation.features import check_compatible, stacked
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.export.observations import Observations
from repdib_lightning.records import DataSpec
from repdib_lightning.rl.decision_transformer.batches import PictureFrames, SeenSource, VectorTable, WindowBatches
from repdib_lightning.rl.decision_transformer.checkpoints import load_checkpoint
from repdib_lightning.rl.decision_transformer.evaluation import ConditionedEpisodes, asked_return, game_of, scores
from repdib_lightning.rl.decision_transformer.module import COSINE_EPOCHS, DecisionTransformerModule
from repdib_lightning.rl.decision_transformer.network import RETURN_RANGE, DecisionTransformer, Sizes
from repdib_lightning.rl.decision_transformer.options import DTOptions
from repdib_lightning.rl.decision_transformer.play import Play
from repdib_lightning.rl.decision_transformer.policy import save_decision_transformer, states_of
from repdib_lightning.rl.decision_transformer.progress import EpochProgress
from repdib_lightning.rl.decision_transformer.states import CodeStates, EncodedStates, LatentStates
from repdib_lightning.rl.decision_transformer.windows import WindowOrder, Windows
from repdib_lightning.rl.devices import check_device
from repdib_lightning.rl.given_bundle import checked_bundle
from repdib_lightning.rl.offline_environment import evaluated_environment
from repdib_lightning.rl.offline_evaluation import open_episodes
from repdib_lightning.rl.one_pass import one_pass_trainer
from repdib_lightning.rl.options import CONFIGURATION, plain
from repdib_lightning.rl.outcome import write_outcome
from repdib_lightning.versions import versions

LATENTS = "latents.h5"
"""What a frozen encoder makes of the data, in the run's folder."""


def configuration_of(options: DTOptions) -> dict[str, Any]:
    """The options as ``finetune.json`` and ``outcome.json`` hold them."""
    return {"agent": "dt", **plain(asdict(options))}


class DTTraining:
    """Opens everything that may not fit, so that it shows before a folder is made.

    Args:
        options: of the verb.

    Raises:
        UserError: a store without what is needed, a bundle that does not fit it or has no codes, an environment that is
            not there or does not fit, a device that is not there.
    """

    module: DecisionTransformerModule
    batches: WindowBatches
    progress: EpochProgress

    def __init__(self, options: DTOptions) -> None:
        self.options = options
        check_device(options.device)
        self.device = resolve_device(options.device)
        self.store = EpisodeStore(options.data)
        windows = Windows(self.store, options.context, options.stride)
        self.bundle = checked_bundle(options.encoder)
        self.encoder: FrozenEncoder | Encoder
        if self.bundle is None:
            torch.manual_seed(options.seed)
            self.encoder = self._fresh_encoder()
        else:
            self.encoder = load_encoder(self.bundle).to(self.device)
            check_compatible(self.encoder, self.store, str(options.encoder))
            if options.codes and not self.encoder.groups:
                raise UserError(f"--codes: the bottleneck of --encoder {options.encoder} has none; leave it out")
        self.films: list[np.ndarray] = []
        self.evaluated_in = evaluated_environment(self.store, options.env, options.env_options or {})
        self.game = game_of(self.evaluated_in)
        self.target_return = asked_return(options.target_return, self.game, windows.best_return)
        self.evaluation = self._open_evaluation()

    def _fresh_encoder(self) -> Encoder:
        stack = self.options.fresh("frame_stack")
        pictures = {name: stacked(a, stack) for name, a in self.store.observations.items() if a.is_image}
        sizes = {name: self.options.fresh(name) for name in ("channels", "kernels", "strides")}
        spec = DataSpec(pictures, self.store.actions_spec, stack)
        return ConvolutionalEncoder(spec, features=self.options.width, **sizes)

    def _open_evaluation(self) -> ConditionedEpisodes | None:
        options, chosen = self.options, self.evaluated_in
        if chosen is None:
            return None
        assert self.store.actions_spec is not None
        whose = f"--data {options.data}" if options.encoder is None else f"--encoder {options.encoder}"
        asked: dict[str, Any] = {"count": options.episodes, "seed": options.seed + 1, "whose": whose}
        return open_episodes(ConditionedEpisodes, chosen, self.store.actions_spec, self.encoder.spec, **asked)

    def train(self, folder: Path) -> None:
        """Learn, from the newest checkpoint in the folder on; progress goes into it."""
        if not (folder / CONFIGURATION).is_file():
            with whole_file(folder / CONFIGURATION) as path:
                path.write_text(json.dumps(configuration_of(self.options), indent=1) + "\n")
        state = load_checkpoint(folder, self.store.fingerprint)
        self._build(folder)
        logger = TensorBoardLogger(folder, name="", version="")
        self.progress = EpochProgress(
            folder,
            self.batches,
            every=self.options.evaluate_every,
            evaluate=None if self.evaluation is None else self._evaluate,
            logger=logger,
            fingerprint=self.store.fingerprint,
        )
        if state is not None:
            self.progress.go_on(state, self.module)
        left = len(self.batches)
        if left:  # for Lightning the rest of the training is one epoch: its numbers are those of the batches
            trainer = one_pass_trainer(
                folder, self.device, batches=left, callback=self.progress, logger=logger, log_every=left
            )
            with exit_codes():
                trainer.fit(self.module, train_dataloaders=self.batches)
        logger.finalize("success")
        (folder / TensorBoardLogger.NAME_HPARAMS_FILE).unlink(missing_ok=True)  # says nothing
        self.module.eval().to(self.device)

    def _build(self, folder: Path) -> None:
        """Encode the data where the encoder is frozen; then batches and network."""
        options = self.options
        store = self.store if self.bundle is None else self._encoded(folder)
        windows = Windows(store, options.context, options.stride)
        torch.manual_seed(options.seed)
        source, states = self._seen(store, windows)
        order = WindowOrder(len(windows), options.batch_size, options.steps_per_epoch, options.seed)
        self.batches = WindowBatches(windows, source, order, options.epochs, self.device)
        assert store.actions_spec is not None
        largest = float(np.abs(windows.returns).max())
        sizes = Sizes(
            actions=store.actions_spec.size,
            beginnings=windows.beginnings,
            return_scale=largest / RETURN_RANGE if largest > 0 else 1.0,
            **{name: getattr(options, name) for name in ("context", "stride", "layers", "heads", "width", "dropout")},
        )
        self.module = DecisionTransformerModule(
            DecisionTransformer(sizes, states),
            None if isinstance(self.encoder, FrozenEncoder) else self.encoder,
            learning_rate=options.learning_rate,
            weight_decay=options.weight_decay,
            warmup_tokens=options.warmup_tokens,
            tokens=round(self.batches.tokens * max(options.epochs, COSINE_EPOCHS)),
        ).to(self.device)

    def _seen(self, store: EpisodeStore, windows: Windows) -> tuple[SeenSource, nn.Module]:
        """What is seen of windows, and what makes tokens of it."""
        encoder, width = self.encoder, self.options.width
        if not isinstance(encoder, FrozenEncoder):
            spec = encoder.spec
            names = list(spec.observations)
            return PictureFrames(store, windows, names, spec.frame_stack, self.device), EncodedStates()
        if self.options.codes:
            table = VectorTable(store, CODES, whole=True, device=self.device)
            return table, CodeStates(encoder.groups, encoder.codes_per_group, width)
        table = VectorTable(store, LATENT, whole=False, device=self.device)
        rows = torch.from_numpy(np.flatnonzero(windows.trained)).to(self.device)
        deviation, mean = torch.std_mean(table.vectors.index_select(0, rows), 0, correction=0)
        return table, LatentStates(mean.cpu(), deviation.cpu(), width)

    def _encoded(self, folder: Path) -> EpisodeStore:
        """The data as the frozen encoder sees them, each frame encoded once.

        Raises:
            UserError: those in the folder are of other data or of another encoder.
        """
        path = folder / LATENTS
        assert self.bundle is not None and isinstance(self.encoder, FrozenEncoder)
        if not path.is_file():
            encode_store(self.bundle, self.options.data, path, device=str(self.device), progress=sys.stderr.isatty())
        store = EpisodeStore(path)
        made_of = json.loads(store.attributes["encoded"])
        now = {"fingerprint": self.store.fingerprint, "encoder": json.loads(json.dumps(self.encoder.description))}
        for name, option in (("fingerprint", "data"), ("encoder", "encoder")):
            if made_of[name] != now[name]:
                raise UserError(f"--resume: --{option} is another than {path} was made of; start a new run")
        return store

    def _states(self, observations: Observations) -> Tensor:
        """What the network takes, of observations name -> (n, *shape)."""
        if isinstance(self.encoder, FrozenEncoder):
            return states_of(self.encoder, self.module.network, observations)
        assert isinstance(observations, dict)
        seen = {name: torch.from_numpy(array).to(self.device) for name, array in observations.items()}
        features: Tensor = self.encoder(seen)
        return features

    def begin(self, episodes: int, seed: int) -> Play:
        """Begin episodes that are asked for the target return."""
        temperature = self.options.temperature
        asked: dict[str, Any] = {"target_return": self.target_return, "temperature": temperature}
        return Play(self.module.network, self._states, episodes=episodes, seed=seed, **asked)

    def _evaluate(self, last: bool) -> dict[str, float]:
        """Scores; the last time, some of the episodes are filmed."""
        assert self.evaluation is not None
        film = min(self.options.film, self.options.episodes) if last else 0
        returns, self.films = self.evaluation.play(self.begin, film)
        return scores(returns, self.game)

    def finish(self, folder: Path) -> dict[str, Any]:
        """Save the trained policy, and write what was reached; returns it."""
        options = self.options
        if not isinstance(self.encoder, FrozenEncoder):
            training = {"agent": "dt", "steps": self.batches.total}
            bottleneck = Identity(self.encoder.features)
            bundle = folder / "bundle"
            save_bundle(bundle, self.encoder.cpu(), bottleneck, training=training, data={}, overwrite=bundle.is_dir())
            self.encoder.to(self.device)
        given = options.encoder
        save_decision_transformer(folder, self.module.network, given, self.target_return, options.temperature)
        outcome = {
            "agent": "dt",
            "environment": "none" if self.evaluated_in is None else self.evaluated_in[0],
            "environment_options": {} if self.evaluated_in is None else self.evaluated_in[1],
            "target_return": self.target_return,
            "versions": versions(),
            "configuration": configuration_of(options),
            "data": {"file": self.store.path.name, "fingerprint": self.store.fingerprint},
            "measures": self.progress.measures,
            "maps": {},
        }
        write_outcome(folder, outcome, self.films)
        return outcome

    def close(self) -> None:
        """Close the environments."""
        if self.evaluation is not None:
            self.evaluation.close()
