"""One file for each foreign format; each importer is a function that streams it into a store.

``IMPORTERS`` maps the name of a format to ``module:function``, imported when it is used. Every function takes
``(source, output, *, overwrite, progress, ...)`` and returns the output.
"""

from __future__ import annotations

IMPORTERS: dict[str, str] = {
    "vd4rl": "repdib_lightning.data.importers.vd4rl:import_vd4rl",
    "images": "repdib_lightning.data.importers.image_folder:import_images",
    "pacs": "repdib_lightning.data.importers.pacs:import_pacs",
    "mmact": "repdib_lightning.data.importers.mmact:import_mmact",
    "smartwatch": "repdib_lightning.data.importers.smartwatch:import_smartwatch",
    "dqn_replay": "repdib_lightning.data.importers.dqn_replay:import_dqn_replay",
    "store": "repdib_lightning.data.importers.repack:import_store",
}
