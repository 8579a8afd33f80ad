"""Rows whose modality is missing neither train a bottleneck nor pass it, on one process and on several."""

from __future__ import annotations

import pytest
import torch
from small_clips import REPDIB, SPEC, clips, missing
from torch import distributed, multiprocessing
from torch.nn.parallel import DistributedDataParallel

from repdib_lightning.bottlenecks import RepDIB, VectorQuantiser
from repdib_lightning.encoders import MultimodalEncoder
from repdib_lightning.encoders.mean_picture import MeanPicture
from repdib_lightning.encoders.present_rows import pass_present
from repdib_lightning.encoders.running_standardisation import RunningStandardisation

M, STEPS = 6, 3
PRESENT = torch.tensor([1, 0, 1, 1, 0, 1, 1, 1]).bool()
SHARES = {"some": [[1, 0, 1, 1], [0, 1, 1, 1]], "one side": [[1, 1, 1, 1], [0, 0, 0, 0]], "none": [[0] * 4, [0] * 4]}


def build(kind=VectorQuantiser, **options):
    torch.manual_seed(0)
    return kind(M, groups=2, codes=3, start="random", start_step=0, decay=0.8, revive_after=2, **options)


def batch(step, count=8):
    return torch.randn(count, M, generator=torch.Generator().manual_seed(step))


def test_it_is_trained_by_the_rows_that_are_present_alone():
    ours, alone = build(RepDIB), build(RepDIB)
    for step in range(STEPS):
        torch.manual_seed(step)
        rows = batch(step).masked_fill(~PRESENT.unsqueeze(1), torch.nan)
        output = pass_present(ours, rows, PRESENT)
        torch.manual_seed(step)
        expected = alone(rows[PRESENT])
        assert torch.equal(output.latent[PRESENT], expected.latent) and (output.latent[~PRESENT] == 0).all()
        assert torch.equal(output.codes[PRESENT], expected.codes) and (output.codes[~PRESENT] == -1).all()
        assert output.losses == expected.losses and output.metrics == expected.metrics
    assert all(torch.equal(value, alone.state_dict()[name]) for name, value in ours.state_dict().items())


@pytest.mark.parametrize("kind", [VectorQuantiser, RepDIB])
def test_without_a_row_nothing_is_learned_and_nothing_left_out_of_the_graph(kind):
    bottleneck = build(kind, codebook="gradient")
    before = {name: value.clone() for name, value in bottleneck.state_dict().items()}
    rows, state = batch(0).requires_grad_(), torch.get_rng_state()
    output = pass_present(bottleneck, rows, torch.zeros(8, dtype=torch.bool))
    assert bottleneck.training and torch.equal(state, torch.get_rng_state())
    assert all(torch.equal(value, before[name]) for name, value in bottleneck.state_dict().items())
    assert (output.latent == 0).all() and (output.codes == -1).all() and not output.metrics
    assert output.losses and all(loss == 0 for loss in output.losses.values())
    (output.latent.sum() + sum(output.losses.values())).backward()
    assert all((parameter.grad == 0).all() for parameter in [rows, *bottleneck.parameters()])


def quantise(rank, name):
    """What one of two processes gets, with the gradients of the rows; ``rank`` None: one process with all rows."""
    quantiser, saved = build(), []
    torch.manual_seed(7)
    present = torch.tensor(SHARES[name]).bool()
    for step in range(STEPS):
        rows, mine = batch(step), present.flatten()
        if rank is not None:
            rows, mine = rows.chunk(2)[rank], present[rank]
        rows.requires_grad_()
        output = pass_present(quantiser, rows, mine)
        weights = torch.arange(rows.numel()).view_as(rows) + (rows.numel() if rank == 1 else 0)
        # A loss of this process is a mean over its rows; the mean over processes is the loss of all.
        ((output.latent * weights).sum() * (1 if rank is None else 2) + output.losses["commitment"]).backward()
        saved.append({"latent": output.latent.detach(), "codes": output.codes, "gradient": rows.grad,
                      "commitment": output.losses["commitment"].detach()})  # fmt: skip
    return {"steps": saved, "state": quantiser.state_dict()}


