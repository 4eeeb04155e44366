"""The search for additions where bodies touch: fair starts, what is heard, and gains that chance does not have."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, TRUTH, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import screen as screening
from det2stoc_bayes.mismatch.contact import search
from det2stoc_bayes.mismatch.contact.beside_starts import BesideStarts
from det2stoc_bayes.mismatch.contact.exchange import exchanged
from det2stoc_bayes.mismatch.contact.pair import Pair, settled, without_last
from det2stoc_bayes.mismatch.contact.scales import Scales
from det2stoc_bayes.mismatch.contact.telling import telling
from det2stoc_bayes.mismatch.contact.window_fit import at
from det2stoc_bayes.mismatch.contact.window_starts import as_recorded, away, smoothed, start_sd
from det2stoc_bayes.mismatch.contact.windows import make_windows
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator


def quiet(*_):
    """Progress that nobody looks at."""


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    study = make_study(tmp_path_factory.mktemp("slides") / "study", XML.format(0.02), PSI, slides())
    return make_problem(Simulator(study, num_threads=1))


@pytest.fixture(scope="module")
def fit(problem):
    return settled(make_windows(problem))


@pytest.fixture(scope="module")
def pool(problem):
    return candidates(problem)


def pair_of(problem, z, placed=None):
    """A hypothesis on three recordings, the fourth held out, from starts corrected under it."""
    windows, recordings = make_windows(problem), problem.simulator.study.recordings
    if placed is not None:
        windows = windows.with_problem(problem.with_effects((placed,)))
    z = np.asarray(z, float)
    fit, held = (at(smoothed(windows.on(part), z), z) for part in (recordings[:3], recordings[3:]))
    return Pair(fit, replace(held, scales=fit.scales))


def z_of(problem, friction):
    return float(problem.simulator.parameters[0].prior.to_normal(friction))


def named(pool, name):
    return next(c for c in pool if c.effect.name == name)


def test_a_part_of_the_windows_predicts_as_all_do(fit):
    rows = np.arange(0, fit.windows.count, 3)
    part = fit.only(rows)
    np.testing.assert_array_equal(part.errors, fit.errors[rows])
    np.testing.assert_allclose(part.windows.errors(fit.z[None])[0], fit.errors[rows], atol=1e-9)
    assert part.windows.recording.tolist() == fit.windows.recording[rows].tolist()


def test_what_is_not_heard_is_not_counted(fit):
    heard = np.ones(fit.errors.shape[1:], bool)
    heard[:, 2] = False
    deaf = at(replace(fit.windows, heard=heard), fit.z)
    assert np.isnan(deaf.errors[:, :, 2]).all() and np.isfinite(deaf.losses).all()
    np.testing.assert_array_equal(deaf.errors[:, :, :2], fit.errors[:, :, :2])
    assert np.isinf(deaf.scales.values[:, 2]).all() and (deaf.scales.weights(deaf.errors)[:, :, 2] == 0).all()
    here = replace(fit.windows, heard=heard).on(fit.problem.segments.recordings[:1])
    np.testing.assert_array_equal(here.heard, heard)


def test_what_is_foretold_worse_than_without_a_model_is_not_telling(fit):
    heard = telling(fit)
    columns = fit.problem.segments.columns
    assert heard[:, columns.index("qpos/glide/x")].all() and heard[:, columns.index("qvel/glide/vx")].all()
    # a model that is wrong by a thousand sds everywhere tells nothing, and then nothing is left out
    assert telling(replace(fit, scales=Scales(np.full_like(fit.scales.values, 1e3)))).all()
    wrong = fit.scales.values.copy()
    wrong[-1, columns.index("qvel/glide/wx")] = 1e3
    assert not telling(replace(fit, scales=Scales(wrong)))[-1, columns.index("qvel/glide/wx")]


def test_a_start_is_as_strange_as_it_is_far_from_what_was_recorded(fit):
    windows = as_recorded(fit.windows)
    np.testing.assert_allclose(away(windows), 0.0, atol=1e-12)
    start, sd = windows.problem.guess.start, start_sd(windows.problem)
    moved = at(windows.starting(replace(start, qpos=start.qpos + np.eye(7)[0] * 3 * sd[0])), fit.z)
    np.testing.assert_allclose(moved.away, np.tile(3 * np.eye(12)[0], (fit.windows.count, 1)), atol=1e-6)
    np.testing.assert_allclose(moved.heights - moved.losses, 4.5, rtol=1e-6)


def test_hypotheses_take_each_others_better_starts(fit):
    """One hypothesis's starts were spoilt in some windows: these, and no others, are replaced."""
    start, sd = fit.problem.guess.start, start_sd(fit.problem)
    speed = start.qvel.copy()
    spoilt = np.arange(fit.windows.count) % 4 == 0
    speed[spoilt, 0] += 30 * sd[6]  # no window is told better from there
    bad = at(fit.windows.starting(replace(start, qvel=speed)), fit.z)
    bad, good = exchanged([bad, fit])
    for one in (bad, good):
        np.testing.assert_array_equal(one.problem.guess.start.qvel, start.qvel)
        np.testing.assert_allclose(one.errors, fit.errors, atol=1e-9)
        assert one.loss == pytest.approx(fit.loss, abs=1e-6)


