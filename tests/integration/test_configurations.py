"""Every YAML under conf/ and every command of the README runs through the real entry point, on small data."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from killing import command_in_processes

from repdib_lightning.__main__ import VERBS, main
from repdib_lightning.configurations import packaged
from repdib_lightning.environments.collect import collect_robot_arm

ROOT = Path(__file__).parents[2]
SMALL = ["--data.batch_size", "8", "--trainer.max_steps", "3", "--trainer.val_check_interval", "2",
         "--trainer.limit_val_batches", "1", "--trainer.enable_progress_bar", "false"]  # fmt: skip
QUANTISER_AT_ONCE = ["--model.bottleneck.init_args.start_step", "1"]


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A short recording of the real arm at the real size."""
    path = tmp_path_factory.mktemp("arm") / "robot_arm.h5"
    return collect_robot_arm(path, samples=240, episode_length=24, workers=1, progress=False)


@pytest.fixture
def here(tmp_path, monkeypatch, recording):
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    shutil.copy(recording, "data/robot_arm.h5")
    shutil.copy(recording, "data/robot_arm_demo.h5")
    return tmp_path


@pytest.mark.parametrize("name", packaged())
def test_every_configuration_trains(here, name):
    overlay = [] if name == "robot_arm" else ["--config", name]
    assert main(["fit", "--config", "robot_arm", *overlay, *SMALL, "--run", "runs/x"]) == 0
    assert Path("runs/x/checkpoints/step-00000003.ckpt").is_file()
    written = {path.name for path in Path("runs/x").iterdir()}
    assert {"config.yaml", "status.json", "metrics.csv", "environment.json", "bundle.json"} <= written


def test_a_missing_recording_is_collected_first(here, recording, monkeypatch):
    asked = {}

    def collect(path, **options):
        asked.update(options)
        shutil.copy(recording, path)

    monkeypatch.setattr("repdib_lightning.environments.collect.collect_robot_arm", collect)
    Path("data/robot_arm.h5").unlink()
    assert main(["fit", *SMALL, "--run", "runs/x"]) == 0
    assert asked == {"samples": 14_000, "seed": 0}


def test_the_saved_configuration_is_the_whole_run(here):
    assert main(["fit", *SMALL, *QUANTISER_AT_ONCE, "--run", "runs/a"]) == 0
    assert main(["fit", "--config", "runs/a/config.yaml", "--run", "runs/b"]) == 0
    assert Path("runs/a/config.yaml").read_text() == Path("runs/b/config.yaml").read_text()
    assert Path("runs/a/metrics.csv").read_text() == Path("runs/b/metrics.csv").read_text()


def readme_commands() -> list[list[str]]:
    """Arguments of every ``python -m repdib_lightning`` line in the README, in order."""
    text = (ROOT / "README.md").read_text()
    lines = re.findall(r"python -m repdib_lightning ([^`\n]*)", text)
    return [line.split("#")[0].split() for line in lines]


def test_every_command_of_the_readme(here, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tests/unit/data/importers")
    from test_image_folder import write_csv, write_images
    from vd4rl_files import as_npz, record, write_npz

    for index in range(3):
        write_npz(Path("vd4rl_data/main/walker_walk/expert/64px"), index, as_npz(record(index, rows=12, size=64)))
    rows = 60
    names = write_images(Path("my_recording"), rows=rows, size=(32, 32))
    actions = [i % 5 for i in range(rows)]
    write_csv(Path("my_recording"), {"image": names, "action": actions, "episode": [i // 10 for i in range(rows)]})
    commands = readme_commands()
    assert {command[0] for command in commands} <= set(VERBS) and len(commands) >= 8
    for command in commands:
        small: list[str] = []
        if command[0] == "fit":
            small = SMALL if "--resume" not in command else ["--trainer.max_steps", "4"]
            if "bottleneck/none" not in command and "--resume" not in command:
                small = [*small, *QUANTISER_AT_ONCE]
        if "--trainer.devices" in command:
            assert command_in_processes(2, here, *command, *small) == [0, 0], (here / "output.txt").read_text()
        else:
            assert main([*command, *small]) == 0, command


def test_the_python_of_the_readme(here):
    assert main(["fit", *SMALL, *QUANTISER_AT_ONCE, "--run", "runs/demo/repdib"]) == 0
    assert main(["export", "runs/demo/repdib"]) == 0
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    import torch

    names = {view: torch.zeros(2, 3, 64, 64, dtype=torch.uint8) for view in ("front", "top")}
    exec(code, names)
    assert names["latent"].shape == (2, 128) and names["codes"].shape == (2, 8)


def test_make_targets_of_the_readme_exist():
    for target in re.findall(r"make ([a-z-]+)", (ROOT / "README.md").read_text()):
        dry = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
        assert dry.returncode == 0, dry.stderr


def test_help_is_quick_and_names_the_default_run():
    """CPU seconds of ``--help`` in a fresh interpreter: below half a second, however busy the machine is."""
    timer = "import resource, sys; from repdib_lightning.__main__ import main; main(['--help']);"
    timer += "usage = resource.getrusage(resource.RUSAGE_SELF); print(usage.ru_utime + usage.ru_stime)"
    result = subprocess.run([sys.executable, "-c", timer], capture_output=True, text=True, check=True)
    assert all(verb in result.stdout for verb in VERBS)
    assert float(result.stdout.splitlines()[-1]) < 0.5


def test_fit_help_opens_with_the_default_run(capsys):
    with pytest.raises(SystemExit) as ending:
        main(["fit", "--help"])
    opening = " ".join(capsys.readouterr().out.split())[:400]
    assert ending.value.code == 0
    assert "the default run: the simulated robot arm" in opening


def test_every_package_is_installed():
    """Packages are listed by hand in pyproject.toml, because conf/ is one of them."""
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "repdib_lightning").rglob("__init__.py")}
    assert listed == found | {"repdib_lightning.conf"}
