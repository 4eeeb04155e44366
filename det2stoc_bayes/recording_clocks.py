"""Whether recordings' times are seconds, by what the model and the other recordings make of them."""

import warnings
from collections.abc import Sequence

import numpy as np

from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.recording import Recording, StudyWarning

MOST_STEPS = 20_000_000  # of the model: hours for one simulation
MOST_STEPS_A_SAMPLE = 1000
LARGEST_STEP = 2.0  # samples: beyond it the model passes over what was recorded
ANOTHER_RATE = 100.0  # times faster or slower than the others


def check_clocks(recordings: Sequence[Recording], timestep: float) -> None:
    """StudyError for a recording that no simulation could follow, StudyWarning for one of quite another rate."""
    usual = sorted(float(np.median(np.diff(r.time))) for r in recordings)[(len(recordings) - 1) // 2]
    for record in recordings:
        label = f"{record.path.parent.name}/{record.path.name}: column time"
        span, steps = float(record.time[-1] - record.time[0]), np.diff(record.time)
        if span / timestep > MOST_STEPS:
            widest = int(np.argmax(steps))
            raise StudyError(
                f"{label}: found {span:.4g} s (after {record.time[widest]:.6g} comes {record.time[widest + 1]:.6g}), "
                f"{span / timestep:.2g} of the model's steps; allowed: at most {MOST_STEPS:.0e} (is it in seconds?)"
            )
        step = float(np.median(steps))
        if timestep > span:
            raise StudyError(
                f"{label}: found {span:.4g} s, less than one of the model's steps ({timestep:.4g} s); allowed: more "
                "(is it in seconds?)"
            )
        if timestep > LARGEST_STEP * step:
            message = f"{label}: a sample every {step:.4g} s, but the model's timestep is {timestep:.4g} s"
            warnings.warn(message, StudyWarning, stacklevel=3)
        if not 1 / ANOTHER_RATE < step / usual < ANOTHER_RATE:
            message = f"{label}: a sample every {step:.4g} s, usually every {usual:.4g} s (is it in seconds?)"
            warnings.warn(message, StudyWarning, stacklevel=3)
        elif step > MOST_STEPS_A_SAMPLE * timestep:
            message = f"{label}: a sample every {step:.4g} s, {step / timestep:.3g} of the model's steps (seconds?)"
            warnings.warn(message, StudyWarning, stacklevel=3)