def train_distributed(rank):
    """A whole encoder under DistributedDataParallel as it comes, whose first process never sees cam2."""
    torch.manual_seed(0)
    options = {"width": 8, "features": 4, "modality_dropout": 0.2, "fusion": "weighting", **REPDIB}
    encoder = MultimodalEncoder(SPEC, modalities=["cam2", "gyroscope"], segments=2, **options)
    learner = DistributedDataParallel(Detailed(encoder))
    optimiser = torch.optim.SGD(encoder.parameters(), 0.1)
    torch.manual_seed(5)
    for step in range(4):
        inputs = clips(4, seed=2 * step + rank)
        if rank == 0 or step == 2:
            inputs["cam2"] = missing(inputs["cam2"])
        inputs["gyroscope"][: rank + 1] = torch.nan
        optimiser.zero_grad()
        learner(inputs).backward()
        optimiser.step()
    return {"encoder": encoder.state_dict(), "generator": torch.get_rng_state()}


class Detailed(torch.nn.Module):
    """The sum of everything that an encoder can be trained on."""

    def __init__(self, encoder):
        super().__init__()
        self.encoder = encoder

    def forward(self, observations):
        output = self.encoder.detailed(observations)
        return output.features.square().mean() + sum(output.losses.values())


def standardise(rank):
    """Rows of two batches as a process gets them, or one process all of them, and the state after these."""
    torch.manual_seed(3)
    module, seen = RunningStandardisation(3), []
    for _ in range(2):
        rows, observed = torch.randn(9, 3) * 4 + 9, torch.rand(9) < 0.6
        if rank is not None:
            rows, observed = rows.tensor_split([2])[rank], observed.tensor_split([2])[rank]
        seen.append(module(rows, observed))
    return {"seen": seen, "state": module.state_dict()}


def centre(rank):
    """Pictures of two batches, as :func:`standardise` has rows."""
    module, seen = MeanPicture((1, 2, 2)), []
    for seed in range(2):
        pictures = torch.randint(0, 256, (9, 1, 2, 2), generator=torch.Generator().manual_seed(seed)).byte()
        seen.append(module(pictures if rank is None else pictures.tensor_split([2])[rank]))
    return {"seen": seen, "state": module.state_dict()}


def one_of_two(rank, folder):
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    saved = {name: quantise(rank, name) for name in SHARES}
    torch.save(
        {**saved, **train_distributed(rank), "standardised": standardise(rank), "centred": centre(rank)},
        f"{folder}/{rank}.pt",
    )
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("present_rows")
    multiprocessing.spawn(one_of_two, args=(str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.mark.parametrize("name", SHARES)
def test_two_processes_train_on_what_one_would(both, name):
    alone = quantise(None, name)
    shares = [result[name] for result in both]
    for step, expected in enumerate(alone["steps"]):
        parts = [share["steps"][step] for share in shares]
        for key in ("latent", "codes"):
            torch.testing.assert_close(torch.cat([part[key] for part in parts]), expected[key])
        torch.testing.assert_close((parts[0]["commitment"] + parts[1]["commitment"]) / 2, expected["commitment"])
        gradients = torch.cat([part["gradient"] for part in parts]) / 2
        torch.testing.assert_close(gradients, expected["gradient"])
    for key, value in alone["state"].items():
        torch.testing.assert_close(shares[0]["state"][key], value)
        assert torch.equal(shares[0]["state"][key], shares[1]["state"][key])


@pytest.mark.parametrize(("name", "run"), [("standardised", standardise), ("centred", centre)])
def test_two_processes_standardise_as_one_would(both, name, run):
    alone, shares = run(None), [result[name] for result in both]
    for batch, expected in enumerate(alone["seen"]):
        torch.testing.assert_close(torch.cat([share["seen"][batch] for share in shares]), expected)
    for key, value in alone["state"].items():
        torch.testing.assert_close(shares[0]["state"][key], value)
        assert torch.equal(shares[0]["state"][key], shares[1]["state"][key])


def test_an_encoder_trains_alike_where_one_process_misses_a_modality(both):
    first, second = (result["encoder"] for result in both)
    for key, value in first.items():
        assert value.isfinite().all() and torch.equal(value, second[key]), key
    assert first["bottlenecks.each.cam2.quantiser.started"]
    assert torch.equal(both[0]["generator"], both[1]["generator"]), "what is drawn for all rows stays in step"
