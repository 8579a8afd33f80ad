"""fit, validate and test: a thin LightningCLI around :class:`RepresentationModule`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from jsonargparse import Namespace
from jsonargparse.typing import PositiveInt
from lightning.fabric.utilities.seed import reset_seed
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from repdib_lightning import configurations, run_folder
from repdib_lightning.bottlenecks import BOTTLENECKS
from repdib_lightning.callbacks import exit_codes, last_good, run_callbacks, run_plugins
from repdib_lightning.callbacks.checkpoint_files import step_of
from repdib_lightning.callbacks.codebook_use import CodebookUse
from repdib_lightning.callbacks.confusion import Confusion
from repdib_lightning.callbacks.metrics_csv import MetricsCSV
from repdib_lightning.callbacks.pictures import Pictures
from repdib_lightning.callbacks.redrawn import Redrawn
from repdib_lightning.classifiers import CLASSIFIERS
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.mazes import MazeDataModule
from repdib_lightning.data.robot_arm import RobotArmDataModule
from repdib_lightning.decoders import DECODERS
from repdib_lightning.encoders import ENCODERS
from repdib_lightning.errors import UserError
from repdib_lightning.export.run_export import write_model_description
from repdib_lightning.objectives import OBJECTIVES
from repdib_lightning.option_errors import one_line
from repdib_lightning.quiet import quieten_lightning
from repdib_lightning.representation import RepresentationModule
from repdib_lightning.resuming import check_idle, check_same_data, check_unchanged
from repdib_lightning.rl.exploration.callbacks import ExplorationProgress, Snapshots
from repdib_lightning.rl.exploration.data import ExplorationDataModule
from repdib_lightning.rl.exploration.module import ExplorationModule

DEFAULT = "robot_arm"
_DATA = (EpisodeDataModule, MazeDataModule, RobotArmDataModule, ExplorationDataModule)
SLOTS: dict[str, list[str]] = {
    "model.encoder": list(ENCODERS),
    "model.bottleneck": list(BOTTLENECKS),
    "model.objective": list(OBJECTIVES),
    "model.objective.classifier": list(CLASSIFIERS),
    "model.objective.decoder": list(DECODERS),
    "model.optimizer": [name for name, item in vars(torch.optim).items() if isinstance(item, type)],
    "data": [module.__name__ for module in _DATA],
}
"""Key of a slot in the configuration -> names of the classes that fit it."""

_DESCRIPTION = """Train a representation. Without --config this is the default run: the simulated robot arm
(3x3 cells, two cameras, 14,000 samples, collected on first use) with multi-step inverse dynamics and the RepDIB
bottleneck (VIB, then 8 groups x 50 codes), 1,000 steps; about four minutes on two cores. Overlays change it:
--config robot_arm --config bottleneck/none. Packaged configurations: {names}."""


class TrainingCLI(LightningCLI):
    """LightningCLI with a run folder: ``--run`` names a new one, ``--resume`` goes on with one."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the options of the run folder and its checkpoints."""
        parser.add_argument("--run", type=str | None, default=None, help="Folder of the run. Default: runs/NAME-DATE.")
        parser.add_argument(
            "--resume", type=str | None, default=None, help="Folder of a run to go on with, exactly where it stopped."
        )
        parser.add_argument("--checkpoint_every", type=PositiveInt, default=100, help="Steps between checkpoints.")
        parser.add_argument("--checkpoint_keep", type=PositiveInt, default=3, help="Checkpoints to keep, newest first.")

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse; bad input becomes one line."""
        with _one_line_errors(parser):
            super().parse_arguments(parser, args)
        seed = self.config.seed_everything
        if not isinstance(seed, bool) and not 0 <= seed < 2**32:
            raise UserError(f"seed_everything must be in 0..{2**32 - 1}, is {seed}")

    def instantiate_classes(self) -> None:
        """Build data module, model and trainer; a constructor's complaint becomes one line."""
        with _one_line_errors(self.parser):
            super().instantiate_classes()

    def instantiate_trainer(self, **kwargs: Any) -> pl.Trainer:
        """Give the trainer the loggers, callbacks and plugins of the run's folder."""
        config, given = self.config, self.config_init.trainer
        _refuse(config)
        self.folder = Path(config.resume or config.run or run_folder.default_folder(self._file_names()))
        self.checkpoint = last_good(self.folder) if config.resume else None
        self.first_step = step_of(self.checkpoint) if self.checkpoint else 0
        if given.logger in (None, True):
            purge = self.first_step if self.checkpoint else None
            board = TensorBoardLogger(self.folder.parent, name=self.folder.name, version="", purge_step=purge)
            kwargs["logger"] = [board, MetricsCSV(self.folder, purge)]
        kwargs |= {"default_root_dir": str(self.folder), "plugins": [*(given.plugins or []), *run_plugins()]}
        kwargs["use_distributed_sampler"] = False  # the loaders give each process its own share
        safety = run_callbacks(self.folder, config.checkpoint_every, config.checkpoint_keep)
        shown = [Pictures(), Redrawn(), CodebookUse(), Confusion()]
        if isinstance(self.datamodule, ExplorationDataModule):
            shown = [Pictures(), ExplorationProgress(), Snapshots()]
        self.trainer_defaults = {"callbacks": [*shown, *safety]}
        return super().instantiate_trainer(**kwargs)

    def configuration(self) -> str:
        """The whole configuration as YAML, without what names files and folders of this call."""
        kept = self.config.clone()
        for key in ("config", "run", "resume"):
            kept.pop(key, None)
        return self.parser.dump(kept, skip_none=False, skip_validation=True)

    def _file_names(self) -> list[str]:
        return [str(path) for path in self.config.get("config") or []]


