"""The search for additions where bodies touch: what is screened, and gains that chance does not have."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, SLIDING, TRUTH, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import chances, merit, rattle, search
from det2stoc_bayes.mismatch.contact import screen as screening
from det2stoc_bayes.mismatch.contact.fit import at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.judge import classes
from det2stoc_bayes.mismatch.contact.pair import Pair, sketched, without_last
from det2stoc_bayes.mismatch.contact.places import elements_of
from det2stoc_bayes.mismatch.effects.actuator import ActuatorSaturation
from det2stoc_bayes.mismatch.effects.base import Element, PlacedEffect, Typical
from det2stoc_bayes.mismatch.effects.contact import ContactStiffness
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator


def quiet(*_):
    """Progress that nobody looks at."""


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    study = make_study(tmp_path_factory.mktemp("slides") / "study", XML.format(0.02), PSI, slides())
    return make_problem(Simulator(study, num_threads=1))


@pytest.fixture(scope="module")
def followed(problem):
    return Followed(problem, 12.0).hearing(np.isin(problem.segments.columns, SLIDING))


@pytest.fixture(scope="module")
def fit(followed):
    return fit_followed(followed)


@pytest.fixture(scope="module")
def pool(problem):
    return candidates(problem)


def pair_of(followed, z, placed=None):
    """A hypothesis on three recordings, the fourth held out."""
    recordings = followed.problem.simulator.study.recordings
    if placed is not None:
        followed = followed.with_problem(followed.problem.with_effects((placed,)))
    z = np.asarray(z, float)
    fit, held = (at(followed.on(part), z) for part in (recordings[:3], recordings[3:]))
    return Pair(fit, replace(held, scales=fit.scales))


def z_of(problem, friction):
    return float(problem.simulator.parameters[0].prior.to_normal(friction))


def named(pool, name):
    return next(c for c in pool if c.effect.name == name)


def test_without_the_last_effect_psi_is_the_same(followed, problem, pool):
    z = z_of(problem, TRUTH)
    with_drag = pair_of(followed, [z, 0.2], named(pool, "linear_drag"))
    bare = without_last(with_drag, 6.0)
    assert bare.problem.effects == () and bare.z.tolist() == [z] and bare.followed.memory == 6.0
    assert not np.allclose(bare.errors, with_drag.fit.errors, equal_nan=True)


def test_a_base_that_is_told_better_where_an_addition_led_psi_goes_there(followed, problem, pool):
    """The addition does nothing; what it gains is psi's own."""
    drag = named(pool, "linear_drag")
    stuck = pair_of(followed, [z_of(problem, 0.5 * TRUTH)])
    more = pair_of(followed, [z_of(problem, TRUTH), 0.0], drag)
    for longer in (False, True):
        base = search.better_base(stuck, [more], 2.0, longer=longer)
        assert base.height < stuck.height - 50 and base.fit.problem.effects == ()
        assert longer or base.fit.followed.memory == more.fit.followed.memory
        assert search.better_base(base, [more], search.BUMPY, longer=longer).height <= base.height
        assert search.better_base(stuck, [], 2.0, longer=longer) is stuck


def test_a_hypothesis_goes_beyond_bumps_where_they_are_high_alone(followed, problem):
    stuck = pair_of(followed, [z_of(problem, 0.98 * TRUTH)])
    assert search.beyond_bumps(stuck, search.BUMPY - 0.1) is stuck
    assert search.beyond_bumps(stuck, search.BUMPY).fit.loss < stuck.fit.loss


@pytest.mark.parametrize(("share", "led"), [(0.88, True), (0.5, False)])
def test_who_gains_much_on_a_bump_is_fitted_with_the_leaders_memory(followed, problem, pool, monkeypatch, share, led):
    """No longer memory serves a friction that is a little wrong; who gains little stays where it is."""
    drag, wind = named(pool, "linear_drag"), named(pool, "quadratic_drag")
    base = pair_of(followed, [0.0])
    leader = pair_of(followed.remembering(50.0), [z_of(problem, TRUTH), 0.0], drag)
    stuck = pair_of(followed, [z_of(problem, share * TRUTH), 0.02], wind)
    assert (stuck.gain(base) > search.CONTENDS * leader.gain(base)) == led
    monkeypatch.setattr(search, "longest", lambda pair, luck: pair)
    found = {p.placed: p for p in search.near_remembered(base, [leader, stuck], 2.0, quiet)}
    assert found[drag] is leader
    if not led:
        assert found[wind] is stuck
        return
    assert found[wind].fit.followed.memory == 50.0 and found[wind].height < stuck.height
    assert 0.85 * TRUTH < found[wind].fit.problem.psi(found[wind].fit.z).item() < 1.05 * TRUTH


