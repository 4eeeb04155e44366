"""Which explanations are one: those that fit and predict alike."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import fit, place, spring_problem

from det2stoc_bayes.mismatch import crossed
from det2stoc_bayes.mismatch.classes import classes, determined
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import log_evidence, probabilities
from det2stoc_bayes.mismatch.race import Ranked, Slot

PUSHES = (("constant_force", "slide"), ("gravity_tilt", "world"), ("joint_spring", "slide"))
SMALL = Typical(force=0.5, speed=1.0, span=0.3, inertia=1.2)


@pytest.fixture(scope="module")
def slot(tmp_path_factory):
    """Drag on a sliding mass, and four explanations of it."""

    def drag(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0]

    problem = spring_problem(tmp_path_factory.mktemp("classes"), push=drag, noise=1e-3)
    base, ranked = fit(problem), []
    for name, element in (
        ("quadratic_drag", "block"),
        ("quadratic_damping", "slide"),
        ("viscous_damping", "slide"),
        ("coulomb_friction", "slide"),
    ):
        placed = place(problem, name, element, SMALL)
        found = fit(problem.with_effects([placed]))
        ranked.append(Ranked(placed, found, log_evidence(found) - log_evidence(base)))
    return Slot(base, (), tuple(sorted(ranked, key=lambda r: -r.gain)))


def names(one):
    return [m.placed.effect.name for m in one.members]


def test_equal_predictions_are_one_class_named_by_its_simplest(slot):
    found = classes(slot, 20, 1.0)
    assert names(found[0]) == ["quadratic_damping", "quadratic_drag"]
    assert sorted(n for c in found[1:] for n in names(c)) == ["coulomb_friction", "viscous_damping"]
    assert found[0].probability > 0.999  # measured: 40 nats ahead
    chances = probabilities([r.gain for r in slot.ranked], 20)
    assert sum(c.probability for c in found) == pytest.approx(chances.sum())
    assert [c.probability for c in found] == sorted((c.probability for c in found), reverse=True)


def test_the_simplest_comes_first_even_where_another_gains_more(slot):
    favoured = [replace(r, gain=r.gain + 5 * (r.placed.effect.name == "quadratic_drag")) for r in slot.ranked]
    ranked = tuple(sorted(favoured, key=lambda r: -r.gain))
    assert ranked[0].placed.effect.name == "quadratic_drag"
    assert names(classes(replace(slot, ranked=ranked), 20, 1.0)[0]) == ["quadratic_damping", "quadratic_drag"]


@pytest.mark.parametrize("sigmas", [1.5, 3.0])
def test_a_difference_in_likelihood_parts_them_where_predictions_differ(slot, sigmas):
    """1.25 nats between predictions that the recordings tell apart by 1.5 sigma at most are numerical."""

    def changed(r):
        stacked = r.fit.linear.stacked.copy()
        values = r.fit.problem.weight.size
        rows = stacked.reshape(-1, stacked.shape[1])[:, : r.fit.problem.weight.shape[1]]
        rows += sigmas / np.sqrt(values)
        return replace(r, fit=replace(r.fit, chi2=r.fit.chi2 + 2.5, linear=replace(r.fit.linear, stacked=stacked)))

    ranked = [changed(r) if r.placed.effect.name == "quadratic_drag" else r for r in slot.ranked]
    found = {tuple(names(c)) for c in classes(replace(slot, ranked=tuple(ranked)), 20, 1.0)}
    assert (("quadratic_drag",) in found) == (sigmas > 2)
    # Where only one sample in ten is independent, the same difference says nothing.
    assert len(classes(replace(slot, ranked=tuple(ranked)), 20, 0.1)[0].members) == 2


def test_a_difference_in_prediction_parts_them(slot):
    def shifted(r):
        stacked = r.fit.linear.stacked.copy()
        stacked[:, ::2] += np.sign(np.random.default_rng(0).standard_normal(stacked[:, ::2].shape))
        return replace(r, fit=replace(r.fit, linear=replace(r.fit.linear, stacked=stacked)))

    ranked = [shifted(r) if r.placed.effect.name == "quadratic_drag" else r for r in slot.ranked]
    found = {tuple(names(c)) for c in classes(replace(slot, ranked=tuple(ranked)), 20, 1.0)}
    assert found >= {("quadratic_damping",), ("quadratic_drag",)}


def test_parameters_that_gain_nothing_part_them_if_recordings_determine_these(tmp_path):
    """A push on a slide: a tilt is one number there, a spring with a middle of its own is two."""

    def push(model, data):
        data.qfrc_applied[0] = 0.3

    problem = spring_problem(tmp_path, push=push, noise=1e-3)
    base = fit(problem)
    places = [place(problem, n, e, SMALL) for n, e in PUSHES]
    fits = [fit(problem.with_effects([placed])) for placed in places]
    ranked = [Ranked(p, f, log_evidence(f) - log_evidence(base)) for p, f in zip(places, fits, strict=True)]
    assert [determined(r) for r in ranked] == [1, 1, 2]
    only, *others = classes(Slot(base, (), tuple(ranked)), 20, 1.0)
    assert names(only) == ["constant_force", "gravity_tilt"] and not others
    assert {r.placed.effect.name for r in only.alike} == {name for name, _ in PUSHES}


def test_nothing_ranked_is_no_class(slot):
    assert classes(replace(slot, ranked=()), 20, 1.0) == []


def test_under_model_error_recordings_are_drawn_anew(slot, monkeypatch):
    """Errors of 4 recordings are told better in 3 by one: by the Dirichlet's closed form, for equal differences."""
    told = {}
    monkeypatch.setattr(crossed, "unseen", lambda f: dict(zip("abcd", told[id(f)], strict=True)))
    fits = [r.fit for r in slot.ranked[:3]]
    told |= {id(fits[0]): (1, 1, 1, 2), id(fits[1]): (2, 2, 2, 1), id(fits[2]): (3, 3, 3, 3)}
    found = crossed.chances(fits)
    # The second leads where one weight of four, Beta(1, 3), is above 1/2.
    np.testing.assert_allclose(found, [7 / 8, 1 / 8, 0], atol=3 * np.sqrt(7 / 64 / crossed.NUM_BOOTSTRAPS))
    noisy = [replace(r, fit=replace(r.fit, chi2=100 * r.fit.chi2)) for r in slot.ranked[:3]]
    told |= {id(r.fit): told[id(f)] for r, f in zip(noisy, fits, strict=True)}
    parted = classes(replace(slot, ranked=tuple(noisy)), 20, 1.0)
    assert sum(c.probability for c in parted) == pytest.approx(1.0)
    told[id(noisy[2].fit)] = (0, 0, 0, 0)
    first = classes(replace(slot, ranked=tuple(noisy)), 20, 1.0)[0]
    assert first.members[0] is noisy[2] and first.probability == 1.0  # though it has least evidence


def test_a_prior_scale_that_pulls_does_not_part_them(slot):
    """One of two twins was expected to be a fifth as large: its fit ends short of where the recordings put it."""
    twin = next(r for r in slot.ranked if r.placed.effect.name == "quadratic_drag")
    timid = place(twin.fit.problem, "quadratic_drag", "block", replace(SMALL, force=SMALL.force / 5))
    pulled = fit(twin.fit.problem.with_effects([timid]), max_iterations=20)
    assert pulled.point.z[-1] > 4  # prior sds; measured: 5.3
    assert 0.5 * (pulled.chi2 - twin.fit.chi2) > 10  # nats; measured: 33
    same = next(r for r in slot.ranked if r.placed.effect.name == "quadratic_damping")
    assert len(classes(replace(slot, ranked=(same, Ranked(timid, pulled, 0.0))), 20, 1.0)) == 1
