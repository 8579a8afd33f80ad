"""What may change when a run goes on, and what counts as a change."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from repdib_lightning.errors import UserError
from repdib_lightning.resuming import check_unchanged

RUN = {
    "seed_everything": 0,
    "model": {"bottleneck": {"class_path": "Identity", "init_args": {}}, "shift": 2},
    "data": {"class_path": "X", "init_args": {"path": "a.h5", "seed": 1}},
    "trainer": {"max_steps": 10},
}


def changed(**parts):
    return yaml.safe_dump({**RUN, **parts})


def test_a_class_without_options_is_the_same_with_and_without_an_empty_block():
    """The parser drops ``init_args: {}`` when it reads a saved configuration again."""
    bare = changed(model={"bottleneck": {"class_path": "Identity", "init_args": None}, "shift": 2})
    check_unchanged(Path("runs/x"), changed(), bare)
    check_unchanged(Path("runs/x"), bare, changed())


@pytest.mark.parametrize(
    "parts",
    [{"trainer": {"max_steps": 20}}, {"data": {"class_path": "X", "init_args": {"path": "moved/a.h5", "seed": 1}}}],
)
def test_steps_and_the_place_of_the_data_may_change(parts):
    check_unchanged(Path("runs/x"), changed(), changed(**parts))


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ({"seed_everything": 1}, "seed_everything was 0 and is 1 now"),
        ({"data": {"class_path": "X", "init_args": {"path": "a.h5", "seed": 2}}}, "data.init_args.seed was 1"),
        ({"model": {"bottleneck": {"class_path": "Other", "init_args": {}}, "shift": 2}}, "class_path was Identity"),
        (
            {"model": {"bottleneck": {"class_path": "Identity", "init_args": {"groups": 4}}, "shift": 2}},
            "init_args.groups was None and is 4 now",
        ),
    ],
)
def test_model_data_and_seed_may_not(parts, said):
    with pytest.raises(UserError) as caught:
        check_unchanged(Path("runs/x"), changed(), changed(**parts))
    assert said in str(caught.value)
