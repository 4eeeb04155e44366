"""Recordings of a sliding puck that are followed: innovations, unknowns found again, and what is told of them."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, TRUTH, XML, slides

from det2stoc_bayes.engines.free_flight import Fall
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import believed as believed_module
from det2stoc_bayes.mismatch.contact import compose, judge, run
from det2stoc_bayes.mismatch.contact import fit as fit_module
from det2stoc_bayes.mismatch.contact import pair as pair_module
from det2stoc_bayes.mismatch.contact import yardstick as yardstick_module
from det2stoc_bayes.mismatch.contact.believed import (
    FINER,
    MEMBERS,
    REGARDS,
    believed,
    finer,
    grounded,
    searched,
)
from det2stoc_bayes.mismatch.contact.compose import ContactComposer
from det2stoc_bayes.mismatch.contact.differences import STEPS, columns_of, steady
from det2stoc_bayes.mismatch.contact.evolution import PATIENCE, evolved
from det2stoc_bayes.mismatch.contact.fit import ContactFit, _taught, at, fit_followed, newton
from det2stoc_bayes.mismatch.contact.flow import Ground
from det2stoc_bayes.mismatch.contact.followed import BLOCK, FARTHEST, Followed
from det2stoc_bayes.mismatch.contact.judge import corrected, judged
from det2stoc_bayes.mismatch.contact.pair import MEMORIES, MOST_WORSE, Pair, climbed, nearer, with_memory, with_own
from det2stoc_bayes.mismatch.contact.replicas import replicated
from det2stoc_bayes.mismatch.contact.rollouts import LENGTH, rollouts
from det2stoc_bayes.mismatch.contact.run import touches
from det2stoc_bayes.mismatch.contact.scales import DEGREES, Scales, certainty, scales_of, scatter
from det2stoc_bayes.mismatch.contact.search import Round
from det2stoc_bayes.mismatch.contact.telling import telling
from det2stoc_bayes.mismatch.contact.yardstick import yardstick
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.unknowns import Unknowns


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    study = make_study(tmp_path_factory.mktemp("slides") / "study", XML.format(0.02), PSI, slides())
    return make_problem(Simulator(study, num_threads=1))


@pytest.fixture(scope="module")
def sliding(problem):
    """The columns of sliding; how the puck rattles is another matter."""
    return np.isin(problem.segments.columns, [f"{c}/glide/{p}" for c, p in SLIDING])


@pytest.fixture(scope="module")
def fit(problem, sliding):
    return climbed(fit_followed(Followed(problem).hearing(sliding)))


SLIDING = ("qpos", "x"), ("qpos", "y"), ("qvel", "vx"), ("qvel", "vy")


def z_of(problem, friction):
    return np.array([float(problem.simulator.parameters[0].prior.to_normal(friction))])


def test_scales_are_those_that_errors_were_drawn_with():
    random = np.random.default_rng(0)
    true = np.array([2.0, 7.0])
    errors = true * random.standard_t(DEGREES, (400, 10, 2))
    # the sd of a scale is about 1.2 % for 4000 samples
    np.testing.assert_allclose(scales_of(errors).values, true, rtol=0.06)


def test_a_few_wild_samples_do_not_widen_a_scale():
    errors = 3.0 * np.random.default_rng(0).standard_normal((40, 10, 1))
    plain = scales_of(errors).values[0]
    errors[:2] = FARTHEST
    assert scales_of(errors).values[0] < 1.3 * plain


def test_scatter_counts_what_neighbours_share():
    random = np.random.default_rng(2)
    noise = random.standard_normal((3001, 1))
    shared = noise[1:] + noise[:-1]  # the sum's variance is 4 a block, the blocks' own 2
    recording = np.zeros(3000, int)
    assert float(scatter(shared, recording)[0, 0]) / 3000 == pytest.approx(2 + 2 * 0.75, rel=0.1)
    assert abs(certainty(random.standard_normal(3000), recording)) < 4


def test_slopes_that_disagree_are_chaos():
    up, down = np.array([1.0, 1.0, 50.0]), np.array([1.0, 0.98, -40.0])
    np.testing.assert_allclose(steady(up, down), [1.0, 0.99, 0.0], atol=0.05)


def test_scales_where_nothing_was_recorded_are_infinite_and_weigh_nothing():
    errors = np.random.default_rng(0).standard_normal((50, 10, 2))
    errors[..., 1] = np.nan
    scales = scales_of(errors)
    assert np.isinf(scales.values[1]) and np.isfinite(scales.values[0])
    assert np.isfinite(scales.losses(errors)).all() and (scales.weights(errors)[..., 1] == 0).all()


def test_only_what_touches_is_a_study_with_contact(problem, tmp_path):
    assert touches(problem)
    high = make_study(tmp_path / "study", XML.format(9.0), PSI, slides(9.0, 1))
    assert not touches(make_problem(Simulator(high, num_threads=1)))


def test_under_the_truth_innovations_are_noise_and_under_another_friction_they_are_not(problem, sliding):
    followed = Followed(problem, 50.0)
    right, wrong = (at(followed, z_of(problem, f)).errors[..., sliding] for f in (TRUTH, 0.8 * TRUTH))
    # measured: 1.25, and 6.4 under the wrong one; of noise alone the sd is 0.07
    assert np.nanmean(right**2) == pytest.approx(1, abs=0.5) and np.nanmean(wrong**2) > 3


def test_the_mean_of_two_simulations_does_not_favour_a_friction_that_rattles_less(problem):
    """With all columns heard: noise that leads a lone simulation makes it rattle, the less the less friction."""

    def lead(members):
        followed = Followed(problem, 6.0).averaged(members)
        right, less = (at(followed, z_of(problem, f)).loss for f in (TRUTH, 0.9 * TRUTH))
        return less - right

    # measured, nats: -11 by one simulation, 21 by the mean of two, 51 of four
    assert lead(2) > max(lead(1), 0.0) + 10


def test_in_flight_the_mean_of_two_simulations_is_what_one_foretells(problem, tmp_path):
    """Noise that parts them has either sign once: what is linear in it cancels."""
    high = make_study(tmp_path / "study", XML.format(9.0), PSI, slides(9.0, 1))
    one = Followed(make_problem(Simulator(high, num_threads=1)), 12.0)
    two, z = one.averaged(2), np.zeros(1)
    apart = np.nanmax(np.abs(at(one, z).errors - at(two, z).errors))
    assert 0 < apart < 0.01  # measured: 0.00014 noise sds, what turns are off a straight line
    assert one.averaged(1) is one and not one.leads_as(two) and two.led_as(one).members == 1


def test_some_recordings_are_foretold_by_the_same_simulations_as_among_all(problem):
    two, z = Followed(problem, 12.0).averaged(2), z_of(problem, TRUTH)
    rows, blocks = np.array([1, 3]), np.isin(two.recording, [1, 3])
    np.testing.assert_allclose(two.only(rows).errors(z[None])[0], two.errors(z[None])[0][blocks], atol=1e-9)


def test_friction_is_found_from_noisy_recordings(problem, fit):
    friction, slope = (float(problem.psi(fit.z + d)[0]) for d in (0.0, 1e-3))
    sd = np.sqrt(fit.covariance[0, 0]) * (slope - friction) / 1e-3
    assert sd < 0.01
    assert abs(friction - TRUTH) < 4 * sd + 0.003, (friction, sd)


def test_blocks_hold_every_sample_but_the_first_of_each_recording(problem):
    followed = Followed(problem)
    samples = problem.segments.time.shape[1]
    assert followed.blocks == -(-(samples - 1) // BLOCK) and followed.count == 4 * followed.blocks
    errors = followed.errors(np.zeros((1, 1)))[0]
    assert np.isfinite(errors).sum() == 4 * (samples - 1) * 13
    np.testing.assert_array_equal(followed.recording, np.repeat(np.arange(4), followed.blocks))
    some = at(followed, np.zeros(1)).only(np.array([1, 3]))
    rows = np.isin(followed.recording, [1, 3])
    np.testing.assert_allclose(some.followed.errors(np.zeros((1, 1)))[0], errors[rows], atol=1e-9)
    np.testing.assert_array_equal(some.errors, errors[rows])


def test_densities_of_different_memories_are_comparable(problem, sliding):
    """Each is that of the samples: what a longer memory takes off the foretold sds it must add in misfit, if wrong."""
    wrong, right = z_of(problem, 0.6 * TRUTH), z_of(problem, TRUTH)
    every = {m: Followed(problem, m).hearing(sliding) for m in MEMORIES}
    told = {m: [at(f, z).losses.sum() for z in (right, wrong)] for m, f in every.items()}
    assert min(MEMORIES, key=lambda m: told[m][0]) >= 12 > min(MEMORIES, key=lambda m: told[m][1])
    assert (np.diff([f.volumes.sum() for f in every.values()]) < 0).all()


def test_a_model_that_is_right_remembers_long(fit):
    assert fit.followed.memory >= 12


def test_what_is_not_heard_is_not_counted(problem):
    heard = np.ones(13, bool)
    heard[2] = False
    followed = Followed(problem)
    deaf, all_ = at(followed.hearing(heard), np.zeros(1)), at(followed, np.zeros(1))
    assert np.isnan(deaf.errors[..., 2]).all() and np.isfinite(deaf.losses).all()
    np.testing.assert_array_equal(deaf.errors[..., :2], all_.errors[..., :2])
    assert np.isinf(deaf.scales.values[2])
    here = followed.hearing(heard).on(problem.segments.recordings[:1])
    np.testing.assert_array_equal(here.heard, heard)


def test_what_is_foretold_worse_than_without_a_model_is_not_telling(problem):
    fit = at(Followed(problem, 12.0), z_of(problem, TRUTH))
    columns = fit.problem.segments.columns
    heard = telling(fit)
    assert heard[columns.index("qpos/glide/x")] and heard[columns.index("qvel/glide/vx")]
    # a model that is wrong by a thousand sds everywhere tells nothing, and then nothing is left out
    assert telling(replace(fit, errors=fit.errors + 1e3)).all()
    spoilt = fit.errors.copy()
    spoilt[..., columns.index("qvel/glide/wx")] += 1e3
    assert not telling(replace(fit, errors=spoilt))[columns.index("qvel/glide/wx")]


def test_the_ground_of_a_search_is_where_psi_is_likely(fit, problem):
    far = at(fit.followed, np.array([4.0]))
    assert nearer(far).z.tolist() == [1.5] and nearer(fit) is fit


def test_replicas_are_what_the_hypothesis_makes(fit):
    made = replicated(fit, np.random.default_rng(0))
    errors = at(made, fit.z).errors
    assert np.nanmean(errors**2) == pytest.approx(1, abs=0.3)
    again = fit_followed(made, fit.z, iterations=3)
    assert abs(again.z - fit.z)[0] < 5 * np.sqrt(fit.covariance[0, 0] + again.covariance[0, 0])


def test_rollouts_start_from_what_was_seen_before(fit):
    """Of the right model they err by little more than noise over 20 samples, of another friction by several times."""
    runs, wrong = rollouts(fit), rollouts(at(fit.followed, z_of(fit.problem, 0.6 * TRUTH)))
    assert runs.segments.time.shape[1] <= LENGTH + 1
    x = fit.problem.segments.columns.index("qpos/glide/x")
    assert runs.rmse()[x] < 4 * fit.problem.noise[x] < wrong.rmse()[x]  # measured: 2.2, and 24
    paths = runs.paths()
    for record in fit.problem.segments.recordings:
        assert np.isfinite(paths[record.name]).all()
        assert np.abs(paths[record.name][:, x] - record.values[:, x]).max() < 10 * fit.problem.noise[x]  # measured: 8.4


def test_pairs_know_their_recordings_and_a_posterior_what_it_took(problem):
    followed, recordings = Followed(problem), problem.simulator.study.recordings
    fit = at(followed.on(recordings[:3]), np.zeros(1))
    pair = Pair(fit, at(followed.on(recordings[2:]), np.zeros(1), fit.scales))
    np.testing.assert_array_equal(
        pair.owners, np.repeat(np.arange(5), followed.blocks)
    )  # the third, held out, is another
    counter = problem.simulator.counter
    begun = counter.simulations
    rod = yardstick(fit, 0)
    assert rod.evaluations == (counter.simulations - begun) // 3 > 0
    belief = ContactComposer(judged(pair, [], 0, pair, rod), [], 0)._belief(pair)
    assert belief["evaluations"] == rod.evaluations


def test_the_believed_model_is_fitted_with_its_memory_and_what_it_tells(problem):
    recordings = problem.simulator.study.recordings
    whole = Followed(problem)
    pair = believed(whole.on(recordings[:3]), whole.on(recordings[3:]))
    assert pair.fit.followed.memory == pair.held.followed.memory >= 6
    np.testing.assert_array_equal(pair.fit.followed.heard, pair.held.followed.heard)
    step = problem.simulator.model.opt.timestep
    (used,) = {f.problem.timestep or step for f in (pair.fit, pair.held)}
    assert step / used in (1, *FINER)
    assert pair.fit.followed.members == pair.held.followed.members == MEMBERS
    assert pair.fit.scales is pair.held.scales


def test_psi_is_looked_for_all_over_its_prior(problem, sliding):
    z = searched(Followed(problem).hearing(sliding))
    assert abs(z - z_of(problem, TRUTH)) < 0.3  # prior sds; measured: 0.02


def test_what_is_left_is_measured_by_what_the_model_itself_would_leave(problem, sliding):
    followed, recordings = Followed(problem).hearing(sliding), problem.simulator.study.recordings

    def pair(friction):
        fit, held = (followed.on(part) for part in (recordings[:3], recordings[3:]))
        there = at(fit, z_of(problem, friction))
        return Pair(there, at(held, there.z, there.scales))

    wrong, right = pair(0.5 * TRUTH), pair(TRUTH)
    rod = yardstick(right.fit, 0)
    before, after = rod.of(wrong), rod.of(right)
    assert before > 5 * rod.level  # measured: 6.2 times
    assert abs(after - rod.level) < 3.5 * rod.uncertain(right)
    assert rod.left(before, after) < 0.1  # measured: 0.046
    assert rod.left(before, before) == 1.0 and rod.left(0.9 * rod.level, after) == 0.0
    assert rod.left(before, rod.level + 0.3 * (before - rod.level)) == pytest.approx(0.3)


def test_nothing_further_is_looked_for_where_surely_little_is_left(problem, sliding, monkeypatch):
    """Little is left in both; of the second it is not sure."""
    followed, recordings = Followed(problem).hearing(sliding), problem.simulator.study.recordings
    fit, held = (followed.on(part) for part in (recordings[:3], recordings[3:]))
    wrong, right = (at(fit, z_of(problem, f * TRUTH)) for f in (0.5, 1.0))
    before, after = (Pair(x, at(held, x.z, x.scales)) for x in (wrong, right))
    rod = yardstick(right, 0)
    rod = replace(rod, level=rod.of(after))
    ends = []
    for sds in (0.0, 100.0):
        monkeypatch.setattr(run, "SURELY", sds)
        ends.append(run._settled(before, after, rod))
    assert ends == [True, False]


@pytest.mark.parametrize(("loc", "verdict"), [(0.22, "mismatch"), (0.37, "inconclusive")])
def test_an_effect_beside_which_psi_strains_at_its_prior_is_no_sure_name(tmp_path, loc, verdict):
    """What tells the recordings is friction, far out in its prior in one of two; the effect is a passenger."""
    psi = PSI.replace("loc = 0.3, scale = 0.1", f"loc = {loc}, scale = 0.03")
    study = make_study(tmp_path / "study", XML.format(0.02), psi, slides())
    problem = make_problem(Simulator(study, num_threads=1))
    heard = np.isin(problem.segments.columns, [f"{c}/glide/{p}" for c, p in SLIDING])
    followed, recordings = Followed(problem).hearing(heard), problem.simulator.study.recordings
    drag = next(c for c in candidates(problem) if c.effect.name == "linear_drag")
    low, z = z_of(problem, 0.1), z_of(problem, TRUTH)
    with_drag = followed.with_problem(problem.with_effects((drag,)))
    pairs = []
    for one, there in ((followed, low), (with_drag, np.array([z[0], 0.01]))):
        fit, held = (one.on(part) for part in (recordings[:3], recordings[3:]))
        pairs.append(Pair(at(fit, there), at(held, there, at(fit, there).scales)))
    base, more = pairs
    assert (abs(z[0]) > 3) == (verdict == "inconclusive")
    said = judged(base, [Round(base, (), (more,), more)], 0, more, yardstick(more.fit, 0))
    assert said.verdict == verdict and said.places[0][0].chance == 1.0


def test_what_an_effect_explains_is_told_with_one_memory(problem, sliding):
    """The wrong friction is led back to the recordings every few samples: with so short a memory little is missing."""
    followed, recordings = Followed(problem).hearing(sliding), problem.simulator.study.recordings
    drag = next(c for c in candidates(problem) if c.effect.name == "linear_drag")
    wrong, right = z_of(problem, 0.6 * TRUTH), z_of(problem, TRUTH)
    pairs = []
    for one, z, memory in (
        (followed, wrong, 3.0),
        (followed.with_problem(problem.with_effects((drag,))), np.append(right, 0.01), 50.0),
    ):
        fit, held = (replace(one, memory=memory).on(part) for part in (recordings[:3], recordings[3:]))
        pairs.append(Pair(at(fit, z), at(held, z, at(fit, z).scales)))
    base, more = pairs
    led = with_memory(base, 50.0)
    assert led.fit.followed.memory == led.held.followed.memory == 50.0 and with_memory(led, 50.0) is led
    # friction is free in the refit, so that the passenger explains nothing; told at two memories it would
    said = judged(base, [Round(base, (), (more,), more)], 0, more, yardstick(more.fit, 0))
    assert said.verdict == "no_mismatch" and said.negligible[0][1] < 0.05


@pytest.mark.parametrize(
    ("share", "sds", "verdict"),
    [(0.6, 2.0, "mismatch"), (0.995, 2.0, "no_mismatch"), (0.95, 0.0, "no_mismatch"), (0.95, 2.0, "mismatch")],
)
def test_a_level_above_what_was_left_before_makes_nothing_negligible(
    problem, sliding, share, sds, verdict, monkeypatch
):
    """By recordings of the explanation's own making even the believed model would leave less than noise.

    Of the last friction 4 % of the noise are gained, and 13 % by 2 standard errors: that is not surely little.
    """
    monkeypatch.setattr(yardstick_module, "SURELY", sds)
    followed, recordings = Followed(problem).hearing(sliding), problem.simulator.study.recordings
    drag = next(c for c in candidates(problem) if c.effect.name == "linear_drag")
    wrong, right = z_of(problem, share * TRUTH), z_of(problem, TRUTH)
    pairs = []
    for one, z in ((followed, wrong), (followed.with_problem(problem.with_effects((drag,))), np.append(right, 0.01))):
        fit, held = (one.on(part) for part in (recordings[:3], recordings[3:]))
        pairs.append(Pair(at(fit, z), at(held, z, at(fit, z).scales)))
    base, more = pairs
    rod = yardstick(more.fit, 0)
    rod = replace(rod, level=1.1 * rod.of(base))
    assert judged(base, [Round(base, (), (more,), more)], 0, more, rod).verdict == verdict


def test_a_last_addition_that_hardly_explains_anything_is_set_apart(problem, sliding):
    """A first one brings friction to where it is; a second is a passenger."""
    followed, recordings = Followed(problem).hearing(sliding), problem.simulator.study.recordings
    drag, other = (
        next(c for c in candidates(problem) if c.effect.name == n) for n in ("linear_drag", "quadratic_drag")
    )
    wrong, right = z_of(problem, 0.5 * TRUTH), z_of(problem, TRUTH)
    pairs = []
    for effects, z in (((), wrong), ((drag,), np.append(right, 0.01)), ((drag, other), np.append(right, [0.01, 0.01]))):
        one = followed.with_problem(problem.with_effects(effects))
        fit, held = (one.on(part) for part in (recordings[:3], recordings[3:]))
        pairs.append(Pair(at(fit, z), at(held, z, at(fit, z).scales)))
    base, first, second = pairs
    rounds = [Round(base, (), (first,), first), Round(first, (), (second,), second)]
    said = judged(base, rounds, 0, second, yardstick(second.fit, 0))
    assert said.verdict == "mismatch" and [e.effect.name for e in said.after.fit.problem.effects] == ["linear_drag"]
    assert len(said.places) == len(said.explains) == 1 and said.explains[0] > 0.9
    assert corrected(said.after.fit, said.rod.replicas)
    assert [(p.placed.effect.name, share < 0.05) for p, share in said.negligible] == [("quadratic_drag", True)]


def test_what_is_sure_is_named_though_something_beside_it_cannot_be_told(problem, sliding, monkeypatch):
    """A first one brings friction most of the way; two that are told apart by nothing the rest."""
    followed, recordings = Followed(problem).hearing(sliding), problem.simulator.study.recordings
    drag, other, third = (
        next(c for c in candidates(problem) if c.effect.name == n)
        for n in ("linear_drag", "quadratic_drag", "payload_mass")
    )

    def pair(effects, share):
        one = followed.with_problem(problem.with_effects(effects))
        z = np.append(z_of(problem, share * TRUTH), np.full(sum(e.size for e in effects), 0.01))
        fit, held = (one.on(part) for part in (recordings[:3], recordings[3:]))
        return Pair(at(fit, z), at(held, z, at(fit, z).scales))

    base, first, second, rival = (
        pair(*given) for given in (((), 0.5), ((drag,), 0.75), ((drag, other), 1.0), ((drag, third), 1.0))
    )
    rounds = [Round(base, (), (first,), first), Round(first, (), (second, rival), second)]
    monkeypatch.setattr(judge, "alike", lambda *_: False)
    said = judged(base, rounds, 0, second, yardstick(second.fit, 0))
    assert said.verdict == "mismatch" and [e.effect.name for e in said.after.fit.problem.effects] == ["linear_drag"]
    assert {c.members[0].placed.effect.name for c in said.open_place} == {"quadratic_drag", "payload_mass"}
    fall = Fall("puck", 9, (0.0, 0.0, -9.4), (0.01, 0.01, 0.01), (0.0, 0.0, -9.81))
    monkeypatch.setattr(compose, "falls", lambda _: (fall,))
    summary = ContactComposer(said, [], 0).compose(1.0).summary
    assert "What else was left out the recordings do not tell: " in summary and fall.text not in summary
    alone = judged(first, rounds[1:], 0, second, yardstick(second.fit, 0))
    assert alone.verdict == "inconclusive" and not alone.open_place
    assert ContactComposer(alone, [], 0).compose(1.0).summary.endswith(fall.text)


def test_scales_of_one_column_are_its_own():
    scales = Scales(np.array([1.0, 3.0]))
    assert scales.only(1).values.tolist() == [3.0]


class Waves(Followed):
    """Predictions that turn about within a fraction of a sd of the first unknown, and are straight in the last."""

    size, floor, unknowns, shape = 2, np.full(2, -np.inf), Unknowns((), ()), (1, 10, 1)
    steps: list[tuple[int, float]]
    asked: list[int]
    recording = cached_property(lambda _: np.zeros(1, int))

    def __init__(self):
        object.__setattr__(self, "problem", self)
        object.__setattr__(self, "steps", [])
        object.__setattr__(self, "asked", [])

    def probes(self):
        return [np.array([0]), np.array([1])]

    def nudge(self, z, which, size):
        self.steps.append((int(which[0]), size))
        return size

    def errors(self, z):
        self.asked.append(len(z))
        phase = np.arange(10.0)
        return -(np.sin(20 * z[:, :1] + phase) + 3 * z[:, 1:])[:, None, :, None]


def test_sensitivities_are_taken_over_steps_on_which_both_sides_agree():
    waves, z = Waves(), np.zeros(2)
    columns, sizes = columns_of(waves, z, waves.errors(z[None])[0], None)
    assert sizes[1] == STEPS[0] and sizes[0] < STEPS[0]
    np.testing.assert_allclose(columns[0, :, 0, 0], 20 * np.cos(np.arange(10.0)), atol=3.0)
    np.testing.assert_allclose(columns[0, :, 0, 1], 3.0)
    waves.steps.clear()
    again, same = columns_of(waves, z, waves.errors(z[None])[0], sizes)
    assert waves.steps == [(0, sizes[0]), (1, sizes[1])]
    np.testing.assert_array_equal(same, sizes)
    np.testing.assert_array_equal(again, columns)


def test_what_recordings_share_of_a_psi_moves_its_mean_and_not_each_of_its_values(tmp_path, sliding):
    """A prediction sees the sum of both, of which only one has a prior that holds it for each recording."""
    psi = PSI.replace("[noise]", 'varies = "trajectory"\n[noise]')
    study = make_study(tmp_path / "study", XML.format(0.02), psi, slides())
    problem = make_problem(Simulator(study, num_threads=1))
    found = fit_followed(Followed(problem).hearing(sliding))
    slopes = problem.unknowns.varying[0].shared_slopes(found.z)
    own = np.stack([found.columns[found.followed.recording == r, ..., 1 + r] for r in range(4)])
    mu = np.stack([found.columns[found.followed.recording == r, ..., 0] for r in range(4)])
    np.testing.assert_allclose(np.nan_to_num(mu), np.nan_to_num(own * slopes[0, :, None, None, None]), atol=1e-12)
    assert z_of(problem, TRUTH)[0] == pytest.approx(found.z[0], abs=0.15)  # measured: 0.006 of a prior sd
    assert np.abs(found.z[1:]).max() < 0.5  # of the spread; measured: 0.26


@pytest.mark.parametrize("sds", [2.0, -1.0])
def test_own_values_of_held_out_recordings_are_looked_for_before_any_step(tmp_path, sliding, sds):
    psi = PSI.replace("[noise]", 'varies = "trajectory"\n[noise]')
    study = make_study(tmp_path / "study", XML.format(0.02), psi, slides())
    problem = make_problem(Simulator(study, num_threads=1))
    spread = problem.unknowns.varying[0].spread
    followed = Followed(problem).hearing(sliding)
    z = np.concatenate([z_of(problem, TRUTH - sds * spread), np.zeros(4)])
    fit = at(followed, np.concatenate([z_of(problem, TRUTH), np.zeros(4)]))
    np.testing.assert_array_equal(with_own(followed, z, fit.scales)[1:], sds)
    fitted = np.append(z[:1], sds + np.array([0.1, -0.1, 0.1, -0.1]))  # one of them is nearer than any that is tried
    found = with_own(followed, fitted, fit.scales)
    assert set(found[1:]) <= {*fitted[1:], sds} and (fit.loss - at(followed, found, fit.scales).loss) > -10


def test_sensitivities_that_are_known_nearby_are_not_found_anew():
    waves, z = Waves(), np.zeros(2)
    columns, sizes = columns_of(waves, z, waves.errors(z[None])[0])
    waves.steps.clear()
    half = np.array([sizes[0], np.nan])  # of the last unknown nothing is known
    again, found = columns_of(waves, z, waves.errors(z[None])[0], half, columns[..., :1])
    assert {which for which, _ in waves.steps} == {1}
    np.testing.assert_array_equal(found, sizes)
    np.testing.assert_array_equal(again, columns)


def test_errors_that_are_not_known_are_found_beside_the_first_differences():
    waves, z = Waves(), np.zeros(2)
    columns, sizes = columns_of(waves, z, waves.errors(z[None])[0])
    waves.asked.clear()
    again, found = columns_of(waves, z, None)
    assert waves.asked[0] == 5 and sum(n % 2 for n in waves.asked) == 1  # two sides of two unknowns, and the middle
    np.testing.assert_array_equal(found, sizes)
    np.testing.assert_array_equal(again, columns)


def test_of_what_is_held_no_sensitivities_are_found():
    waves, z = Waves(), np.zeros(2)
    columns, sizes = columns_of(waves, z, waves.errors(z[None])[0], untold=(0,))
    assert {which for which, _ in waves.steps} == {1} and np.isnan(sizes[0])
    assert (columns[..., 0] == 0).all()
    np.testing.assert_allclose(columns[0, :, 0, 1], 3.0)


def test_a_step_that_promises_next_to_nothing_is_not_tried(problem, sliding):
    counter, fit = problem.simulator.counter, at(Followed(problem).hearing(sliding), np.full(1, -0.5))
    promised = 0.5 * float((fit.slopes.sum(0) - fit.z) @ newton(fit, ()))
    tried, ends = [], []
    for settled in (0.9 * promised, 1.1 * promised):
        begun = counter.simulations
        ends.append(fit_followed(fit.followed, fit.z, like=fit, iterations=1, settled=settled))
        tried.append(counter.simulations - begun)
    assert tried[0] > 0 == tried[1] and ends[0].loss < ends[1].loss == fit.loss


@pytest.mark.parametrize(("needed", "tried"), [(-10.0, True), (3.0, True), (5.0, False)])
def test_no_step_is_tried_from_where_what_is_needed_is_out_of_reach(problem, sliding, needed, tried):
    """It is given up where a step promises less than a quarter of it."""
    fit = at(Followed(problem).hearing(sliding), np.full(1, -0.5))
    promised = 0.5 * float((fit.slopes.sum(0) - fit.z) @ newton(fit, ()))
    found = fit_followed(fit.followed, fit.z, like=fit, iterations=1, needed=needed * promised)
    assert (found.loss < fit.loss) == tried


def test_memories_are_tried_in_turn_until_two_serve_less(fit, monkeypatch):
    worth = dict(zip(MEMORIES, (5.0, 4.0, 6.0, 4.5, 0.0, 0.0), strict=True))

    def told(followed, z):
        one = replace(fit, followed=followed)
        one.__dict__["losses"] = np.array([worth[followed.memory]])
        return one

    monkeypatch.setattr(pair_module, "at", told)
    tried = pair_module.remembering_each(fit, MEMORIES)
    assert [f.followed.memory for f in tried] == list(MEMORIES[:4])
    assert len(pair_module.remembering_each(fit, MEMORIES, -1e9)) == MOST_WORSE


def test_what_is_heard_is_told_without_a_simulation(problem, sliding):
    begun, whole = problem.simulator.counter, at(Followed(problem), z_of(problem, TRUTH))
    count = begun.simulations
    some = whole.hearing(sliding)
    assert begun.simulations == count
    assert some.loss == pytest.approx(at(Followed(problem).hearing(sliding), whole.z).loss, abs=1e-9)


def test_the_regards_of_contact_that_are_told_best_are_fitted(problem, sliding):
    """None, the likeliest one, and the likeliest by what that tells."""

    def way(one):
        return (one.followed.ground.holds, one.followed.ground.share) if one.followed.ground else None

    fit = fit_followed(Followed(problem, 12.0).hearing(sliding), z_of(problem, TRUTH))
    found = grounded(fit)
    assert found[0] is fit and all(f.loss <= at(f.followed, fit.z).loss for f in found)
    ground = Ground(problem, fit.z)
    each = [fit, *(at(fit.followed.grounded(ground.regarding(*regard)), fit.z) for regard in REGARDS)]
    likeliest = min(each, key=lambda f: f.loss)
    clearest = min(each, key=lambda f: f.hearing(telling(likeliest)).loss)
    assert {way(f) for f in found} == {None, way(likeliest), way(clearest)}


def steps_of(problem, monkeypatch, losses, grounded=None):
    """Fits by steps 1, 2 and 4 times as short have these losses; led by ground that is found anew, `grounded`."""
    step, asked = float(problem.simulator.model.opt.timestep), []

    def told(followed, z, **_):
        times = round(step / (followed.problem.timestep or step))
        anew = followed.ground is not None and followed.ground.problem.timestep is not None
        asked.append("anew" if anew else times)
        one = ContactFit(followed, z, np.zeros(followed.shape), Scales(np.ones(followed.shape[-1])))
        one.__dict__["losses"] = np.full(followed.count, (grounded if anew else losses[times]) / followed.count)
        return one

    monkeypatch.setattr(believed_module, "fit_followed", told)
    return told, asked


@pytest.mark.parametrize(
    ("losses", "best", "asked"),
    [
        ({1: 10, 2: 8, 4: 5}, 4, [2, 4]),
        ({1: 10, 2: 8, 4: 9}, 2, [2, 4]),
        ({1: 10, 2: 11, 4: 5}, 1, [2]),
    ],
)
def test_shorter_steps_are_tried_while_they_tell_better(problem, monkeypatch, losses, best, asked):
    told, seen = steps_of(problem, monkeypatch, losses)
    plain = told(Followed(problem), np.zeros(1))
    del seen[:]
    found = finer(plain)
    assert seen == asked and found.losses.sum() == pytest.approx(losses[best])
    assert (found is plain) is (best == 1)
    if best == 2:  # what is by half the step already is asked for a quarter alone
        del seen[:]
        assert finer(found) is found and seen == [4]


@pytest.mark.parametrize("grounded", [4.0, 9.0])
def test_under_shorter_steps_what_contact_does_is_found_anew_if_that_tells_better(problem, monkeypatch, grounded):
    told, asked = steps_of(problem, monkeypatch, {1: 10, 2: 8, 4: 9}, grounded)
    followed = Followed(problem)
    found = finer(told(followed.grounded(Ground(problem, np.zeros(1), True, 0.1)), np.zeros(1)))
    assert asked == [1, 2, 4, "anew"] and found.losses.sum() == pytest.approx(min(grounded, 8))
    assert (found.followed.ground.holds, found.followed.ground.share) == (True, 0.1)


@pytest.mark.parametrize("room", [0.1, 0.16, 0.3])
def test_beside_a_wall_slopes_are_over_what_is_left_of_a_step(room):
    waves, z = Waves(), np.zeros(2)
    object.__setattr__(waves, "floor", np.array([-np.inf, -room]))
    columns, _ = columns_of(waves, z, waves.errors(z[None])[0], np.array([STEPS[-1], STEPS[0]]))
    np.testing.assert_allclose(columns[0, :, 0, 1], 3.0, rtol=1e-9)


def test_sensitivities_of_other_recordings_serve_for_none(fit):
    other = replicated(fit, np.random.default_rng(1))
    same = fit.followed.on(fit.problem.simulator.study.recordings)
    assert fit.followed.leads_as(same) and not fit.followed.leads_as(other)
    assert fit.columns.size and _taught(at(same, fit.z), fit).known is not None
    assert _taught(at(other, fit.z), fit).known is None


def test_sensitivities_that_served_for_two_steps_are_not_those_of_the_end(problem, sliding):
    """Where a fit ends they are found anew, however it came there; two steps a set are at least as far as one."""
    followed = Followed(problem, 6.0).hearing(sliding)
    fits = [fit_followed(followed, np.full(1, start), iterations=n) for start in (0.5, -0.8) for n in (1, 2, 10)]
    assert [f.known for f in fits] == [None] * 6
    there = at(followed, fits[2].z, fits[2].scales)
    np.testing.assert_allclose(fits[2].columns, there.columns, atol=1e-9)
    assert fits[2].loss <= fits[1].loss <= fits[0].loss


def test_a_fit_that_is_taught_by_one_nearby_ends_at_the_same_place(problem, sliding):
    """Far from it its sensitivities do not serve, and with another memory neither."""
    followed = Followed(problem, 6.0).hearing(sliding)
    fit = fit_followed(followed, np.full(1, 0.5))
    taught = fit_followed(followed, fit.z + 0.1, like=fit)
    assert abs(taught.z - fit.z)[0] < 3 * np.sqrt(fit.covariance[0, 0])
    at_once = [_taught(at(f, z), fit) for f, z in ((followed, fit.z + 0.1), (followed, fit.z + 1.0))]
    at_once.append(_taught(at(followed.remembering(12.0), fit.z), fit))
    assert [f.known is not None for f in at_once] == [True, False, False]
    assert all(f.sizes is not None and np.isfinite(f.sizes).all() for f in at_once)


@pytest.mark.parametrize(("share", "best", "asked"), [(1.0, 1.0, 1), (0.3, 0.3, 2), (3.0, 3.0, 2), (0.1, 0.1, 3)])
def test_along_a_step_is_asked_where_it_can_be_better(problem, sliding, monkeypatch, share, best, asked):
    """A step that is right, too long, too short, and much too long."""
    fit, told = at(Followed(problem, 6.0).hearing(sliding), np.full(1, -0.96)), []
    slope = (fit.slopes.sum(0) - fit.z)[0]

    def parabola(followed, z):
        told.extend(z)
        found = [fit_module.ContactFit(followed, one, fit.errors, fit.scales) for one in z]
        for one in found:
            x = one.z[0] - fit.z[0]
            one.__dict__["losses"] = np.array([fit.loss - slope * x * (1 - x / 0.2) - 0.5 * one.z @ one.z])
        return found

    monkeypatch.setattr(fit_module, "fits_at", parabola)
    found = fit_module._along(fit, np.full(1, 0.1 / share))
    assert len(told) == asked
    np.testing.assert_allclose(found.z, fit.z + best * 0.1 / share)


def test_evolution_ends_where_nothing_better_is_found_for_long(problem, sliding):
    top = fit_followed(Followed(problem, 6.0).hearing(sliding), np.full(1, 0.2))
    asked = []

    def unknowns(x):
        asked.append(x)
        return top.z + 1.0 + x**2  # all are worse

    z = evolved(top, unknowns, size=1, sigma=1.0, population=4, generations=20)
    assert z is top.z and len(asked) == 4 * PATIENCE
