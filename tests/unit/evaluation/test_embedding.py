"""t-SNE maps: neighbours stay neighbours, and the map does not depend on the machine's number of threads."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from repdib_lightning.evaluation.embedding import tsne


@pytest.fixture
def clusters():
    generator = np.random.default_rng(0)
    centres = generator.normal(size=(3, 16)) * 5
    labels = np.arange(90) % 3
    return centres[labels] + generator.normal(size=(90, 16)) * 0.3, labels


def test_clusters_stay_apart(clusters):
    latents, labels = clusters
    plane = tsne(latents)
    distances = np.square(plane[:, None] - plane[None]).sum(-1)
    np.fill_diagonal(distances, np.inf)
    assert np.all(labels[distances.argmin(1)] == labels)


def test_the_map_is_the_same_with_any_number_of_threads(clusters):
    with threadpool_limits(1):
        one = tsne(clusters[0])
    with threadpool_limits(2):
        assert np.array_equal(tsne(clusters[0]), one)


def test_few_points_are_drawn_too():
    assert tsne(np.random.default_rng(0).normal(size=(4, 8)).astype(np.float32)).shape == (4, 2)
