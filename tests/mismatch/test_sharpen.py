"""The pattern search from trials to points between them, and what is one neighbourhood."""

import numpy as np
import pytest

from det2stoc_bayes.mismatch.effects.attraction import UNIT
from det2stoc_bayes.mismatch.sharpen import MOST_STEPS, REACHES, sharpened, unlike


def hill(place):
    """Nats, most at (0.5, -0.2, 0.9)."""
    return -400.0 * float(((place - [0.5, -0.2, 0.9]) ** 2).sum())


def test_it_ends_near_the_top_of_a_smooth_hill():
    asked = []

    def about(place, reach):
        asked.append(reach)
        return [place + reach * d for d in UNIT]

    found = sharpened(np.zeros(3), about, hill)
    assert hill(found) > -1.5  # nats below the top; measured: 0.56
    assert sorted(set(asked), reverse=True) == list(REACHES) and len(asked) <= MOST_STEPS * len(REACHES)


def test_where_nothing_about_is_better_the_start_stays():
    top = np.array([0.5, -0.2, 0.9])
    assert sharpened(top, lambda place, reach: [place + reach * d for d in UNIT], hill) is top


def test_what_changes_predictions_alike_is_one_neighbourhood():
    changes = {"a": [1.0, 0.0], "like a": [3.0, 0.3], "other": [0.0, 1.0], "none": [0.0, 0.0], "last": [1.0, -1.0]}
    ranked = list(changes)
    assert unlike(ranked, lambda name: np.array(changes[name]), 3) == ["a", "other", "last"]
    assert unlike(ranked, lambda name: np.array(changes[name]), 1) == ["a"]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_is_turned_round_is_another_neighbourhood(sign):
    found = unlike(["a", "b"], lambda name: np.array([1.0, 0.0]) * (1.0 if name == "a" else sign), 2)
    assert found == (["a"] if sign > 0 else ["a", "b"])
