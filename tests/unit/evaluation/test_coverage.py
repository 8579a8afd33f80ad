"""Coverage and visitation entropy by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from repdib_lightning.evaluation.coverage import covered, visitation_entropy


@pytest.mark.parametrize(
    ("visits", "share", "entropy"),
    [
        ([0, 1, 3, 0], 0.5, (0.25 * math.log(4) + 0.75 * math.log(4 / 3)) / math.log(4)),
        ([7, 0, 0, 0, 0], 0.2, 0.0),
        ([5, 5, 5], 1.0, 1.0),
        ([2, 2, 0, 0], 0.5, 0.5),
        ([1, 1, 2], 1.0, (0.5 * math.log(4) + 0.5 * math.log(2)) / math.log(3)),
    ],
)
def test_hand_values(visits, share, entropy):
    assert covered(np.array(visits)) == pytest.approx(share)
    found = visitation_entropy(np.array(visits))
    assert found == pytest.approx(entropy, abs=1e-12) and math.copysign(1, found) == 1


def test_entropy_hangs_on_shares_alone_and_grows_as_visits_even_out():
    visits = np.array([9, 1, 0, 4])
    assert visitation_entropy(visits) == pytest.approx(visitation_entropy(visits[[3, 2, 0, 1]] * 1000))
    values = [visitation_entropy(np.array([10 - k, k])) for k in range(6)]
    assert values == sorted(values) and values[0] == 0 and values[-1] == pytest.approx(1)
