"""``finetune td3bc`` and ``finetune bc``: offline agents on a frozen encoder, or with one that they train."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl.offline_options import OfflineOptions, check_offline_options
from repdib_lightning.rl.run_folders import check_folder, make_folder

_OF_TD3 = ("alpha", "tau", "noise", "noise_clip")


def finetune_td3bc(
    *,
    data: Path,
    encoder: Path | None = None,
    run: Path | None = None,
    env: str = "",
    env_options: dict[str, Any] | None = None,
    steps: int = 100_000,
    seed: int = 0,
    learning_rate: float = 3e-4,
    batch_size: int = 256,
    hidden: int = 1024,
    alpha: float = 2.5,
    gamma: float = 0.99,
    n_steps: int = 3,
    tau: float = 0.01,
    noise: float = 0.2,
    noise_clip: float = 0.3,
    copies: int = 1,
    shift: int | None = None,
    features: int | None = None,
    channels: int | None = None,
    strides: list[int] | None = None,
    frame_stack: int | None = None,
    evaluate_every: int = 10_000,
    episodes: int = 10,
    film: int = 3,
    device: str = "auto",
    overwrite: bool = False,
) -> str:
    """Train TD3+BC on a store (paper, offline visual control): on latents of a frozen encoder, or end to end.

    With ``--encoder`` every frame is encoded once and the agent trains on vectors. Without it the critic trains an
    encoder on randomly shifted pictures, after V-D4RL's DrQ+BC. Only training episodes are used. Writes
    ``progress.csv``, ``outcome.json``, ``policy.safetensors``, ``evaluation.mp4``, TensorBoard files, and ``bundle/``
    where the encoder was trained, into the run's folder.

    Args:
        data: a store with continuous actions and rewards.
        encoder: a bundle, or the run that it was exported in.
        run: folder to make; runs/td3bc-DATA-DATE by default.
        env: where to evaluate: by default where the data were recorded, amid held-out clips of the same kind of
            distractor; a gymnasium id; or none.
        env_options: of that environment, such as --env_options.distractors video.
        steps: updates.
        seed: of weights, batches, noise and evaluation.
        learning_rate: Adam's, of all parts.
        batch_size: transitions an update.
        hidden: width of the two hidden layers of actor and critics.
        alpha: weight of the values against the cloning.
        gamma: discount.
        n_steps: of the return that is bootstrapped from.
        tau: rate at which the target critic follows.
        noise: deviation of the noise on actions.
        noise_clip: where that noise is clipped.
        copies: how often each frame is encoded, randomly shifted but for the first time.
        shift: largest random shift in pixels, of the copies, or of every picture of an encoder that is trained; 4 by
            default.
        features: width of a trained encoder; 256 by default.
        channels: of a trained encoder's convolutions; 32 by default.
        strides: of a trained encoder's convolutions; [2, 1, 1, 1] by default.
        frame_stack: of a trained encoder; 3 by default.
        evaluate_every: updates between evaluations.
        episodes: of an evaluation, played at once.
        film: how many of them are filmed at the end, at most.
        device: cpu, cuda, or auto.
        overwrite: replace an earlier run of this verb.

    Returns:
        A line of what was reached.

    Raises:
        UserError: a bad option, a store without what is needed, a bundle or an environment that does not fit it;
            nothing is left behind then. Or losses that are no longer finite; the folder stays then, without an outcome.
    """
    return _train("td3bc", locals())


def finetune_bc(
    *,
    data: Path,
    encoder: Path | None = None,
    run: Path | None = None,
    env: str = "",
    env_options: dict[str, Any] | None = None,
    steps: int = 100_000,
    seed: int = 0,
    learning_rate: float = 3e-4,
    batch_size: int = 256,
    hidden: int = 1024,
    copies: int = 1,
    shift: int | None = None,
    features: int | None = None,
    channels: int | None = None,
    strides: list[int] | None = None,
    frame_stack: int | None = None,
    evaluate_every: int = 10_000,
    episodes: int = 10,
    film: int = 3,
    device: str = "auto",
    overwrite: bool = False,
) -> str:
    """Clone the behaviour in a store: on latents of a frozen encoder, or end to end. Needs no rewards.

    Args:
        data: a store with continuous actions.
        encoder, run, env, env_options, steps, seed, learning_rate, batch_size, hidden: as in ``finetune td3bc``.
        copies, shift, features, channels, strides, frame_stack: as in ``finetune td3bc``.
        evaluate_every, episodes, film, device, overwrite: as in ``finetune td3bc``.

    Returns:
        A line of what was reached.

    Raises:
        UserError: as ``finetune td3bc``.
    """
    return _train("bc", locals())


def check_td3bc(**given: Any) -> None:
    """What is wrong with options of ``finetune td3bc``, as far as that can be known before anything runs."""
    _check("td3bc", given)


def check_bc(**given: Any) -> None:
    """What is wrong with options of ``finetune bc``, as far as that can be known before anything runs."""
    _check("bc", given)


def _check(agent: str, given: Mapping[str, Any]) -> None:
    """The options alone; and where the data are there, whether they have what is needed, and the environment opens."""
    options = _options(agent, given)
    check_offline_options(options)
    if not options.data.exists():
        return
    from repdib_lightning.data.episodes import EpisodeStore
    from repdib_lightning.rl.offline_environment import evaluated_environment
    from repdib_lightning.rl.offline_evaluation import open_copies
    from repdib_lightning.rl.transitions import Transitions

    store = EpisodeStore(options.data)
    Transitions(store, rewarded=agent != "bc").check_batch(options.batch_size)
    chosen = evaluated_environment(store, options.env, options.env_options or {})
    if chosen is not None and store.actions_spec is not None:
        for environment in open_copies(*chosen, 1, store.actions_spec):
            environment.close()


def _options(agent: str, given: Mapping[str, Any]) -> OfflineOptions:
    fields = OfflineOptions.__dataclass_fields__
    values = {name: given[name] for name in _OF_TD3 if name in given}
    return OfflineOptions(agent=agent, values=values, **{name: given[name] for name in fields if name in given})


def _train(agent: str, given: Mapping[str, Any]) -> str:
    options = _options(agent, given)
    check_offline_options(options)
    named = f"{agent}-{options.data.stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = given["run"] or Path("runs") / named
    check_folder(folder, given["overwrite"])
    for name in ("data", "encoder"):
        if given[name] is not None and folder.resolve() in (given[name].resolve(), *given[name].resolve().parents):
            raise UserError(f"--run {folder}: holds --{name} {given[name]}; choose another folder")
    from repdib_lightning.quiet import quieten_lightning
    from repdib_lightning.rl.offline_training import OfflineTraining  # imports torch and Lightning

    quieten_lightning()
    training = OfflineTraining(options)
    make_folder(folder)
    try:
        training.train(folder)
        return f"{_told(training.finish(folder)['measures'], options)}    wrote {folder}"
    finally:
        training.close()


def _told(measures: Mapping[str, float], options: OfflineOptions) -> str:
    if "return" not in measures:
        return f"{options.steps} updates"
    return (
        f"return {measures['return']:.1f} over {options.episodes} episodes (normalised: {measures['normalised']:.1f}), "
        f"after {options.steps} updates"
    )
