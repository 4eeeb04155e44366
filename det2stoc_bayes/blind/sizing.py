"""How large a concealed effect is made: by what psi and the initial states cannot absorb of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.blind.laws import INTEGRATION, LAWS, UNLISTED, Effect
from det2stoc_bayes.blind.probe import Probe
from det2stoc_bayes.blind.reality import simulate_believed
from det2stoc_bayes.blind.refit import absorbable, beside, refit

SMALLEST, LARGEST = 3.0, 30.0  # RMS in noise sds that remains of an effect after a refit, drawn log-uniformly
FIRST_ORDER = 0.03  # of a slight effect's change: where less remains, psi is the same thing
WITHIN = 0.1  # of the wanted size, relatively
REFITS, TRIALS = 3, 10  # at most, for one size
KEPT = 1.5  # RMS in noise sds that effects at once must leave of each other
COARSE = (0.0025, 0.005, 0.01, 0.015, 0.02)  # believed timesteps when the integration is what is wrong
FLAT = 0.3  # noise sds: a component of a vector of which less remains is not asked for


@dataclass(frozen=True)
class Found:
    """A concealed effect, what psi leaves of it and what it changes (noise sds), and the believed (timestep, ...)."""

    effect: Effect
    size: float
    change: float
    believed: tuple[float, str] | None = None


def combinations(probe: Probe, effect: str | None = None) -> list[tuple[str, str]]:
    """(effect, element) pairs that this system may conceal."""
    scene, names = probe.scene, _named(effect)
    touching = probe.system.touching  # there sensors and the integration are left alone
    laws = {n: LAWS[n] for n in names if not touching or LAWS[n].kind in ("contact", "world", "body")}
    return [
        (n, e)
        for n, law in laws.items()
        for e in scene.names(law.kind)
        if law.fits(scene, e) and law.definite(scene, e)
    ]


def _named(effect: str | None) -> list[str]:
    """The laws that a name stands for; None: all that are on a list."""
    if effect in (None, UNLISTED):
        return [name for name, law in LAWS.items() if bool(law.variables) == (effect == UNLISTED)]
    return [effect]


def draw_size(rng: np.random.Generator) -> float:
    """A size in noise sds."""
    return float(np.exp(rng.uniform(np.log(SMALLEST), np.log(LARGEST))))


def find(
    rng: np.random.Generator, probe: Probe, pair: tuple[str, str], wanted: float, *, fixed: bool = False
) -> Found | None:
    """An effect of the wanted size; None where that is beyond its physical range, or psi absorbs all of it."""
    if pair[0] == INTEGRATION:
        return _coarse(probe, wanted)
    name, element = pair
    law = LAWS[name]
    drawn = law.draw(rng, probe.scene, element)
    sign = float(rng.choice((-1.0, 1.0))) if law.signed else 1.0
    largest = law.largest(probe.scene, element)
    basis, goal, best = absorbable(probe), wanted, None

    def trial(size: float) -> tuple[Effect, list[np.ndarray], float]:
        effect = Effect(name, law.kind, element, law.parameters(sign * size, drawn))
        changed = probe.with_effects(effect)
        return effect, changed, beside(basis, probe, changed)

    _, slight, left = trial(0.01 * largest)
    if left < FIRST_ORDER * probe.change(slight):
        return None
    for _ in range(REFITS):
        tuned = _tune(trial, largest, goal)
        if tuned is None:
            break
        effect, changed = tuned
        size = refit(probe, changed).left
        found = Found(effect, size, probe.change(changed))
        if SMALLEST <= size <= LARGEST and (best is None or _off(found, wanted) < _off(best, wanted)):
            best = found
        if abs(size / wanted - 1.0) < WITHIN:
            return found
        goal *= float(np.clip(wanted / max(size, 1e-6), 0.2, 5.0))
    return None if fixed else best


def _off(found: Found, wanted: float) -> float:
    return abs(np.log(found.size / wanted))


def _tune(
    trial: Callable[[float], tuple[Effect, list[np.ndarray], float]], largest: float, goal: float
) -> tuple[Effect, list[np.ndarray]] | None:
    """The effect that leaves `goal` noise sds to first order, or the largest; None where that is next to nothing."""
    magnitude, low, high = 0.1 * largest, 0.0, np.inf
    for _ in range(TRIALS):
        effect, changed, reached = trial(magnitude)
        if abs(reached / goal - 1.0) < WITHIN or (reached < goal and magnitude >= largest):
            return (effect, changed) if reached >= 0.5 * SMALLEST else None
        low, high = (magnitude, high) if reached < goal else (low, magnitude)
        magnitude *= float(np.clip(goal / max(reached, 1e-6), 0.02, 20.0))  # the change is nearly proportional
        if not low < magnitude < high:
            magnitude = 0.5 * (low + min(high, largest)) if high < np.inf else largest
        magnitude = min(magnitude, largest)
    return None


def _coarse(probe: Probe, wanted: float) -> Found | None:
    """The believed timestep for Euler's method whose error comes closest to `wanted` noise sds after a refit."""
    system, sampling, choices = probe.system, probe.times[1] - probe.times[0], []
    for step in COARSE:
        if step > sampling or abs(sampling / step - round(sampling / step)) > 1e-6:
            continue
        believed = (step, "Euler")
        model = system.compile(probe.psi, *believed)
        runs = zip(probe.starts, probe.inputs, strict=True)
        change = probe.change([simulate_believed(system, model, s, probe.times, u) for s, u in runs])
        if SMALLEST <= change < np.inf:
            left = refit(probe, probe.plain, believed=believed).left
            if SMALLEST <= left <= LARGEST:
                truth = {"timestep": system.timestep, "integrator": system.integrator}
                choices.append(Found(Effect(INTEGRATION, "simulator", "option", truth), left, change, believed))
    return min(choices, key=lambda f: abs(np.log(f.size / wanted)), default=None)


def clash(first: tuple[str, str], second: tuple[str, str]) -> bool:
    """Pairs whose order of action is open, or that are one effect: on one actuator, one column, or one name."""
    same_place = first[1] == second[1] and LAWS[first[0]].kind == LAWS[second[0]].kind != "joint"
    return first == second or INTEGRATION in (first[0], second[0]) or same_place


def all_kept(probe: Probe, found: Sequence[Found]) -> bool:
    """Whether no effect can be absorbed by the other ones together with psi."""
    effects = [f.effect for f in found]
    changed = probe.with_effects(*effects)
    if not np.isfinite(probe.change(changed)):
        return False
    return all(refit(probe, changed, [e for e in effects if e is not one]).left >= KEPT for one in reversed(effects))


def judged_components(probe: Probe, effect: Effect) -> dict[str, list[int]]:
    """For each parameter with directions the components (a scalar has 0) that psi and initial states do not take up."""
    result, reference, basis = {}, probe.with_effects(effect), absorbable(probe)
    for key, value in effect.parameters.items():
        if not isinstance(value, list) and key not in LAWS[effect.name].axes:
            continue
        result[key] = []
        for i in range(len(value) if isinstance(value, list) else 1):
            neutral = 1.0 if key == "ratio" else 0.0
            without = [v if j != i else neutral for j, v in enumerate(value)] if isinstance(value, list) else neutral
            other = probe.with_effects(replace(effect, parameters={**effect.parameters, key: without}))
            if beside(basis, probe, other, reference) > FLAT:
                result[key].append(i)
    return result
