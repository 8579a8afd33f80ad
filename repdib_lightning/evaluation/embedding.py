"""Latents in two dimensions, for the eye: t-SNE (van der Maaten and Hinton, 2008), by scikit-learn."""

from __future__ import annotations

import numpy as np

PERPLEXITY = 30.0


def tsne(latents: np.ndarray, seed: int = 0) -> np.ndarray:
    """(n, M) latents to an (n, 2) map in which near neighbours stay near; n of at least 3.

    Started from the first two principal components, so that the large-scale layout means something. Dimensions keep
    their scale, as the objective and the quantiser see them. On one thread, since more would round differently.
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    perplexity = min(PERPLEXITY, (len(latents) - 1) / 3.0)
    with threadpool_limits(1):
        return np.asarray(TSNE(2, perplexity=perplexity, init="pca", random_state=seed).fit_transform(latents))
