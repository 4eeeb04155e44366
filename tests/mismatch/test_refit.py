"""Another effect in an effect's place."""

import numpy as np
from simulated import fit, place, spring_problem

from det2stoc_bayes.mismatch import refit
from det2stoc_bayes.mismatch.race import Ranked


def test_what_takes_an_effects_place_starts_from_its_own_fit(tmp_path, monkeypatch):
    """Beside the same others all its unknowns are known, psi and the others' among them."""
    problem = spring_problem(tmp_path)
    push, drag, rub = (place(problem, n, "slide") for n in ("constant_force", "quadratic_damping", "coulomb_friction"))
    present, rival = fit(problem.with_effects([push, drag])), fit(problem.with_effects([drag, rub]))
    asked, search = [], refit.fit_many
    monkeypatch.setattr(refit, "fit_many", lambda points, **options: asked.extend(points) or search(points, **options))
    swapped = refit.swap(present, 0, Ranked(rub, rival, 0.0))
    assert swapped.problem.effects == (rub, drag)
    np.testing.assert_array_equal(asked[0][1].z, rival.point.z[[0, 1, 3, 2]])
    np.testing.assert_array_equal(asked[0][1].start.qpos, rival.point.start.qpos)
    assert swapped.chi2 <= rival.chi2 * (1 + 1e-9)
