"""One DQN training from an environment's name to its outcome."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.logger import configure

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.coverage import covered, visitation_entropy
from repdib_lightning.evaluation.topology import latent_topology
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.gymnasium_wrapper import EncodeObservation, PrepareObservation
from repdib_lightning.export.load import load_encoder
from repdib_lightning.records import DataSpec
from repdib_lightning.rl.devices import check_device
from repdib_lightning.rl.dqn import BottleneckDQN
from repdib_lightning.rl.encoders import fresh_description, load_into
from repdib_lightning.rl.environment import check_discrete, maze_of, open_environment
from repdib_lightning.rl.evaluation import EpisodeEvaluation, MazeEvaluation
from repdib_lightning.rl.features import BottleneckFeatures
from repdib_lightning.rl.given_bundle import checked_bundle
from repdib_lightning.rl.options import CONFIGURATION, FRESH, DQNOptions, plain
from repdib_lightning.rl.outcome import write_outcome
from repdib_lightning.rl.progress import POLICY, Progress
from repdib_lightning.rl.visits import CountVisits
from repdib_lightning.versions import versions


class Training:
    """Builds everything, so that whatever does not fit shows before a folder is made.

    Args:
        options: of the verb.

    Raises:
        UserError: an unknown environment, a bundle that does not fit it, a device that is not there.
    """

    def __init__(self, options: DQNOptions) -> None:
        self.options = options
        check_device(options.device)
        bare = open_environment(options.env, options.env_options or {})
        check_discrete(options.env, bare, "DQN")
        self.maze = maze_of(bare)
        self.visits = CountVisits(bare, self.maze) if self.maze is not None else None
        environment = bare if self.visits is None else self.visits
        bundle = checked_bundle(options.encoder)
        self.pretrained = None if bundle is None else load_encoder(bundle)
        if self.pretrained is None:
            space = bare.observation_space
            self.description = fresh_description(space, options.features, options.channels, options.strides)
            sizes = self.description["encoder"]["arguments"]
            self.options = options = replace(options, **{name: sizes[name] for name in FRESH})
        else:
            self.description = self.pretrained.description
        self.spec = DataSpec.from_dict(self.description["spec"])
        self.frozen = self.pretrained if options.frozen else None
        try:
            self.environment = self._as_encoder_sees(environment)
        except UserError as error:
            raise UserError(f"--encoder {options.encoder}: does not fit {options.env}: {error}") from error
        self.agent = self._build_agent()
        self.evaluation = self._build_evaluation()

    def _as_encoder_sees(self, environment: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        if self.frozen is not None:
            return EncodeObservation(environment, self.frozen)
        for name, array in self.spec.observations.items():
            # Stable-Baselines3 takes the smallest side for the channels, and would turn the picture.
            if array.is_image and array.shape[0] > min(array.shape[1:]):
                raise UserError(f"'{name}' {array.shape} has more channels than pixels along a side; --frozen takes it")
        return PrepareObservation(environment, self.spec)

    def _build_agent(self) -> BottleneckDQN:
        options = self.options
        network: dict[str, Any] = {"net_arch": [options.hidden], "optimizer_kwargs": {"fused": True}}
        if self.frozen is None:
            network |= {
                "features_extractor_class": BottleneckFeatures,
                "features_extractor_kwargs": {
                    "description": self.description,
                    "bottleneck_losses": options.bottleneck_losses,
                },
                "normalize_images": False,
            }
        try:
            agent = BottleneckDQN(
                "MlpPolicy" if self.frozen is not None else "MultiInputPolicy",
                self.environment,
                learning_rate=options.learning_rate,
                batch_size=options.batch_size,
                gamma=options.gamma,
                tau=options.tau,
                target_update_interval=1,
                buffer_size=options.buffer_size,
                learning_starts=options.learning_starts,
                train_freq=options.train_freq,
                n_steps=options.n_steps,
                exploration_fraction=options.exploration_fraction,
                exploration_final_eps=options.exploration_final_eps,
                policy_kwargs=network,
                seed=options.seed,
                device=options.device,
            )
        except MemoryError as error:
            raise UserError(f"--buffer_size {options.buffer_size}: does not fit into memory ({error})") from error
        except RuntimeError as error:
            raise UserError(f"--device {options.device}: {str(error).splitlines()[0]}") from error
        if self.pretrained is not None and self.frozen is None:
            load_into(agent.q_net, self.pretrained)
            agent.q_net_target.load_state_dict(agent.q_net.state_dict())
        return agent

    def _build_evaluation(self) -> MazeEvaluation | EpisodeEvaluation | None:
        options = self.options
        if self.maze is not None:
            if not len(self.maze.batch.goal_cells):
                return None
            (name,) = self.spec.observations
            return MazeEvaluation(self.maze.maze.name, options.env_options or {}, name, self.spec.frame_stack)
        other = open_environment(options.env, options.env_options or {})
        return EpisodeEvaluation(PrepareObservation(other, self.spec), options.seed + 1)

    def act(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        """Greedy actions (n,) for name -> (n, *shape)."""
        seen: Any = observations if self.frozen is None else self.frozen.encode(observations).cpu().numpy()
        actions, _ = self.agent.predict(seen, deterministic=True)
        return np.asarray(actions)

    def train(self, folder: Path) -> None:
        """Learn; progress and the best policy go into the folder."""
        with whole_file(folder / CONFIGURATION) as path:
            path.write_text(json.dumps(plain(asdict(self.options)), indent=1) + "\n")
        self.agent.set_logger(configure(str(folder), ["tensorboard"]))
        self.progress = Progress(folder, self.options.evaluate_every, self.evaluation, self.act, self.visits)
        self.agent.learn(self.options.steps, callback=self.progress, log_interval=10)
        self.agent.logger.close()

    def finish(self, folder: Path) -> dict[str, Any]:
        """Take the best policy, save its encoder, and write what was reached; returns it."""
        self.agent.set_parameters(str(folder / POLICY), exact_match=True, device=self.agent.device)
        best = self._best_encoder(folder)
        measures, maps = self._reached(), {}
        if self.maze is not None and self.visits is not None:
            maze = self.maze.maze
            mazes = MazeEvaluation(maze.name, self.options.env_options or {}, "", 1).mazes
            topology = latent_topology(best, mazes)
            measures |= topology.measures()
            of_cells = {
                "visits": self.visits.visits,
                "latent_distance": topology.latent_map,
                "path_length": topology.path_map,
            }
            maps = {name: values.reshape(maze.size, -1).round(6).tolist() for name, values in of_cells.items()}
        outcome = {
            "agent": "dqn",
            "environment": self.options.env if self.maze is None else self.maze.maze.name,
            "versions": versions(),
            "configuration": plain(asdict(self.options)),
            "measures": measures,
            "maps": maps,
        }
        write_outcome(folder, outcome)
        return outcome

    def _best_encoder(self, folder: Path) -> FrozenEncoder:
        if self.frozen is not None:
            return self.frozen
        features = self.agent.q_net.features_extractor
        assert isinstance(features, BottleneckFeatures)
        training = {"agent": "dqn", "environment": self.options.env, "steps": self.options.steps}
        encoder, bottleneck = features.encoder.eval(), features.bottleneck.eval()
        return load_encoder(save_bundle(folder / "bundle", encoder, bottleneck, training=training, data={}))

    def _reached(self) -> dict[str, float]:
        found: dict[str, float] = {}
        if self.evaluation is not None:
            best = self.evaluation.run(self.act)
            found |= {"return": best["return"], "moves": best["moves"]}
            found["mean_return"] = float(self.progress.curve("eval/return").mean())
        if isinstance(self.evaluation, MazeEvaluation):
            success = self.progress.curve("eval/success")
            found |= {"success": best["success"], "solved": float(best["success"] == 1.0)}
            found |= {"mean_success": float(success.mean()), "final_success": float(success[-1])}
            solved = [row["step"] for row in self.progress.rows if row["eval/success"] == 1.0]
            found["steps_to_solve"] = float(solved[0] if solved else self.options.steps)
        if self.visits is not None:
            found |= {"coverage": covered(self.visits.visits), "entropy": visitation_entropy(self.visits.visits)}
            found["mean_coverage"] = float(self.progress.curve("train/coverage").mean())
        return found


def report(outcome: dict[str, Any]) -> str:
    """One line for people."""
    found = outcome["measures"]
    words = [outcome["environment"]]
    if "success" in found:
        words.append(f"reaches the goal from {100 * found['success']:.0f} % of the start cells")
        words.append(f"after {found['steps_to_solve']:.0f} steps" if found["solved"] else "not solved")
    if "return" in found:
        words.append(f"mean return {found['return']:.1f}")
    if "coverage" in found:
        words.append(f"was in {100 * found['coverage']:.0f} % of the cells")
    return ", ".join(words)
