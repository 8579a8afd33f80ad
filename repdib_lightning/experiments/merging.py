"""What several YAML files and dotted options say together, as the option parser reads them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

REPLACED = "replaced"
"""Where a block keeps the block of another class that it replaced."""


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Lay one tree over another: leaves and lists replace, mappings merge.

    A block that names another ``class_path`` replaces the block below. That one is kept inside it, because the parser
    takes over those of its ``init_args`` that the new class has too: two trees that agree are the same run, whatever
    the classes accept.
    """
    result = dict(below)
    for key, value in above.items():
        result[key] = _laid_over(result.get(key), value)
    return result


def with_option(tree: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Set one dotted key. Where the block has a class, ``data.path`` means ``data.init_args.path``."""
    first, _, rest = key.partition(".")
    if key == "class_path":
        return _block_over(tree, {key: value})
    inner = tree.get(first)
    if not rest:
        return {**tree, first: _laid_over(inner, value)}
    block: Mapping[str, Any] = inner if isinstance(inner, Mapping) else {}
    if isinstance(inner, str):
        block = {"class_path": inner}
    short = "class_path" in block and rest.partition(".")[0] not in ("class_path", "init_args")
    return {**tree, first: with_option(block, f"init_args.{rest}" if short else rest, value)}


def _laid_over(old: Any, new: Any) -> Any:
    """A class may be named by a word instead of a block; any other word is a leaf."""
    if isinstance(old, str) and isinstance(new, Mapping):
        old = {"class_path": old}
    if isinstance(new, str) and isinstance(old, Mapping) and "class_path" in old:
        new = {"class_path": new}
    return _block_over(old, new) if isinstance(old, Mapping) and isinstance(new, Mapping) else new


def _block_over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    before = below.get("class_path")
    if before is not None and above.get("class_path", before) != before:
        return {**above, REPLACED: below}
    return merged(below, above)
