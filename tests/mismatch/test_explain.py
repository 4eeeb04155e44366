"""Adding effects, and looking back at each."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import SPRING, fit, noise_table, place, pose, recordings, spring_problem

from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch import crossed, looks, rivals
from det2stoc_bayes.mismatch import explain as module
from det2stoc_bayes.mismatch.crossed import untold
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import by_chance, log_evidence
from det2stoc_bayes.mismatch.explain import explain
from det2stoc_bayes.mismatch.looks import Looks
from det2stoc_bayes.mismatch.race import Ranked, Slot
from det2stoc_bayes.mismatch.screen import Screened
from det2stoc_bayes.optimize import fit_many

NO_LOOKS = looks.Looks(lambda *_: None)
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
    found = explain(drag, pool_of(drag.problem), Looks(lambda *stage: told.append(stage)))
    assert [e.effect.name for e in found.after.problem.effects] == ["quadratic_damping"]
    assert found.before is drag and len(found.slots) == 1 and found.num_candidates == 5
    assert found.slots[0].ranked[0].gain > 40  # measured: 62 nats
    assert ("screening effects", 5, 5) in told
    assert not found.others_chose


def test_where_nothing_is_left_out_nothing_is_added(tmp_path):
    base = fit(spring_problem(tmp_path, noise=1e-3))
    found = explain(base, pool_of(base.problem), Looks())
    assert found.after is base and found.share == 1.0 and len(found.slots) == 1


def test_a_later_effect_that_makes_the_first_needless_has_a_slot_of_its_own(drag, monkeypatch):
    """The first look does not rank the truth; the second adds it, and what was added first is dropped again."""
    truth, wrong = (place(drag.problem, n, "slide", SMALL) for n in ("quadratic_damping", "viscous_damping"))
    real, calls = looks.look, []

    def blinded(base, pool, progress, present=None):
        calls.append(base)
        if len(calls) > 1:
            return real(base, pool, progress)
        first = fit(base.problem.with_effects([wrong]))
        return Slot(base, (), (Ranked(wrong, first, log_evidence(first) - log_evidence(base) + 20),))

    monkeypatch.setattr(looks, "look", blinded)
    found = explain(drag, pool_of(drag.problem), Looks())
    assert found.after.problem.effects == (truth,)
    assert [r.placed for r in found.slots[0].ranked][0] == truth


def test_under_a_misfit_beyond_the_noise_other_recordings_decide(drag, monkeypatch):
    """What gains less evidence is taken where it tells recordings better that were not fitted."""
    base, noisy = drag, replace(drag.problem, noise=drag.problem.noise / 10)
    friction, damping = (place(noisy, n, "slide", SMALL) for n in ("coulomb_friction", "viscous_damping"))
    wrong, less_wrong = (fit(noisy.with_effects([e])) for e in (friction, damping))
    assert min(wrong.noise_inflation, less_wrong.noise_inflation) > module.MODEL_ERROR
    slot = Slot(base, (), (Ranked(friction, wrong, 90.0), Ranked(damping, less_wrong, 60.0)))
    monkeypatch.setattr(looks, "refine_pairs", lambda *_: [])
    for scores, chosen in (((3, 2, 5), less_wrong), ((2, 3, 5), wrong), ((4.9, 7, 5), None)):
        of = dict(zip(map(id, (wrong, less_wrong, base)), scores, strict=True))
        monkeypatch.setattr(module, "untold", lambda f, of=of: of[id(f)])
        search = looks.Looks(lambda *_: None)
        assert module._better(slot, [], 10.0, base, search) is chosen and search.others_chose


def test_two_that_were_found_one_beside_the_other_contend_under_a_misfit(drag, monkeypatch):
    """As pairs and single additions do: those that tell other recordings best are taken."""
    noisy = replace(drag.problem, noise=drag.problem.noise / 10)
    friction, damping = (place(noisy, n, "slide", SMALL) for n in ("coulomb_friction", "viscous_damping"))
    alone, both = fit(noisy.with_effects([friction])), fit(noisy.with_effects([friction, damping]))
    slot = Slot(drag, (), (Ranked(friction, alone, 90.0),))
    monkeypatch.setattr(module, "leading", lambda *_: (None, [both]))
    monkeypatch.setattr(looks, "refine_pairs", lambda *_: [])
    for scores, chosen in (((3, 1, 5), both), ((1.0, 0.9, 5), alone)):  # a further effect must tell 0.25 more
        of = dict(zip(map(id, (alone, both, drag)), scores, strict=True))
        monkeypatch.setattr(module, "untold", lambda f, of=of: of[id(f)])
        assert module._better(slot, [], 10.0, drag, looks.Looks(lambda *_: None)) is chosen


def test_two_effects_are_found_one_after_the_other_where_that_leaves_but_chance(tmp_path, monkeypatch):
    """Without trying pairs, which costs most of a search."""

    def push(model, data):
        data.qfrc_applied[0] = 0.4 - 0.5 * abs(data.qvel[0]) * data.qvel[0]

    base = fit(spring_problem(tmp_path, push=push, noise=1e-3))
    pool, search = pool_of(base.problem), looks.Looks(lambda *_: None)
    asked = []
    monkeypatch.setattr(looks, "refine_pairs", lambda *given: asked.append(given[-1]) or [])
    grown, _ = module.grow(search.at(base, pool), pool, 10.0, search)
    assert {e.effect.name for e in grown.problem.effects} == {"quadratic_damping", "constant_force"}
    assert by_chance(grown)
    assert set(asked) <= {looks.NUM_TRUER}  # those alone that may be what the two look like


def test_more_pairs_are_tried_before_a_misfit_is_called_unexplained(drag, monkeypatch):
    noisy = replace(drag.problem, noise=drag.problem.noise / 10)
    base, pair = fit(noisy), fit(noisy.with_effects(pool_of(noisy)[1:3]))
    assert min(base.noise_inflation, pair.noise_inflation) > module.MODEL_ERROR
    asked = []

    def refine_pairs(*given):
        asked.append(given[-1])
        return [pair] if asked[-1] > module.NUM_PAIRS else []

    monkeypatch.setattr(looks, "refine_pairs", refine_pairs)
    monkeypatch.setattr(module, "untold", lambda f: 1.0 if f is pair else 9.0)
    assert module._better(Slot(base, (), ()), [], 10.0, base, looks.Looks(lambda *_: None)) is pair
    assert asked == [module.NUM_PAIRS, module.NUM_WIDE]


def test_recordings_that_were_left_out_are_told_by_the_right_effect(tmp_path):
    """Halves of four recordings: chi2 within its scatter with what is there, far beyond it without."""

    def push(model, data):
        data.qfrc_applied[0] = -0.5 * abs(data.qvel[0]) * data.qvel[0]

    starts = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5]), ([-0.4], [0.5])]
    made = recordings(model_xml(SPRING), starts, 10 * np.arange(60), (1e-3, 1e-2), push=push)
    toml = '[psi.stiffness]\ntarget = "joint/slide/stiffness"\nprior = { Normal = { loc = 30, scale = 4 } }\n'
    problem = pose(make_study(tmp_path / "study", model_xml(SPRING), toml + noise_table(1e-3, 1e-2), made))
    right = fit(problem.with_effects([place(problem, "quadratic_damping", "slide", SMALL)]))
    values = int(problem.segments.observed.sum())
    assert abs(untold(right) - values) < 3 * np.sqrt(2 * values)
    assert untold(fit(problem)) > 2 * values


def test_of_two_that_tell_the_same_only_one_is_dropped(drag, monkeypatch):
    """Each is needless beside the other, but not both."""
    problem = replace(drag.problem, noise=drag.problem.noise / 10)
    bare = fit(problem)
    placed = [place(problem, n, "slide", SMALL) for n in ("coulomb_friction", "viscous_damping")]
    both, one, other = (fit(problem.with_effects(e)) for e in (placed, placed[1:], placed[:1]))
    chi2 = {id(bare): 1000.0, id(both): 400.0, id(one): 410.0, id(other): 412.0}

    monkeypatch.setattr(module, "untold", lambda f: chi2[id(f)])
    kept, _, useless = module._without_useless(bare, both, dict(zip(placed, (one, other), strict=True)))
    assert kept is one and useless == {placed[0]}


def test_what_tells_other_recordings_worse_is_no_rival_under_a_misfit(drag, monkeypatch):
    problem = replace(drag.problem, noise=drag.problem.noise / 10)
    own, rival = (
        Ranked(e, fit(problem.with_effects([e])), gain)
        for e, gain in zip(
            (place(problem, n, "slide", SMALL) for n in ("coulomb_friction", "viscous_damping")),
            (60.0, 90.0),
            strict=True,
        )
    )
    for scores, expected in (((2, 3), (own,)), ((3, 2), (rival, own))):
        of = {id(own.fit): scores[0], id(rival.fit): scores[1]}
        monkeypatch.setattr(rivals, "untold", lambda f, of=of: of[id(f)])
        assert rivals._rivals(own, (rival, own)) == expected


def test_a_rival_on_its_way_is_held_against_an_effect_at_its_optimum(drag, monkeypatch):
    """While a misfit remains and where it tells other recordings about as well."""
    problem = replace(drag.problem, noise=drag.problem.noise / 10)
    own, rival = (
        problem.with_effects([place(problem, n, "slide", SMALL)]) for n in ("coulomb_friction", "viscous_damping")
    )
    bare, there, rest = fit(problem), fit(own), fit(rival)
    point = start_point(rival, np.append(bare.point.z, np.full(rival.size - problem.size, -3.0)))
    (early,) = fit_many([(rival, point)], max_iterations=0)
    assert early.end == "unfinished" and log_evidence(early, 1.0) < log_evidence(rest, 1.0) - 1
    present = Ranked(own.effects[0], there, 60.0)
    slot = Slot(bare, (), (present, Ranked(rival.effects[0], early, 30.0)))
    for told, expected in ((1.0, rest.chi2), (9.0, early.chi2)):
        monkeypatch.setattr(rivals, "untold", lambda f, told=told: told if f is early else 1.0)
        _, found = rivals._arrived(slot, present)[0].ranked
        assert found.fit.chi2 == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("share", "goes_on"), [(0.9, True), (0.5, False)])
def test_a_rival_that_promised_as_much_is_followed_to_its_optimum(drag, share, goes_on):
    """Though the effect leaves but chance: a clock's skew was on its way when a speed's scale, psi far off, ended."""
    own, rival = (
        drag.problem.with_effects([place(drag.problem, n, "slide", SMALL)])
        for n in ("quadratic_damping", "viscous_damping")
    )
    there, rest = fit(own), fit(rival)
    point = start_point(rival, np.append(drag.point.z, np.full(rival.size - drag.problem.size, -3.0)))
    (early,) = fit_many([(rival, point)], max_iterations=0)
    assert by_chance(there) and early.end == "unfinished" and early.noise_inflation > 1.5
    present = Ranked(own.effects[0], there, 60.0)
    none = np.zeros(drag.problem.size)
    screened = tuple(
        Screened(e, e.effect.trials(e.typical)[0], told, told, np.zeros(1), none)
        for e, told in ((own.effects[0], 100.0), (rival.effects[0], 100.0 * share))
    )
    slot = Slot(drag, screened, (present, Ranked(rival.effects[0], early, 30.0)))
    found = rivals._arrived(slot, present)[0].ranked[1].fit
    assert found.chi2 == pytest.approx(rest.chi2 if goes_on else early.chi2, rel=1e-3)


def test_a_single_recording_has_no_others_to_ask(drag, monkeypatch):
    """The evidence of what was fitted decides, and nothing is refitted without the only recording."""
    problem = replace(drag.problem, noise=drag.problem.noise / 10)
    placed = [place(problem, n, "slide", SMALL) for n in ("coulomb_friction", "viscous_damping")]
    own, rival = (Ranked(e, fit(problem.with_effects([e])), gain) for e, gain in zip(placed, (60.0, 90.0), strict=True))
    for asked in (module, crossed):
        monkeypatch.setattr(asked, "others_exist", lambda fit: False)
    monkeypatch.setattr(rivals, "untold", lambda *_: pytest.fail("there are no other recordings"))
    assert rivals._rivals(own, (rival, own)) == (rival, own)
    assert module._without_useless(drag, own.fit, {}) == (own.fit, {}, set())
    monkeypatch.setattr(looks, "refine_pairs", lambda *_: [])
    assert module._better(Slot(drag, (), (rival, own)), [], 10.0, drag, NO_LOOKS) is rival.fit


def test_a_rival_that_tells_other_recordings_about_as_well_stays(drag, monkeypatch):
    """So that what cannot be told apart is one class, whatever its last digit."""
    problem = replace(drag.problem, noise=drag.problem.noise / 10)
    placed = [place(problem, n, "slide", SMALL) for n in ("coulomb_friction", "viscous_damping")]
    own, rival = (Ranked(e, fit(problem.with_effects([e])), gain) for e, gain in zip(placed, (60.0, 59.0), strict=True))
    for score, kept in ((1.02, (own, rival)), (1.5, (own,))):
        of = {id(own.fit): 1.0, id(rival.fit): score}
        monkeypatch.setattr(rivals, "untold", lambda f, of=of: of[id(f)])
        assert rivals._rivals(own, (own, rival)) == kept


def test_no_look_is_taken_twice(drag, monkeypatch):
    """With fewer candidates the first look serves; with one more it is taken anew."""
    pool, calls, real = pool_of(drag.problem), [], looks.look
    monkeypatch.setattr(looks, "look", lambda base, *rest: calls.append(base) or real(base, *rest))
    taken = looks.Looks(lambda *_: None)
    most, fewer = taken.at(drag, pool[:-1]), taken.at(drag, pool[1:-1])
    assert len(calls) == 1 and pool[0] not in [s.placed for s in fewer.screened]
    kept = {r.placed: r.fit for r in most.ranked if r.placed != pool[0]}
    assert all(kept[r.placed] is r.fit for r in fewer.ranked if r.placed in kept)
    taken.at(drag, pool)
    assert len(calls) == 2


def test_over_parts_of_recordings_nothing_is_negligible(drag):
    """A misfit a twentieth of the believed model's ends the search over whole recordings alone."""
    left = replace(drag, chi2=1.4 * drag.linear.degrees_of_freedom)
    believed = replace(drag, chi2=30 * drag.linear.degrees_of_freedom)
    assert not by_chance(left) and module.enough(left, believed)
    segments = drag.problem.segments
    parts = replace(segments, recordings=segments.recordings[:1])  # as if each were cut in three
    cut_up = replace(left.linear, problem=replace(drag.problem, segments=parts))
    assert not module.enough(replace(left, linear=cut_up), believed)
