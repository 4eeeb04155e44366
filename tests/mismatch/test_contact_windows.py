"""Short windows of a sliding puck: scales, unknowns that are found again, and what is screened beside them."""

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, TRUTH, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact.compose import ContactComposer
from det2stoc_bayes.mismatch.contact.judge import judged
from det2stoc_bayes.mismatch.contact.pair import Pair, settled
from det2stoc_bayes.mismatch.contact.run import touches
from det2stoc_bayes.mismatch.contact.scales import DEGREES, certainty, scales_of, scatter
from det2stoc_bayes.mismatch.contact.search import Round
from det2stoc_bayes.mismatch.contact.window_fit import at, steady
from det2stoc_bayes.mismatch.contact.window_starts import smoothed
from det2stoc_bayes.mismatch.contact.windows import FARTHEST, make_windows
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    study = make_study(tmp_path_factory.mktemp("slides") / "study", XML.format(0.02), PSI, slides())
    return make_problem(Simulator(study, num_threads=1))


def test_scales_are_those_that_errors_were_drawn_with():
    random = np.random.default_rng(0)
    true = np.array([[2.0, 7.0], [30.0, 5.0]])
    errors = true * random.standard_t(DEGREES, (4000, 2, 2))
    # the sd of a scale is about 1.2 % for 4000 windows
    np.testing.assert_allclose(scales_of(errors).values, true, rtol=0.06)


def test_a_few_wild_windows_do_not_widen_a_scale():
    errors = 3.0 * np.random.default_rng(0).standard_normal((400, 1, 1))
    plain = scales_of(errors).values[0, 0]
    errors[:20] = FARTHEST
    assert scales_of(errors).values[0, 0] < 1.3 * plain


def test_scatter_counts_what_neighbours_share():
    random = np.random.default_rng(2)
    noise = random.standard_normal((3001, 1))
    shared = noise[1:] + noise[:-1]  # the sum's variance is 4 a window, the windows' own 2
    recording = np.zeros(3000, int)
    assert float(scatter(shared, recording)[0, 0]) / 3000 == pytest.approx(2 + 2 * 0.75, rel=0.1)
    assert abs(certainty(random.standard_normal(3000), recording)) < 4


def test_slopes_that_disagree_are_chaos():
    up, down = np.array([1.0, 1.0, 50.0]), np.array([1.0, 0.98, -40.0])
    np.testing.assert_allclose(steady(up, down), [1.0, 0.99, 0.0], atol=0.05)


def test_scales_where_nothing_is_heard_are_infinite_and_weigh_nothing():
    errors = np.random.default_rng(0).standard_normal((50, 2, 2))
    errors[:, 0, 1] = np.nan
    scales = scales_of(errors)
    assert np.isinf(scales.values[0, 1]) and np.isfinite(np.delete(scales.values, 1)).all()
    assert np.isfinite(scales.losses(errors)).all() and (scales.weights(errors)[:, 0, 1] == 0).all()


def test_only_what_touches_is_a_study_with_contact(problem, tmp_path):
    assert touches(problem)
    high = make_study(tmp_path / "study", XML.format(9.0), PSI, slides(9.0, 1))
    assert not touches(make_problem(Simulator(high, num_threads=1)))


def test_friction_is_found_from_noisy_starts(problem):
    fit = settled(make_windows(problem))
    friction, slope = (float(problem.psi(fit.z + d)[0]) for d in (0.0, 1e-3))
    sd = np.sqrt(fit.covariance[0, 0]) * (slope - friction) / 1e-3
    assert sd < 0.01
    assert abs(friction - TRUTH) < 4 * sd + 0.003, (friction, sd)
    # measured: 5.7 noise sds in x, 145 in a rate of tilting, which depends on contact alone
    assert fit.scales.values[-1, 0] < 12 < fit.scales.values.max()


def test_windows_know_their_recordings_and_a_posterior_what_it_took(problem):
    windows, recordings = make_windows(problem), problem.simulator.study.recordings
    fit = at(windows.on(recordings[:3]), np.zeros(1))
    pair = Pair(fit, at(windows.on(recordings[2:]), np.zeros(1), fit.scales))
    each = fit.windows.count // 3
    np.testing.assert_array_equal(pair.owners, np.repeat(np.arange(5), each))  # the third, held out, is another
    counter = problem.simulator.counter
    begun = counter.simulations
    said = judged(pair, [], False, 0, pair)
    assert said.evaluations == (counter.simulations - begun) // fit.windows.count > 0
    belief = ContactComposer(said, [], 0)._belief(pair)
    assert belief["evaluations"] == said.evaluations


@pytest.mark.parametrize(("loc", "verdict"), [(0.37, "mismatch"), (0.25, "inconclusive")])
def test_an_effect_beside_which_psi_strains_at_its_prior_is_no_sure_name(tmp_path, loc, verdict):
    """What tells the windows is friction, far out in its prior in one of two; the effect is a passenger."""
    psi = PSI.replace("loc = 0.3, scale = 0.1", f"loc = {loc}, scale = 0.03")
    study = make_study(tmp_path / "study", XML.format(0.02), psi, slides())
    problem = make_problem(Simulator(study, num_threads=1))
    windows, recordings = make_windows(problem), problem.simulator.study.recordings
    drag = next(c for c in candidates(problem) if c.effect.name == "linear_drag")
    low, z = (float(problem.simulator.parameters[0].prior.to_normal(v)) for v in (0.1, TRUTH))
    with_drag = windows.with_problem(problem.with_effects((drag,)))
    pairs = []
    for one, there in ((windows, np.array([low])), (with_drag, np.array([z, 0.01]))):
        fit, held = (smoothed(one.on(part), there) for part in (recordings[:3], recordings[3:]))
        pairs.append(Pair(at(fit, there), at(held, there, at(fit, there).scales)))
    base, more = pairs
    assert (abs(z) > 3) == (verdict == "inconclusive")
    said = judged(base, [Round(base, (), (more,), more)], False, 0, more)
    assert said.verdict == verdict and said.places[0][0].chance == 1.0
