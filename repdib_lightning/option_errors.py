"""Turns what the option parser says of bad input into one line with the nearest valid choice."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterable

from repdib_lightning.errors import UserError, nearest


def one_line(error: BaseException, options: Iterable[str], classes: dict[str, list[str]]) -> UserError:
    """Rewrite a parser's error.

    Args:
        error: what jsonargparse raised.
        options: all dotted keys that the parser knows, without dashes.
        classes: key of a slot -> class names that it takes.
    """
    text = str(error)
    keys = re.findall(r'Parser key "([^"]+)"', text)
    key = _join(keys)
    known = list(options)
    if match := re.search(r"unrecognized arguments: (\S+)", text):
        return UserError(f"unknown option {match[1]}, {_nearest_option(match[1], known)}")
    if match := re.search(r"Group '([^']*)' does not accept (?:option|nested key) '([^']+)'", text):
        inside = [name.removeprefix(match[1] + ".") for name in known if name.startswith(match[1] + ".")]
        return UserError(f"unknown key {match[1]}.{match[2]}, {nearest(match[2], {i.split('.')[0] for i in inside})}")
    if match := re.search(r"Option '([^']+)' is not accepted", text):
        return _not_accepted(key, match[1], text)
    if match := re.search(r"Expected a dot import path string: (\S+)", text):
        name = match[1].rstrip(".")
        return UserError(f"{key}: unknown class '{name}', {nearest(name, _fitting(key, keys[0], classes))}")
    if match := re.search(r"Expected an import path or a subclass spec, but got (.*?)\. Got value", text):
        return UserError(
            f"{key}: expected a class, got '{match[1]}', {nearest(match[1], _fitting(key, keys[0], classes))}"
        )
    if match := re.search(r"Expected a typing\.Literal\[(.*?)\]\. Got value: (.*)", text):
        choices = re.findall(r"'([^']*)'", match[1])
        return UserError(f"{key}: unknown '{match[2]}', {nearest(match[2], choices)}")
    if match := re.search(r"Expected an? (?:<class ')?([\w.]+)'?>?\. Got value: (.*)", text):
        return _of_another_kind(key, match[1], match[2].split(" Got value")[0].strip().rstrip("."))
    plain = re.search(r"Subtypes: \[((?:<class '(?:int|float|str|bool|NoneType)'>(?:, )?)+)\]", text)
    given = re.search(r"Given value: (.*)", text)
    if plain and given:
        kinds = re.findall(r"'(\w+)'", plain[1])
        wanted = " or ".join(kind for kind in kinds if kind != "NoneType")
        return _of_another_kind(key, wanted, given[1])
    if given and (pairs := re.search(r"Subtypes: \[dict\[(\w+), (\w+)\].*<class 'dict'>", text, re.DOTALL)):
        return UserError(f"{key}: expected pairs '{{{pairs[1]}: {pairs[2]}}}', got '{given[1]}'")
    if match := re.search(r"(?:Errors:\s*|expects a function or a callable class: )-? ?(.+)", text):
        return UserError(_unwrap(match[1]) if not keys else f"{key}: {_unwrap(match[1])}")
    return UserError(f"{key}: {_unwrap(text)}" if key and key not in text.splitlines()[-1] else _unwrap(text))


def _of_another_kind(key: str, wanted: str, given: str) -> UserError:
    if wanted == "float" and given.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return UserError(f"{key}: must be a finite number, is {given}")
    return UserError(f"{key}: expected {wanted}, got '{given}'")


def _join(keys: list[str]) -> str:
    """['data', 'batch_size'] -> 'data.batch_size'; a key that already holds its parent stands alone."""
    joined = ""
    for key in keys:
        joined = key if not joined or key.startswith(joined) else f"{joined}.{key}"
    return joined


def _fitting(key: str, slot: str, classes: dict[str, list[str]]) -> list[str]:
    """Names of the classes that fit a key: those of the slot with its last word, such as a classifier anywhere."""
    inside = [names for known, names in classes.items() if known.rpartition(".")[2] == key.rpartition(".")[2]]
    return inside[0] if inside else classes.get(slot, [])


def _nearest_option(given: str, known: list[str]) -> str:
    word = given.lstrip("-").split("=")[0]
    hint = nearest(word, known)
    return hint.split("? ")[0].replace("did you mean '", "did you mean '--") + "?" if "? " in hint else hint


def _not_accepted(key: str, option: str, text: str) -> UserError:
    accepted = _accepted(text)
    if not accepted and option == "class_path":
        return UserError(f"{key}: options of a class belong under its init_args")
    if not accepted:  # an item of a list without a class_path, which the parser takes for options of the base class
        option, accepted = option.split(".")[0], ["class_path", "init_args"]
    return UserError(f"unknown key {key}.{option}, {nearest(option, accepted)}")


def _accepted(text: str) -> list[str]:
    """Options of the class that the parser speaks of; none for a base class, which takes anything."""
    match = re.search(r"class_path='?([\w.]+)", text) or re.search(r"class_path '([\w.]+)'", text)
    if match is None:
        return []
    module, _, name = match[1].rpartition(".")
    signature = inspect.signature(getattr(importlib.import_module(module), name))
    return [word for word in signature.parameters if word not in ("spec", "width", "params", "args", "kwargs")]


def _unwrap(text: str) -> str:
    text = text.split(". Got value: Namespace(")[0]
    lines = [line.strip(" -") for line in text.splitlines() if line.strip()]
    return re.sub(r"Parser key \"[^\"]+\":\s*", "", lines[0] if len(lines) == 1 else " ".join(lines[:3]))
