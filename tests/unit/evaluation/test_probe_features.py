import numpy as np
import pytest
import torch
from evaluation_fakes import LENGTH, FakeEncoder, cell_and_video_codes, cell_encoder, write_store

from repdib_lightning.devices import resolve_device
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.features import check_compatible, encode_rows
from repdib_lightning.records import ArraySpec, DataSpec


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("features") / "a.h5", episodes=4, evaluation=2)


def test_rows_come_back_in_order_whatever_the_batch_size(store):
    rows = np.array([5, 3, 200, 3, 17])
    latents, codes = encode_rows(cell_and_video_codes(), store, rows, batch_size=2, progress=False)
    assert latents.dtype == np.float32
    assert latents.argmax(1).tolist() == store.gather("factors/cell", rows).tolist()
    assert codes[:, 1].tolist() == store.gather("factors/video", rows).tolist()


def test_no_codes_without_groups(store):
    assert encode_rows(cell_encoder(), store, np.arange(4), progress=False)[1] is None


def test_frames_are_stacked_oldest_first_and_never_across_an_episodes_start(store):
    encoder = FakeEncoder(9, lambda sensor: sensor, frame_stack=3)
    latents, _ = encode_rows(encoder, store, np.array([LENGTH, LENGTH + 1, LENGTH + 5]), progress=False)
    steps = latents.reshape(3, 3, 3)[:, :, 1]
    assert steps.tolist() == [[60, 60, 60], [60, 60, 61], [63, 64, 65]]


def test_an_encoder_that_returns_nan_is_reported_with_its_row(store):
    encoder = FakeEncoder(1, lambda sensor: torch.where(sensor[:, 1:2] == 7, torch.nan, 0.0))
    with pytest.raises(UserError, match=r"a\.h5.*NaN or infinite values at row 7"):
        encode_rows(encoder, store, np.arange(20), progress=False)


def test_a_wrong_shape_names_bundle_data_and_both_shapes(store):
    encoder = cell_encoder()
    encoder.spec = DataSpec({"front": ArraySpec((3, 64, 64))})
    with pytest.raises(UserError, match=r"a\.h5.*'front' is 3x16x16 uint8, runs/x was trained on 3x64x64 uint8"):
        check_compatible(encoder, store, "runs/x")
    encoder.spec = DataSpec({"front": ArraySpec((6, 16, 16))}, frame_stack=2)
    check_compatible(encoder, store)
    encoder.spec = DataSpec({"front": ArraySpec((6, 16, 16))}, frame_stack=1)
    with pytest.raises(UserError, match="3x16x16"):
        check_compatible(encoder, store)


def test_a_missing_observation_names_the_nearest(store):
    encoder = cell_encoder()
    encoder.spec = DataSpec({"frond": ArraySpec((3, 16, 16))})
    with pytest.raises(UserError, match=r"no observation 'frond', which runs/x was trained on, did you mean 'front'"):
        check_compatible(encoder, store, "runs/x")


def test_an_unknown_device_is_a_user_error():
    assert resolve_device("cpu") == torch.device("cpu")
    with pytest.raises(UserError, match="device 'gpu' cannot be used"):
        resolve_device("gpu")
