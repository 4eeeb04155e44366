"""Every method of the registry keeps the same contract."""

import inspect
import json
from dataclasses import replace

import numpy as np
import pytest

from det2stoc_bayes.doubts import misfit
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.inference import METHODS, get_method
from det2stoc_bayes.posterior import ATTRIBUTES, GROUPS, load, save

OWN = ("blackjax_nuts", "emcee", "laplace", "nuts", "prior", "smc", "svi")
SAMPLERS = ("blackjax_nuts", "emcee", "nuts", "smc", "svi")


def test_registry_lists_the_methods():
    assert set(OWN) <= set(METHODS)
    with pytest.raises(Det2StocError, match="did you mean 'laplace'.*emcee"):
        get_method("laplase")


@pytest.mark.parametrize("name", METHODS)
def test_options_are_explicit(name):
    parameters = inspect.signature(get_method(name).fit).parameters
    assert list(parameters)[:2] == ["problem", "key"]
    rest = [p for p in parameters.values() if p.name not in ("problem", "key")]
    assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in rest)
    assert parameters["num_samples"].default == 1000


@pytest.mark.parametrize("name", OWN)
def test_unknown_option_is_refused(name, gaussian_problem):
    with pytest.raises(TypeError, match="num_sample"):
        get_method(name).fit(gaussian_problem, 0, num_sample=10)


@pytest.mark.parametrize("name", OWN)
def test_contract(name, fits, gaussian_problem, tmp_path):
    tree = fits(name)
    assert set(GROUPS) <= set(tree.children)
    assert set(ATTRIBUTES) <= set(tree.attrs)
    assert tree.attrs["method"] == name
    assert json.loads(tree.attrs["options"])["num_samples"] == 1000
    assert json.loads(tree.attrs["versions"])["mujoco"]
    assert tree.attrs["seed"] == 2
    assert tree.attrs["simulations"] > 0
    assert tree.attrs["seconds_run"] > 0
    assert tree.attrs["noise_inflation"] < 1.5 and not misfit(tree)
    posterior = tree.posterior
    assert tuple(posterior) == gaussian_problem.names == ("gravity_x", "gravity_z")
    for variable in posterior.values():
        assert variable.dims == ("chain", "draw")
        assert np.isfinite(variable).all()
    assert posterior.sizes["chain"] * posterior.sizes["draw"] >= 1000
    terms = tree.log_likelihood["values"]
    assert terms.dims == ("chain", "draw", "recording")
    assert list(terms.recording.values) == ["slide_1", "slide_2"]
    observed = tree.observed_data
    np.testing.assert_array_equal(observed["values"], gaussian_problem.segments.values)
    np.testing.assert_array_equal(observed["time"], gaussian_problem.segments.time)
    z = tree.unconstrained_posterior.z.values
    prior = -0.5 * (z**2).sum(-1) - np.log(2 * np.pi)
    np.testing.assert_allclose(tree.sample_stats.lp, terms.sum("recording") + prior, rtol=1e-12)
    save(tree, tmp_path / "fit.nc")
    assert load(tmp_path / "fit.nc").identical(tree)


@pytest.mark.parametrize("name", OWN)
def test_reproducible_from_key(name, fits, gaussian_problem):
    """The same with progress reported; other draws from another key."""
    seen = []
    module = get_method(name)
    report = {"progress": lambda done, of: seen.append((done, of))} if name in SAMPLERS else {}
    first = module.fit(gaussian_problem, 5, num_samples=40)
    same = module.fit(gaussian_problem, 5, num_samples=40, **report)
    for group in ("posterior", "sample_stats", "log_likelihood"):
        assert first[group].identical(same[group])
    assert float(first.posterior.gravity_x[0, 0]) != float(fits(name).posterior.gravity_x[0, 0])
    if name in SAMPLERS:
        assert [done for done, _ in seen] == list(range(1, len(seen) + 1))
        assert len({of for _, of in seen}) == 1


def test_a_fit_says_how_far_the_model_is_from_the_recordings(gaussian_problem):
    """Ten times less noise told than there is: the squared misfit is a hundred times the noise's."""
    quiet = replace(gaussian_problem, noise=gaussian_problem.noise / 10)
    tree = get_method("laplace").fit(quiet, 0, num_samples=100)
    assert 60 < tree.attrs["noise_inflation"] < 150 and "squared misfit" in misfit(tree)  # measured 90
