"""Posteriors behind a claim: against closed forms, against NUTS, and calibrated."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import ARM, make_study, model_xml
from scipy import stats
from simulated import PENDULUM, SPRING, SPRING_PSI, fit, noise_table, place, pose, recordings, spring_problem

from det2stoc_bayes.density import Density, log_prior
from det2stoc_bayes.inference import nuts
from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.belief import believe, roughly
from det2stoc_bayes.mismatch.coordinates import Affine, Population
from det2stoc_bayes.mismatch.credence import compared
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.leave_out import doubtful, k_hats
from det2stoc_bayes.models import linear_gaussian
from det2stoc_bayes.optimize import fit_many
from det2stoc_bayes.populations import freed
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.psis import reliable, standard_errors
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import load_study
from det2stoc_bayes.verbs import tempered

NOISE = 0.01


def psi(name, target, loc, scale):
    return f'[psi.{name}]\ntarget = "{target}"\nprior = {{ Normal = {{ loc = {loc}, scale = {scale} }} }}\n'


@pytest.fixture(scope="module")
def gaussian(tmp_path_factory):
    folder = linear_gaussian.write_study(tmp_path_factory.mktemp("belief") / "slides", (0.3, -0.1), seed=1)
    return make_problem(Simulator(load_study(folder), num_threads=1))


def coulomb(folder):
    def push(model, data):
        data.qfrc_applied[0] = -0.1 * np.tanh(data.qvel[0] / 0.01)

    made = recordings(
        model_xml(PENDULUM), [([0.8], [0.0]), ([-0.5], [1.0])], 10 * np.arange(30), (NOISE, 0.1), push=push
    )
    toml = psi("mass", "body/rod/mass", 0.8, 0.1) + psi("damping", "joint/pivot/damping", 0.05, 0.03)
    problem = pose(make_study(folder, model_xml(PENDULUM), toml + noise_table(NOISE, 0.1), made))
    return problem, place(problem, "coulomb_friction", "pivot", Typical(force=0.3, speed=1.0, span=0.5, inertia=0.07))


# --- closed form ----------------------------------------------------------------------------------
def test_closed_form(gaussian):
    mean, covariance = linear_gaussian.exact_posterior(gaussian)
    found = believe(fit(gaussian, tolerance=1e-5), 1.0, 0)
    draws, sd = gaussian.psi(found.z), np.sqrt(np.diag(covariance))
    assert found.method == "laplace+psis" and found.k_hat < 0.3 and found.z.shape == (1000, 2)
    assert (np.abs(draws.mean(0) - mean) < 0.08 * sd).all()  # measured over four seeds: 0.023 at most (256 points)
    np.testing.assert_allclose(draws.std(0), sd, rtol=0.08)  # measured: 0.027
    assert np.corrcoef(draws.T)[0, 1] == pytest.approx(covariance[0, 1] / sd.prod(), abs=0.08)


def test_model_error_widens_the_target(gaussian):
    """A likelihood to the power 1/4 is noise of twice the sd, but for the prior."""
    found = fit(gaussian, tolerance=1e-5)
    wide = replace(found, noise_scale=2.0)
    power = Density.at(wide, 0.25)
    z = np.random.default_rng(0).standard_normal((5, 2))
    np.testing.assert_allclose(power.log_likelihood(z), Density.at(found).log_likelihood(z) / 4, rtol=1e-9)
    np.testing.assert_allclose(
        power.terms_and_grad(z)[1], Density.at(found).terms_and_grad(z)[1] / 4, rtol=1e-6, atol=1e-9
    )
    sd = [believe(f, s, 0).z.std(0) for f, s in ((found, 1.0), (wide, 0.5))]
    gram = found.linear.gram()[0].sum(0)
    exact = [np.sqrt(np.diag(np.linalg.inv(p * gram + np.eye(2)))) for p in (1.0, 0.25)]
    np.testing.assert_allclose(sd[1] / sd[0], exact[1] / exact[0], rtol=0.1)


def test_a_gaussian_s_draws_stay_within_the_walls(tmp_path):
    """Friction that the recordings hardly show is not negative; what has no wall keeps the Gaussian's moments."""
    problem, effect = coulomb(tmp_path / "study")
    found = fit(problem.with_effects([effect]))
    drawn = roughly(found, 1e-3, 0)
    assert drawn.method == "laplace" and drawn.terms is None and len(drawn.z) == 1000
    assert (drawn.z[:, 2] >= 0).all() and drawn.z[:, 2].min() < 0.2
    power = found.linear.gram()[0].sum(0) * 1e-3 / found.noise_scale + np.eye(3)
    np.testing.assert_allclose(drawn.z[:, 0].std(), np.sqrt(np.linalg.inv(power)[0, 0]), rtol=0.1)
    beyond = found.point.z - [0, 0, 10]
    assert drawn.density.log_likelihood(beyond[None]) == -np.inf


