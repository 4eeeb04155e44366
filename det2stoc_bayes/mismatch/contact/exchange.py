"""Hypotheses take each other's better starts, so that none is ahead by luck in the estimation of its own.

A window's start is corrected step by step under one hypothesis and may end at a worse optimum than under another: over
a study's windows that is hundreds of nats, of which nothing is the hypothesis's merit.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.scales import scales_of
from det2stoc_bayes.mismatch.contact.window_fit import WindowFit


def exchanged(fits: Sequence[WindowFit], own_scales: bool = True) -> list[WindowFit]:
    """Hypotheses on the same windows, each from the likeliest of all their starts; the unknowns stay.

    own_scales: scales follow the new errors; otherwise they stay, as on windows that were not fitted.
    """
    different = list({id(f.problem.guess.start): f for f in fits}.values())
    return [_from_the_best(fit, different, own_scales) for fit in fits]


def _from_the_best(fit: WindowFit, others: Sequence[WindowFit], own_scales: bool) -> WindowFit:
    windows, errors, height = fit.windows, fit.errors, fit.heights
    everywhere = np.ones(windows.count, bool)
    for other in others:
        if other.problem.guess.start is fit.problem.guess.start:
            continue
        found = fit.windows.taking(other.windows, everywhere).errors(fit.z[None])[0]
        there = fit.scales.losses(found) + other.strange
        better = there < height
        height = np.where(better, there, height)
        errors = np.where(better[:, None, None], found, errors)
        windows = windows.taking(other.windows, better)
    scales = scales_of(errors) if own_scales else fit.scales
    return replace(fit, windows=windows, errors=errors, scales=scales, near=None)
