"""What is told of pictures that are no whole factorial."""

from pathlib import Path

import pytest

from repdib_lightning.data.importers.combinations import notes_on_combinations
from repdib_lightning.data.importers.picture_folders import Picture

NAMES = ("style", "species")


def pictures(*cells):
    return [Picture(*cell.split("/"), Path("a.png")) for cell in cells]


@pytest.mark.parametrize(
    ("cells", "told"),
    [
        (("ink/ant", "ink/crab", "oil/ant", "oil/crab"), []),
        (("oil/crab", "ink/ant", "ink/ant"), ["2 of 4 combinations have no picture: ink/crab, oil/ant"]),
        (("a/x", "b/y", "c/z"), ["6 of 9 combinations have no picture: a/y, a/z, b/x, ..."]),
        (("ink/ant", "ink/crab"), ["'style' is always 'ink': nothing can be measured of it"]),
        (("ink/ant", "oil/ant"), ["'species' is always 'ant': nothing can be measured of it"]),
    ],
)
def test_each_lack_is_a_line(cells, told):
    assert notes_on_combinations(pictures(*cells), NAMES) == told
