"""Sentences and numbers of a finding, from fits and classes."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from det2stoc_bayes.mismatch import finding
from det2stoc_bayes.mismatch.any_fit import AnyFit
from det2stoc_bayes.mismatch.classes import Class
from det2stoc_bayes.mismatch.curves import described, sentence
from det2stoc_bayes.mismatch.effects import PlacedEffect
from det2stoc_bayes.mismatch.evidence import widened
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import Problem

NUM_DRAWS = 1000
INTERVAL = 0.95
SEEN = 0.005  # change of an error that is told
LEAST_TOLD = 0.005  # probability of a candidate that is told in words


def draws(fit: Fit, share: float, seed: int, num_draws: int = NUM_DRAWS) -> Float[np.ndarray, "draws size"]:
    """Draws of the unknowns from Laplace's approximation at a fit."""
    if fit.problem.size == 0:
        return np.zeros((num_draws, 0))
    factor = np.linalg.cholesky(widened(fit, share))
    normal = np.random.default_rng(seed).standard_normal((num_draws, fit.problem.size))
    return fit.point.z + normal @ factor.T


def quantity(values: Float[np.ndarray, "draws *components"], unit: str, *, circular: bool = False) -> finding.Quantity:
    """Mean, sd and 95 % interval of draws, of a vector as lists; an angle's about its circular mean.

    A vector's intervals are simultaneous: with 95 % all of its components lie in them.
    """
    if circular:
        centre = np.angle(np.exp(1j * values).mean())
        values = centre + np.angle(np.exp(1j * (values - centre)))
    level = INTERVAL if values.ndim == 1 or not np.isfinite(values).all() else _simultaneous(values)
    bounds = np.quantile(values, (0.5 - 0.5 * level, 0.5 + 0.5 * level), axis=0, method="hazen").T
    return finding.Quantity.model_validate(
        {"mean": values.mean(0), "sd": values.std(0), "interval": bounds, "unit": unit}
    )


def _simultaneous(values: Float[np.ndarray, "draws components"]) -> float:
    """The level of each component's interval at which 95 % of draws lie in all (Besag et al., 1995, section 6.3)."""
    rank = (stats.rankdata(values, axis=0) - 0.5) / len(values)
    return float(np.quantile(np.abs(2 * rank - 1).max(1), INTERVAL, method="higher"))


def parameters(fit: AnyFit, placed: PlacedEffect, z: Float[np.ndarray, "draws size"]) -> dict[str, finding.Parameter]:
    """An effect's parameters from draws of a fit's unknowns; a coupling's source by its name."""
    slot = list(fit.problem.effects).index(placed)
    values = fit.problem.effect_values(z)[slot]
    if not placed.effect.listed:
        return described(fit, placed, values)
    source: dict[str, finding.Parameter] = {"source": placed.element.source} if placed.element.source else {}
    return source | {
        p.name: quantity(values[p.name], p.unit_on(placed.element), circular=p.name == "phase")
        for p in placed.effect.parameters
    }


def spanning(
    told: Mapping[str, finding.Parameter], others: Sequence[Mapping[str, finding.Quantity]]
) -> dict[str, finding.Parameter]:
    """Parameters whose intervals hold those of other tops, too; mean and sd stay."""
    out = dict(told)
    for name in {n for other in others for n in other}:
        q = told[name]
        assert isinstance(q, finding.Quantity)
        every = np.stack([np.array(x.interval, float) for x in (q, *(o[name] for o in others if name in o))])
        bounds = np.stack([every[..., 0].min(0), every[..., 1].max(0)], -1)
        out[name] = finding.Quantity.model_validate(q.model_dump() | {"interval": bounds.tolist()})
    return out


def mirror(effect: finding.Effect) -> str:
    """That parameters with some signs turned would do as well; empty where not."""
    tops = [", ".join(f"{n.replace('_', ' ')} {rounded(q)}" for n, q in top.items()) for top in effect.mirrored]
    return f"Mirrored it tells the recordings as well: {', or '.join(tops)}." if tops else ""


def psi_moments(fit: AnyFit, z: Float[np.ndarray, "draws size"]) -> dict[str, finding.Moments]:
    """Mean and sd of each psi, by draws of a fit's unknowns."""
    values = zip(fit.problem.simulator.parameters, fit.problem.psi(z).T, strict=True)
    return {p.name: finding.Moments(mean=float(x.mean()), sd=float(x.std())) for p, x in values}


