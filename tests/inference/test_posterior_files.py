"""Fits on file: whole or not at all, and a clear error for anything else."""

import numpy as np
import pytest
import xarray as xr

from det2stoc_bayes.doubts import unreliable
from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.posterior import load, observed_data, save
from det2stoc_bayes.problem import make_problem


def test_damaged_file(fits, tmp_path):
    path = tmp_path / "fit.nc"
    save(fits("laplace"), path)
    content = path.read_bytes()
    for damaged in (b"", b"not a file at all", content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(Det2StocError, match="fit.nc: cannot be read"):
            load(path)


def test_a_folder_and_a_diagnosis(fits, tmp_path):
    save(fits("laplace"), tmp_path / "fit.nc")
    assert load(tmp_path).identical(fits("laplace"))
    of_a_diagnosis = xr.DataTree.from_dict({"before": xr.Dataset(), "after": xr.Dataset()})
    save(of_a_diagnosis, tmp_path / "fit.nc")
    with pytest.raises(Det2StocError, match="fit.nc: is a diagnosis's; allowed: a fit written by `det2stoc fit`"):
        load(tmp_path)


def test_missing_file(tmp_path):
    with pytest.raises(Det2StocError, match="no such file"):
        load(tmp_path / "fit.nc")


def test_file_of_something_else(tmp_path):
    xr.DataTree.from_dict({"other": xr.Dataset({"x": 1})}).to_netcdf(tmp_path / "x.nc", engine="h5netcdf")
    with pytest.raises(Det2StocError, match="lacks posterior"):
        load(tmp_path / "x.nc")


def test_failed_save_leaves_the_old_file(fits, tmp_path, monkeypatch):
    path = tmp_path / "fit.nc"
    path.write_text("old")
    tree = fits("laplace").copy()
    tree.attrs["unwritable"] = object()
    with pytest.raises(TypeError):
        save(tree, path)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["fit.nc"]


def test_observed_data_joins_segments(gaussian_problem):
    cut = make_problem(gaussian_problem.simulator, num_samples=7)
    assert cut.segments.count > 2
    xr.testing.assert_identical(observed_data(cut), observed_data(gaussian_problem))


def test_weights_with_a_heavy_tail_are_told(fits):
    """Draws of the exact posterior have equal weights; those of a far narrower one have a few that count for all."""
    tree = fits("laplace").copy(deep=True)
    weights = tree["sample_stats"]["log_weight"]
    assert not unreliable(fits("laplace")) and not unreliable(fits("nuts"))  # of which one has none
    weights.values[:] = np.random.default_rng(0).exponential(1.5, weights.shape)  # k-hat 1.5
    assert "reliable below 0.67" in unreliable(tree)
    assert not unreliable(tree.isel(draw=slice(5), missing_dims="ignore"))  # too few to tell