def fit(arguments: list[str]) -> int:
    """Train a new run, or go on with one."""
    cli = _prepare(_with_run("--resume", arguments))
    limit = cli.trainer.max_steps
    if cli.checkpoint is not None and 0 <= limit <= cli.first_step:
        print(f"{cli.folder}: is at step {cli.first_step} already; to go on, give a --trainer.max_steps above it")
        return 0
    _open(cli)
    _say(f"run folder: {cli.folder}")
    reset_seed()  # as Lightning does where several processes train: one process draws what they will
    try:
        with exit_codes(), _one_line_errors(cli.parser, _SETUP_ERRORS):
            cli.trainer.fit(cli.model, datamodule=cli.datamodule, ckpt_path=cli.checkpoint)
    except ValueError as error:
        if isinstance(error, UserError) or cli.trainer.global_step > cli.first_step:
            raise
        raise UserError(str(error)) from error  # options that do not fit the data, such as validation intervals
    except SystemExit:
        _say(f"stopped: {cli.folder}    go on: python -m repdib_lightning fit --resume {shlex.quote(str(cli.folder))}")
        raise
    finally:
        if isinstance(cli.datamodule, ExplorationDataModule):
            cli.datamodule.close()
        run_folder.remove_stillborn(cli.folder)
    _say(f"finished: {cli.folder}    next: python -m repdib_lightning export {shlex.quote(str(cli.folder))}")
    return 0


def _open(cli: TrainingCLI) -> None:
    """Try everything that can go wrong with data, model and options, then make the run's folder or go on in it."""
    resumed, configuration = cli.checkpoint is not None, cli.configuration()
    if isinstance(cli.datamodule, ExplorationDataModule):
        cli.datamodule.folder = cli.folder
        if cli.trainer.num_devices * cli.trainer.num_nodes > 1:
            raise UserError("trainer.devices: an exploration runs in one process; set trainer.devices to 1")
    run_folder.check_new(cli.folder, exist_ok=resumed)
    if resumed:
        check_idle(cli.folder)
        check_unchanged(cli.folder, (cli.folder / run_folder.CONFIGURATION).read_text(), configuration)
    else:
        cli.datamodule.prepare_data()
    cli.datamodule.setup("fit")
    if resumed:
        check_same_data(cli.folder, cli.datamodule.facts)
    cli.datamodule.train_dataloader()
    with _one_line_errors(cli.parser):
        cli.model.build(cli.datamodule.spec).configure_optimizers()
    cli.model.rehearse(cli.datamodule.example())  # an error in somebody's own part keeps its traceback
    run_folder.open_run(cli.folder, configuration, cli.datamodule.facts, resumed=resumed)
    if not resumed:
        _describe_model(cli)


@rank_zero_only
def _say(line: str) -> None:
    print(line, flush=True)


def _refuse(config: Namespace) -> None:
    """Trainer options that this command line cannot honour. Raises UserError saying what to do instead."""
    trainer = config.trainer
    if config.run is not None and not config.run.strip():
        raise UserError("--run: needs the name of a folder")
    if config.run is not None and config.resume is not None:
        raise UserError("--resume goes on in the run's own folder: leave out --run")
    if trainer.fast_dev_run:
        raise UserError("trainer.fast_dev_run leaves no run behind; for a run of seconds use --config debug")
    if trainer.default_root_dir is not None:
        raise UserError("trainer.default_root_dir: name the run's folder with --run")
    if trainer.overfit_batches or trainer.reload_dataloaders_every_n_epochs:
        raise UserError("trainer.overfit_batches and reload_dataloaders_every_n_epochs do not fit an exact data stream")
    for key in ("max_steps", "max_epochs", "limit_train_batches"):
        if trainer[key] == 0:
            raise UserError(f"trainer.{key} is 0: no step would be trained")
    if trainer.enable_checkpointing is False:
        raise UserError(
            "trainer.enable_checkpointing: a run keeps checkpoints; make them rarer with --checkpoint_every"
        )


