"""What several YAML files and dotted options say together, as the option parser reads them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeGuard


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Lay one tree over another: leaves and lists replace, mappings merge.

    A block that names another ``class_path`` replaces the whole block below it, whose ``init_args`` are another
    class's.
    """
    result = dict(below)
    for key, value in above.items():
        old = result.get(key)
        result[key] = merged(old, value) if _is_mapping(old) and _same_class(old, value) else value
    return result


def _is_mapping(value: Any) -> TypeGuard[Mapping[str, Any]]:
    return isinstance(value, Mapping)


def _same_class(old: Mapping[str, Any], new: Any) -> bool:
    return _is_mapping(new) and bool(new.get("class_path", old.get("class_path")) == old.get("class_path"))


def with_option(tree: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Set one dotted key. Where the block has a class, ``data.path`` means ``data.init_args.path``."""
    first, _, rest = key.partition(".")
    if not rest:
        return {**tree, first: value}
    inner = tree.get(first)
    block: Mapping[str, Any] = inner if isinstance(inner, Mapping) else {}
    short = "class_path" in block and rest.partition(".")[0] not in ("class_path", "init_args")
    return {**tree, first: with_option(block, f"init_args.{rest}" if short else rest, value)}
