"""Which values a model field takes."""

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.errors import StudyError

# Fields that a simulation needs to be 0 or more, and those of moving things that it needs to be more than 0.
NOT_NEGATIVE = frozenset(
    ["mass", "inertia", "damping", "armature", "frictionloss", "friction", "size", "density", "viscosity"]
)
POSITIVE = frozenset(["mass", "inertia"])
UNIT = frozenset(["axis", "quat", "iquat"])  # MuJoCo takes their length to be 1 once a model is compiled
ROUNDED = 1e-3


def check_value(kind: str, field: str, value: Float[np.ndarray, "..."], where: str) -> None:
    """StudyError for a value that no simulation can use."""
    found = np.array2string(value, separator=", ") if value.ndim else f"{value:g}"
    if kind == "body" and field in POSITIVE and (value <= 0).any():
        raise StudyError(f"{where}: found {found}; allowed: more than 0, since a {kind} has some {field}")
    if field in NOT_NEGATIVE and (value < 0).any():
        raise StudyError(f"{where}: found {found}; allowed: 0 or more, since {field} is never negative")
    length = float(np.linalg.norm(value))
    if field in UNIT and abs(length - 1) > ROUNDED:
        raise StudyError(f"{where}: found {found}, of length {length:.4g}; allowed: length 1")
