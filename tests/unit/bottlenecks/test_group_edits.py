"""Edits of groups, against loops over every row, position, group and dimension."""

from __future__ import annotations

import numpy as np
import pytest

from repdib_lightning.bottlenecks.group_edits import GroupLayout, layout_of, most_used
from repdib_lightning.errors import UserError

LAYOUTS = [(1, 2, 3), (4, 2, 3), (3, 4, 1), (1, 1, 6)]


def latents_of(positions, groups, width, seed=0, rows=5):
    return np.random.default_rng(seed).normal(size=(rows, positions * groups * width)).astype(np.float32)


def edited(latents, shape, group, value):
    """``value(row, index)`` where the group stands, by plain arithmetic on the flat index."""
    positions, groups, width = shape
    result = latents.copy()
    for row in range(len(latents)):
        for p in range(positions):
            for d in range(width):
                index = (p * groups + group) * width + d
                result[row, index] = value(row, index)
    return result


@pytest.mark.parametrize("shape", LAYOUTS)
def test_edits_are_those_of_slow_loops_and_leave_their_input_alone(shape):
    positions, groups, _ = shape
    layout = GroupLayout(positions, groups)
    latents, donors = latents_of(*shape), latents_of(*shape, seed=1)
    before, given = latents.copy(), donors.copy()
    for group in range(groups):
        zeros = edited(latents, shape, group, lambda row, index: 0.0)
        swapped = edited(latents, shape, group, lambda row, index: donors[row, index])
        np.testing.assert_array_equal(layout.zeroed(latents, group), zeros)
        np.testing.assert_array_equal(layout.swapped(latents, donors, group), swapped)
    np.testing.assert_array_equal(latents, before)
    np.testing.assert_array_equal(donors, given)


@pytest.mark.parametrize("shape", LAYOUTS)
def test_a_swap_with_itself_changes_nothing_and_all_swaps_give_the_donors(shape):
    positions, groups, _ = shape
    layout = GroupLayout(positions, groups)
    latents, donors = latents_of(*shape), latents_of(*shape, seed=1)
    swapped = latents
    for group in range(groups):
        np.testing.assert_array_equal(layout.swapped(latents, latents, group), latents)
        swapped = layout.swapped(swapped, donors, group)
    np.testing.assert_array_equal(swapped, donors)


@pytest.mark.parametrize("arrange", [np.asfortranarray, lambda a: a[::-1], lambda a: np.repeat(a, 2, axis=1)[:, ::2]])
def test_edits_do_not_depend_on_how_the_latents_lie_in_memory(arrange):
    layout, latents, donors = GroupLayout(2, 3), latents_of(2, 3, 2), latents_of(2, 3, 2, seed=1)
    odd, odd_donors = arrange(latents), arrange(donors)
    plain, plain_donors = np.ascontiguousarray(odd), np.ascontiguousarray(odd_donors)
    np.testing.assert_array_equal(layout.zeroed(odd, 1), layout.zeroed(plain, 1))
    np.testing.assert_array_equal(layout.swapped(odd, odd_donors, 1), layout.swapped(plain, plain_donors, 1))
    assert layout.zeroed(odd, 1).any()


def test_one_donor_may_serve_all_rows():
    layout, latents = GroupLayout(1, 2), latents_of(1, 2, 2)
    donor = np.broadcast_to(latents[3], latents.shape)
    swapped = layout.swapped(latents, donor, 1)
    assert (swapped[:, 2:] == latents[3, 2:]).all() and (swapped[:, :2] == latents[:, :2]).all()


def test_codes_stand_position_by_position_and_can_be_set_in_place():
    layout, codes = GroupLayout(3, 2), np.arange(12).reshape(2, 6)
    assert layout.codes(codes)[1, 2].tolist() == [10, 11] and layout.codes(codes).shape == (2, 3, 2)
    layout.codes(codes)[:, :, 1] = -1
    assert codes[0].tolist() == [0, -1, 2, -1, 4, -1]


@pytest.mark.parametrize(
    ("features", "positions", "groups", "wanted", "found"),
    [
        (32, 1, 2, None, (1, 2)),
        (32, 1, 2, 2, (1, 2)),
        (32, 1, 0, 4, (1, 4)),
        (64, 4, 8, None, (4, 2)),
        (64, 4, 0, 8, (4, 8)),
        (3, 1, 0, 3, (1, 3)),
        (3, 1, 0, 1, (1, 1)),
    ],
)
def test_the_groups_are_the_bottlenecks_own_or_those_wanted(features, positions, groups, wanted, found):
    assert layout_of(features, positions, groups, wanted) == GroupLayout(*found)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((32, 1, 2, 4), "--groups 4: this encoder quantises 2 groups; leave the option out"),
        ((64, 4, 8, 8), "--groups 8: this encoder quantises 2 groups"),
        ((32, 1, 2, 0), "--groups 0: this encoder quantises 2 groups"),
        ((32, 1, 0, None), "quantises nothing, so that it has no groups; cut its latent with --groups"),
        ((12, 1, 0, 5), r"--groups 5: must divide the latent's width, 12 \(1, 2, 3, 4, 6, 12\)"),
        ((64, 4, 0, 32), r"--groups 32: must divide the latent's width, 16"),
        ((12, 1, 0, 0), "--groups 0: must divide"),
        ((12, 1, 0, -2), "--groups -2: must divide"),
    ],
)
def test_groups_that_cannot_be_are_refused_in_one_line(given, message):
    with pytest.raises(UserError, match=message) as error:
        layout_of(*given)
    assert "\n" not in str(error.value)


def test_most_used_codes_come_first_and_ties_by_number():
    codes = np.array([7, 2, 7, 9, 2, 7, 4])
    assert most_used(codes, 3).tolist() == [7, 2, 4]
    assert most_used(codes, 10).tolist() == [7, 2, 4, 9]
