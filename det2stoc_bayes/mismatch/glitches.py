"""Lone samples far off, as a sensor's glitches are: no physics makes them between neighbours that are not.

Least squares lets a glitch drag its neighbours along, above all one at a recording's beginning. So they are looked for
beside a fit under Student-t errors, from which they hardly take any weight.
"""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.measurement import Measurement
from det2stoc_bayes.optimize import Fit, fit_many

TAILS = Measurement(4.0)
FAR, NEAR = 8.0, 4.0  # noise sds off of a glitch, and of its neighbours
MOST = 0.8  # of the squared error beyond the noise's that they make, where nothing else need be missing


def glitches(fit: Fit) -> tuple[float, ...]:
    """By how many noise sds lone samples are off, where they make most of what a fit leaves; empty otherwise."""
    problem = fit.problem
    if problem.measurement.degrees_of_freedom is not None:
        return ()
    study = replace(problem.simulator.study, measurement=TAILS)
    (robust,) = fit_many([(replace(problem, simulator=problem.simulator.on(study)), fit.point)])
    if robust is None:
        return ()
    shape = problem.segments.values.shape
    bent = robust.linear.stacked[:, : shape[1] * shape[2], 0].reshape(shape)
    off = np.where(problem.segments.observed, np.abs(TAILS.unbent(bent)), 0.0)
    beside = np.pad(off, ((0, 0), (1, 1), (0, 0)))
    lone = (off > FAR) & (np.maximum(beside[:, :-2], beside[:, 2:]) < NEAR)
    beyond = (off**2).sum() - robust.linear.degrees_of_freedom
    return tuple(off[lone].tolist()) if (off[lone] ** 2 - 1).sum() > MOST * max(beyond, 0.0) else ()
