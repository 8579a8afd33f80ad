"""``finetune dqn``: DQN on an exported encoder, trained with it or frozen, or from scratch."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl.devices import check_device_name
from repdib_lightning.rl.options import DQNOptions, check_options
from repdib_lightning.rl.run_folders import check_folder, make_folder


def finetune_dqn(
    *,
    env: str = "GridWorld",
    encoder: Path | None = None,
    run: Path | None = None,
    frozen: bool = False,
    steps: int = 5_000,
    seed: int = 0,
    env_options: dict[str, Any] | None = None,
    bottleneck_losses: float = 1.0,
    learning_rate: float = 1e-3,
    batch_size: int = 128,
    gamma: float = 0.99,
    tau: float = 0.01,
    hidden: int = 128,
    buffer_size: int = 20_000,
    learning_starts: int = 500,
    train_freq: int = 1,
    n_steps: int = 1,
    exploration_fraction: float = 0.6,
    exploration_final_eps: float = 0.05,
    features: int | None = None,
    channels: int | None = None,
    strides: list[int] | None = None,
    evaluate_every: int = 250,
    device: str = "auto",
    overwrite: bool = False,
) -> str:
    """Train Stable-Baselines3's DQN on pixels (paper, maze navigation): a fine-tuned, frozen or fresh encoder.

    Writes ``progress.csv``, ``outcome.json`` (measures and maps), ``policy.zip`` (the best policy), ``bundle/`` (its
    encoder, unless frozen) and TensorBoard files into the run's folder.

    Args:
        env: GridWorld, SpiralWorld, LoopWorld, RobotArm, or any gymnasium id with pictures and discrete actions.
        encoder: a bundle, or the run that it was exported in. Without one, DQN trains a fresh encoder from scratch.
        run: folder to make; runs/dqn-ENV-DATE by default.
        frozen: leave the encoder as it is; each frame is encoded once, and the replay buffer holds latents.
        steps: of the environment.
        seed: of weights, exploration and environment.
        env_options: of the environment, such as --env_options.distractors procedural. The mazes have goals, start,
            size, cell_pixels, episode_length, show_walls, distractors, distractor_seed and evaluation.
        bottleneck_losses: weight of the bottleneck's own losses while its encoder is fine-tuned; 0 leaves them out.
        learning_rate: Adam's, of agent and encoder.
        batch_size: transitions an update.
        gamma: discount.
        tau: rate at which the target network follows, at every step.
        hidden: width of the one hidden layer of the Q network.
        buffer_size: transitions in the replay buffer.
        learning_starts: random steps before the first update.
        train_freq: steps between updates.
        n_steps: of the return that is bootstrapped from.
        exploration_fraction: share of the steps over which the rate of random actions falls from 1.
        exploration_final_eps: rate of random actions after that.
        features: width of a fresh encoder (128); means nothing beside --encoder, as the two that follow.
        channels: of a fresh encoder's convolutions (16).
        strides: of a fresh encoder's convolutions ([3, 2]).
        evaluate_every: steps between evaluations of the greedy policy.
        device: cpu, cuda, or auto.
        overwrite: replace an earlier run of this verb.

    Returns:
        A line of what was reached.

    Raises:
        UserError: a bad option, an unknown environment, a bundle that does not fit it; nothing is left behind then.
    """
    options = DQNOptions.of(locals())
    check_options(options)
    _check_installed()
    folder = run or Path("runs") / f"dqn-{env.rpartition('/')[2]}-{time.strftime('%Y%m%d-%H%M%S')}"
    check_folder(folder, overwrite)
    # Imported here, since Stable-Baselines3 is an extra of this package.
    from repdib_lightning.rl.training import Training, report

    training = Training(options)
    make_folder(folder)
    training.train(folder)
    return f"{report(training.finish(folder))}    wrote {folder}"


def check_dqn(**given: Any) -> None:
    """Check the arguments of :func:`finetune_dqn` as far as that is possible without the bundle.

    Whether the bundle is there and fits, whether this machine has the device, and whether the run's folder can be
    made are left to the training.

    Raises:
        UserError: a number out of range, options that exclude each other, an environment that cannot be opened, or one
            that DQN or a fresh encoder cannot take.
    """
    options = DQNOptions.of(given)
    check_options(options)
    check_device_name(options.device)
    _check_installed()
    from repdib_lightning.rl.encoders import fresh_description
    from repdib_lightning.rl.environment import check_discrete, open_environment

    environment = open_environment(options.env, options.env_options or {})
    check_discrete(options.env, environment, "DQN")
    if options.encoder is None:
        fresh_description(environment.observation_space, options.features, options.channels, options.strides)
    environment.close()


def _check_installed() -> None:
    try:
        import stable_baselines3  # noqa: F401
    except ImportError as error:
        raise UserError("finetune needs Stable-Baselines3: pip install 'repdib_lightning[rl]'") from error
