"""Names of the values of categorical factors and actions, as a file states them."""

from __future__ import annotations

import json
from typing import Any


def stated_names(attributes: dict[str, Any], counts: dict[str, int]) -> dict[str, list[str]]:
    """Key -> one name for each of its values, where the attribute ``classes`` has one for each.

    What another program wrote there is passed over.

    Args:
        attributes: of the file.
        counts: categorical factor, or ``actions`` -> how many values it has.
    """
    try:
        stated = json.loads(str(attributes.get("classes", "{}")))
    except ValueError:
        return {}
    named = stated if isinstance(stated, dict) else {}
    return {
        key: [str(name) for name in named[key][:count]]
        for key, count in counts.items()
        if isinstance(named.get(key), list) and len(named[key]) >= count
    }
