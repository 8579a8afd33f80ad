"""Merging of configurations and options, beside what the option parser makes of the same words."""

from dataclasses import dataclass

import pytest
import yaml
from jsonargparse import ArgumentParser

from repdib_lightning.experiments.merging import REPLACED, merged, with_option


def test_leaves_and_lists_replace_and_mappings_merge():
    below = {"a": {"b": 1, "c": [1, 2], "d": {"e": 5}}, "f": 6}
    assert merged(below, {"a": {"b": 2, "c": [3]}, "g": 7}) == {
        "a": {"b": 2, "c": [3], "d": {"e": 5}},
        "f": 6,
        "g": 7,
    }
    assert below == {"a": {"b": 1, "c": [1, 2], "d": {"e": 5}}, "f": 6}
    assert merged({"a": {"b": 1}}, {"a": None}) == {"a": None}
    assert merged({"a": 1}, {"a": {"b": 1}}) == {"a": {"b": 1}}
    assert merged({"a": {"b": 1}, "c": "x"}, {"a": "word", "c": "y"}) == {"a": "word", "c": "y"}


def test_another_class_replaces_the_block_and_keeps_what_it_replaced_apart():
    below = {"class_path": "A", "init_args": {"x": 1, "y": 2}}
    assert merged({"k": below}, {"k": {"class_path": "A", "init_args": {"x": 3}}})["k"]["init_args"] == {"x": 3, "y": 2}
    assert merged({"k": below}, {"k": {"init_args": {"x": 3}}})["k"]["init_args"] == {"x": 3, "y": 2}
    other = {"class_path": "B", "init_args": {"x": 3}}
    found = merged({"k": below}, {"k": other})["k"]
    assert found.pop(REPLACED) == below and found == other


class Tool:
    pass


class Hammer(Tool):
    def __init__(self, weight: int = 1, handle: int = 1):
        pass


class Axe(Tool):
    def __init__(self, weight: int = 2, edge: int = 2):
        pass


class Saw(Tool):
    def __init__(self, teeth: int = 3):
        pass


@dataclass
class Parsed:
    kind: str
    options: dict


def parsed(*texts, options=()):
    """What the option parser makes of configurations and options, all defaults filled in."""
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--cfg", action="config")
    parser.add_argument("--tool", type=Tool)
    tool = parser.parse_args([*(f"--cfg={text}" for text in texts), *options]).tool
    return Parsed(tool.class_path.rpartition(".")[2], tool.init_args.as_dict())


def together(*texts, options=()):
    tree = {}
    for text in texts:
        tree = merged(tree, yaml.safe_load(text))
    for option in options:
        key, _, value = option.removeprefix("--").partition("=")
        tree = with_option(tree, key, yaml.safe_load(value))
    return tree


def tool(name, **init_args):
    return yaml.safe_dump({"tool": {"class_path": f"{__name__}.{name}", "init_args": init_args}})


HEAVY, LIGHT, BARE_AXE = tool("Hammer", weight=9), tool("Hammer", weight=3), tool("Axe")
BY_WORD = f"--tool={__name__}.Axe"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        # The parser keeps what the new class takes too, so these are two runs.
        (((HEAVY, BARE_AXE), ()), ((LIGHT, BARE_AXE), ())),
        (((HEAVY,), (BY_WORD,)), ((LIGHT,), (BY_WORD,))),
        (((HEAVY,), (f"--tool.class_path={__name__}.Axe",)), ((LIGHT,), (f"--tool.class_path={__name__}.Axe",))),
        # A class between them that does not take it loses it.
        (((HEAVY, BARE_AXE), ()), ((HEAVY, tool("Saw"), BARE_AXE), ())),
        (((HEAVY, tool("Saw"), tool("Axe", weight=9)), ()), ((HEAVY, tool("Saw"), BARE_AXE), ())),
        # The class is given first, its options after it.
        (((LIGHT,), (BY_WORD, "--tool.weight=7")), ((LIGHT,), ("--tool.weight=7",))),
        (((), (BY_WORD, "--tool.weight=7")), ((), (f"--tool={__name__}.Hammer", "--tool.weight=7"))),
        (((f"tool: {__name__}.Axe", "tool: {init_args: {weight: 7}}"), ()), ((LIGHT,), ("--tool.weight=7",))),
    ],
)
def test_two_runs_are_never_taken_for_one(first, second):
    found = [parsed(*configs, options=options) for configs, options in (first, second)]
    assert found[0] != found[1]
    assert together(*first[0], options=first[1]) != together(*second[0], options=second[1])


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (((HEAVY, LIGHT), ()), ((LIGHT,), ())),
        (((HEAVY,), ("--tool.weight=3",)), ((LIGHT,), ())),
        (((HEAVY,), ("--tool.init_args.weight=3",)), ((LIGHT,), ())),
        (((tool("Axe", weight=7),), ()), ((f"tool: {__name__}.Axe", "tool: {init_args: {weight: 7}}"), ())),
        (((HEAVY, f"tool: {__name__}.Axe"), ("--tool.weight=3",)), ((HEAVY,), (BY_WORD, "--tool.weight=3"))),
        (((HEAVY, BARE_AXE), ()), ((HEAVY,), (f"--tool.class_path={__name__}.Axe", "--tool.init_args={}"))),
    ],
)
def test_one_run_that_is_said_in_two_ways_is_one(first, second):
    assert parsed(*first[0], options=first[1]) == parsed(*second[0], options=second[1])
    assert together(*first[0], options=first[1]) == together(*second[0], options=second[1])


def test_dotted_keys_find_init_args_of_a_class_and_only_of_a_class():
    tree = {"data": {"class_path": "A", "init_args": {"path": "x", "deep": {"class_path": "B"}}}, "trainer": {"n": 1}}
    assert with_option(tree, "data.path", "y")["data"]["init_args"]["path"] == "y"
    assert with_option(tree, "data.init_args.path", "y") == with_option(tree, "data.path", "y")
    assert with_option(tree, "data.deep.k", 3)["data"]["init_args"]["deep"]["init_args"] == {"k": 3}
    for key in ("data", "data.class_path"):
        assert with_option(tree, key, "C")["data"] == {"class_path": "C", REPLACED: tree["data"]}
    assert with_option(tree, "trainer.n", 2)["trainer"] == {"n": 2}
    assert with_option({}, "a.b.c", 1) == {"a": {"b": {"c": 1}}}
    assert tree["data"]["init_args"]["path"] == "x"
