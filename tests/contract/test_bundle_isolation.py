"""Loading a bundle needs neither Lightning nor pickle, and imports nothing that a bundle names."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import torch

from repdib_lightning.bottlenecks import VectorQuantiser
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.export import save_bundle
from repdib_lightning.records import ArraySpec, DataSpec

PROGRAM = """
import importlib.abc, pickle, sys

class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("lightning", "pytorch_lightning", "jsonargparse", "h5py", "mujoco"):
            raise AssertionError("imported " + name)

sys.meta_path.insert(0, Refuse())
import torch
from repdib_lightning.export import load_encoder

def refuse(*args, **kwargs):
    raise AssertionError("unpickled")

torch.load = torch.serialization.load = pickle.load = pickle.loads = pickle.Unpickler = refuse
frozen = load_encoder(sys.argv[1])
latent, codes = frozen.encode_with_codes(torch.zeros(2, 3, 12, 12, dtype=torch.uint8))
assert latent.shape == (2, 8) and codes.shape == (2, 2)
assert not any(name.split(".")[0] in ("lightning", "pytorch_lightning") for name in sys.modules)
print("fine")
"""


def test_no_lightning_and_no_pickle(tmp_path: Path) -> None:
    encoder = ConvolutionalEncoder(DataSpec({"front": ArraySpec((3, 12, 12))}), features=8, channels=2, strides=[2])
    bottleneck = VectorQuantiser(8, groups=2, codes=3, start_step=1)
    for _ in range(3):
        bottleneck(torch.randn(20, 8))
    save_bundle(tmp_path / "bundle", encoder, bottleneck, training={}, data={})
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "bundle")], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and done.stdout == "fine\n", done.stderr
