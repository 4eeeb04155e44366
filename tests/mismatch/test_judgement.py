"""A correction that spoils what it does not mend names nothing."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import fit, spring_problem

from det2stoc_bayes.mismatch.heldout import held_out
from det2stoc_bayes.mismatch.judgement import SPOILT, _spoils


@pytest.mark.parametrize(
    ("inflation", "worse", "spoilt"), [(50, 2 * SPOILT, True), (50, 0.5 * SPOILT, False), (1.2, 2 * SPOILT, False)]
)
def test_a_column_told_worse_beside_a_misfit_that_stays(tmp_path, inflation, worse, spoilt):
    base = fit(spring_problem(tmp_path, noise=1e-3))
    scores = held_out(base)
    growth = np.array([0.5, (1 + worse) ** 2])  # one column gains, the other loses
    later = replace(scores, squared_error=scores.squared_error * growth)
    left = replace(base, chi2=inflation * base.linear.degrees_of_freedom)
    assert _spoils(left, scores, later) is spoilt
    assert not _spoils(left, scores, scores)
