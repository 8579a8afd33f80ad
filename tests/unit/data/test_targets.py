"""What is to be recognised reaches every batch, from the file, from the device's memory and through workers."""

import numpy as np
import pytest
import torch
from clip_stores import ACTIVITIES, write_clips

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return str(write_clips(tmp_path_factory.mktemp("clips") / "clips.h5", evaluation=("4",)))


def opened(path, **options):
    data = EpisodeDataModule(path, **{"batch_size": 5, "futures": 0, "target": "activity"} | options)
    data.setup()
    return data


@pytest.mark.parametrize("options", [{}, {"resident": True}, {"workers": 1}, {"views": ["gyroscope"]}])
def test_targets_are_those_of_the_anchors(clips, options):
    data = opened(clips, **options)
    activities = data.store.array("factors/activity")
    for loader in (data.train_dataloader(), data.val_dataloader()):
        for batch in loader:
            assert batch.targets.dtype == torch.int64 and batch.targets.shape == (len(batch),)
            assert np.array_equal(batch.targets.numpy(), activities[batch.rows.numpy()])
    assert np.array_equal(data.example(3).targets, activities[data.example(3).rows])
    assert batch.pin_memory().targets is not None if torch.cuda.is_available() else True


def test_the_spec_names_the_classes_and_survives_json(clips):
    spec = opened(clips).spec
    assert spec.target == "activity" and spec.classes == ACTIVITIES[:3]
    assert DataSpec.from_dict(spec.to_dict()) == spec
    assert opened(clips, target="subject").spec.classes == ("1", "2", "3", "4")


def test_without_a_target_there_are_no_targets(clips):
    data = opened(clips, target="")
    assert data.spec.target == "" and data.spec.classes == ()
    assert next(iter(data.train_dataloader())).targets is None


def test_classes_without_names_are_numbers(store_file):
    data = opened(str(store_file), target="cell", futures=1, horizon=2)
    assert data.spec.classes == ("0", "1", "2", "3")
    batch = next(iter(data.train_dataloader()))
    assert np.array_equal(batch.targets, data.store.array("factors/cell")[batch.rows])


def test_a_target_changes_nothing_else(clips):
    with_target, without = (next(iter(opened(clips, target=t).train_dataloader())) for t in ("activity", ""))
    assert torch.equal(with_target.rows, without.rows)
    for name, array in with_target.observations.items():
        assert torch.equal(array.nan_to_num(-1.0), without.observations[name].nan_to_num(-1.0)), name


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("activty", r"data\.target: has no factor 'activty', did you mean 'activity'\?"),
        ("light", r"small\.h5: data\.target: factor 'light' is continuous, choices: cell"),
    ],
)
def test_bad_targets_are_one_line(clips, store_file, target, message):
    with pytest.raises(UserError, match=message) as error:
        opened(clips if target == "activty" else str(store_file), target=target, horizon=1)
    assert "\n" not in str(error.value)
