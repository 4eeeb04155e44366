"""Heavy-tailed measurement noise, against scipy's Student t and against outliers."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from scipy.optimize import minimize
from scipy.stats import norm, t
from simulated import SPRING, SPRING_PSI, fit, here, noise_table, recordings

from det2stoc_bayes.density import Density
from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.map import find_map
from det2stoc_bayes.measurement import Measurement
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

STUDENT = '[likelihood]\nnoise = "student_t"\n'
ERRORS = np.concatenate([-np.logspace(3, -9, 40), [0.0], np.logspace(-9, 3, 40)])


@pytest.mark.parametrize("nu", [1.0, 4.0, 30.0])
def test_the_density_is_students(nu):
    m = Measurement(nu)
    np.testing.assert_allclose(m.log_peak - 0.5 * m.bend(ERRORS) ** 2, t(nu).logpdf(ERRORS), rtol=1e-12)
    step = 1e-6 * np.maximum(np.abs(ERRORS), 1e-3)
    slope = (m.bend(ERRORS + step) - m.bend(ERRORS - step)) / (2 * step)
    np.testing.assert_allclose(m.slope(ERRORS), slope, rtol=1e-6)
    drawn = m.bend(t(nu).rvs(200_000, random_state=0)) ** 2
    assert drawn.mean() == pytest.approx(m.mean_square, abs=5 * drawn.std() / np.sqrt(200_000))


def test_the_normal_density_leaves_errors_as_they_are():
    m = Measurement()
    np.testing.assert_array_equal(m.bend(ERRORS), ERRORS)
    np.testing.assert_allclose(m.log_peak - 0.5 * m.bend(ERRORS) ** 2, norm.logpdf(ERRORS))
    assert m.mean_square == 1 and (m.slope(ERRORS) == 1).all()


def outlying(folder, toml, share=0.1, **options):
    """A mass on a spring; a share of its positions is wrong, and always to one side."""
    starts = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5])]
    made = recordings(model_xml(SPRING), starts, 10 * np.arange(100), (0.01, 0.1), seed=3)
    random = np.random.default_rng(7)
    for _, table in made.values():
        for values in table.values():
            wrong = random.random(100) < share
            values += wrong * random.uniform(0.2, 0.6, 100) * np.ptp(values)
    study = make_study(folder / "spring", model_xml(SPRING), SPRING_PSI + noise_table(0.01, 0.1) + toml, made)
    return make_problem(Simulator(study, num_threads=1), **options)


def test_outliers_bend_a_normal_fit_and_hardly_a_students(tmp_path):
    found = {name: find_map(outlying(tmp_path / name, toml)) for name, toml in (("n", ""), ("t", STUDENT))}
    psi = {name: f.problem.psi(f.point.z) for name, f in found.items()}
    sd = np.sqrt(np.diag(found["t"].covariance)) * [0.1, 3]
    # Measured: damping 0.566 and 0.390 +- 0.013, stiffness 29.93 and 30.04 +- 0.06; inflation 41 and 2.2.
    assert abs(psi["n"][0] - 0.4) > 0.1
    np.testing.assert_array_less(np.abs(psi["t"] - [0.4, 30]), 4 * sd)
    assert found["n"].noise_inflation > 20 and found["t"].noise_inflation < 4


def test_clean_noise_is_judged_the_same_by_both(tmp_path):
    normal = find_map(outlying(tmp_path / "n", "", share=0.0))
    student = find_map(outlying(tmp_path / "t", STUDENT + "degrees_of_freedom = 1e6\n", share=0.0))
    assert student.log_likelihood == pytest.approx(normal.log_likelihood, rel=1e-4)
    np.testing.assert_allclose(student.covariance, normal.covariance, rtol=1e-3)
    assert student.noise_inflation == pytest.approx(normal.noise_inflation, rel=1e-3)


def test_the_exact_density_is_students_of_the_residuals(tmp_path):
    """With starts as good as known nothing is left to integrate out."""
    problem = outlying(tmp_path, STUDENT)
    problem.guess.prior_sd[:] = 1e-9
    linear = here(problem)
    density = Density.at(linear)
    r = problem.residuals(problem.simulator.rollout(problem.request(np.zeros((1, 2)), problem.guess.start)))
    expected = t(4).logpdf(r * problem.weight) + np.log(problem.weight)
    assert density.log_likelihood(np.zeros((1, 2)))[0] == pytest.approx(expected.sum(), rel=1e-9)
    assert linear.log_likelihood == pytest.approx(expected.sum(), rel=1e-9)


def test_starts_are_refitted_at_each_point_as_a_minimizer_would(tmp_path):
    """The joint density of samples and starts at its top, by a general minimizer over the same sensitivities."""
    problem = outlying(tmp_path, STUDENT)
    problem.guess.prior_sd[:] *= 10  # so that starts have a say
    density = Density.at(fit(problem))
    for shift in ([0.0, 0.0], [4.0, -6.0], [-15.0, 10.0]):
        z = density.center + density.scale @ shift
        left = density.projected(z[None])[..., 0]
        r = problem.residuals(problem.simulator.rollout(problem.request(z[None], density.start)))
        for s, error in enumerate(r * problem.weight):
            sd, offset = density.latent.prior_sd[s], density.offset[s]

            def loss(x, s=s, error=error, sd=sd, offset=offset):
                e = error - density.sensitivity[s] @ (x * sd)
                return -t(4).logpdf(e).sum() + 0.5 * ((offset / sd - x) ** 2).sum()

            least = minimize(loss, np.zeros(2), method="BFGS", options={"gtol": 1e-8}).fun
            peak = -len(error) * t(4).logpdf(0.0)
            assert 0.5 * left[s] @ left[s] + peak == pytest.approx(least, abs=1e-6)


def test_heavy_tails_and_unknown_starts_leave_the_truth_likeliest(tmp_path):
    """Far from the top, too, where errors from the frozen starts are many sds and outliers are everywhere."""
    problem = outlying(tmp_path, STUDENT)
    density = Density.at(fit(problem))
    far = density.center + (density.scale @ np.array([[20.0, 0], [-20, 0], [0, 20], [0, -20], [20, 20]]).T).T
    best, *others = density.log_density(np.stack([density.center, *far]))
    # Measured: 117 to 211 nats; 30 to 88 where bent errors are projected.
    assert max(others) < best - 60


def test_the_gradient_is_that_of_the_density(tmp_path):
    density = Density.at(fit(outlying(tmp_path, STUDENT)))
    z = density.center + density.scale @ [0.7, -1.1]
    _, gradient = density.value_and_grad(z[None])
    ways = 0.02 * density.scale.T
    slopes = [np.diff(density.log_density(np.stack([z - w, z + w])))[0] / 2 for w in ways]
    np.testing.assert_allclose(ways @ gradient[0], slopes, rtol=2e-2, atol=1e-5)


def test_both_engines_have_one_density(tmp_path):
    import jax.numpy as jnp

    from det2stoc_bayes.density_jax import jax_terms

    density = Density.at(fit(outlying(tmp_path, STUDENT)))
    problem = density.problem
    other = make_problem(Simulator(problem.simulator.study, "mjx"))
    jaxed = Density(other, density.center, density.scale, density.start, density.latent, density.offset)
    z = density.center + density.scale @ [0.5, 1.0]
    expected, terms = density.log_likelihood_by_recording(z[None])[0], jax_terms(jaxed)
    np.testing.assert_allclose(np.asarray(terms(jnp.asarray(z))), expected, rtol=1e-7)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('noise = "cauchy"', "likelihood.noise: found 'cauchy'; allowed: 'normal' or 'student_t'"),
        ("degrees_of_freedom = 4.0", 'likelihood.degrees_of_freedom: found 4 with noise = "normal"'),
        ('noise = "student_t"\ndegrees_of_freedom = 0', "likelihood.degrees_of_freedom: found 0; allowed: greater"),
        ("nu = 4", "likelihood.nu: unknown key; .*allowed: noise, degrees_of_freedom"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, table, said):
    with pytest.raises(StudyError, match=said):
        make_study(tmp_path / "a", model_xml(SPRING), f"[likelihood]\n{table}\n")
