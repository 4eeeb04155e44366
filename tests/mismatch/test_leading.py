"""One addition after the other, and a lone one that a race left on its way."""

import numpy as np
from simulated import fit, place, spring_problem

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import by_chance
from det2stoc_bayes.mismatch.leading import _single
from det2stoc_bayes.mismatch.race import Ranked, Slot
from det2stoc_bayes.mismatch.screen import screen
from det2stoc_bayes.optimize import fit_many


def test_who_promised_as_much_and_was_on_its_way_is_followed_to_its_end(tmp_path):
    def push(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0]

    base = fit(spring_problem(tmp_path, push=push, noise=1e-3))
    typical = Typical(force=0.5, speed=1.0, span=0.3, inertia=1.2)
    viscous, quadratic = (place(base.problem, n, "slide", typical) for n in ("viscous_damping", "quadratic_damping"))
    leader = fit(base.problem.with_effects([viscous]))
    problem = base.problem.with_effects([quadratic])
    (slow,) = fit_many([(problem, start_point(problem, np.append(base.point.z, 0.01)))], max_iterations=0)
    assert slow is not None and slow.end == "unfinished"
    assert not by_chance(slow) and not by_chance(leader)
    screened = tuple(screen(base, [viscous, quadratic]))
    ranked = (Ranked(viscous, leader, 2.0), Ranked(quadratic, slow, 1.0))
    found = _single(Slot(base, screened, ranked))
    assert found is not None and found.problem.effects == (quadratic,) and by_chance(found)
    few = tuple(s for s in screened if s.placed == viscous)  # it promised nothing: it is left where it is
    assert _single(Slot(base, few, ranked)) is None
    assert _single(Slot(base, screened, ranked[:1])) is None
