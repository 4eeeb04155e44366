"""Calibration on replications whose posteriors are known: right ones pass, narrow and shifted ones do not."""

import json
from dataclasses import asdict, replace
from functools import partial

import numpy as np
import pytest
import xarray as xr
from simulated import spring_problem

from det2stoc_bayes.calibration import NUM_DRAWS, Experiment, Replication, judge, run, to_json
from det2stoc_bayes.coverage import ecdf_band, holm
from det2stoc_bayes.errors import Det2StocError, SamplingFailed
from det2stoc_bayes.executors import Here
from det2stoc_bayes.models import PROBLEMS, get_problem, linear_gaussian
from det2stoc_bayes.replication import bare, fitted_start, replicate
from det2stoc_bayes.report.calibration_page import calibration_page

COUNT = 500


@pytest.fixture(scope="module")
def known():
    """Truths of many replications of the linear Gaussian study, and mean and root of covariance of their posteriors."""
    problem = bare(get_problem("linear_gaussian", num_threads=1))
    start, setting = fitted_start(problem), linear_gaussian.SETTING
    truths, means, roots = [], [], []
    for index in range(COUNT):
        posed, truth = replicate(problem, start, np.random.default_rng([0, index]))
        mean, covariance = linear_gaussian.exact_posterior(posed)
        sd = np.array(setting.prior_sd)
        truths.append(truth)
        means.append((mean - setting.prior_mean) / sd)
        roots.append(np.linalg.cholesky(covariance / np.outer(sd, sd)))
    return truths, np.stack(means), np.stack(roots)


def judged(known, stretch=1.0, shift=0.0, failed=()):
    truths, means, roots = known
    u = np.random.default_rng(1).standard_normal((COUNT, NUM_DRAWS, 2))
    sd = np.sqrt((roots**2).sum(-1))
    draws = means[:, None] + shift * sd[:, None] + stretch * np.einsum("rij,rdj->rdi", roots, u)
    every = [Replication(i, dict(truths[i]), draws[i].tolist(), 200.0) for i in range(COUNT)]
    every = [replace(r, draws=[], failed="no") if r.index in failed else r for r in every]
    return judge(every, problem="linear_gaussian", method="closed form")


def test_exact_posteriors_of_replications_are_calibrated(known):
    found = judged(known)
    assert found.calibrated, found.verdict
    assert "no test of 500 replications rejects it at 1%" in found.verdict
    told = found.least_shift, found.least_narrowness
    assert told == pytest.approx((0.215, 1.379), rel=0.2)  # measured
    assert f"shifted by {found.least_shift:.2g} of their sds" in found.verdict
    for unknown in found.unknowns:
        assert abs(unknown.mean - 0.5) < 0.04 and abs(unknown.spread - 1) < 0.13  # 3 standard errors
        assert 0.3 < unknown.sd < 0.8


@pytest.mark.parametrize(
    ("wrong", "shape"),
    [
        ({"stretch": 0.8}, "too narrow"),
        ({"stretch": 1.25}, "too wide"),
        ({"shift": 0.3}, "too high"),
        ({"shift": -0.3}, "too low"),
    ],
)
def test_wrong_posteriors_are_rejected_and_told_how(known, wrong, shape):
    found = judged(known, **wrong)
    assert not found.calibrated
    assert any(u.rejected for u in found.unknowns)
    assert {u.shape for u in found.unknowns if u.rejected} == {shape}
    assert f"posteriors are {shape}" in found.verdict


def test_failures_are_told_and_many_of_them_leave_no_verdict(known):
    few, many = judged(known, failed=range(5)), judged(known, failed=range(50))
    assert few.calibrated and len(few.failed) == 5 and len(few.ranks) == 495
    assert not many.calibrated and "is not judged: 50 of 500" in many.verdict
    with pytest.raises(Det2StocError, match="no replication could be fitted; the first: no"):
        judged(known, failed=range(COUNT))


def test_the_page_says_what_the_table_says(known):
    found = judged(known, stretch=0.8)
    page = calibration_page(replace(found, problem="<study>"))
    assert "&lt;study&gt;" in page and "<study>" not in page
    assert "Not calibrated" in page and "gravity_x" in page and page.count('role="img"') == 5
    told = json.loads(json.dumps(to_json(found)))
    assert not told["calibrated"] and len(told["ranks"]) == COUNT and told["tarp"]["coverage"][-1] < 0.99


def test_holm_corrects_by_the_number_of_tests_left():
    np.testing.assert_allclose(holm(np.array([0.04, 0.001, 0.03])), [0.06, 0.003, 0.06])
    np.testing.assert_allclose(holm(np.array([0.6, 0.9])), [1.0, 1.0])


