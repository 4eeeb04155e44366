"""A hypothesis where it predicts what another does: equivalent effects end apart where a likelihood has bumps."""

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit, fits_at, within

ROUNDS = 4  # with the same sensitivities
FRACTIONS = (1.0, 0.5)  # of a step
LESS = 0.9  # of the difference: a round that leaves more is the last
SIZES = np.linspace(0.9, 1.1, 21)  # of an effect beside the model's psi
FARTHEST = 3.0  # scales beyond which a difference counts no more: an impact came a step later


def mimicking(rival: ContactFit, model: ContactFit) -> ContactFit:
    """The rival where it predicts most like a model that is led alike; as it is where no step leads there.

    It is looked for from its own unknowns, and from those that it shares with the model as they are there.
    """
    last = rival.problem.effects[-1]
    shared = rival.problem.size - last.size
    found = [_descended(rival, rival, model)]
    if model.problem.effects[:-1] == rival.problem.effects[:-1]:
        # An impact a step later parts two hypotheses more than all else does, and no step sees beyond it.
        own = np.arange(last.size) < last.effect.parameters[0].size
        ways = [np.concatenate([model.z[:shared], np.where(own, f, 1.0) * rival.z[shared:]]) for f in SIZES]
        there = min(fits_at(rival.followed, np.stack(ways)), key=lambda f: apart(f, model))
        found.append(_descended(there, rival, model))
    best = min(found, key=lambda f: apart(f, model))
    return best if apart(best, model) < LESS * apart(rival, model) else rival


def apart(rival: ContactFit, model: ContactFit) -> float:
    """Mean squared difference of what two hypotheses predict, in the model's scales."""
    left = _scaled(model, rival.errors - model.errors)
    told = np.isfinite(model.errors) & np.isfinite(model.scales.values)
    return float(np.minimum(left**2, FARTHEST**2).sum() / max(told.sum(), 1))


def _descended(near: ContactFit, rival: ContactFit, model: ContactFit) -> ContactFit:
    columns = _scaled(model, rival.columns).reshape(-1, len(rival.z))
    for _ in range(ROUNDS):
        left = _scaled(model, near.errors - model.errors)
        said = np.sqrt(np.minimum(1.0, (FARTHEST / np.maximum(np.abs(left), 1e-12)) ** 2))
        step = np.linalg.lstsq(said[:, None] * columns, said * left, rcond=1e-8)[0]
        tried = np.stack([within(near, near.z + f * step) for f in FRACTIONS])
        found = min(fits_at(near.followed, tried), key=lambda f: apart(f, model))
        if not apart(found, model) < LESS * apart(near, model):
            break
        near = found
    return near


def _scaled(fit: ContactFit, values: np.ndarray) -> np.ndarray:
    """Values by block, sample and column (and more axes) in the fit's scales, a row each; 0 where nothing was told."""
    known = np.isfinite(fit.scales.values)
    each = np.where(known, 1 / np.where(known, fit.scales.values, 1.0), 0.0)
    extra = values.shape[3:]
    scaled = np.nan_to_num(values) * each.reshape(-1, *[1] * len(extra))
    return scaled.reshape(-1, *extra)
