"""Which horizons and columns a model tells at all: what it foretells worse than nothing does has no say."""

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.contact.scales import scales_of
from det2stoc_bayes.mismatch.contact.window_fit import WindowFit

WORSE = 1.05  # times the scale of errors that need no model


def telling(fit: WindowFit) -> Bool[np.ndarray, "horizons columns"]:
    """Horizons and columns predicted about as well as by the window's first value or by all windows' middle one.

    How a body that lies flat rattles depends on contact alone. Windows whose predictions of that are mostly wrong ask
    for a sensor that shows less of it, whatever else is missing. All, if nothing is told.
    """
    windows = fit.windows
    segments = windows.problem.segments
    values = segments.values[:, list(windows.horizons)] / windows.problem.noise
    first = segments.values[:, :1] / windows.problem.noise
    mine = fit.scales.values
    heard = np.isfinite(mine)
    for other in (values - first, values - _middle(values)):
        heard &= mine <= WORSE * scales_of(np.where(windows.observed, other, np.nan)).values
    return heard if heard.any() else np.isfinite(mine)


def _middle(values: Float[np.ndarray, "windows horizons columns"]) -> Float[np.ndarray, "horizons columns"]:
    there = np.isfinite(values)
    return np.nanmedian(np.where(there.any(0), values, 0.0), axis=0)