@pytest.mark.parametrize(("of_base", "of_best", "luck"), [(100.0, 6.0, 8.0), (10.0, 6.0, 10.0), (2.0, 60.0, 60.0)])
def test_an_addition_that_leads_out_of_what_rattles_is_judged_by_its_own_bumps(
    followed, problem, pool, monkeypatch, of_base, of_best, luck
):
    """Beside a base's bumps of 100 nats its steps had ended early, and three times as much it did not gain.

    The base goes on from where it is led then, too; the bumps that count are the highest about who is near the best.
    """
    base, led = (pair_of(followed, [z_of(problem, f * TRUTH)]) for f in (0.5, 0.6))
    more = pair_of(followed, [z_of(problem, 0.9 * TRUTH), 0.0], named(pool, "linear_drag"))
    near = pair_of(followed, [z_of(problem, 0.9 * TRUTH), 0.0], named(pool, "gravity_error"))
    heights, bases = {id(base.fit): of_base, id(more.fit): of_best, id(near.fit): 8.0}, []
    monkeypatch.setattr(search, "bumps", lambda fit, _: heights[id(fit)])
    monkeypatch.setattr(search, "beyond_bumps", lambda pair, _: pair)
    monkeypatch.setattr(search, "_screened", lambda *_: [])
    monkeypatch.setattr(search, "refined", lambda *_: [more])
    monkeypatch.setattr(search, "near_remembered", lambda base, found, *_: found)
    monkeypatch.setattr(search, "better_base", lambda base, found, luck, longer: bases.append(found) or led)
    monkeypatch.setattr(search, "fitted_on", lambda *_: [more, near])
    monkeypatch.setattr(search, "smoothed", lambda base, found, luck, _: found)
    monkeypatch.setattr(search, "earns", lambda *_: False)
    one = search.look(base, pool, quiet)
    assert one.luck == luck and one.base is led
    assert bases == [[more], [more]] + [[more, near]] * (of_best < search.CALM * of_base)


def test_what_is_fitted_on_goes_beyond_where_it_ended(followed, problem, pool, monkeypatch):
    base = pair_of(followed, [z_of(problem, 0.5 * TRUTH)])
    more = pair_of(followed, [z_of(problem, 0.9 * TRUTH), 0.0], named(pool, "linear_drag"))
    monkeypatch.setattr(search, "near_remembered", lambda base, found, luck, progress: found)
    for luck in (2.0, search.BUMPY):
        first = search.fitted_on(base, [more], luck, quiet)[0]
        assert first.placed == more.placed and first.height < more.height - luck


@pytest.mark.parametrize("led", [True, False])
def test_where_all_lose_evidence_none_is_looked_at_further(followed, problem, pool, monkeypatch, led):
    """What gains at all goes on, for a longer memory may tell it better; a base that is led on leaves it nothing."""
    drag, went_on = named(pool, "linear_drag"), []
    right, wrong = (pair_of(followed, [z_of(problem, f * TRUTH)]) for f in (1.0, 0.5))
    more = pair_of(followed, [z_of(problem, TRUTH), 0.0], drag)
    monkeypatch.setattr(search, "bumps", lambda *_: 0.0)
    monkeypatch.setattr(search, "_screened", lambda *_: [])
    monkeypatch.setattr(search, "near_remembered", lambda base, found, *_: went_on.append(base) or found)
    monkeypatch.setattr(search, "smoothed", lambda base, found, *_: found)
    if not led:
        monkeypatch.setattr(search, "better_base", lambda base, *_, longer: base)
    for base, found in ((right, []), (right, [more]), (wrong, [more])):
        monkeypatch.setattr(search, "refined", lambda *_, found=found: found)
        one = search.look(base, pool, quiet)
        assert one.refined == tuple(found) and one.taken is None
    assert more.gain(right) < 0 < more.gain(wrong) and went_on == ([] if led else [wrong])


