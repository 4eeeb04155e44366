"""Rivals that were missed from afar are found from where an effect ended."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, fit, noise_table, place, pose, recordings, spring_problem

from det2stoc_bayes.linearization import Point
from det2stoc_bayes.mismatch import kin
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import log_evidence
from det2stoc_bayes.mismatch.kin import truer_pair, with_kin
from det2stoc_bayes.mismatch.race import Ranked, Slot
from det2stoc_bayes.mismatch.screen import screen
from det2stoc_bayes.optimize import fit_many

SMALL = Typical(force=0.5, speed=1.0, span=0.3, inertia=1.2)
CHOICES = (("quadratic_damping", "slide"), ("quadratic_drag", "block"), ("joint_spring", "slide"))


@pytest.fixture(scope="module")
def drag(tmp_path_factory):
    """Drag on a sliding mass: its fit, and rivals, one of the same law, that stayed where they began."""

    def push(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0]

    problem = spring_problem(tmp_path_factory.mktemp("kin"), push=push, noise=1e-3)
    base = fit(problem)
    placed = [place(problem, name, element, SMALL) for name, element in CHOICES]
    ranked = []
    for p, iterations in zip(placed, (8, 0, 0), strict=True):
        start = Point(np.concatenate([base.point.z, np.full(p.size, 1e-3)]), base.point.start)
        found = fit_many([(problem.with_effects([p]), start)], max_iterations=iterations)[0]
        assert found is not None
        ranked.append(Ranked(p, found, log_evidence(found) - log_evidence(base)))
    return Slot(base, tuple(screen(base, placed)), tuple(ranked))


def test_a_rival_of_the_same_response_gets_as_far(drag):
    own, twin, other = drag.ranked
    assert twin.gain < own.gain - 30  # measured: 63
    found = {r.placed: r for r in with_kin(drag, own).ranked}
    assert found[twin.placed].fit.chi2 == pytest.approx(own.fit.chi2, abs=1.0)  # measured: 0.4
    assert found[other.placed].fit is other.fit  # another law is left alone


def test_without_a_response_nothing_is_kin(drag):
    bare = replace(drag, screened=tuple(replace(s, response=None, others=()) for s in drag.screened))
    assert with_kin(bare, drag.ranked[0]) is bare


def test_beside_another_effect_distant_rivals_start_from_there_as_well(drag):
    """Dry friction predicts 94 % of what quadratic damping does; alone, that is not enough to try it again."""
    problem = drag.base.problem
    bias, own, rival = (
        place(problem, n, "slide", SMALL) for n in ("constant_force", "quadratic_damping", "coulomb_friction")
    )
    for beside, expected in (((), []), ((bias,), [rival])):
        base, best = (fit(problem.with_effects(e)) for e in (beside, [*beside, own]))
        ranked = Ranked(own, best, log_evidence(best) - log_evidence(base))
        slot = Slot(base, tuple(screen(base, [own, rival])), (ranked,))
        starts = kin._starts(slot, ranked)
        assert [placed for placed, _ in starts] == expected
        for _, (_, point) in starts:  # everything else stays where it is
            np.testing.assert_array_equal(point.z[: base.problem.size], best.point.z[: base.problem.size])


def test_a_simpler_law_that_promised_less_from_afar_is_tried_where_the_larger_one_ended(tmp_path):
    """Dry friction that only Stribeck's law, which has more parameters, was fitted to."""

    def change(model):
        model.dof_frictionloss[:] = 0.8

    problem = spring_problem(tmp_path, change=change, noise=1e-3)
    base = fit(problem)
    large, small, other = (
        place(problem, n, "slide", SMALL) for n in ("stribeck_friction", "coulomb_friction", "constant_force")
    )
    best = fit(problem.with_effects([large]), np.concatenate([base.point.z, [4.0, 0.1, 0.0]]))
    own = Ranked(large, best, log_evidence(best) - log_evidence(base))
    screened = tuple(replace(s, response=None, others=()) for s in screen(base, [large, small, other]))
    slot = Slot(base, screened, (own,))
    assert [placed for placed, _ in kin._simpler(slot, own)] == [small]
    first, second = with_kin(slot, own).ranked
    assert (first.placed, second.placed) == (small, large) and first.gain > own.gain
    assert first.fit.chi2 == pytest.approx(best.chi2, rel=0.05)


