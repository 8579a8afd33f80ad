"""``finetune ddpg`` and ``finetune sac``: agents that learn a task of continuous control while they play it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl.online_options import DDPGOptions, OnlineOptions, SACOptions, check_online_options
from repdib_lightning.rl.run_folders import check_folder, make_folder


def finetune_ddpg(
    *,
    encoder: Path | None = None,
    snapshot: int | None = None,
    task: str = "",
    run: Path | None = None,
    env_options: dict[str, Any] | None = None,
    frames: int = 100_000,
    seed: int = 0,
    frozen: bool | None = None,
    bottleneck: bool = True,
    bottleneck_losses: float | None = None,
    agent: str | None = None,
    learning_rate: float = 1e-4,
    batch_size: int = 1024,
    hidden: int | None = None,
    gamma: float = 0.99,
    n_steps: int = 3,
    tau: float = 0.01,
    noise: float = 0.2,
    noise_clip: float = 0.3,
    standardise: bool | None = None,
    action_penalty: float = 0.0,
    update_every: int = 2,
    seed_frames: int = 4_000,
    shift: int | None = None,
    features: int | None = None,
    channels: int | None = None,
    strides: list[int] | None = None,
    frame_stack: int | None = None,
    evaluate_every: int = 10_000,
    episodes: int = 10,
    film: int = 3,
    value_limit: float = 1e4,
    device: str = "auto",
    overwrite: bool = False,
) -> str:
    """Fine-tune DDPG to a task of URLB or the Control Suite (paper, continuous control), from a snapshot or scratch.

    With a frozen encoder each frame is encoded once, and agent and replay see vectors. Else the critic trains encoder
    and bottleneck on randomly shifted pictures, after DrQ-v2. Writes ``progress.csv``, ``outcome.json``,
    ``policy.safetensors``, ``values.npz`` (latents and values of the last evaluation), ``evaluation.mp4``, TensorBoard
    files, and ``bundle/`` where the encoder is no longer the one that was given, into the run's folder.

    Args:
        encoder: a run of exploration, a snapshot of one, or any bundle. Without one, a fresh encoder is trained.
        snapshot: of a run, by its frames; the newest one by default.
        task: domain-task, such as walker-run; by default the one that the snapshot's agent explored.
        run: folder to make; runs/ddpg-TASK-DATE by default.
        env_options: of the environment, such as --env_options.distractors video; those of the snapshot's training by
            default.
        frames: control steps of the environment; the last episode is played to its end.
        seed: of weights, batches, noise, environment and evaluation.
        frozen: leave the encoder as it is; by default true of a given one.
        bottleneck: whether what the agent sees has passed the bottleneck; false takes the encoder's own features, also
            where they are trained.
        bottleneck_losses: weight of the bottleneck's own losses while its encoder is trained; 1 by default, 0 leaves
            them out.
        agent: what is taken over of the agent that explored: actor (as published), both (actor and critic, which knows
            the reward of exploration), or fresh, nothing. By default actor where there is one, and fresh with
            --bottleneck false. An actor that is taken over plays the seed frames, else they are random.
        learning_rate: Adam's, of all parts.
        batch_size: transitions an update.
        hidden: width of the two hidden layers of actor and critics; by default that of the snapshot's agent, or 1024.
        gamma: discount.
        n_steps: of the return that is bootstrapped from.
        tau: rate at which the target critic follows.
        noise: deviation of the noise on actions, that explore and that are bootstrapped from.
        noise_clip: where the latter's is clipped.
        standardise: whether actor and critics see features less their running mean, over their deviation; by default
            as the agent that is taken over did, else true.
        action_penalty: weight of the squared actions in the actor's loss, which keep it from the bounds, where it has
            no gradient.
        update_every: actions between two updates.
        seed_frames: before the first update; one episode at least.
        shift: largest random shift of the pictures of an encoder that is trained; 4 pixels by default.
        features: width of a fresh encoder; 256 by default.
        channels: of a fresh encoder's convolutions; 32 by default.
        strides: of a fresh encoder's convolutions; [2, 1, 1, 1] by default.
        frame_stack: of a fresh encoder; 3 by default.
        evaluate_every: frames between evaluations; there is one before the first and one after the last frame, too.
        episodes: of an evaluation, played at once.
        film: how many of them are filmed at the end, at most.
        value_limit: mean value of a batch's actions at which the training is given up.
        device: cpu, cuda, or auto.
        overwrite: replace an earlier run of this verb.

    Returns:
        A line of what was reached.

    Raises:
        UserError: a bad option, a snapshot or a bundle that does not fit the task; nothing is left behind then. Or a
            critic that has diverged; the folder stays then, with the policy of before and without an outcome.
    """
    return _train(DDPGOptions.of(locals()), run, overwrite)


def finetune_sac(
    *,
    encoder: Path | None = None,
    snapshot: int | None = None,
    task: str = "",
    run: Path | None = None,
    env_options: dict[str, Any] | None = None,
    frames: int = 100_000,
    seed: int = 0,
    frozen: bool | None = None,
    bottleneck: bool = True,
    bottleneck_losses: float | None = None,
    learning_rate: float = 1e-4,
    batch_size: int = 1024,
    hidden: int | None = None,
    gamma: float = 0.99,
    n_steps: int | None = None,
    tau: float = 0.01,
    buffer_size: int = 1_000_000,
    update_every: int = 2,
    seed_frames: int = 4_000,
    shift: int | None = None,
    features: int | None = None,
    channels: int | None = None,
    strides: list[int] | None = None,
    frame_stack: int | None = None,
    evaluate_every: int = 10_000,
    episodes: int = 10,
    film: int = 3,
    value_limit: float = 1e4,
    device: str = "auto",
    overwrite: bool = False,
) -> str:
    """Train Stable-Baselines3's SAC, a fresh agent, on the encoder of a snapshot, of a bundle, or on a fresh one.

    Writes what ``finetune ddpg`` does, with ``policy.zip`` in place of ``policy.safetensors``.

    Args:
        encoder, snapshot, task, env_options, frames, seed: as in ``finetune ddpg``.
        run: folder to make; runs/sac-TASK-DATE by default.
        frozen, bottleneck, bottleneck_losses, shift: as in ``finetune ddpg``.
        learning_rate, batch_size, gamma, tau, update_every: as in ``finetune ddpg``.
        hidden: width of the two hidden layers of actor and critics; 1024 by default.
        n_steps: of the return that is bootstrapped from; 3 by default, and 1 where the encoder is trained.
        buffer_size: transitions in the replay buffer, in memory; never more than there are.
        seed_frames: random ones before the first update; one episode at least.
        features, channels, strides, frame_stack: as in ``finetune ddpg``.
        evaluate_every, episodes, film, value_limit, device, overwrite: as in ``finetune ddpg``.

    Returns:
        A line of what was reached.

    Raises:
        UserError: as ``finetune ddpg``.
    """
    options = SACOptions.of(locals())
    return _train(options, run, overwrite)


def check_ddpg(**given: Any) -> None:
    """What is wrong with options of ``finetune ddpg``, as far as that can be known before anything runs."""
    _check(DDPGOptions.of(given))


def check_sac(**given: Any) -> None:
    """What is wrong with options of ``finetune sac``, as far as that can be known before anything runs."""
    _check(SACOptions.of(given))


def _check(options: OnlineOptions) -> None:
    """The options alone; and whether the task can be opened, as far as it is known without the encoder."""
    check_online_options(options)
    _check_installed(options)
    if options.task:
        from repdib_lightning.rl.online_environment import chosen_options, open_task

        open_task(chosen_options(options.task, options.env_options or {}, {}, None), evaluation=True).close()


def _check_installed(options: OnlineOptions) -> None:
    if options.algorithm != SACOptions.algorithm:
        return
    try:
        import stable_baselines3  # noqa: F401
    except ImportError as error:
        raise UserError("finetune sac needs Stable-Baselines3: pip install 'repdib_lightning[rl]'") from error


def _train(options: OnlineOptions, run: Path | None, overwrite: bool) -> str:
    check_online_options(options)
    _check_installed(options)
    named = f"{options.algorithm}-{options.task or 'explored'}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = run or Path("runs") / named
    check_folder(folder, overwrite)
    encoder = options.encoder
    if encoder is not None and folder.resolve() in (encoder.resolve(), *encoder.resolve().parents):
        raise UserError(f"--run {folder}: holds --encoder {encoder}; choose another folder")
    training = _training(options)
    try:
        make_folder(folder)
        training.train(folder)
        return f"{_told(training.finish(folder), options)}    wrote {folder}"
    finally:
        training.close()


def _training(options: OnlineOptions) -> Any:
    # Imported here, since Stable-Baselines3 is an extra of this package, and torch takes its time.
    if isinstance(options, DDPGOptions):
        from repdib_lightning.rl.online_ddpg import DDPGTraining

        return DDPGTraining(options)
    from repdib_lightning.rl.online_sac import SACTraining

    assert isinstance(options, SACOptions)
    return SACTraining(options)


def _told(outcome: Mapping[str, Any], options: OnlineOptions) -> str:
    measures = outcome["measures"]
    return (
        f"{outcome['environment_options']['task']}: return {measures['return']:.1f} over {options.episodes} episodes "
        f"after {measures['frames']:.0f} frames, {measures['first_return']:.1f} before"
    )