@pytest.mark.parametrize(("memory", "held"), [(12.0, 0.0), (50.0, 0.0), (50.0, 10.0)])
def test_where_a_longer_memory_serves_no_held_out_recording_the_first_is_asked(
    followed, problem, pool, monkeypatch, memory, held
):
    """Rolling friction of a thrown box gained 625 nats with the longer one, and lost 30 on what was held out."""
    drag, scale, asked = named(pool, "linear_drag"), named(pool, "gravity_error"), []
    base = pair_of(followed, [z_of(problem, 0.5 * TRUTH)])
    longer_led = followed.remembering(memory)
    short, longer = (pair_of(f, [z_of(problem, TRUTH), 0.0], drag) for f in (followed, longer_led))
    rival, rival_longer = (pair_of(f, [z_of(problem, 0.6 * TRUTH), 0.0], scale) for f in (followed, longer_led))
    monkeypatch.setattr(search, "bumps", lambda *_: 0.0)
    monkeypatch.setattr(search, "_screened", lambda *_: [])
    monkeypatch.setattr(search, "refined", lambda *_: [short, rival])
    monkeypatch.setattr(search, "near_remembered", lambda *_: [longer, rival_longer])
    monkeypatch.setattr(search, "better_base", lambda base, *_, longer: base)
    monkeypatch.setattr(search, "smoothed", lambda base, found, *_: found)
    monkeypatch.setattr(search, "held_gain", lambda *_: held)
    monkeypatch.setattr(search, "earns", lambda base, more, *_: asked.append(more) or more is short)
    one = search.look(base, pool, quiet)
    again = memory != followed.memory and held < merit.HELD_GAIN
    assert asked == ([longer, short] if again else [longer])
    assert one.taken is (short if again else None)
    assert one.refined[0] is (short if again else longer)
    assert len({p.fit.followed.memory for p in one.refined}) == 1  # who stands beside it is told alike
    if again:
        first = classes(one, np.random.default_rng(0))[0]
        assert first.members[0] is short and first.chance > 0.9


@pytest.mark.parametrize("log_odds", [0.5, -10.0])
def test_what_a_rivals_own_recordings_would_say_leaves_a_lead_no_name(followed, problem, pool, monkeypatch, log_odds):
    """A lead of hundreds of nats is sure by likelihood; where simulations rattle that is not asked alone."""
    drag, weight = named(pool, "linear_drag"), named(pool, "gravity_error")
    base = pair_of(followed, [z_of(problem, 0.5 * TRUTH)])
    right, wrong = (pair_of(followed, [z_of(problem, f * TRUTH), 0.0], e) for f, e in ((1.0, drag), (0.6, weight)))
    weighed = (rattle.Rival(wrong, log_odds),)
    monkeypatch.setattr(search, "bumps", lambda *_: 0.0)
    monkeypatch.setattr(search, "_screened", lambda *_: [])
    monkeypatch.setattr(search, "refined", lambda *_: [right])
    monkeypatch.setattr(search, "near_remembered", lambda base, found, *_: found)
    monkeypatch.setattr(search, "better_base", lambda base, *_, longer: base)
    monkeypatch.setattr(search, "smoothed", lambda base, found, *_: found)
    monkeypatch.setattr(search, "earns", lambda *_: True)
    monkeypatch.setattr(search, "rivals", lambda *_: weighed)
    one = search.look(base, pool, quiet)
    assert one.taken is right and one.refined == (right, wrong) and one.rivals == weighed
    first, second = classes(one, np.random.default_rng(0))
    assert first.members == (right,) and second.members == (wrong,)
    assert second.chance / first.chance == pytest.approx(np.exp(log_odds), rel=1e-6)
    monkeypatch.setattr(search, "rivals", lambda *_: (rattle.Rival(wrong, 3.0),))
    for earns in (True, False):  # what is surely likelier must have earned its place as well
        monkeypatch.setattr(search, "earns", lambda _, more, *__, earns=earns: earns or more is right)
        one = search.look(base, pool, quiet)
        assert one.taken is (wrong if earns else right) and one.leader is (right if earns else None)
        first, second = classes(one, np.random.default_rng(0))
        assert first.members == ((wrong,) if earns else (right,)) and first.chance > 0.9 - 0.89 * (not earns)
    told = []
    one = search.look(base, pool, quiet, 0, lambda *pairs: bool(told.append(pairs)))
    assert told == [(base, right, [right])]
    assert one.taken is right and one.rivals == ()  # what does not matter has no rivals
    monkeypatch.setattr(search, "rattles", lambda _: False)
    assert search.look(base, pool, quiet).rivals == ()


