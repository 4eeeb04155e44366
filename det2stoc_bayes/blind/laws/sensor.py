"""Concealed laws of what is recorded, the clock among it; a delayed reading is resolved by the simulation."""

from det2stoc_bayes.blind.laws.base import Law, Scene


def _plain(scene: Scene, column: str) -> bool:
    """A column of its own: neither the clock nor a component of a quaternion."""
    return column != "time" and column.rsplit("/", 1)[-1] not in ("qw", "qx", "qy", "qz")


SENSOR_LAWS: dict[str, Law] = {
    "sensor_bias": Law(
        "sensor",
        {"offset": "its unit"},
        lambda scene, column: scene.column[column],
        lambda m, drawn: {"offset": m},
        signed=True,
        fits=_plain,
        record=lambda values, t, p: values + p["offset"],
    ),
    "sensor_scale": Law(
        "sensor",
        {"ratio": "1"},
        lambda scene, column: 0.4,
        lambda m, drawn: {"ratio": 1.0 + m},
        signed=True,
        fits=_plain,
        record=lambda values, t, p: p["ratio"] * values,
    ),
    "sensor_delay": Law(
        "sensor", {"delay": "s"}, lambda scene, column: 0.08, lambda m, drawn: {"delay": m}, fits=_plain
    ),
    "sensor_drift": Law(
        "sensor",
        {"rate": "its unit per s"},
        lambda scene, column: 2.0 * scene.column[column] / scene.duration,
        lambda m, drawn: {"rate": m},
        signed=True,
        fits=_plain,
        record=lambda values, t, p: values + p["rate"] * t,
    ),
    "clock_skew": Law(
        "sensor",
        {"ratio": "1"},
        lambda scene, column: 0.2,
        lambda m, drawn: {"ratio": 1.0 + m},
        signed=True,
        fits=lambda scene, column: column == "time",
    ),
}
