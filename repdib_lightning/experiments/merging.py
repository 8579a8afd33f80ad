"""What several YAML files and dotted options say together, as the option parser reads them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Lay one tree over another: leaves and lists replace, mappings merge.

    A block that names another ``class_path`` keeps the ``init_args`` below it, because the parser keeps those of them
    that the new class takes too. Those that it drops stay in the tree: they may make one run look like two, but never
    two runs like one.
    """
    result = dict(below)
    for key, value in above.items():
        result[key] = _laid_over(result.get(key), value)
    return result


def with_option(tree: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Set one dotted key. Where the block has a class, ``data.path`` means ``data.init_args.path``."""
    first, _, rest = key.partition(".")
    inner = tree.get(first)
    if not rest:
        return {**tree, first: _laid_over(inner, value)}
    block = _as_block(inner) or {}
    short = "class_path" in block and rest.partition(".")[0] not in ("class_path", "init_args")
    return {**tree, first: with_option(block, f"init_args.{rest}" if short else rest, value)}


def _laid_over(old: Any, new: Any) -> Any:
    below, above = _as_block(old), _as_block(new)
    if below is None or above is None or not (isinstance(new, Mapping) or "class_path" in below):
        return new
    return merged(below, above) if isinstance(old, Mapping) or isinstance(new, Mapping) else new


def _as_block(value: Any) -> Mapping[str, Any] | None:
    """A class may be named by a word alone; None for what is neither a mapping nor a word."""
    if isinstance(value, str):
        return {"class_path": value}
    return value if isinstance(value, Mapping) else None