def test_a_missing_drag_is_screened_and_fitted(problem, followed, pool):
    """Recordings are those of a puck with drag, by plain MuJoCo; size and friction are found beside each other."""
    study = problem.simulator.study
    drag = named(pool, "linear_drag")
    with_drag = followed.with_problem(problem.with_effects((drag,)))
    value = 0.5
    z = np.concatenate([[z_of(problem, TRUTH)], drag.effect.to_normal({"coefficient": value}, drag.typical)])
    random = np.random.default_rng(5)
    made = with_drag.drawn(z, random)
    made[:, 0] = problem.segments.values[:, 0]
    segments = replace(problem.segments, values=made)
    base = fit_followed(Followed(problem.on(segments), 12.0).hearing(followed.heard))
    assert len(study.recordings) == 4
    promises = screening.screen(base, pool)
    order = [p.placed.effect.name for p in promises]
    assert order.index("linear_drag") < 8, order[:10]
    more = fit_followed(sketched(base, next(p for p in promises if p.placed == drag)).followed, z)
    found = more.problem.effect_values(more.z[None])[0]["coefficient"][0]
    per_z = drag.effect.from_normal([np.array(1.0)], drag.typical)["coefficient"]
    sd = float(np.sqrt(more.covariance[1, 1]) * per_z)
    assert abs(found - value) < 4 * sd < 0.5 * value, (found, sd)
    assert base.losses.sum() - more.losses.sum() > 30


def test_columns_have_the_size_that_promises_most(fit):
    """Of what is simulated all sizes are tried; a trial of full size stays as it is."""
    placed = named(candidates(fit.problem, elements_of(fit)), "contact_stiffness")
    trials = list(placed.effect.trials(placed.typical))
    tell = partial(screening._simulated, fit)
    gains = {}
    for k, trial in enumerate(trials):
        for size in screening.SIZES if trial.sd > 1 else (1.0,):
            (change,) = screening._changes(tell, placed, [(trial, size)])
            gains[k, size] = screening._promised(fit, placed, trial, change, size).gain
    best, size = max(gains, key=lambda key: gains[key])
    kept = screening._sized(fit, tell, placed)
    assert kept[0] == (trials[best], size) and len(kept) <= screening.KEPT
    full = PlacedEffect(Whole(), placed.element, placed.typical)
    assert [size for _, size in screening._sized(fit, tell, full)] == [1.0]


def test_what_is_absent_at_no_number_promises_by_its_columns_as_they_are(fit):
    """A limit's trials are neither larger nor mirrored: what is infinite has no other side."""
    limit = PlacedEffect(ActuatorSaturation(), Element("actuator", "motor", ctrl=0), Typical())
    sized = [(t, 1.0) for t in limit.effect.trials(limit.typical)]
    told = []

    def tell(placed, tried):
        told.extend(values["limit"] for values in tried)
        return np.repeat(np.nan_to_num(fit.errors)[..., None], len(tried), -1)

    found = screening._to_both_sides(fit, tell, limit, sized)
    assert told == [t.columns[0]["limit"] for t, _ in sized] and all(np.isfinite(told))
    assert all(p.gain > 0 for p in found)  # its columns are the errors themselves


class Whole(ContactStiffness):
    """With a trial that is as large as the effect."""

    def trials(self, typical):
        """Of its first trial."""
        return [replace(next(iter(super().trials(typical))), sd=1.0)]


def gaining(base, more, gains):
    """The hypothesis with blocks that are told better by so many nats."""
    count = base.fit.followed.count
    fit, held = replace(more.fit), replace(more.held)
    fit.__dict__["losses"] = base.fit.losses - gains[:count]
    held.__dict__["losses"] = base.held.losses - gains[count:]
    found = Pair(fit, held)
    found.__dict__["height"] = base.height - gains.sum()
    return found


