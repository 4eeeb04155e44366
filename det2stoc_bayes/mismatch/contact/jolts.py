"""Where contact makes a simulation's speeds uncertain: an impact turns what noise leaves unknown into a jolt.

An observer that takes a body for a free mass believes its speed after an impact as firmly as before, and is wrong for
as long as its memory lasts. Simulations that are led along the same recording with noise drawn anew part at impacts;
their spread is the uncertainty that an ensemble Kalman filter would have there (Evensen, 2009, ch. 4).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.observer import Observer, Places
from det2stoc_bayes.mismatch.contact.observers import on_rows, recorded_start
from det2stoc_bayes.problem import Problem

MEMBERS = 16
SEED = 5


def jolts(
    problem: Problem, observer: Observer, z: Float[np.ndarray, " size"]
) -> Float[np.ndarray, "recordings samples nv"]:
    """By how much the variance of each coordinate's speed grows up to each sample: SI units, squared."""
    count = problem.segments.count
    rows = np.tile(np.arange(count), MEMBERS)
    many = on_rows(problem, rows)
    noise = problem.noise * np.random.default_rng(SEED).standard_normal(many.segments.values.shape)
    members = Observer(observer.gains[rows], observer.values[rows] + noise, observer.seen[rows])
    path = problem.simulator.engine.trajectory(replace(many.request(z[None], recorded_start(many)), observer=members))
    places = Places(problem.simulator.model, many.segments.columns)
    flat = (-1, path.columns.shape[-1])
    errors = places.errors(path.columns.reshape(flat), members.values.reshape(flat)).reshape(members.seen.shape)
    errors = np.where(members.seen, errors, 0.0)
    ahead = path.qvel - np.einsum("rsvj,rsvj->rsv", members.gains[..., 1, :], errors)
    grown = np.zeros((count, *path.qvel.shape[1:]))
    grown[:, 1:] = _variance(ahead, count)[:, 1:] - _variance(path.qvel, count)[:, :-1]
    return np.maximum(np.nan_to_num(grown), 0.0)


def _variance(speeds: Float[np.ndarray, "rows samples nv"], count: int) -> Float[np.ndarray, "recordings samples nv"]:
    return speeds.reshape(MEMBERS, count, *speeds.shape[1:]).var(0, ddof=1)