def rounded(q: finding.Quantity) -> str:
    """`0.310 +- 0.012 N m`, with two digits of uncertainty; a vector's components in brackets."""
    unit = "" if q.unit in ("", "1") else f" {q.unit}"
    if isinstance(q.mean, tuple) and isinstance(q.sd, tuple):
        return f"({', '.join(_rounded(m, s) for m, s in zip(q.mean, q.sd, strict=True))}){unit}"
    return f"{_rounded(q.mean, q.sd)}{unit}"


def _rounded(mean, sd) -> str:
    mean, sd = (float("nan") if x is None else float(x) for x in (mean, sd))
    digits = max(0, 1 - int(np.floor(np.log10(sd)))) if sd > 0 else 3
    if digits > 6 or abs(mean) >= 1e6:
        return f"{mean:.3g} +- {sd:.2g}"
    return f"{mean:z.{digits}f} +- {sd:.{digits}f}"


def statement(placed: PlacedEffect, values: Mapping[str, finding.Parameter], equivalent: tuple[str, ...]) -> str:
    """What is missing, where and how much, in a sentence."""
    effect = placed.effect
    equally = f" (or equally {', '.join(equivalent)})" if equivalent else ""
    if not effect.listed:
        return sentence(placed, values, equally)
    said = {name: rounded(q) if isinstance(q, finding.Quantity) else str(q) for name, q in values.items()}
    sizes = ", ".join(f"{name.replace('_', ' ')} {text}" for name, text in said.items())
    if len(values) == 1:
        sizes = next(iter(said.values()))
    word = effect.noun or effect.name.replace("_", " ").capitalize()
    verb = "is missing" if effect.kind not in ("sensor", "actuator") else "was left out"
    return f"{word}{equally} of {sizes} on {placed.element.label} {verb}."


def finer_step(problem: Problem) -> str:
    """That the corrected simulator has another timestep than the model file; empty where it has not."""
    finer = problem.finer
    if finer is None:
        return ""
    return (
        f"The corrected simulator integrates by {finer.integrator} at {finer.timestep:g} s: "
        "the error of the believed step would show."
    )


def element(placed: PlacedEffect) -> finding.Element:
    """Kind and name."""
    return finding.Element(kind=placed.element.kind, name=placed.element.name)


def variables(placed: PlacedEffect) -> dict[str, tuple[str, ...]]:
    """What an effect on no list depends on, as an extra key."""
    return {} if placed.effect.listed else {"variables": placed.effect.variables}  # type: ignore[attr-defined]


def alternatives(rest: Sequence[Class], limit: int = 5) -> list[finding.Alternative]:
    """The other classes by their simplest member."""
    return [
        finding.Alternative(
            name=c.members[0].placed.effect.name,
            element=element(c.members[0].placed),
            probability=c.probability,
            **variables(c.members[0].placed),
        )
        for c in rest[:limit]
    ]


def likeliest(candidates: Sequence[finding.Alternative], limit: int = 3) -> list[str]:
    """The first candidates in words, but for those of 0 %; one without rivals has no probability beside them."""
    likely = [
        (f"{word(c)} on {c.element.name}", f" ({c.probability:.0%})")
        for c in candidates[:limit]
        if c.element and c.probability >= LEAST_TOLD
    ]
    return [name + odds * (len(likely) > 1) for name, odds in likely]


def word(c: finding.Alternative) -> str:
    """What a candidate is called within a sentence."""
    return "a force on no list" if c.name == "unlisted" else c.name.replace("_", " ")


def open_beside(candidates: Sequence[finding.Alternative]) -> str:
    """What may be missing beside what is named; empty where nothing is open."""
    each = ", ".join(likeliest(candidates))
    return f"What else was left out the recordings do not tell: {each}." if each else ""


def drop(fit: finding.Fit, them: str) -> str:
    """By how much columns' held-out errors fall, where one rises or a rollout diverges; empty where nothing changes."""
    before, after = fit.rollout_rmse_before, fit.rollout_rmse_after
    drops = {c: 1 - a / b for c in before if (b := before[c]) and (a := after.get(c)) is not None}
    falls = sorted(d for d in drops.values() if d >= SEEN)
    parts = []
    if falls:
        low, high = f"{falls[0]:.0%}", f"{falls[-1]:.0%}"
        many = f"{low} to {high}, depending on the column" if low != high else high
        parts.append(f"the held-out error falls by {many}")
    parts += [f"that of {c} rises by {-d:.0%}" for c, d in drops.items() if d <= -SEEN]
    parts += [f"held-out rollouts of {c} diverge" for c, b in before.items() if b is not None and after.get(c) is None]
    return f"With {them} {'; '.join(parts)}." if parts else ""