def test_a_second_look_asks_those_that_promise_more_beside_its_leader(pool):
    leader, same, more = pool[:3]

    def promises(*gains):
        return [
            screening.Promise(placed, gain, {}, np.zeros(1))
            for placed, gain in zip((leader, same, more), gains, strict=True)
        ]

    asked = screening.promising_more(leader, promises(100.0, 50.0, 50.0), promises(200.0, 101.0, 120.0))
    assert [s.placed for s in asked] == [more]


def test_a_gain_that_few_blocks_have_must_be_far_beyond_chance(followed, problem, pool, monkeypatch):
    """The addition is the friction's own error in the base: clear, but few blocks are made to have all of it."""
    drag = named(pool, "linear_drag")
    base = pair_of(followed, [z_of(problem, TRUTH)])
    more = pair_of(followed, [z_of(problem, TRUTH), 1.0], drag)
    gains = np.zeros(len(base.losses))
    gains[:2], gains[-1] = 50.0, 5.0
    more = gaining(base, more, gains)
    monkeypatch.setattr(merit, "LEAST_BLOCKS", 1)
    asked = []

    def chance(gain):
        return lambda most: asked.append(most) or gain

    assert merit.earns(base, more, 11.0, chance(10.0))
    assert not merit.earns(base, more, 11.0, chance(40.0))
    assert asked == pytest.approx(2 * [100.0 / merit.TIMES])
    assert not merit.earns(base, more, 200.0, lambda _: 0.0)  # less than an addition must earn
    gains[-1] = 1.0
    more = gaining(base, more, gains)
    assert not merit.earns(base, more, 11.0, lambda _: 0.0)  # nothing of it is held out
    gains[:2], gains[-1] = 1.0, 100.0
    more = gaining(base, more, gains)
    assert not merit.earns(base, more, 11.0, lambda _: 0.0)  # all of it is: the base's own values end elsewhere there


def test_who_gains_little_beside_the_best_goes_no_further(fit):
    """Where nothing gains the best stays all the same, and who is behind it by no more than luck."""

    def kept(*gains, slack=0.0):
        fits = [replace(fit) for _ in gains]
        for one, gain in zip(fits, gains, strict=True):
            one.__dict__["losses"] = fit.losses - gain / len(fit.losses)
        near = search.in_reach(fits, fit.loss, 0.2, slack)
        return [gain for one, gain in zip(fits, gains, strict=True) if one in near]

    assert kept(50.0, 11.0, 9.0, -3.0) == [50.0, 11.0]
    assert kept(-10.0, -11.5, -30.0) == [-10.0, -11.5]
    assert kept(-10.0, -11.5, -30.0, -31.0, slack=20.5) == [-10.0, -11.5, -30.0]
    assert kept(50.0, 11.0, 9.0, slack=30.0) == [50.0, 11.0]
    assert kept() == []


def test_what_leads_psi_back_is_no_additions_merit(followed, problem, pool, monkeypatch):
    """Looked for where psi is far off, an addition is held against what psi alone reaches from there."""
    base, ground = (pair_of(followed, [z_of(problem, f * TRUTH)]) for f in (1.0, 0.5))
    drag, held = named(pool, "linear_drag"), []
    in_reach = search.in_reach
    monkeypatch.setattr(search, "in_reach", lambda fits, *rest: held.append((fits, *rest)) or in_reach(fits, *rest))
    promise = screening.Promise(drag, 100.0, {"coefficient": 0.001}, np.zeros(1))
    search.refined(base, ground.fit, [promise], 2.0, quiet)
    few = screening.some(ground.fit)
    stayed = at(few.followed, base.fit.z).loss
    (_, first, *_), ((sketch,), last, *_), ((whole,), all_told, *_) = held
    assert stayed < few.loss - 50 and first < few.loss - 50 and last <= stayed
    assert all_told == base.fit.loss < ground.fit.loss - 50
    assert max(last - sketch.loss, all_told - whole.loss) < 10  # over where it began it gains all that psi does