def test_same_seed_same_draws(gaussian):
    found = fit(gaussian)
    np.testing.assert_array_equal(believe(found, 1.0, 3).z, believe(found, 1.0, 3).z)
    assert not np.array_equal(believe(found, 1.0, 3).z, believe(found, 1.0, 4).z)


# --- against NUTS ---------------------------------------------------------------------------------
def dry_friction(folder):
    """A hinge with friction, one of whose walls is near; states are recorded."""
    problem, effect = coulomb(folder)
    return problem.with_effects([effect])


def two_joints(folder):
    """An arm by positions alone: dry friction at one joint, a spring at the other, and a psi that is hardly told."""

    def push(model, data):
        data.qfrc_applied[:] = -0.2 * np.tanh(data.qvel[0] / 0.01), -0.5 * (data.qpos[1] - 0.2)

    xml, starts = model_xml(ARM), [([0.6, 0.4], [0.0, 0.0]), ([-0.4, 0.9], [1.0, -1.0]), ([0.2, -0.5], [-2.0, 2.0])]
    made = recordings(xml, starts, 10 * np.arange(30), [NOISE] * 4, push=push, columns=("qpos/shoulder", "qpos/elbow"))
    toml = psi("damping", "joint/shoulder/damping", 0.3, 0.1) + psi("armature", "joint/elbow/armature", 0.005, 0.002)
    problem = pose(make_study(folder, xml, toml + noise_table(NOISE), made))
    typical = Typical(force=0.5, speed=2.0, span=0.5, inertia=0.2)
    pairs = (("coulomb_friction", "shoulder"), ("joint_spring", "elbow"))
    return problem.with_effects([place(problem, *pair, typical) for pair in pairs])


def outliers(folder):
    """A mass on a spring in a medium, measured with heavy tails."""
    heavy = '[likelihood]\nnoise = "student_t"\n'

    def push(model, data):
        data.qfrc_applied[0] = -0.3 * data.qvel[0] * abs(data.qvel[0])

    starts = [([0.3], [0.0]), ([-0.2], [1.5])]
    made = recordings(model_xml(SPRING), starts, 10 * np.arange(25), (0.01, 0.1), push=push)
    problem = pose(make_study(folder, model_xml(SPRING), SPRING_PSI + noise_table(0.01, 0.1) + heavy, made))
    return problem.with_effects([place(problem, "quadratic_damping", "slide", Typical(force=1.0, speed=1.0))])


@pytest.mark.timeout(900)  # NUTS on simulations, a minute each alone
@pytest.mark.parametrize(
    ("study", "num_samples"),
    [(dry_friction, 1200), *(pytest.param(study, 320, marks=pytest.mark.long) for study in (two_joints, outliers))],
)
def test_cheap_and_exact_agree(tmp_path, study, num_samples):
    found = fit(study(tmp_path / "study"))
    assert found.noise_inflation < 1.4
    cheap = believe(found, 1.0, 0)
    chains = nuts.draw(cheap.density, 1, num_samples=num_samples, num_warmup=60)
    told = compared("after", cheap, chains)
    assert told["r_hat"] < 1.05
    assert cheap.k_hat < 0.7
    assert chains.shape[-1] == cheap.z.shape[-1]
    scale = chains.std((0, 1))
    _, times = np.unique(cheap.z, axis=0, return_counts=True)  # draws repeat where weights differ
    effective = times.sum() ** 2 / (times**2).sum()
    assert effective > 90
    errors = 3 * np.hypot(standard_errors(chains), scale / np.sqrt(effective))
    # Stated tolerance beside the errors of chance: 2 % of a sd.
    assert (np.abs(cheap.z.mean(0) - chains.mean((0, 1))) < errors + 0.02 * scale).all(), told
    np.testing.assert_allclose(cheap.z.std(0), scale, rtol=0.15 if num_samples > 1000 else 0.25)


# --- where a Gaussian fails -----------------------------------------------------------------------
@pytest.fixture
def shaped(gaussian, monkeypatch):
    """Replaces the likelihood by a function of whitened coordinates about the fit."""
    found = fit(gaussian, tolerance=1e-5)
    inverse = Affine(found, 1.0)
    center = inverse(np.zeros((1, 2)))[0][0]
    root = (inverse(np.eye(2))[0] - center).T

    def replaced(log_density):
        def terms(self, z):
            x = np.linalg.solve(root, (z - center).T).T
            total = log_density(x) - log_prior(z)
            return np.stack([total / 2, total / 2], 1)

        monkeypatch.setattr(Density, "log_likelihood_by_recording", terms)

        def whitened(z):
            return np.linalg.solve(root, (z - center).T).T

        return found, whitened

    return replaced


