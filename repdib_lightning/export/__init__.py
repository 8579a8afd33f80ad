"""Export: a frozen encoder as a folder of JSON and safetensors that needs neither Lightning nor pickle."""

from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_classifier, load_decoder, load_encoder
from repdib_lightning.export.run_export import export_run, write_model_description

__all__ = [
    "FrozenEncoder",
    "export_run",
    "load_classifier",
    "load_decoder",
    "load_encoder",
    "save_bundle",
    "write_model_description",
]