@rank_zero_only
def _describe_model(cli: TrainingCLI) -> None:
    """Write into the run's folder what ``export`` needs to build encoder and bottleneck again."""
    training = {"objective": cli.model.objective.label, "run": cli.folder.name}
    found = {"decoder": cli.model.objective.find_decoder(), "classifier": cli.model.objective.find_classifier()}
    heads = {key: head for key, head in found.items() if head is not None}
    modules = (cli.model.encoder, cli.model.bottleneck)
    write_model_description(cli.folder, *modules, training=training, data=cli.datamodule.facts, heads=heads)


def validate(arguments: list[str]) -> int:
    """Losses of a run's last checkpoint on the held-out episodes: ``validate runs/x``."""
    return _evaluate("validate", arguments)


def test(arguments: list[str]) -> int:
    """The same as :func:`validate`, logged under test/."""
    return _evaluate("test", arguments)


def _evaluate(verb: str, arguments: list[str]) -> int:
    if arguments and not arguments[0].startswith("-"):
        arguments = ["--resume", *arguments]
    elif not {"-h", "--help"} & set(arguments):
        raise UserError(f"{verb}: needs the folder of a run: python -m repdib_lightning {verb} runs/NAME")
    cli = _prepare(_with_run("--resume", arguments))
    if isinstance(cli.datamodule, ExplorationDataModule):
        raise UserError(f"{verb} {cli.folder}: an exploration has no held-out losses; export it, and probe its bundle")
    cli.datamodule.setup(verb)
    cli.model.build(cli.datamodule.spec)
    plain = {"logger": False, "callbacks": None, "plugins": run_plugins(), "use_distributed_sampler": False}
    trainer = pl.Trainer(**{**cli.config_init.trainer, **plain, "enable_model_summary": False})
    with _one_line_errors(cli.parser, (RuntimeError, *_SETUP_ERRORS)):
        getattr(trainer, verb)(cli.model, datamodule=cli.datamodule, ckpt_path=cli.checkpoint)
    return 0


def _prepare(arguments: list[str]) -> TrainingCLI:
    """Parse and build everything; nothing is written."""
    quieten_lightning()
    expanded = configurations.expand(arguments)
    if not any(argument.startswith("--config") for argument in expanded):
        expanded = ["--config", str(configurations.resolve(DEFAULT)), *expanded]
    command = "python -m repdib_lightning fit"
    parser = {"exit_on_error": False, "allow_abbrev": False, "prog": command, "usage": f"{command} [--KEY VALUE ...]"}
    explores = configurations.chosen_class(expanded, "data") == ExplorationDataModule.__name__
    return TrainingCLI(
        ExplorationModule if explores else RepresentationModule,
        pl.LightningDataModule,
        subclass_mode_data=True,
        save_config_callback=None,
        parser_kwargs={**parser, "description": _DESCRIPTION.format(names=", ".join(configurations.packaged()))},
        auto_configure_optimizers=False,
        seed_everything_default=0,
        run=False,
        args=expanded,
    )


def _with_run(option: str, arguments: list[str]) -> list[str]:
    """Put the saved configuration of ``--resume RUN`` in front of the other arguments."""
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == option:
            if not equals and index + 1 == len(arguments):
                raise UserError(f"{option}: needs the folder of a run")
            folder = run_folder.existing(Path(value if equals else arguments[index + 1]))
            return ["--config", str(folder / run_folder.CONFIGURATION), *arguments]
    return arguments


_PARSING_ERRORS = (
    argparse.ArgumentError,
    ValueError,
    TypeError,
    ImportError,
    AttributeError,
    MisconfigurationException,
)
_SETUP_ERRORS = (MisconfigurationException,)
"""What Lightning raises where trainer options do not fit each other or this machine."""


@contextmanager
def _one_line_errors(
    parser: LightningArgumentParser, kinds: tuple[type[Exception], ...] = _PARSING_ERRORS
) -> Iterator[None]:
    """Turn errors of these kinds into one line."""
    try:
        yield
    except UserError:
        raise
    except kinds as error:
        options = [option[2:] for action in parser._actions for option in action.option_strings if option[:2] == "--"]
        raise one_line(error, options, SLOTS) from error
