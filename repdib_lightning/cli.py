"""fit, validate and test: a thin LightningCLI around :class:`RepresentationModule`."""

from __future__ import annotations

import argparse
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from jsonargparse.typing import PositiveInt
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from repdib_lightning import configurations, run_folder
from repdib_lightning.bottlenecks import BOTTLENECKS
from repdib_lightning.callbacks import exit_codes, last_good, run_callbacks, run_plugins
from repdib_lightning.callbacks.checkpoint_files import step_of
from repdib_lightning.callbacks.codebook_use import CodebookUse
from repdib_lightning.callbacks.metrics_csv import MetricsCSV
from repdib_lightning.callbacks.pictures import Pictures
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.robot_arm import RobotArmDataModule
from repdib_lightning.encoders import ENCODERS
from repdib_lightning.errors import UserError
from repdib_lightning.export.run_export import write_model_description
from repdib_lightning.objectives import OBJECTIVES
from repdib_lightning.option_errors import one_line
from repdib_lightning.representation import RepresentationModule

DEFAULT = "robot_arm"
SLOTS: dict[str, list[str]] = {
    "model.encoder": list(ENCODERS),
    "model.bottleneck": list(BOTTLENECKS),
    "model.objective": list(OBJECTIVES),
    "model.optimizer": [name for name, item in vars(torch.optim).items() if isinstance(item, type)],
    "data": [EpisodeDataModule.__name__, RobotArmDataModule.__name__],
}
"""Key of a slot in the configuration -> names of the classes that fit it."""

_DESCRIPTION = """Train a representation. Without --config this is the default run: the simulated robot arm
(3x3 cells, two cameras, 14,000 samples, collected on first use) with multi-step inverse dynamics and the RepDIB
bottleneck (VIB, then 8 groups x 50 codes), 1,000 steps; about five minutes on two cores. Overlays change it:
--config robot_arm --config bottleneck/none. Packaged configurations: {names}."""

_HARMLESS = (
    ".*does not have many workers.*",
    ".*LightningCLI's args parameter.*",
    ".*exists and is not empty.*",
    ".*treespec.*",
)
"""Warnings of the libraries below that tell a user nothing."""


class TrainingCLI(LightningCLI):
    """LightningCLI with a run folder: ``--run`` names a new one, ``--resume`` goes on with one."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the two options of the run folder."""
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

    def instantiate_classes(self) -> None:
        """Build data module, model and trainer; a constructor's complaint becomes one line."""
        with _one_line_errors(self.parser):
            super().instantiate_classes()

    def instantiate_trainer(self, **kwargs: Any) -> pl.Trainer:
        """Give the trainer the loggers, callbacks and plugins of the run's folder."""
        config = self.config
        self.folder = Path(config.resume or config.run or run_folder.default_folder(self._file_names()))
        self.checkpoint = last_good(self.folder) if config.resume else None
        step = step_of(self.checkpoint) if self.checkpoint else None
        board = TensorBoardLogger(self.folder.parent, name=self.folder.name, version="", purge_step=step)
        kwargs |= {"logger": [board, MetricsCSV(self.folder, step)], "default_root_dir": str(self.folder)}
        kwargs["plugins"] = [*(self.config_init.trainer.plugins or []), *run_plugins()]
        safety = run_callbacks(self.folder, config.checkpoint_every, config.checkpoint_keep)
        self.trainer_defaults = {"callbacks": [Pictures(), CodebookUse(), *safety]}
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
    resumed = cli.checkpoint is not None
    run_folder.check_new(cli.folder, exist_ok=resumed)
    cli.datamodule.prepare_data()
    cli.datamodule.setup("fit")
    cli.model.build(cli.datamodule.spec).rehearse(cli.datamodule.example())
    run_folder.open_run(cli.folder, cli.configuration(), cli.datamodule.store, resumed=resumed)
    if not resumed:
        _describe_model(cli)
    print(f"run folder: {cli.folder}", flush=True)
    with exit_codes():
        cli.trainer.fit(cli.model, datamodule=cli.datamodule, ckpt_path=cli.checkpoint)
    print(f"finished: {cli.folder}    next: python -m repdib_lightning export {cli.folder}", flush=True)
    return 0


@rank_zero_only
def _describe_model(cli: TrainingCLI) -> None:
    """Write into the run's folder what ``export`` needs to build encoder and bottleneck again."""
    store = cli.datamodule.store
    training = {"objective": type(cli.model.objective).__name__, "run": cli.folder.name}
    data = {"file": store.path.name, "fingerprint": store.fingerprint}
    write_model_description(cli.folder, cli.model.encoder, cli.model.bottleneck, training=training, data=data)


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
    cli.datamodule.setup(verb)
    cli.model.build(cli.datamodule.spec)
    trainer = pl.Trainer(logger=False, enable_checkpointing=False, enable_model_summary=False, plugins=run_plugins())
    getattr(trainer, verb)(cli.model, datamodule=cli.datamodule, ckpt_path=cli.checkpoint)
    return 0


def _prepare(arguments: list[str]) -> TrainingCLI:
    """Parse and build everything; nothing is written."""
    for chatty in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    for harmless in _HARMLESS:
        warnings.filterwarnings("ignore", message=harmless)
    expanded = configurations.expand(arguments)
    if not any(argument.startswith("--config") for argument in expanded):
        expanded = ["--config", str(configurations.resolve(DEFAULT)), *expanded]
    command = "python -m repdib_lightning fit"
    parser = {"exit_on_error": False, "allow_abbrev": False, "prog": command, "usage": f"{command} [--KEY VALUE ...]"}
    return TrainingCLI(
        RepresentationModule,
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


@contextmanager
def _one_line_errors(parser: LightningArgumentParser) -> Iterator[None]:
    try:
        yield
    except UserError:
        raise
    except (argparse.ArgumentError, ValueError, TypeError, ImportError, AttributeError) as error:
        options = [option[2:] for action in parser._actions for option in action.option_strings if option[:2] == "--"]
        raise one_line(error, options, SLOTS) from error
