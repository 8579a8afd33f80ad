"""Finds the packaged configurations: ``--config robot_arm`` means conf/robot_arm.yaml."""

from __future__ import annotations

from pathlib import Path

import yaml

from repdib_lightning.errors import UserError, nearest


def packaged() -> dict[str, Path]:
    """Name (without .yaml, with its folder) -> file of every configuration of a run that ships with the package."""
    names = {str(path.relative_to(_root()).with_suffix("")): path for path in sorted(_root().rglob("*.yaml"))}
    return {name: path for name, path in names.items() if not name.startswith("suites/")}


def packaged_suites() -> dict[str, Path]:
    """Name (without .yaml) -> file of every suite that ships with the package."""
    return {path.stem: path for path in sorted(_root().glob("suites/*.yaml"))}


def _root() -> Path:
    installed, cloned = Path(__file__).parent / "conf", Path(__file__).parents[1] / "conf"
    return installed if installed.is_dir() else cloned


def resolve(name: str) -> Path:
    """The file that a ``--config`` value means: an existing path, else a packaged name.

    Raises:
        UserError: neither, with the nearest packaged name.
    """
    path = Path(name)
    if path.is_file():
        return _readable(path)
    known = packaged()
    short = name.removesuffix(".yaml").removeprefix("conf/")
    if short not in known:
        raise UserError(f"--config {name}: no such file or packaged configuration; {nearest(short, known)}")
    return known[short]


def _readable(path: Path) -> Path:
    try:
        yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        reason = str(error).splitlines()[-1].strip()
        raise UserError(f"{path}: not valid YAML ({reason})") from error
    return path


def expand(arguments: list[str]) -> list[str]:
    """Replace the value of every ``--config`` (or ``-c``) by the file that it means."""
    expanded: list[str] = []
    expects_name = False
    for argument in arguments:
        option, equals, value = argument.partition("=")
        if expects_name:
            argument = str(resolve(argument))
        elif option in ("--config", "-c") and equals:
            argument = f"--config={resolve(value)}"
        expects_name = not expects_name and argument in ("--config", "-c")
        expanded.append("--config" if argument == "-c" else argument)
    return expanded


def chosen_class(arguments: list[str], slot: str) -> str:
    """The class that expanded arguments choose for a slot such as ``data``, without its module; "" if they choose none.

    Args:
        arguments: of :func:`expand`. slot: its name.
    """
    chosen = ""
    for place, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        value = value if equals else "".join(arguments[place + 1 : place + 2])
        if option == "--config" and value:
            tree = yaml.safe_load(Path(value).read_text())
            block = tree.get(slot) if isinstance(tree, dict) else None
            chosen = str(block.get("class_path", chosen)) if isinstance(block, dict) else chosen
        elif option in (f"--{slot}", f"--{slot}.class_path") and value:
            chosen = value
    return chosen.rpartition(".")[2]