def test_exchanged_starts_are_never_worse(fit, problem):
    """Each window ends at the likeliest of the starts that were tried, under the scales that it had."""
    other = at(smoothed(make_windows(problem), fit.z - 1.0), fit.z - 1.0)
    for before, after in zip((fit, other), exchanged([fit, other]), strict=True):
        height = before.scales.losses(after.errors) + 0.5 * (after.away**2).sum(1)
        np.testing.assert_allclose(after.away, away(after.windows), atol=1e-9)
        for tried in (fit, other):
            there = before.windows.taking(tried.windows, np.ones(fit.windows.count, bool))
            theirs = before.scales.losses(there.errors(before.z[None])[0]) + 0.5 * (away(there) ** 2).sum(1)
            assert (height <= theirs + 1e-9).all()


def test_beside_starts_is_least_squares_with_a_start_a_window():
    """The gain, the unknowns and the starts are those of one large regression with the starts' priors as data."""
    random = np.random.default_rng(0)
    windows, values, states, size = 5, 12, 3, 2
    slopes, columns = (
        random.standard_normal((windows, values, 1, states)),
        random.standard_normal((windows, values, 1, size)),
    )
    errors, away_ = random.standard_normal((windows, values, 1)), random.standard_normal((windows, states))
    weights = random.uniform(0.2, 2.0, errors.shape)
    beside = BesideStarts(weights, slopes, away_)
    told, left = beside.columns(columns), beside.errors(errors)
    step = np.linalg.solve(np.einsum("wnk,wnl->kl", told, told), np.einsum("wnk,wn->k", told, left))
    rows = windows * (values + states)
    whole, target = np.zeros((windows, values + states, size + windows * states)), np.zeros((windows, values + states))
    for w in range(windows):
        root = np.sqrt(weights[w].ravel())
        mine = slice(size + w * states, size + (w + 1) * states)
        whole[w, :values, :size], whole[w, :values, mine] = (
            root[:, None] * columns[w, :, 0],
            root[:, None] * slopes[w, :, 0],
        )
        whole[w, values:, mine] = np.eye(states)
        target[w] = np.concatenate([root * errors[w, :, 0], -away_[w]])
    exact = np.linalg.lstsq(whole.reshape(rows, -1), target.ravel())[0]
    np.testing.assert_allclose(step, exact[:size], rtol=1e-9)
    np.testing.assert_allclose(beside.moves(errors - columns @ step), exact[size:].reshape(windows, states), rtol=1e-9)