def test_a_proposal_that_is_off_adapts(shaped):
    """A Gaussian five sds away and half as wide."""
    found, whitened = shaped(lambda x: -0.5 * (((x - [5.0, -4.0]) / 0.5) ** 2).sum(1))
    drawn = believe(found, 1.0, 0)
    assert drawn.method == "adapted" and drawn.k_hat < 0.7
    x = whitened(drawn.z)
    np.testing.assert_allclose(x.mean(0), [5.0, -4.0], atol=0.1)
    np.testing.assert_allclose(x.std(0), 0.5, rtol=0.15)


def test_particles_where_importance_sampling_fails(shaped):
    """A thin, bent ridge: y about x^2."""

    def ridge(x):
        return stats.norm.logpdf(x[:, 0]) + stats.norm.logpdf(x[:, 1], x[:, 0] ** 2, 0.05)

    found, whitened = shaped(ridge)
    alone, drawn = believe(found, 1.0, 0), believe(found, 1.0, 0, temper=tempered)
    assert alone.method == "laplace" and alone.k_hat > reliable(alone.evaluations)
    assert drawn.method == "smc"
    x = whitened(drawn.z)
    # Measured: 0.047 and 0.95.
    np.testing.assert_allclose((x[:, 1] - x[:, 0] ** 2).std(), 0.05, rtol=0.2)
    np.testing.assert_allclose(x[:, 0].std(), 1.0, rtol=0.2)


def test_a_few_draws_in_a_bent_valley_do_not_pass_as_its_width(shaped):
    """Ten thousand times as long as wide: no draw of a Gaussian lies in it but by chance."""

    def ridge(x):
        return stats.norm.logpdf(x[:, 0]) + stats.norm.logpdf(x[:, 1], 30 * x[:, 0] ** 2, 1e-4)

    found, whitened = shaped(ridge)
    drawn = believe(found, 1.0, 0)
    assert drawn.method == "laplace" and drawn.terms is None
    assert doubtful(drawn, k_hats(drawn)) == tuple(
        r.name for r in found.problem.segments.recordings
    )  # left out by exact refits
    assert drawn.k_hat > reliable(drawn.evaluations) and 0.7 < drawn.summary()["k_hat"] <= 10.0
    assert whitened(drawn.z)[:, 0].std() > 0.8


# --- populations ----------------------------------------------------------------------------------
VARYING = psi("stiffness", "joint/slide/stiffness", 30, 3) + 'varies = "trajectory"\n'


def test_volume_of_a_population_s_coordinates(tmp_path):
    held = fit(spring_problem(tmp_path, toml=VARYING + psi("damping", "joint/slide/damping", 0.4, 0.1)))
    own = freed(held)
    coordinates = Population(held, own.problem.unknowns, 1.0)
    assert coordinates.size == own.problem.size == 6  # mu, sigma, three recordings, damping
    for x in np.random.default_rng(0).standard_normal((3, 6)):
        h = 1e-5
        ends = [coordinates(x + s * h * np.eye(6))[0] for s in (1, -1)]
        jacobian = (ends[0] - ends[1]) / (2 * h)
        assert coordinates(x[None])[1][0] == pytest.approx(np.linalg.slogdet(jacobian)[1], abs=1e-4)


# --- calibration ----------------------------------------------------------------------------------
def covered(problem, truth, seed):
    """Whether 95 % intervals of belief hold the truth; one Gauss-Newton fit from the prior's median."""
    found = fit_many([(problem, start_point(problem))], max_iterations=12, free_scale=False)[0]
    drawn = believe(found, 1.0, seed)
    low, high = np.percentile(drawn.z, (2.5, 97.5), axis=0)
    return (low <= truth) & (truth <= high)


@pytest.mark.long
def test_intervals_are_calibrated_when_linear(gaussian):
    random, setting = np.random.default_rng(11), linear_gaussian.Setting()
    held = []
    for r in range(100):
        gravity = linear_gaussian.draw_gravity(random, setting)
        problem = linear_gaussian.with_recordings(gaussian, linear_gaussian.simulate(gravity, random, setting))
        truth = (gravity - np.asarray(setting.prior_mean)) / np.asarray(setting.prior_sd)
        held.append(covered(problem, truth, r))
    for count in np.sum(held, 0):
        assert stats.binomtest(int(count), 100, 0.95).pvalue > 0.01, count
