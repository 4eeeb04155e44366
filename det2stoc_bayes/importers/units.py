"""Units of recorded signals, and the ones that a study's columns have."""

from det2stoc_bayes.engines.model_names import ModelNames
from det2stoc_bayes.errors import listing
from det2stoc_bayes.importers.base import MODEL_UNITS, SourceError
from det2stoc_bayes.suggestions import choices

TURN = 6.283185307179586
# Unit -> quantity and how many SI units it is. An angle is a quantity of its own, so that metres or percents are never
# taken for it.
UNITS: dict[str, tuple[str, float]] = {
    "rad": ("angle", 1.0), "mrad": ("angle", 1e-3), "deg": ("angle", TURN / 360), "turn": ("angle", TURN),
    "m": ("length", 1.0), "cm": ("length", 1e-2), "mm": ("length", 1e-3), "um": ("length", 1e-6),
    "rad/s": ("angular velocity", 1.0), "mrad/s": ("angular velocity", 1e-3),
    "deg/s": ("angular velocity", TURN / 360), "rpm": ("angular velocity", TURN / 60),
    "turn/s": ("angular velocity", TURN),
    "m/s": ("velocity", 1.0), "cm/s": ("velocity", 1e-2), "mm/s": ("velocity", 1e-3), "km/h": ("velocity", 1 / 3.6),
    "m/s^2": ("acceleration", 1.0), "g": ("acceleration", 9.80665),
    "N": ("force", 1.0), "mN": ("force", 1e-3), "kN": ("force", 1e3),
    "N m": ("torque", 1.0), "mN m": ("torque", 1e-3), "N cm": ("torque", 1e-2),
    "V": ("voltage", 1.0), "mV": ("voltage", 1e-3), "A": ("current", 1.0), "mA": ("current", 1e-3),
    "1": ("number", 1.0), "%": ("number", 1e-2),
}  # fmt: skip


def quantity_of(column: str, names: ModelNames) -> str | None:
    """What a column measures; None for controls and sensors, which measure whatever the model makes of them."""
    kind, _, rest = column.partition("/")
    part = rest.rpartition("/")[2] if "/" in rest else ""
    if kind not in ("qpos", "qvel"):
        return None
    if any(column in group for group in names.quaternions):
        return "number"
    turning = f"qpos/{rest}" in names.hinges or part in ("wx", "wy", "wz")
    if kind == "qpos":
        return "angle" if turning else "length"
    return "angular velocity" if turning else "velocity"


def factor(unit: str, column: str, names: ModelNames, where: str) -> float:
    """By what a signal of this unit is multiplied to become the column; SourceError if it is another quantity."""
    if unit == MODEL_UNITS:
        return 1.0
    if unit not in UNITS:
        raise SourceError(f"{where}: found the unit '{unit}'; {choices(unit, (*UNITS, MODEL_UNITS), 40)}")
    quantity, size = UNITS[unit]
    wanted = quantity_of(column, names)
    if wanted is not None and quantity != wanted:
        raise SourceError(f"{where}: found '{unit}', a unit of {quantity}; allowed: {listing(allowed(wanted))}")
    return size


def allowed(quantity: str | None) -> list[str]:
    """The units of a quantity, or all of them."""
    return [unit for unit, (q, _) in UNITS.items() if quantity in (None, q)] + [MODEL_UNITS]