def test_a_special_case_is_tried_whatever_its_columns_say(tmp_path):
    """Of the same joint alone, from values near the law's own."""

    def change(model):
        model.dof_frictionloss[:] = 0.8

    problem = spring_problem(tmp_path, change=change, noise=1e-3)
    base = fit(problem)
    large, small = (place(problem, n, "slide", SMALL) for n in ("stribeck_friction", "coulomb_friction"))
    best = fit(problem.with_effects([large]), np.concatenate([base.point.z, [4.0, 0.1, 0.0]]))
    own = Ranked(large, best, log_evidence(best) - log_evidence(base))
    unpromising = tuple(replace(s, response=None, others=(), gain=0.0) for s in screen(base, [large, small]))
    elsewhere = replace(small, element=replace(small.element, name="other"))
    slot = Slot(base, (*unpromising, replace(unpromising[0], placed=elsewhere)), (own,))
    assert not kin._simpler(slot, own) and [placed for placed, _ in kin._special_cases(slot, own).items()] == [small]
    first, second = with_kin(slot, own).ranked
    assert (first.placed, second.placed) == (small, large) and first.gain > own.gain
    assert first.fit.chi2 == pytest.approx(best.chi2, rel=0.05)


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """Swings under weaker gravity and a constant force, and what a spring, which comes first, makes of them."""

    def change(model):
        model.opt.gravity[2] += 3.0

    def push(model, data):
        data.qfrc_applied[0] = 0.1

    xml, noise = model_xml(PENDULUM), (1e-3, 1e-2)
    psi = '[psi.damping]\ntarget = "joint/pivot/damping"\nprior = { LogNormal = { loc = -3.0, scale = 0.3 } }\n'
    starts = [([0.9], [0.0]), ([-0.3], [2.0]), ([0.1], [-1.2])]
    made = recordings(xml, starts, 10 * np.arange(100), noise, change=change, push=push)
    study = make_study(tmp_path_factory.mktemp("swings") / "study", xml, psi + noise_table(*noise), made)
    problem = pose(study)
    base = fit(problem)
    pool = [place(problem, n, e) for n, e in (("joint_spring", "pivot"), ("constant_force", "pivot"))]
    pool += [place(problem, "gravity_error", "world"), place(problem, "coulomb_friction", "pivot")]
    alone = fit(problem.with_effects(pool[:1]), np.zeros(base.problem.size + 2), max_iterations=20)
    return Slot(base, tuple(screen(base, pool)), ()), Ranked(pool[0], alone, 0.0), pool


def test_two_effects_that_leave_only_chance_are_truer_than_one_that_does_not(swings):
    slot, own, pool = swings
    assert own.fit.noise_inflation > 1.2  # measured: 3.5
    found = truer_pair(slot, own, needed=10.0)
    assert set(found.problem.effects) == {pool[1], pool[2]}
    values = dict(zip(found.problem.names, [*found.problem.constrained(found.point.z).values()], strict=True))
    assert values["gravity_error[world].change"] == pytest.approx(3.0, abs=0.3)
    assert values["constant_force[pivot].force"] == pytest.approx(0.1, abs=0.01)


def test_two_effects_must_earn_their_place(swings):
    slot, own, _ = swings
    assert truer_pair(slot, own, needed=1e6) is None
    bare = replace(slot, screened=tuple(replace(s, response=None, others=()) for s in slot.screened))
    assert truer_pair(bare, own, needed=10.0) is None
