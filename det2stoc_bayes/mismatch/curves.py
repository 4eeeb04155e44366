"""What a force on no list looks like: its curve, and words for its symmetry, its energy and its memory."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch import finding
from det2stoc_bayes.mismatch.any_fit import AnyFit
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.effects.unlisted import UnlistedForce
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR

MOSTLY = 0.9  # of a curve's square, or of its power: then it is called so
WIDE = 0.6  # of the range about a middle that a symmetry must hold over
NUM_MIDDLES = 41
COLUMNS = {"position": "qpos", "velocity": "qvel"}


def grid(effect: UnlistedForce, values: Mapping[str, Any]) -> list[Float[np.ndarray, " knots"]]:
    """The knots of each variable, from one set of an effect's parameters."""
    least, most = np.atleast_1d(values["least"]), np.atleast_1d(values["most"])
    return [np.linspace(a, b, n) for a, b, n in zip(least, most, effect.counts, strict=True)]


def described(
    fit: AnyFit, placed: PlacedEffect, values: Mapping[str, Float[np.ndarray, "draws *components"]]
) -> dict[str, Any]:
    """Parameters of an effect on no list, from draws of its curve: what it depends on, the curve, and words for it."""
    effect = placed.effect
    assert isinstance(effect, UnlistedForce)
    knots = grid(effect, {name: values[name][0] for name in ("least", "most")})
    mean, sd = values["curve"].mean(0), values["curve"].std(0)
    x = knots[0].tolist() if len(knots) == 1 else [[a, b] for a in knots[0].tolist() for b in knots[1].tolist()]
    curve = finding.Curve.model_validate(
        {"x": x, "y": mean, "y_sd": sd, "unit": effect.parameters[0].unit_on(placed.element)}
    )
    return {
        "variables": effect.variables,
        "columns": columns(placed, fit),
        "curve": curve,
        "symmetry": symmetry(effect.variables, knots, mean),
        "energy": energy(effect.variables, knots, mean),
        "memory": "possible" if fit.noise_inflation >= MODEL_ERROR else "none",
    }


def columns(placed: PlacedEffect, fit: AnyFit) -> tuple[str, ...]:
    """The variables as a recording calls them."""
    at, model = placed.element, fit.problem.simulator.model
    motor = model.actuator(at.actuators[0]).name if at.actuators else ""
    named = {name: f"{column}/{at.name}" for name, column in COLUMNS.items()}
    named |= {"time": "time", "control": f"ctrl/{motor}"}
    return tuple(named[v] for v in placed.effect.variables)  # type: ignore[attr-defined]


def symmetry(variables: tuple[str, ...], knots: list[np.ndarray], curve: Float[np.ndarray, " values"]) -> str:
    """`odd` or `even` about a middle (0 for a speed or a command), else `none`; of two variables in the second one."""
    rows = curve.reshape(-1, len(knots[-1]))
    x, span = knots[-1], knots[-1][-1] - knots[-1][0]
    if variables[-1] == "time":
        return "none"
    middles = np.linspace(x[0] + 0.5 * WIDE * span, x[-1] - 0.5 * WIDE * span, NUM_MIDDLES)
    if variables[-1] in ("velocity", "control"):
        middles = np.zeros(1)
    best = ("none", MOSTLY, 0.0)
    for middle in middles:
        half = min(middle - x[0], x[-1] - middle)
        if half <= 0.2 * span:
            continue
        way = np.linspace(0.0, half, 2 * len(x))
        ahead, behind = (np.stack([np.interp(middle + s * way, x, row) for row in rows]) for s in (1, -1))
        odd, even = (float(np.sum((ahead + s * behind) ** 2)) for s in (-1, 1))
        for word, part in (("odd", odd), ("even", even)):
            if part > best[1] * (odd + even) > 0:
                best = (word, part / (odd + even), float(middle))
    word, _, middle = best
    return word if word == "none" else f"{word} about {middle:.3g}"


def energy(variables: tuple[str, ...], knots: list[np.ndarray], curve: Float[np.ndarray, " values"]) -> str:
    """`conserves`, `dissipates`, `supplies`, or `exchanges` where neither holds throughout."""
    if variables == ("position",):
        return "conserves"
    if "velocity" not in variables:
        return "exchanges"
    v = knots[-1]
    half = min(-v[0], v[-1])
    if half <= 0:
        power = curve.reshape(-1, len(v)) * v
    else:  # of what changes sign with the speed alone, the rest comes back
        way = np.linspace(-half, half, 2 * len(v) + 1)
        rows = np.stack([np.interp(way, v, row) for row in curve.reshape(-1, len(v))])
        power = 0.5 * (rows - rows[:, ::-1]) * way if len(variables) > 1 else rows * way
    balance = float(power.sum()) / max(float(np.abs(power).sum()), 1e-300)
    return "dissipates" if balance < -MOSTLY else "supplies" if balance > MOSTLY else "exchanges"


def sentence(placed: PlacedEffect, said: Mapping[str, Any], equally: str) -> str:
    """What is missing, in words."""
    at, curve = placed.element, said["curve"]
    on = {"position": "its position", "velocity": "its speed", "time": "time", "control": "its command"}
    parity = "neither odd nor even" if said["symmetry"] == "none" else said["symmetry"]
    second = f" in {on[said['variables'][1]]}" if len(said["variables"]) > 1 else ""
    work = {
        "conserves": "conserves energy",
        "dissipates": "takes energy away",
        "supplies": "supplies energy",
        "exchanges": "both gives and takes energy",
    }[said["energy"]]
    memory = "it has no memory" if said["memory"] == "none" else "what it leaves may be memory"
    low, high, sd = min(curve.y), max(curve.y), float(np.median(curve.y_sd))
    size = f"{low:.3g} to {high:.3g} {curve.unit} (sd {sd:.2g})"
    return (
        f"A force on no list{equally} on {at.label} that depends on {' and '.join(on[v] for v in said['variables'])} "
        f"is missing: {size}, {parity}{second}; it {work}, and {memory}."
    )
