"""``finetune dt``: the Decision Transformer on a frozen encoder, or with one that it trains."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl.decision_transformer.options import DTOptions, check_dt_options
from repdib_lightning.rl.options import CONFIGURATION, OUTCOME
from repdib_lightning.rl.run_folders import check_folder, make_folder


def finetune_dt(
    *,
    data: Path,
    encoder: Path | None = None,
    run: Path | None = None,
    codes: bool = False,
    env: str = "",
    env_options: dict[str, Any] | None = None,
    target_return: float | None = None,
    temperature: float = 1.0,
    epochs: int = 5,
    steps_per_epoch: int | None = None,
    stride: int = 1,
    context: int = 30,
    layers: int = 6,
    heads: int = 8,
    width: int = 128,
    dropout: float = 0.1,
    learning_rate: float = 6e-4,
    weight_decay: float = 0.1,
    batch_size: int = 128,
    warmup_tokens: int = 10_240,
    channels: list[int] | None = None,
    kernels: list[int] | None = None,
    strides: list[int] | None = None,
    frame_stack: int | None = None,
    episodes: int = 10,
    evaluate_every: int = 1,
    film: int = 3,
    seed: int = 0,
    device: str = "auto",
    overwrite: bool = False,
    resume: bool = False,
) -> str:
    """Train a Decision Transformer on a store with discrete actions: on a frozen encoder, or end to end (paper, Atari).

    With ``--encoder`` every frame is encoded once, into ``latents.h5`` in the run's folder, and the transformer reads
    windows of vectors. Without it the transformer trains an encoder on windows of stacked pictures, as published. Only
    training episodes are used. Writes ``progress.csv``, ``outcome.json``, ``policy.safetensors``, ``evaluation.mp4``,
    TensorBoard files, a checkpoint for each epoch, and ``bundle/`` where the encoder was trained.

    Args:
        data: a store with discrete actions and rewards.
        encoder: a bundle, or the run that it was exported in.
        run: folder to make; runs/dt-DATA-DATE by default.
        codes: read the encoder's codes, an embedding for each group, in place of its latents.
        env: where to evaluate: by default where the data were recorded, amid held-out images of the same kind of
            distractor; a gymnasium id; or none.
        env_options: of that environment, such as --env_options.sticky 0.25.
        target_return: what is asked for; by default 90 in Breakout, 1150 in Seaquest, 14000 in Qbert, 20 in Pong, else
            the best return in the data.
        temperature: of the actions that are drawn when it is evaluated; 0 takes the likeliest.
        epochs: over the data.
        steps_per_epoch: updates an epoch; every window of the data once by default.
        stride: steps between the beginnings of two windows; that of --context takes each step once an epoch.
        context: steps of a window.
        layers: of the transformer.
        heads: of its attention.
        width: of its tokens.
        dropout: in its attention and behind its layers.
        learning_rate: AdamW's, after the warm-up; it falls to a tenth.
        weight_decay: AdamW's.
        batch_size: windows an update.
        warmup_tokens: steps of windows over which the learning rate rises.
        channels: of a trained encoder's convolutions; [32, 64, 64] by default.
        kernels: of a trained encoder's convolutions; [8, 4, 3] by default.
        strides: of a trained encoder's convolutions; [4, 2, 1] by default.
        frame_stack: of a trained encoder; 4 by default.
        episodes: of an evaluation, played at once.
        evaluate_every: epochs between evaluations; there is one after the last epoch in any case.
        film: how many of its episodes are filmed, at most, for their first 1000 steps.
        seed: of weights, windows, dropout and evaluation.
        device: cpu, cuda, or auto.
        overwrite: replace an earlier run of finetune.
        resume: go on with an unfinished run in --run, exactly as though it had never stopped.

    Returns:
        A line of what was reached.

    Raises:
        UserError: a bad option, a store without what is needed, a bundle or an environment that does not fit it;
            nothing is left behind then. Or losses that are no longer finite; the folder stays then, without an outcome.
    """
    given = locals()
    options = DTOptions.of(given)
    check_dt_options(options)
    folder = run or Path("runs") / f"dt-{data.stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    _check_run(options, folder, overwrite, resume, named=run is not None)
    if resume and (folder / OUTCOME).is_file():
        return f"{_told(json.loads((folder / OUTCOME).read_text()), options)}    was finished: {folder}"
    from repdib_lightning.quiet import quieten_lightning
    from repdib_lightning.rl.decision_transformer.training import DTTraining  # imports torch and Lightning

    quieten_lightning()
    training = DTTraining(options)
    try:
        if not resume:
            make_folder(folder)
        training.train(folder)
        return f"{_told(training.finish(folder), options)}    wrote {folder}"
    finally:
        training.close()


def check_dt(**given: Any) -> None:
    """What is wrong with options of ``finetune dt``, as far as that can be known before anything runs."""
    options = DTOptions.of(given)
    check_dt_options(options)
    if not options.data.exists():
        return
    from repdib_lightning.data.episodes import EpisodeStore
    from repdib_lightning.rl.decision_transformer.windows import Windows
    from repdib_lightning.rl.offline_environment import evaluated_environment
    from repdib_lightning.rl.offline_evaluation import open_copies

    store = EpisodeStore(options.data)
    Windows(store, options.context, options.stride)
    chosen = evaluated_environment(store, options.env, options.env_options or {})
    if chosen is not None and store.actions_spec is not None:
        for environment in open_copies(*chosen, 1, store.actions_spec):
            environment.close()


def _check_run(options: DTOptions, folder: Path, overwrite: bool, resume: bool, *, named: bool) -> None:
    """Raise UserError where a folder cannot be begun, or gone on with."""
    if resume and overwrite:
        raise UserError("--resume goes on with a run, --overwrite replaces it; leave one of them out")
    if resume:
        if not named:
            raise UserError("--resume needs --run FOLDER, the run to go on with")
        from repdib_lightning.rl.decision_transformer.checkpoints import check_resumable
        from repdib_lightning.rl.decision_transformer.training import configuration_of

        check_resumable(folder, configuration_of(options))
        return
    if not overwrite and (folder / CONFIGURATION).is_file() and not (folder / OUTCOME).is_file():
        raise UserError(
            f"--run {folder}: exists already, unfinished; go on with it by --resume, choose another folder or pass "
            "--overwrite"
        )
    check_folder(folder, overwrite)
    for name in ("data", "encoder"):
        path = getattr(options, name)
        if path is not None and folder.resolve() in (path.resolve(), *path.resolve().parents):
            raise UserError(f"--run {folder}: holds --{name} {path}; choose another folder")


def _told(outcome: Mapping[str, Any], options: DTOptions) -> str:
    measures = outcome["measures"]
    learnt = f"{measures['accuracy']:.1%} of the actions are the data's after {options.epochs} epochs"
    if "return" not in measures:
        return learnt
    normalised = f" ({measures['normalised']:.1f} % of a gamer's)" if "normalised" in measures else ""
    asked = f"asked for {outcome['target_return']:g}"
    return f"return {measures['return']:.1f}{normalised} over {options.episodes} episodes, {asked}; {learnt}"
