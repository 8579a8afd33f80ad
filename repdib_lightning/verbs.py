"""The verbs that do not train: plain typed functions, their options read from their signatures."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

from repdib_lightning.errors import UserError, nearest

SUITE_VERBS = {
    "run": "repdib_lightning.experiments.run:run_suite",
    "status": "repdib_lightning.experiments.run:suite_status",
    "report": "repdib_lightning.experiments.report:report_suite",
}


FIGURES = {
    "factors": "repdib_lightning.evaluation.factor_figures:draw_factors",
    "recognition": "repdib_lightning.evaluation.recognition_figures:draw_recognition",
}


def collect(arguments: list[str]) -> int:
    """``collect ENVIRONMENT PATH [options]``."""
    from repdib_lightning.environments import COLLECTORS

    name, rest = _choose("collect", "environment", COLLECTORS, arguments)
    print(f"wrote {_call(f'collect {name}', _load(COLLECTORS[name]), rest)}")
    return 0


def import_data(arguments: list[str]) -> int:
    """``import FORMAT SOURCE OUTPUT [options]``."""
    from repdib_lightning.data.importers import IMPORTERS

    name, rest = _choose("import", "format", IMPORTERS, arguments)
    print(f"wrote {_call(f'import {name}', _load(IMPORTERS[name]), rest)}")
    return 0


def inspect(arguments: list[str]) -> int:
    """``inspect FILE [options]``."""
    from repdib_lightning.data.inspection import inspect_store

    print(_call("inspect", inspect_store, arguments))
    return 0


def export(arguments: list[str]) -> int:
    """``export RUN [options]``."""
    from repdib_lightning.export.run_export import export_run

    folder = _call("export", export_run, arguments)
    print(f"wrote {folder}    use it: repdib_lightning.export.load_encoder('{folder}')")
    return 0


def probe(arguments: list[str]) -> int:
    """``probe BUNDLE DATA [options]``."""
    from repdib_lightning.evaluation.probe import probe_bundle

    print(_call("probe", probe_bundle, arguments).table())
    return 0


def encode(arguments: list[str]) -> int:
    """``encode BUNDLE DATA OUTPUT [options]``."""
    from repdib_lightning.evaluation.encoded_store import encode_store

    print(f"wrote {_call('encode', encode_store, arguments)}")
    return 0


def features(arguments: list[str]) -> int:
    """``features DATA OUTPUT [options]``."""
    from repdib_lightning.data.frame_features import store_features

    print(f"wrote {_call('features', store_features, arguments)}")
    return 0


def finetune(arguments: list[str]) -> int:
    """``finetune AGENT [options]``."""
    from repdib_lightning.rl import AGENTS

    name, rest = _choose("finetune", "agent", AGENTS, arguments)
    print(_call(f"finetune {name}", _load(AGENTS[name]), rest))
    return 0


def figures(arguments: list[str]) -> int:
    """``figures KIND BUNDLE DATA [options]``."""
    name, rest = _choose("figures", "kind", FIGURES, arguments)
    print(_call(f"figures {name}", _load(FIGURES[name]), rest))
    return 0


def compare(arguments: list[str]) -> int:
    """``compare DATA OUTPUT RUN [RUN ...]``: ratios are relative to the first run."""
    from repdib_lightning.evaluation.bundles import named_bundles

    options = _comparison_options(arguments)
    bundles = named_bundles(options.runs)
    from repdib_lightning.evaluation.report import compare as compare_bundles

    curves = {name: path.parent / "metrics.csv" for name, path in bundles.items()}
    known = {name: path for name, path in curves.items() if path.is_file()}
    chosen = {"probes": options.probes, "groups": options.groups, "seed": options.seed, "device": options.device}
    print(compare_bundles(bundles, options.data, options.output, metrics=known, **chosen))
    print(f"wrote {options.output}")
    return 0


@dataclass(frozen=True)
class Outcome:
    """What a verb has to say in the end where the work itself may have failed, and its exit code."""

    text: str
    exit_code: int = 0


def suite(arguments: list[str]) -> int:
    """``suite run|status|report SUITE [options]``."""
    verb, rest = _choose("suite", "verb", SUITE_VERBS, arguments)
    said = _call(f"suite {verb}", _load(SUITE_VERBS[verb]), rest)
    outcome = said if isinstance(said, Outcome) else Outcome(said)
    print(outcome.text)
    return outcome.exit_code


class _OneLineParser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"compare: {message}")


def _comparison_options(arguments: list[str]) -> argparse.Namespace:
    parser = _OneLineParser(
        prog="python -m repdib_lightning compare",
        description="Probe exported runs on one data set, side by side: a table here, an HTML page with pictures.",
        epilog="Beside OUTPUT.html, OUTPUT.json holds the numbers and OUTPUT-kept.png the bars; all are replaced.",
        allow_abbrev=False,
    )
    parser.add_argument("data", type=Path, help="a data file with factors")
    parser.add_argument("output", type=Path, help="the HTML page to write (.html)")
    parser.add_argument("runs", nargs="+", help="runs that were exported, or bundles; NAME=PATH names one")
    parser.add_argument(
        "--probes", default="linear,mlp", help="some of linear,mlp,decoder,groups,recognition (default: linear,mlp)"
    )
    parser.add_argument("--groups", type=int, help="for groups: how many to cut a latent into that is not quantised")
    parser.add_argument("--seed", type=int, default=0, help="of the MLP and of the permutation null (default: 0)")
    parser.add_argument("--device", default="auto", help="runs the encoders (default: auto, a GPU if there is one)")
    return parser.parse_args(arguments)


def _choose(verb: str, what: str, known: dict[str, str], arguments: list[str]) -> tuple[str, list[str]]:
    """The first argument, one of ``known``, and the rest. ``--help`` alone lists the choices."""
    if not arguments or arguments[0] in ("-h", "--help"):
        usage = f"usage: python -m repdib_lightning {verb} {what.upper()} ... (--help after it lists its options)"
        print(usage, *(f"  {name}" for name in sorted(known)), sep="\n")
        raise SystemExit(0 if arguments else 2)
    if arguments[0] not in known:
        raise UserError(f"{verb}: unknown {what} '{arguments[0]}', {nearest(arguments[0], known)}")
    return arguments[0], arguments[1:]


def _load(place: str) -> Callable[..., Any]:
    module, _, function = place.partition(":")
    return getattr(importlib.import_module(module), function)  # type: ignore[no-any-return]


def _call(verb: str, function: Callable[..., Any], arguments: list[str]) -> Any:
    return function(**parse(verb, function, arguments))


def check_finetune(arguments: Sequence[str]) -> None:
    """Check the arguments of ``finetune``, agent first, before anything that they need is there.

    Raises:
        UserError: an unknown option, one of another type, or what the agent's check finds.
    """
    from repdib_lightning.rl import AGENTS, CHECKS

    name, rest = _choose("finetune", "agent", AGENTS, list(arguments))
    _load(CHECKS[name])(**parse(f"finetune {name}", _load(AGENTS[name]), rest))


def parse(verb: str, function: Callable[..., Any], arguments: list[str]) -> dict[str, Any]:
    """All arguments of a function, as its signature reads them from words: required ones by place, others by name.

    Args:
        verb: what the help calls it. function: typed and documented. arguments: words of the command line.

    Raises:
        UserError: an unknown option, a missing one, or a value of another type.
    """
    from jsonargparse import ArgumentParser

    from repdib_lightning.option_errors import one_line

    description = (function.__doc__ or "").strip().split("\n\n")[0]
    parser = ArgumentParser(
        prog=f"python -m repdib_lightning {verb}", description=description, exit_on_error=False, allow_abbrev=False
    )
    parser.add_function_arguments(function, as_group=False, as_positional=True, fail_untyped=True)
    try:
        options = parser.parse_args(_spelled_out(function, arguments))
    except argparse.ArgumentError as error:
        known = [option[2:] for action in parser._actions for option in action.option_strings if option[:2] == "--"]
        raise one_line(error, known, {}) from error
    return parser.instantiate(options).as_dict()  # type: ignore[no-any-return]


def _spelled_out(function: Callable[..., Any], arguments: list[str]) -> list[str]:
    """Give bare flags of yes-or-no parameters their value: ``--overwrite`` means ``--overwrite true``.

    A word behind a flag is its value where it cannot be a required argument.
    """
    hints = get_type_hints(function)
    required = any(given.default is Parameter.empty for given in signature(function).parameters.values())
    flags = {f"--{name}" for name, hint in hints.items() if hint is bool}
    spelled: list[str] = []
    for index, argument in enumerate(arguments):
        following = arguments[index + 1 : index + 2]
        valued = following in (["true"], ["false"]) or (
            not required and following and not following[0].startswith("--")
        )
        spelled.append(f"{argument}=true" if argument in flags and not valued else argument)
    return spelled
