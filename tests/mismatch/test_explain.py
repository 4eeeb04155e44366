"""Adding effects, and looking back at each."""

import pytest
from simulated import fit, place, spring_problem

from det2stoc_bayes.mismatch import explain as module
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import log_evidence
from det2stoc_bayes.mismatch.explain import Ranked, Slot, explain

SMALL = Typical(force=0.5, speed=1.0, span=0.3, inertia=1.2)


@pytest.fixture(scope="module")
def drag(tmp_path_factory):
    """Drag on a sliding mass."""

    def push(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0]

    return fit(spring_problem(tmp_path_factory.mktemp("explain"), push=push, noise=1e-3))


def pool_of(problem):
    names = ("quadratic_damping", "viscous_damping", "coulomb_friction", "constant_force", "cubic_stiffness")
    return [place(problem, name, "slide", SMALL) for name in names]


def test_one_effect_is_added_and_no_more(drag):
    told = []
    found = explain(drag, pool_of(drag.problem), lambda *stage: told.append(stage))
    assert [e.effect.name for e in found.after.problem.effects] == ["quadratic_damping"]
    assert found.before is drag and len(found.slots) == 1 and found.num_candidates == 5
    assert found.slots[0].ranked[0].gain > 40  # measured: 62 nats
    assert ("screening effects", 5, 5) in told


def test_where_nothing_is_left_out_nothing_is_added(tmp_path):
    base = fit(spring_problem(tmp_path, noise=1e-3))
    found = explain(base, pool_of(base.problem))
    assert found.after is base and found.share == 1.0 and len(found.slots) == 1


def test_a_later_effect_that_makes_the_first_needless_has_a_slot_of_its_own(drag, monkeypatch):
    """The first look does not rank the truth; the second adds it, and what was added first is dropped again."""
    truth, wrong = (place(drag.problem, n, "slide", SMALL) for n in ("quadratic_damping", "viscous_damping"))
    real, calls = module.look, []

    def blinded(base, pool, progress):
        calls.append(base)
        if len(calls) > 1:
            return real(base, pool, progress)
        first = fit(base.problem.with_effects([wrong]))
        return Slot(base, (), (Ranked(wrong, first, log_evidence(first) - log_evidence(base) + 20),))

    monkeypatch.setattr(module, "look", blinded)
    found = explain(drag, pool_of(drag.problem))
    assert found.after.problem.effects == (truth,)
    assert [r.placed for r in found.slots[0].ranked][0] == truth