def test_without_the_last_effect_psi_and_starts_are_the_same(problem, pool):
    z = z_of(problem, TRUTH)
    with_drag = pair_of(problem, [z, 0.2], named(pool, "linear_drag"))
    bare = without_last(with_drag)
    assert bare.fit.problem.effects == () and bare.fit.z.tolist() == [z] and bare.held.z.tolist() == [z]
    assert bare.fit.problem.guess.start is with_drag.fit.problem.guess.start
    assert not np.allclose(bare.fit.errors, with_drag.fit.errors)


def test_many_trials_are_sifted_and_the_best_is_kept(fit, pool, monkeypatch):
    rich = max(pool, key=lambda p: sum(len(t.columns) for t in p.effect.trials(p.typical)))
    few = fit.only(np.arange(0, fit.windows.count, screening.EVERY))
    trials = list(rich.effect.trials(rich.typical))
    assert sum(len(t.columns) for t in trials) > screening.MANY
    assert len(screening._sifted(few, rich)) == screening.SIFTED
    (best,) = screening.screen(fit, [rich])
    monkeypatch.setattr(screening, "MANY", 10**6)
    (whole,) = screening.screen(fit, [rich])
    # nothing is missing here: a few nats by all trials, and some of them by those that promise most on two windows
    assert 0.2 * whole.gain < best.gain <= whole.gain + 1e-9


def test_columns_have_the_size_that_promises_most(fit, pool):
    """A trial of full size stays as it is; of others all sizes are glimpsed."""
    drag = named(pool, "linear_drag")
    (trial,) = drag.effect.trials(drag.typical)
    told = {size: screening._glimpsed(fit, drag, trial, (size,))[0] for size in screening.SIZES}
    ((_, size),) = screening._sifted(fit, drag)
    assert told[size] == max(told.values()) > 0
    assert screening._glimpsed(fit, drag, replace(trial, sd=1.0), screening.SIZES)[1] == 1.0


def gaining(base, more, gains):
    """The hypothesis with windows that are told better by so many nats."""
    count = base.fit.windows.count
    fit, held = replace(more.fit), replace(more.held)
    fit.__dict__["heights"] = base.fit.heights - gains[:count]
    held.__dict__["heights"] = base.held.heights - gains[count:]
    return Pair(fit, held)


def test_a_gain_that_few_windows_have_must_be_far_beyond_chance(problem, pool, monkeypatch):
    """The addition is the friction's own error in the base: clear, but few windows are made to have all of it."""
    drag = named(pool, "linear_drag")
    base = pair_of(problem, [z_of(problem, TRUTH)])
    more = pair_of(problem, [z_of(problem, TRUTH), 1.0], drag)
    gains = np.zeros(len(base.heights))
    gains[:2], gains[-1] = 50.0, 5.0
    more = gaining(base, more, gains)
    chance = iter([10.0, 40.0])
    monkeypatch.setattr(search, "LEAST_WINDOWS", 1)
    assert search.earns(base, more, lambda: next(chance))
    assert not search.earns(base, more, lambda: next(chance))  # chance gains 40
    gains[-1] = 1.0
    more = gaining(base, more, gains)
    assert not search.earns(base, more, lambda: next(chance))  # nothing of it is held out


def test_chance_gains_little_where_nothing_is_missing(problem, pool):
    base = pair_of(problem, [z_of(problem, TRUTH)])
    few = [c for c in pool if c.effect.name in ("linear_drag", "gravity_error", "friction_error")]
    gain = search.gain_by_chance(base, few, 0, quiet)
    assert 0 <= gain < 20  # a few nats a parameter


def test_a_lead_within_the_luck_of_fits_is_not_sure(problem, pool):
    """Every window says so, by a few nats in all: the bootstrap over recordings alone would be certain."""
    base = pair_of(problem, [z_of(problem, TRUTH), 0.1], named(pool, "linear_drag"))
    random = np.random.default_rng(0)
    for lead, low, high in ((5.0, 0.6, 0.95), (40.0, 0.999, 1.0)):
        better = gaining(base, base, np.full(len(base.heights), lead / len(base.heights)))
        assert low < search.chances([better, base], random)[0] <= high
    assert search.chances([base, base], random)[0] == pytest.approx(0.5, abs=0.05)
