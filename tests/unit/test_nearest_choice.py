"""The hint behind an unknown word."""

import pytest

from repdib_lightning.errors import nearest


@pytest.mark.parametrize(
    ("word", "choices", "hint"),
    [
        ("vibb", ["vq", "vib"], "did you mean 'vib'? (choices: vib, vq)"),
        ("xyz", ["vq", "vib"], "choices: vib, vq"),
        ("vibb", ["vib", "vq", "vib"], "did you mean 'vib'? (choices: vib, vq)"),
        ("xyz", [], ""),
        ("zzz", [f"a{index:02}" for index in range(20)], f"choices: {', '.join(f'a{i:02}' for i in range(12))}, ..."),
    ],
)
def test_a_hint_goes_on_behind_a_comma(word, choices, hint):
    assert nearest(word, choices) == hint
