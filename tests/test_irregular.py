"""Recordings with holes, uneven times and other columns in each: the same psi as the closed form has."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import SPRING, SPRING_PSI, fit, jacobians, noise_table, pose, recordings

from det2stoc_bayes.density import Density
from det2stoc_bayes.map import find_map
from det2stoc_bayes.mismatch.horizon import climb

STARTS = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5]), ([0.0], [2.0])]
COLUMNS = [("qpos/slide", "qvel/slide"), ("qpos/slide",), ("qvel/slide",), ("qpos/slide", "qvel/slide")]
NOISE = (0.01, 0.1)


def irregular(dropped=0.3, seed=0):
    """A mass on a spring: uneven times, cells dropped, positions or speeds alone in two of four recordings."""
    random, out = np.random.default_rng(seed), {}
    for number, (start, columns) in enumerate(zip(STARTS, COLUMNS, strict=True)):
        steps = np.cumsum(random.integers(1, 25, 120))
        (made,) = recordings(
            model_xml(SPRING), [start], steps - steps[0], NOISE, seed=seed + number, columns=columns
        ).values()
        time, table = made
        for values in table.values():
            values[random.random(120) < dropped] = np.nan
        out[f"run_{number}"] = (time, table)
    return out


def posed(folder, made, noise=True):
    toml = SPRING_PSI + (noise_table(*NOISE) if noise else "")
    return pose(make_study(folder, model_xml(SPRING), toml, made))


@pytest.mark.parametrize("search", [find_map, climb])
def test_irregular_recordings_are_fitted(tmp_path, search):
    found = search(posed(tmp_path / "a", irregular()))
    psi, sd = found.problem.psi(found.point.z), np.sqrt(np.diag(found.covariance)) * [0.1, 3]
    # Measured: 0.3 and 0.8 sds off, noise inflation 1.00 (518 values).
    np.testing.assert_array_less(np.abs(psi - [0.4, 30]), 4 * sd)
    assert 0.8 < found.noise_inflation < 1.2


def test_unknown_noise_is_found_in_them(tmp_path):
    problem = posed(tmp_path / "a", irregular(), noise=False)
    # Measured: 0.90 and 0.96 of the truth, from 160 and 250 values.
    np.testing.assert_allclose(problem.noise, NOISE, rtol=0.3)
    found = climb(problem)
    assert found is not None
    np.testing.assert_array_less(
        np.abs(found.problem.psi(found.point.z) - [0.4, 30]), 4 * np.sqrt(np.diag(found.covariance)) * [0.1, 3]
    )


def test_a_cell_that_was_dropped_counts_for_nothing(tmp_path):
    """Rows whose cells are all empty, and columns that a recording lacks or has without a value there."""
    made = irregular()
    sparse = {}
    for name, (time, table) in made.items():
        seen = np.isfinite(np.stack(list(table.values()))).any(0)
        seen[[0, -1]] = True  # the ends decide how long is simulated
        sparse[name] = (time[seen], {c: v[seen] for c, v in table.items()})
    whole, part = (find_map(posed(tmp_path / n, m)) for n, m in (("whole", made), ("part", sparse)))
    np.testing.assert_allclose(part.point.z, whole.point.z, atol=1e-3)
    np.testing.assert_allclose(part.covariance, whole.covariance, rtol=1e-3)


def test_the_likelihood_is_the_dense_gaussian(tmp_path):
    """In closed form: the motion is linear in its start, and psi is held."""
    problem = posed(tmp_path / "a", irregular())
    held = fit(problem, tolerance=1e-4)
    density = Density.at(held)
    z = held.point.z
    shift = z + 0.5 * np.sqrt(np.diag(held.covariance))
    found = np.diff(density.log_likelihood(np.stack([z, shift])))[0]
    expected = [_dense(problem, point, held.point.start) for point in (z, shift)]
    # Measured: -0.238 and -0.221 nats: the density keeps the starts' sensitivities of the MAP.
    assert found == pytest.approx(expected[1] - expected[0], abs=0.05)


def _dense(problem, z, start):
    """log N of the residuals with starts integrated out, unknowns held."""
    r, a, _ = jacobians(problem, z, start)
    guess, total = problem.guess, 0.0
    off = np.concatenate([guess.start.qpos - start.qpos, guess.start.qvel - start.qvel], 1)
    for s in range(problem.segments.count):
        seen = problem.weight[s] > 0
        sensitivity = a[s][seen]
        covariance = np.diag(problem.weight[s][seen] ** -2.0)
        covariance += sensitivity @ np.diag(guess.prior_sd[s] ** 2) @ sensitivity.T
        difference = r[s][seen] - sensitivity @ off[s]
        total += -0.5 * (difference @ np.linalg.solve(covariance, difference) + np.linalg.slogdet(covariance)[1])
    return total