def test_the_band_holds_a_whole_distribution_as_often_as_it_says():
    level, random = np.arange(1, 50) / 50, np.random.default_rng(3)
    low, high = ecdf_band(200, level, 0.9, random)
    found = (random.uniform(size=(1000, 200, 1)) <= level).mean(1)
    inside = ((found >= low) & (found <= high)).all(1).mean()
    assert 0.86 < inside < 0.95  # measured: 0.90


def test_a_replication_is_the_experiment_once_more(tmp_path):
    problem = spring_problem(tmp_path)
    segments = problem.segments
    values = segments.values.copy()
    values[1, 3, 0] = np.nan
    problem = replace(problem, segments=replace(segments, values=values))
    posed, truth = replicate(problem, fitted_start(problem), np.random.default_rng(0))
    again, same = replicate(problem, fitted_start(problem), np.random.default_rng(0))
    np.testing.assert_array_equal(again.segments.values, posed.segments.values)
    assert truth == same and tuple(truth) == problem.names
    assert np.isnan(posed.segments.values[1, 3, 0]) and np.isnan(posed.segments.values).sum() == 1
    assert posed.segments.recordings[1].path == segments.recordings[1].path
    z, start = np.array([list(truth.values())]), fitted_start(problem)
    error = (posed.segments.values - posed.simulator.rollout(problem.request(z, start))) / problem.noise
    assert abs(np.nanstd(error) - 1) < 0.15  # 240 values: 3 standard errors


def toy(random):
    """theta ~ N(0, 1), x | theta ~ N(theta, 1)."""
    truth = random.standard_normal()
    return truth + random.standard_normal(), {"theta": truth}


def drawn(x, key, *, num_samples, kept=1, fails=()):
    """theta | x ~ N(x / 2, 1 / 2); each draw `kept` times in a row."""
    if key % 7 in fails:
        raise SamplingFailed("this one")
    random = np.random.default_rng(key)
    z = x / 2 + np.sqrt(0.5) * np.repeat(random.standard_normal(-(-num_samples // kept)), kept).reshape(4, -1, 1)
    tree = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({"theta": (("chain", "draw"), z[..., 0])}),
            "unconstrained_posterior": xr.Dataset({"z": (("chain", "draw", "unknown"), z)}, {"unknown": ["theta"]}),
            "sample_stats": xr.Dataset(),
        }
    )
    tree.attrs = {"method": "toy", "simulations": 1, "seconds_run": 0.5}
    return tree


def replications(path, count, seed=0, made=None, **options):
    experiment = Experiment(lambda: toy, partial(drawn, **options), seed, 200)
    return run(lambda: experiment, count, Here(), path, made or {"seed": seed})


def test_correlated_draws_are_drawn_again_until_there_are_enough(tmp_path):
    found = replications(tmp_path / "a.jsonl", 5, kept=4)
    assert all(r.effective > NUM_DRAWS and len(r.draws) == NUM_DRAWS for r in found)
    few = replications(tmp_path / "b.jsonl", 5, kept=100)
    told = judge(few * 8, problem="p", method="m")
    assert told.num_few == 40


def test_finished_replications_are_kept_and_a_torn_line_is_done_again(tmp_path):
    path = tmp_path / "out" / "replications.jsonl"
    first = replications(path, 6)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:4]) + '\n{"index": 4, "tru')
    assert replications(path, 6) == first
    assert sorted(path.read_text().splitlines()) == sorted(lines)
    more = replications(path, 8)
    assert more[:6] == first and path.read_text().splitlines()[:6] == lines
    other = replications(path, 3, seed=1)  # beside them: nothing is lost
    assert other != first[:3] and replications(path, 8) == more


def test_what_fails_is_a_line_as_well(tmp_path):
    found = replications(tmp_path / "a.jsonl", 20, fails=(3,))
    failed = [r for r in found if r.failed]
    assert failed and len(failed) < 20 and failed[0].failed == "this one"
    assert [asdict(r) for r in replications(tmp_path / "a.jsonl", 20)] == [asdict(r) for r in found]


def test_problems_go_by_their_modules_names():
    assert {"cartpole", "linear_gaussian", "pendulum"} <= set(PROBLEMS) and "windy_slope" not in PROBLEMS
    for name in PROBLEMS:
        assert get_problem(name, num_threads=1).simulator.study.name == name
    with pytest.raises(Det2StocError, match="unknown problem 'linear_gausian'; did you mean 'linear_gaussian'"):
        get_problem("linear_gausian")
