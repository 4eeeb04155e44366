"""What contact does to a state's uncertainty: a floor holds a body, and an impact turns what is unknown into a jolt.

An observer that takes a body for a free mass believes its speed after an impact as firmly as before, and is wrong for
as long as its memory lasts. Simulations that are led along the same recording with noise drawn anew part at impacts;
their spread is the uncertainty that an ensemble Kalman filter would have there (Evensen, 2009, ch. 4).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.observer import ContactFlow, Observer, Places
from det2stoc_bayes.mismatch.contact.observers import on_rows, recorded_start
from det2stoc_bayes.problem import Problem

MEMBERS = 16
SEED = 5


def contact_flow(problem: Problem, observer: Observer, z: Float[np.ndarray, " size"]) -> ContactFlow:
    """What contact does to the variances of positions and speeds up to each sample, by members led with noise anew."""
    count, time = problem.segments.count, problem.segments.time
    rows = np.tile(np.arange(count), MEMBERS)
    many = on_rows(problem, rows)
    noise = problem.noise * np.random.default_rng(SEED).standard_normal(many.segments.values.shape)
    members = Observer(observer.gains[rows], observer.values[rows] + noise, observer.seen[rows])
    path = problem.simulator.engine.trajectory(replace(many.request(z[None], recorded_start(many)), observer=members))
    places, flat = Places(problem.simulator.model, many.segments.columns), (-1, path.columns.shape[-1])

    def apart(values: np.ndarray) -> np.ndarray:
        e = places.errors(path.columns.reshape(flat), values.reshape(flat)).reshape(members.seen.shape)
        return np.where(members.seen, e, 0.0)

    change = np.einsum("rsvij,rsvj->rsvi", members.gains, apart(members.values))
    place = -apart(path.columns[:count][np.tile(np.arange(count), MEMBERS)])[..., 0]  # beside the first member's
    led = np.stack([place + change[..., 0], path.qvel], -1)
    free = led[:, :-1].copy()
    free[..., 0] += np.diff(time, axis=1)[rows][..., None] * free[..., 1]
    foretold = np.stack([place, path.qvel - change[..., 1]], -1)[:, 1:]
    before, after = (np.nan_to_num(x.reshape(MEMBERS, count, *x.shape[1:]).var(0, ddof=1)) for x in (free, foretold))
    kept = np.ones((count, *path.qvel.shape[1:], 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        kept[:, 1:] = np.where((before > 0) & (after < before), after / before, 1.0)
    kept[..., 0] = np.where(observer.seen[..., 0], kept[..., 0], 1.0)
    grown = np.zeros(kept.shape[:-1])
    grown[:, 1:] = np.maximum(after[..., 1] - before[..., 1], 0.0)
    return ContactFlow(kept, grown)