def test_who_falls_behind_on_all_recordings_is_not_fitted_to_the_end(followed, problem, pool, monkeypatch):
    base = pair_of(followed, [z_of(problem, TRUTH)])
    ended, in_reach, finished = [], search.in_reach, search.finished
    monkeypatch.setattr(search, "finished", lambda fit, *rest: ended.append(fit) or finished(fit, *rest))
    monkeypatch.setattr(
        search, "in_reach", lambda fits, *rest: in_reach(fits, *rest) if rest[1] == search.FITTED else fits
    )
    promises = [
        screening.Promise(named(pool, "linear_drag"), 100.0, {"coefficient": 0.1}, np.zeros(1)),
        screening.Promise(named(pool, "gravity_error"), 90.0, {"change": 1e-3}, np.zeros(1)),
    ]
    found = search.refined(base, base.fit, promises, 0.0, quiet)
    assert len(ended) == len(found) == 1


def test_a_step_that_gains_next_to_nothing_beside_luck_is_the_last(followed, problem):
    start, counter, asked = np.array([z_of(problem, 0.6 * TRUTH)]), problem.simulator.counter, []
    for nats in (0.1, 30.0, 1e9):
        begun = counter.simulations
        asked.append((fit_followed(followed, start, settled=nats).loss, counter.simulations - begun))
    (whole, most), (near, fewer), (bare, fewest) = asked
    assert whole <= near < min(whole + 60, bare) and most > fewer > fewest


def test_chance_gains_little_where_nothing_is_missing(followed, problem, pool):
    base = pair_of(followed, [z_of(problem, TRUTH)])
    few = [c for c in pool if c.effect.name in ("linear_drag", "gravity_error", "friction_error")]
    gain = merit.gain_by_chance(base, few, 0, quiet, 0.0)
    assert 0 <= gain < 20  # a few nats a parameter
    assert merit.gain_by_chance(base, few, 0, quiet, 187.0, 60.0) == 187.0  # the bumps of the recordings themselves
    for most, sets in ((np.inf, len(merit.MAKERS)), (0.0, 0), (1e4, merit.FEWEST)):
        made = []
        merit.gain_by_chance(base, few, 0, lambda _, k, of, made=made: made.append((k, of)), 0.0, most)
        # None where there is enough, one of each kind where that is far below; the last is the end.
        assert made == [*((k, len(merit.MAKERS)) for k in range(sets)), (1, 1)]


@pytest.mark.parametrize("kind", [0, 1])
def test_chance_is_asked_of_what_nothing_led_and_of_what_was_led(followed, problem, pool, monkeypatch, kind):
    """What only one kind of data set shows is seen."""
    base = pair_of(followed, [z_of(problem, TRUTH)])
    braked = pair_of(followed, [z_of(problem, TRUTH), 1.0], named(pool, "linear_drag"))

    def with_drag(make):
        def made(fit, random):
            there = make(braked.fit, random).problem.segments
            return replace(fit.followed, problem=fit.problem.on(there))

        return made

    makers = [with_drag(make) if k % 2 == kind else make for k, make in enumerate(merit.MAKERS)]
    monkeypatch.setattr(merit, "MAKERS", makers)
    assert merit.gain_by_chance(base, [named(pool, "linear_drag")], 0, quiet, 0.0, 50.0) > 50


def test_a_lead_within_the_luck_of_fits_is_not_sure(followed, problem, pool):
    """Every block says so, by a few nats in all: the bootstrap over recordings alone would be certain."""
    base = pair_of(followed, [z_of(problem, TRUTH), 0.1], named(pool, "linear_drag"))
    random = np.random.default_rng(0)
    for lead, low, high in ((2.5, 0.6, 0.95), (30.0, 0.999, 1.0)):
        better = gaining(base, base, np.full(len(base.losses), lead / len(base.losses)))
        assert low < chances.chances([better, base], random)[0] <= high
    assert chances.chances([base, base], random)[0] == pytest.approx(0.5, abs=0.05)


def test_only_what_predicts_the_same_with_as_much_evidence_is_alike(followed, problem, pool):
    one = pair_of(followed, [z_of(problem, TRUTH), 0.1], named(pool, "linear_drag"))
    assert chances.alike(one, one)
    behind = gaining(one, one, np.full(len(one.losses), -10.0 / len(one.losses)))
    assert not chances.alike(one, behind)
    other = pair_of(followed, [z_of(problem, 0.8 * TRUTH), 0.1], named(pool, "linear_drag"))
    other.__dict__["height"] = one.height
    assert not chances.alike(one, other)
