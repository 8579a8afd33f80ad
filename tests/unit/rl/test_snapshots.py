"""Snapshots: a bundle and an agent come back as they were, and are found by frames."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from small_trainings import WIDTH, copied, make_bundle, pictures, quantiser, spec

from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.rl.exploration.ddpg import DDPG
from repdib_lightning.rl.exploration.snapshots import (
    AGENT,
    find_snapshot,
    read_agent,
    snapshot_folder,
    snapshots_of,
    write_snapshot,
)

FACTS = {"task": "walker-stand", "frames": 40, "image_size": 20, "hidden": 6, "features": WIDTH, "actions": 3}


def parts(seed=0):
    """Trained parts: running codebooks that have moved, a target that is not the critic."""
    torch.manual_seed(seed)
    encoder, bottleneck = ConvolutionalEncoder(spec(), features=WIDTH, channels=4, strides=[3, 2]), quantiser()
    with torch.no_grad():
        bottleneck.train()(encoder({"picture": pictures(16)}))
    agent = DDPG(WIDTH, 3, hidden=6)
    for parameter in agent.target.parameters():
        parameter.data += 1.0
    return encoder.train(), bottleneck, agent


def write(run, frames, made=None, **facts):
    folder = snapshot_folder(run, frames)
    training = {"objective": "Prototypes", "run": run.name, "frames": frames}
    return write_snapshot(
        folder, *(made or parts()), training=training, data={"file": "replay.h5"}, facts={**FACTS, **facts}
    )


def test_what_a_killed_run_left_of_a_snapshot_goes_with_the_next_one_there(tmp_path):
    beside = snapshot_folder(tmp_path, 40)
    left, other = beside.with_name(f".{beside.name}.tmp-1"), beside.with_name(".frames-000000080.tmp-1")
    for folder in (left, other):
        folder.mkdir(parents=True)
        (folder / AGENT).write_bytes(b"half")
    write(tmp_path, 40)
    assert sorted(path.name for path in beside.parent.iterdir()) == sorted([other.name, beside.name])


def test_the_bundle_encodes_as_the_parts_do_at_rest(tmp_path):
    made = parts()
    before = copied(made[0]) | copied(made[1])
    loaded = load_encoder(write(tmp_path, 40, made))
    assert made[0].training and made[1].training, "training goes on"
    assert all(torch.equal(before[name], value) for part in made[:2] for name, value in part.state_dict().items())
    seen = {"picture": pictures(5, seed=3)}
    with torch.no_grad():
        output = made[1].eval()(made[0].eval()(seen))
    torch.testing.assert_close(loaded.encode(seen), output.latent)
    assert torch.equal(loaded.codes(seen), output.codes) and loaded.features == WIDTH
    assert json.loads((tmp_path / "snapshots/frames-000000040/config.json").read_text())["training"]["frames"] == 40


def test_the_agent_comes_back_tensor_by_tensor(tmp_path):
    made = parts()
    found = read_agent(write(tmp_path, 40, made, distractors="none", quality="fast"))
    wanted = made[2].state_dict()
    assert found.tensors.keys() == wanted.keys()
    assert all(torch.equal(value, wanted[name]) for name, value in found.tensors.items())
    assert found.facts == FACTS | {"distractors": "none", "quality": "fast"}
    again = DDPG(WIDTH, 3, hidden=found.facts["hidden"])
    for name, part in again.named_children():
        part.load_state_dict(found.part(f"{name}."))
    seen = torch.randn(4, WIDTH)
    assert torch.equal(again.act(seen), made[2].act(seen)) and torch.equal(again.values(seen), made[2].values(seen))
    assert not torch.equal(found.part("target.")["first.0.bias"], found.part("critic.")["first.0.bias"])


def test_what_is_on_another_device_or_in_other_memory_is_written_too(tmp_path):
    made = parts()
    made[2].actor.network[0].weight.data = made[2].actor.network[0].weight.data.T.contiguous().T
    found = read_agent(write(tmp_path, 40, made)).part("actor.")
    assert torch.equal(found["network.0.weight"], made[2].actor.network[0].weight)


def test_snapshots_are_found_by_frames_and_the_newest_without(tmp_path):
    run = tmp_path / "run"
    for frames in (40, 1_000_000_000, 5):
        write(run, frames)
    (run / "snapshots" / "notes").mkdir()
    assert list(snapshots_of(run)) == [5, 40, 1_000_000_000]
    assert find_snapshot(run) == find_snapshot(run, 1_000_000_000) == snapshot_folder(run, 1_000_000_000)
    assert find_snapshot(run, 40) == run / "snapshots/frames-000000040"
    with pytest.raises(UserError, match=re.escape(f"--snapshot 41: not in {run}, which has 5, 40, 1000000000")):
        find_snapshot(run, 41)


def test_a_folder_of_a_snapshot_or_a_bundle_or_an_exported_run_stands_for_itself(tmp_path):
    folder = write(tmp_path / "run", 40)
    assert find_snapshot(folder) == folder
    with pytest.raises(UserError, match=r"--snapshot 40: not in .*frames-000000040, which has none"):
        find_snapshot(folder, 40)
    plain = make_bundle(tmp_path / "plain")
    assert find_snapshot(plain) == plain and read_agent(plain) is None
    make_bundle(tmp_path / "exported" / "bundle")
    assert find_snapshot(tmp_path / "exported") == tmp_path / "exported" / "bundle"
    assert find_snapshot(tmp_path / "nowhere") == tmp_path / "nowhere"
    with pytest.raises(UserError, match=r"--snapshot 40: not in .*nowhere, which has none"):
        find_snapshot(tmp_path / "nowhere", 40)


def test_a_later_one_replaces_an_earlier_one_whole(tmp_path):
    write(tmp_path, 40, parts(0))
    folder, made = None, parts(1)
    for _ in range(2):
        folder = write(tmp_path, 40, made, task="walker-run")
    assert read_agent(folder).facts["task"] == "walker-run"
    assert torch.equal(read_agent(folder).part("actor.")["network.4.bias"], made[2].actor.network[4].bias)
    assert sorted(os.listdir(folder)) == ["agent.safetensors", "config.json", "model.safetensors"]


class Killed(BaseException):
    pass


@pytest.mark.parametrize("earlier", [False, True])
def test_one_that_was_being_written_when_the_process_died_is_no_snapshot(tmp_path, monkeypatch, earlier):
    """At every renaming: what is found is whole, of one moment, or is not found."""
    renamed = os.replace, os.rename
    kinds = set()
    for step in range(20):
        run = tmp_path / str(step)
        write(run, 5, parts(3))
        if earlier:
            write(run, 40, parts(0), task="before")
        count = iter(range(step + 1))

        def dying(*arguments, real=renamed[0], count=count, step=step):
            if next(count) == step:
                raise Killed
            return real(*arguments)

        ended = True
        with monkeypatch.context() as patched:
            for name in ("replace", "rename"):
                patched.setattr(os, name, dying)
            try:
                write(run, 40, parts(1), task="after")
            except Killed:
                ended = False
        there = snapshots_of(run)
        if 40 in there:
            agent, encoder = read_agent(there[40]), load_encoder(there[40])
            assert agent is not None, step
            of = {"before": 0, "after": 1}[agent.facts["task"]]
            wanted = parts(of)[0].eval()
            assert torch.equal(encoder.encoder({"picture": pictures(2)}), wanted({"picture": pictures(2)}))
        kinds.add((40 in there, ended))
        write(run, 40, parts(1), task="after")  # and may be written again
        assert read_agent(snapshot_folder(run, 40)).facts["task"] == "after"
        if ended:
            break
    assert (True, True) in kinds and step >= 2


def damaged(folder, how):
    path = folder / AGENT
    content = path.read_bytes()
    tensors = {"actor.x": torch.zeros(2)}
    if how == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "header":
        path.write_bytes(content[:8] + b"}" + content[9:])
    else:
        facts = {"no facts": None, "no object": {"agent": "[1]"}, "no JSON": {"agent": "{"}}
        without = {"agent": json.dumps({key: value for key, value in FACTS.items() if key != "hidden"})}
        odd = {"agent": json.dumps(FACTS | {"hidden": "many"})}
        save_file(tensors, path, (facts | {"no hidden": without, "odd hidden": odd})[how])
    return folder


@pytest.mark.parametrize(
    "how", ["cut", "empty", "header", "no facts", "no object", "no JSON", "no hidden", "odd hidden"]
)
def test_a_damaged_agent_is_one_line(tmp_path, how):
    folder = damaged(write(tmp_path, 40), how)
    with pytest.raises(UserError, match=r"agent\.safetensors: not the agent of a snapshot \(.+\)$") as caught:
        read_agent(folder)
    assert "\n" not in str(caught.value)
    assert load_encoder(folder).features == WIDTH  # the bundle is as good as before


def test_a_broken_encoder_is_refused_and_nothing_is_left(tmp_path):
    made = parts()
    made[0].load_state_dict({name: value * float("nan") for name, value in made[0].state_dict().items()})
    with pytest.raises(UserError, match="not finite"):
        write(tmp_path, 40, made)
    assert snapshots_of(tmp_path) == {}


@pytest.mark.parametrize("full_at", ["model.safetensors", AGENT])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, full_at):
    real = Path.write_bytes

    def write_bytes(path, content):
        if path.name == full_at:
            real(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(path, content)

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    with pytest.raises(UserError, match=r"cannot be written \(No space left on device\)"):
        write(tmp_path, 40)
    assert os.listdir(tmp_path / "snapshots") == []
