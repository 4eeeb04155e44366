"""Who goes on in a race, and for how long."""

from dataclasses import replace

import numpy as np
from simulated import fit, place, spring_problem

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch import race as module
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import by_chance


def test_beside_what_explains_all_but_chance_who_is_far_behind_is_not_fitted(tmp_path, monkeypatch):
    def push(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0]

    base = fit(spring_problem(tmp_path, push=push, noise=1e-3))
    typical = Typical(force=0.5, speed=1.0, span=0.3, inertia=1.2)
    truth, other = (place(base.problem, n, "slide", typical) for n in ("quadratic_damping", "constant_force"))
    real, asked = module.fit_many, []

    def fit_many(points, *, max_iterations, **options):
        asked.append(max_iterations)
        return real(points, max_iterations=max_iterations, **options)

    monkeypatch.setattr(module, "fit_many", fit_many)
    problem = base.problem.with_effects([other])
    points = [(problem, start_point(problem, np.append(base.point.z, 0.1)))]
    module.race(base, points)
    assert module.FURTHER in asked
    asked.clear()
    module.race(base, points, present=fit(base.problem.with_effects([truth])))
    assert set(asked) <= {module.SOON}


def test_beside_what_stands_far_ahead_who_went_astray_is_given_little_time(tmp_path, monkeypatch):
    """Though what stands there leaves a misfit."""

    def push(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0] + 0.08 * np.sin(9 * data.time)

    base = fit(spring_problem(tmp_path, push=push, noise=1e-3))
    typical = Typical(force=0.5, speed=1.0, span=0.3, inertia=1.2)
    names = ("quadratic_damping", "viscous_damping", "cubic_stiffness")
    present, racing, lost = (fit(base.problem.with_effects([place(base.problem, n, "slide", typical)])) for n in names)
    lost, asked = replace(lost, chi2=1e9), []
    assert not by_chance(present)
    monkeypatch.setattr(module, "effective_share", lambda fit: 1.0)
    monkeypatch.setattr(module, "sketch", lambda *_, **__: [racing, lost])
    monkeypatch.setattr(
        module, "fit_many", lambda points, *, max_iterations, **_: asked.append(max_iterations) or [None]
    )
    points = [(f.problem, f.point) for f in (racing, lost)]
    for standing, iterations in ((None, module.FURTHER), (present, module.SOON)):
        asked.clear()
        module.race(base, points, present=standing)
        assert asked == [module.FURTHER, iterations]
