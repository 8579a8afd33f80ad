"""Recognition in the LightningModule: terms from inside the encoder, scores of the whole held-out set, schedules."""

from __future__ import annotations

import sys
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from sklearn.metrics import accuracy_score, confusion_matrix, f1_score
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).parents[1]))
from clip_encoders import TOLD, PlainClips
from clip_stores import write_clips

from repdib_lightning.bottlenecks import Identity, RepDIB
from repdib_lightning.callbacks.codebook_use import CodebookUse
from repdib_lightning.callbacks.confusion import Confusion, draw_confusion
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.objectives import Classification
from repdib_lightning.representation import RepresentationModule


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips") / "clips.h5", clips=44, size=8, evaluation=("3",))


def data_of(path, **options):
    data = EpisodeDataModule(str(path), **{"batch_size": 6, **options}, futures=0, target="activity")
    data.setup()
    return data


def module(bottleneck=lambda width: RepDIB(width, groups=2, codes=4, start="random", start_step=0), **options):
    torch.manual_seed(0)
    return RepresentationModule(PlainClips, bottleneck, Classification, **options)


def evaluated(model, data):
    """True and told classes of all held-out clips, one batch after the other."""
    model.eval()
    with torch.no_grad():
        pairs = [
            (
                batch.targets,
                model.objective.classifier(model({n: a[:, 0] for n, a in batch.observations.items()}).latent),
            )
            for batch in data.val_dataloader()
        ]
    model.train()
    return torch.cat([true for true, _ in pairs]), torch.cat([scores.argmax(1) for _, scores in pairs])


class Note(Callback):
    """Keeps the numbers of every validation, and what they should be."""

    def __init__(self):
        self.found, self.wanted, self.rates = [], [], []

    def on_validation_end(self, trainer, pl_module):
        if trainer.sanity_checking:
            return
        true, told = evaluated(pl_module, trainer.datamodule)
        averages = {f"val/f1_{kind}": f1_score(true, told, average=kind) for kind in ("macro", "micro", "weighted")}
        self.wanted.append({**averages, "val/accuracy": accuracy_score(true, told)})
        self.found.append({name: float(trainer.callback_metrics[name]) for name in self.wanted[-1]})
        table = confusion_matrix(true, told, labels=range(3))
        assert pl_module.tables["confusion"].tolist() == table.tolist()

    def on_train_batch_start(self, trainer, pl_module, *_):
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])


def fit(model, data, folder=None, callbacks=(), **options):
    trainer = pl.Trainer(
        **{"max_epochs": 4, "num_sanity_val_steps": 1, "log_every_n_steps": 2, **options},
        logger=False if folder is None else TensorBoardLogger(folder, name="", version=""),
        callbacks=list(callbacks),
        accelerator="cpu",
        enable_progress_bar=False,
        enable_checkpointing=False,
        enable_model_summary=False,
    )
    trainer.fit(model, datamodule=data)
    return trainer


def test_scores_are_those_of_the_whole_held_out_set_at_every_validation(path):
    data, note = data_of(path, batch_size=5, held_out={"subject": ["1", "2"]}), Note()
    assert len({len(batch) for batch in data.val_dataloader()}) > 1
    model = module(optimizer=lambda parameters: torch.optim.Adam(parameters, 1e-2))
    trainer = fit(model, data, callbacks=[note])
    assert len(note.found) == 4
    for found, wanted in zip(note.found, note.wanted, strict=True):
        assert found == pytest.approx(wanted, abs=1e-6)
    model.rehearse(data.example())
    (again,) = trainer.test(model, datamodule=data, verbose=False)
    assert {name: again[name.replace("val", "test")] for name in note.wanted[-1]} == pytest.approx(note.wanted[-1])
    assert again["test/loss"] == pytest.approx(float(trainer.callback_metrics["test/loss"]))


def test_it_learns_to_tell_the_activity_of_people_never_seen(path):
    data = data_of(path, held_out={"subject": ["4"]})
    model = module(Identity, optimizer=lambda parameters: torch.optim.Adam(parameters, 1e-2))
    trainer = fit(model, data, max_epochs=40, limit_val_batches=0)
    assert trainer.test(model, datamodule=data, verbose=False)[0]["test/f1_macro"] > 0.8


def test_terms_from_inside_the_encoder_join_those_of_the_bottleneck(path):
    data, model = data_of(path), module()
    model.build(data.spec).train()
    model.log = lambda *_, **__: None
    result = model.training_step(next(iter(data.train_dataloader())), 0)
    terms = result["terms"]
    assert set(terms) == {"classification", "kl", "commitment", "unimodal_kl", "unimodal_commitment"}
    wanted = terms["classification"] + 0.01 * (terms["kl"] + terms["unimodal_kl"])
    wanted = wanted + 0.25 * (terms["commitment"] + terms["unimodal_commitment"])
    torch.testing.assert_close(result["loss"].detach(), wanted)
    assert "unimodal_present" in model._evaluate(data.example()).metrics


def test_an_evaluation_changes_no_buffer(path):
    data, model = data_of(path), module()
    model.build(data.spec).train()._evaluate(data.example(6))
    before = {key: value.clone() for key, value in model.state_dict().items()}
    evaluated(model, data)
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())


def test_videos_are_shifted_in_training_only(path):
    model, video = module(shift=2), torch.randint(0, 256, (4, 3, 3, 8, 8), dtype=torch.uint8)
    assert torch.equal(model.eval()._augment(video), video)
    assert not torch.equal(model.train()._augment(video), video)
    readings = torch.randn(4, 20, 6)
    assert model._augment(readings) is readings


@pytest.mark.parametrize("interval", ["step", "epoch"])
def test_the_schedule_advances_when_it_is_told_to(path, interval):
    data, note = data_of(path), Note()
    model = module(
        Identity,
        optimizer=lambda parameters: torch.optim.SGD(parameters, 1.0),
        scheduler=lambda optimizer: torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5),
        scheduler_interval=interval,
    )
    fit(model, data, callbacks=[note], max_epochs=3, limit_val_batches=0)
    steps = len(note.rates) // 3
    assert steps > 1
    passed = range(3 * steps) if interval == "step" else [number // steps for number in range(3 * steps)]
    assert note.rates == [0.5**number for number in passed]


def test_tensorboard_shows_confusion_and_the_codes_of_each_modality(tmp_path, path):
    trainer = fit(module(), data_of(path), tmp_path, [CodebookUse(), Confusion()], max_epochs=2)
    for name in (*TOLD, "group_0"):
        assert 1.0 <= float(trainer.callback_metrics[f"val/perplexity/{name}"]) <= 5.0
        assert 1.0 <= float(trainer.callback_metrics[f"val/used/{name}"]) <= 5.0
    events = EventAccumulator(str(tmp_path), size_guidance={"images": 0}).Reload()
    assert [event.step for event in events.Images("confusion")] == [5, 10]


def test_what_is_right_is_dark_and_on_the_diagonal():
    counts = torch.diag(torch.tensor([9, 0, 3])).numpy()
    picture = draw_confusion(counts, "activity", ("run", "sit", "walk"))
    assert picture.ndim == 3 and picture.shape[2] == 3 and str(picture.dtype) == "uint8"
    dark = (picture.astype(int).sum(2) < 250) & (picture[:, :, 2] > 90)  # the darkest blue
    lines, columns = dark.any(1).nonzero()[0], dark.any(0).nonzero()[0]
    assert dark[lines[5], columns[5]] and dark[lines[-5], columns[-5]]
    assert not dark[lines[5], columns[-5]] and not dark[lines[-5], columns[5]]
