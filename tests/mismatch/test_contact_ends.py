"""A hypothesis is told of its unknowns no surer than by where fits end that begin about it."""

from dataclasses import replace

import numpy as np
import pytest
from rough import Fixed, Rough, smooth_top

from det2stoc_bayes.mismatch.contact import ends
from det2stoc_bayes.mismatch.contact.ends import APART, NUM_ENDS, no_surer_than_ends
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at


def widened(fit, luck=2.0):
    return no_surer_than_ends(fit, luck, np.random.default_rng(0), lambda _: None)


def test_where_all_fits_end_at_one_place_it_is_as_sure_as_before():
    fit = smooth_top(0)
    found = widened(fit)
    np.testing.assert_array_equal(found.z, fit.z)
    wider = np.sqrt(np.diag(found.covariance) / np.diag(fit.covariance))
    assert (wider >= 1).all() and (wider < 1.2).all()  # measured: 1.03 to 1.09


def ending_at(monkeypatch, fit, offsets, worse):
    """Fits that begin anywhere end so far off, told so many nats worse; and where they began."""
    began, told = [], zip(offsets, worse, strict=True)

    class Told(ContactFit):
        loss = property(lambda self: self.nats)

    def ended(followed, z, **_):
        began.append(z)
        offset, nats = next(told)
        end = Told(followed, fit.z + offset, fit.errors, fit.scales)
        object.__setattr__(end, "nats", fit.loss + nats)
        return end

    monkeypatch.setattr(ends, "fit_followed", ended)
    return began


def test_fits_that_end_apart_widen_it_by_their_mean_square(monkeypatch):
    fit = smooth_top(1)
    offsets = np.array([[0.3, 0.0], [-0.3, 0.0], [0.1, 0.2], [0.0, -0.4]])
    began = ending_at(monkeypatch, fit, offsets, [0.0, 1.0, 5.9, -3.0])
    found = widened(fit)
    # the third is told by 8.9 nats worse than the best, more than three times the bumps: it is no end
    kept = offsets[[0, 1, 3]]
    np.testing.assert_allclose(found.covariance - fit.covariance, kept.T @ kept / 3, atol=1e-12)
    away = (np.array(began) - fit.z) @ np.linalg.inv(np.linalg.cholesky(fit.covariance)).T
    assert len(began) == NUM_ENDS and np.allclose(away[: NUM_ENDS // 2], -away[NUM_ENDS // 2 :])
    assert 0.2 * APART < np.sqrt((away**2).mean()) < 2 * APART


@pytest.mark.parametrize("seed", range(3))
def test_on_bumps_it_is_less_sure_than_one_of_them_says(seed):
    fit = smooth_top(seed)
    rough = replace(fit, followed=Rough(seed, 3.0))
    rough = ContactFit(rough.followed, fit.z, rough.followed.errors(fit.z[None])[0], fit.scales)
    found, alone = widened(rough, luck=10.0), rough.covariance
    assert np.trace(found.covariance) > 1.2 * np.trace(alone)  # measured: 1.7 to 5.5


def test_without_unknowns_nothing_is_fitted():
    fit = at(Fixed(0, 0.0), np.zeros(0))
    assert widened(fit) is fit
