"""Shares of the held-out error, over all recordings and in each."""

from dataclasses import replace

import numpy as np
import pytest

from det2stoc_bayes.mismatch.heldout import HeldOut
from det2stoc_bayes.mismatch.shares import excess_beyond_chance, share_explained, shares_by_recording


def scores(*chi2):
    """Recordings of 100 values with these squared errors."""
    count = len(chi2)
    names, nothing = tuple(f"run_{i}" for i in range(count)), np.zeros((count, 1))
    return HeldOut(names, None, np.zeros(count), np.array(chi2, float), np.full(count, 100.0), nothing, nothing, {})


def test_shares_of_the_whole():
    believed, base, better = scores(1100, 1100), scores(600, 1100), scores(100, 600)
    assert excess_beyond_chance(believed) == 2000
    assert share_explained(believed, base, better) == pytest.approx(0.5)
    assert excess_beyond_chance(scores(110, 105)) == 0.0 == share_explained(scores(110, 105), scores(110), scores(90))


def test_each_recording_by_itself():
    """All of it; a part, the rest unexplained; chance; next to nothing of a large error; worse; more left than gone."""
    believed = scores(1100, 1100, 112, 100_100, 600, 1100)
    better = scores(100, 500, 100, 98_100, 1100, 800)
    found = shares_by_recording(believed, believed, better)
    assert [s.kind for s in found] == ["explained", "explained", "negligible", "negligible", "uncertain", "uncertain"]
    assert [s.explains for s in found] == [
        pytest.approx(1.0), pytest.approx(0.6), None, pytest.approx(0.02), -1.0, pytest.approx(0.3),
    ]  # fmt: skip
    # All of an error that is no chance is not next to nothing, however few the values.
    short = [replace(s, num_values=np.array([20.0])) for s in (scores(52), scores(20))]
    assert shares_by_recording(short[0], short[0], short[1])[0].kind == "explained"
    # 290 of chi2 is far beyond chance however many values there are: noise is common to both predictions.
    long = [replace(s, num_values=np.array([5000.0])) for s in (scores(7000), scores(6710), scores(6990))]
    assert [shares_by_recording(long[0], long[0], s)[0].kind for s in long[1:]] == ["uncertain", "negligible"]
    assert [s.recording for s in found] == [f"run_{i}" for i in range(6)]
