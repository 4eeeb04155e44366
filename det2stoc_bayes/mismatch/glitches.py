"""Lone samples far off, as a sensor's glitches are, between neighbours that are told well.

Reading a recording drops those that its own smoothness shows (`recording_glitches`): not at its ends, nor where motion
is rough; a model shows these, too. Least squares lets a glitch drag its neighbours along, above all one at a
recording's beginning. So they are looked for beside a fit under Student-t errors, from which they hardly take weight.
"""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.measurement import Measurement
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR
from det2stoc_bayes.optimize import Fit, fit_many

TAILS = Measurement(4.0)
FAR, NEAR = 8.0, 4.0  # noise sds off of a glitch, and of its neighbours
MOST = 0.8  # of the squared error beyond the noise's that they make


def lone_errors(fit: Fit) -> tuple[float, ...]:
    """By how many noise sds lone samples are off, where they make most of what a fit leaves; empty otherwise.

    Without them the rest must be within the noise. What has no recorded neighbour on a side is held against the other.
    """
    problem = fit.problem
    if problem.measurement.degrees_of_freedom is not None:
        return ()
    study = replace(problem.simulator.study, measurement=TAILS)
    (robust,) = fit_many([(replace(problem, simulator=problem.simulator.on(study)), fit.point)])
    if robust is None:
        return ()
    shape = problem.segments.values.shape
    bent = robust.linear.stacked[:, : shape[1] * shape[2], 0].reshape(shape)
    seen, off = problem.segments.observed, np.abs(TAILS.unbent(bent))
    beside = np.pad(np.where(seen, off, np.nan), ((0, 0), (1, 1), (0, 0)), constant_values=np.nan)
    beside = np.stack([beside[:, :-2], beside[:, 2:]])
    told = np.isfinite(beside).any(0) & (np.nan_to_num(beside).max(0) < NEAR)
    square, lone = np.where(seen, off, 0.0) ** 2, seen & (off > FAR) & told
    freedom = max(robust.linear.degrees_of_freedom - problem.size, 1)
    made, rest = (square[lone] - 1).sum(), square[~lone].sum()
    most = made > MOST * max(square.sum() - freedom, 0.0)
    return tuple(off[lone].tolist()) if most and rest < MODEL_ERROR * freedom else ()
