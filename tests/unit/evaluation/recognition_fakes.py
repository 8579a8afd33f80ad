"""Encoders that read the activity off the clips of ``clip_stores``, and classifiers that pass on what they read."""

from __future__ import annotations

import torch
from clip_stores import ACTIVITIES
from torch import nn

from repdib_lightning.encoders.base import EncoderOutput
from repdib_lightning.evaluation.recognition_without import modalities_of
from repdib_lightning.records import DataSpec

SCALES = {"acceleration": 0.1, "gyroscope": 1.0, "orientation": 10.0}


class Reader(nn.Module):
    """One vote of each modality that it looks at for the activity that it shows; none where it is missing.

    Attention over modalities is shared among those that are there; over time it lies on the last step.
    """

    groups = 0

    def __init__(self, store, looks_at, activities=3):
        super().__init__()
        self.spec = DataSpec(dict(store.observations))
        self.looks_at, self.activities = looks_at, activities
        self.batches = []

    def detailed(self, observations):
        names = modalities_of(self.spec)
        self.batches.append({name: array.clone() for name, array in observations.items()})
        votes = torch.zeros(len(observations[names[0]]), self.activities)
        for name in self.looks_at:
            votes += self.read(name, observations[name])
        there = torch.stack([present(observations[name]) for name in names], 1).float()
        attention = {"modalities": there / there.sum(1, keepdim=True).clamp(min=1)}
        for name in names:
            attention[name] = nn.functional.one_hot(torch.full((len(votes),), 3), 4).float() * there[:, [0]]
        codes = {name: torch.where(present(observations[name]), 1, -1)[:, None] for name in self.looks_at}
        return EncoderOutput(votes, attention=attention, codes=codes)

    def encode(self, observations):
        return self.detailed(observations).features

    def read(self, name, array):
        told = told_by_view(array) if array.dim() == 5 else told_by_sensor(array, SCALES[name])
        return nn.functional.one_hot(told.clamp(0, self.activities - 1), self.activities) * present(array)[:, None]


def present(array):
    """(N, T, ...) to (N,) bool."""
    flat = array.flatten(1)
    return (flat != 0).any(1) if array.dtype == torch.uint8 else flat.isfinite().any(1)


def told_by_view(video):
    """The row of the bright bar."""
    return video.float().mean((1, 2, 4)).argmax(1) // max(1, video.shape[3] // len(ACTIVITIES))


def told_by_sensor(readings, scale):
    """The resting value of the first channel; whole oscillations have mean 0."""
    return (readings[:, :, 0].nanmean(1) / scale + 1.0).nan_to_num().round().long()


class Votes(nn.Module):
    """The votes are the logits; columns are in the order of the classes, wherever the encoder's activities stand."""

    def __init__(self, classes, target="activity", order=None):
        super().__init__()
        self.classes, self.target = tuple(classes), target
        self.order = [ACTIVITIES.index(name) for name in classes] if order is None else order

    def forward(self, latents):
        return latents[:, self.order]
