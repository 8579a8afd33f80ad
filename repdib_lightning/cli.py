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
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from repdib_lightning import configurations, run_folder
from repdib_lightning.bottlenecks import BOTTLENECKS
from repdib_lightning.callbacks import CHECKPOINTS, AtomicCheckpointIO, last_good, run_callbacks
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.robot_arm import RobotArmDataModule
from repdib_lightning.encoders import ENCODERS
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import OBJECTIVES
from repdib_lightning.option_errors import one_line
from repdib_lightning.representation import RepresentationModule

DEFAULT = "robot_arm"
SLOTS = {
    "model.encoder": ENCODERS,
    "model.bottleneck": BOTTLENECKS,
    "model.objective": OBJECTIVES,
    "model.optimizer": [name for name, item in vars(torch.optim).items() if isinstance(item, type)],
    "data": [EpisodeDataModule.__name__, RobotArmDataModule.__name__],
}
"""Key of a slot in the configuration -> names of the classes that fit it."""

_DESCRIPTION = """Train a representation. Without --config this is the default run: the simulated robot arm
(3x3 cells, two cameras, 14,000 samples, collected on first use) with multi-step inverse dynamics and the RepDIB
bottleneck (VIB, then 8 groups x 50 codes), 2,500 steps; about ten minutes on two cores. Overlays change it:
--config robot_arm --config bottleneck/none. Packaged configurations: {names}."""


class TrainingCLI(LightningCLI):
    """LightningCLI with a run folder: ``--run`` names a new one, ``--resume`` goes on with one."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add the two options of the run folder."""
        parser.add_argument("--run", type=str | None, default=None, help="Folder of the run. Default: runs/NAME-DATE.")
        parser.add_argument(
            "--resume", type=str | None, default=None, help="Folder of a run to go on with, exactly where it stopped."
        )

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
        resumed = self.config.resume is not None
        self.folder = Path(self.config.resume or self.config.run or run_folder.default_folder(self._file_names()))
        place = {"save_dir": str(self.folder.parent), "name": self.folder.name, "version": ""}
        kwargs |= {"logger": [TensorBoardLogger(**place), CSVLogger(**place)], "default_root_dir": str(self.folder)}
        kwargs["plugins"] = [*(self.config_init.trainer.plugins or []), AtomicCheckpointIO()]
        folder = run_folder.RunFolder(self.folder, self._configuration(), resumed=resumed)
        self.trainer_defaults = {"callbacks": [folder, *run_callbacks(self.folder)]}
        return super().instantiate_trainer(**kwargs)

    def _configuration(self) -> str:
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
    resumed = cli.config.resume is not None
    if not resumed:
        run_folder.check_new(cli.folder)
    checkpoint = last_good(cli.folder / CHECKPOINTS) if resumed else None
    cli.datamodule.prepare_data()
    cli.datamodule.setup("fit")
    cli.model.build(cli.datamodule.spec)
    print(f"run folder: {cli.folder}", flush=True)
    cli.trainer.fit(cli.model, datamodule=cli.datamodule, ckpt_path=checkpoint)
    print(f"finished: {cli.folder}    next: python -m repdib_lightning export {cli.folder}", flush=True)
    return 0


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
    checkpoint = last_good(cli.folder / CHECKPOINTS)
    cli.datamodule.setup(verb)
    cli.model.build(cli.datamodule.spec)
    trainer = pl.Trainer(logger=False, enable_checkpointing=False, enable_model_summary=False, plugins=AtomicCheckpointIO())
    getattr(trainer, verb)(cli.model, datamodule=cli.datamodule, ckpt_path=checkpoint)
    return 0


def _prepare(arguments: list[str]) -> TrainingCLI:
    """Parse and build everything; nothing is written."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    expanded = configurations.expand(arguments)
    if not any(argument.startswith("--config") for argument in expanded):
        expanded = ["--config", str(configurations.resolve(DEFAULT)), *expanded]
    parser = {"exit_on_error": False, "allow_abbrev": False, "prog": "python -m repdib_lightning fit"}
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
        raise one_line(error, options, {slot: sorted(known) for slot, known in SLOTS.items()}) from error
