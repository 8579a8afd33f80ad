"""Edits of a latent, one group of it at a time: zeroed, swapped between pictures, set to a code (paper, PACS)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.errors import UserError


@dataclass(frozen=True)
class GroupLayout:
    """Where the groups of a latent stand: (n, M) is (n, P, G, D), P positions of G groups of width D = M / (P G).

    Attributes:
        positions: P, 1 without a grid. groups: G, of each position.
    """

    positions: int
    groups: int

    def split(self, latents: np.ndarray) -> np.ndarray:
        """(n, M) as (n, P, G, D), without a copy."""
        return latents.reshape(len(latents), self.positions, self.groups, -1)

    def zeroed(self, latents: np.ndarray, group: int) -> np.ndarray:
        """(n, M) with one group set to 0, at all positions."""
        edited = latents.copy()
        self.split(edited)[:, :, group] = 0.0
        return edited

    def swapped(self, latents: np.ndarray, donors: np.ndarray, group: int) -> np.ndarray:
        """(n, M) with one group taken from donors (n, M)."""
        edited = latents.copy()
        self.split(edited)[:, :, group] = self.split(donors)[:, :, group]
        return edited

    def codes(self, codes: np.ndarray) -> np.ndarray:
        """Codes (n, P * G) of a quantised latent as (n, P, G), without a copy."""
        return codes.reshape(len(codes), self.positions, self.groups)


def layout_of(features: int, positions: int, groups: int, wanted: int | None) -> GroupLayout:
    """The groups of a latent of width M.

    Args:
        features: M. positions: P.
        groups: P * G of the bottleneck; 0 where nothing is quantised.
        wanted: G to cut an unquantised latent into; None for the bottleneck's own.

    Raises:
        UserError: no groups to speak of, other groups than the bottleneck's, or groups that do not divide the latent.
    """
    own = groups // positions
    if own and wanted not in (None, own):
        raise UserError(f"--groups {wanted}: this encoder quantises {own} groups; leave the option out")
    count = own or wanted
    if count is None:
        raise UserError("this encoder quantises nothing, so that it has no groups; cut its latent with --groups")
    width = features // positions
    if count < 1 or width % count:
        divisors = [str(divisor) for divisor in range(1, width + 1) if width % divisor == 0]
        raise UserError(f"--groups {count}: must divide the latent's width, {width} ({', '.join(divisors)})")
    return GroupLayout(positions, count)


def most_used(codes: np.ndarray, count: int) -> np.ndarray:
    """The most frequent of (n,) codes, most frequent first; fewer where fewer are used."""
    found, counts = np.unique(codes, return_counts=True)
    return found[np.argsort(-counts, kind="stable")][:count]
