"""How large a concealed effect is made, and whether psi leaves enough of it to be seen."""

from dataclasses import dataclass

import numpy as np

from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.reality import simulate_believed, simulate_reality
from det2stoc_bayes.blind.refit import unabsorbed
from det2stoc_bayes.blind.systems import System

SMALLEST, LARGEST = 3.0, 30.0  # RMS change that an effect makes, in noise sds, drawn log-uniformly between
UNABSORBED = 1.5  # RMS in noise sds that must remain once psi and the initial states are refitted
PROBES = 3  # recordings that the size is tuned on
COARSE = (0.0025, 0.005, 0.01, 0.015, 0.02)  # believed timesteps when the integration is what is wrong


@dataclass(frozen=True)
class Probe:
    """Experiments without the effect, on which the size is tuned and refits are made."""

    system: System
    psi: dict[str, float]
    times: np.ndarray
    starts: list[np.ndarray]
    inputs: list[np.ndarray]
    plain: list[np.ndarray]

    def with_effect(self, effect: Effect) -> list[np.ndarray]:
        runs = zip(self.starts, self.inputs, strict=True)
        return [simulate_reality(self.system, self.psi, effect, s, self.times, u, finer=2) for s, u in runs]

    def size(self, changed: list[np.ndarray]) -> float:
        noise = self.system.noise()
        with np.errstate(over="ignore", invalid="ignore"):
            squares = [np.mean(((c - p) / noise) ** 2) for c, p in zip(changed, self.plain, strict=True)]
        return float(np.sqrt(np.mean(squares))) if np.isfinite(squares).all() else np.inf


@dataclass(frozen=True)
class Found:
    """A concealed effect, its size and what psi leaves of it, and the believed (timestep, integrator)."""

    effect: Effect
    size: float
    left: float
    believed: tuple[float, str] | None = None


def find(rng: np.random.Generator, probe: Probe, pair: tuple[str, str], wanted: float, fixed: bool) -> Found | None:
    """An effect that psi cannot absorb; made larger, up to the largest, where psi takes too much of it."""
    if pair[0] == "numerical_integration":
        found = _coarse(probe, wanted)
        return found if found is not None and found.left >= UNABSORBED else None
    shape = Shape.draw(rng, pair)
    for _ in range(3):
        found = _tune(probe, shape, wanted)
        if found is None or found.left >= UNABSORBED or fixed:
            return found if found is not None and found.left >= UNABSORBED else None
        wanted = 1.15 * wanted * UNABSORBED / found.left
        if wanted > LARGEST:
            return None
    return None


def experiment(
    rng: np.random.Generator, system: System, psi: dict[str, float], effect: Effect | None, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, inputs and reality's columns of one recording that stays within reach."""
    reach = np.array(system.reach)
    model = system.compile(psi)
    for _ in range(200):
        start, inputs = system.draw_start(rng), system.draw_inputs(rng, times)
        positions = simulate_believed(model, start, times, inputs)[:, : reach.size]
        if (np.abs(positions) > reach).any():
            continue
        columns = simulate_reality(system, psi, effect, start, times, inputs)
        if np.isfinite(columns).all() and (np.abs(columns[:, : reach.size]) <= 1.3 * reach).all():
            return start, inputs, columns
    raise ValueError(f"{system.name}: no recording stays within reach")


def draw_probe(rng: np.random.Generator, system: System, psi: dict[str, float], times: np.ndarray) -> Probe:
    runs = [experiment(rng, system, psi, None, times) for _ in range(PROBES)]
    starts, inputs, plain = (list(part) for part in zip(*runs, strict=True))
    return Probe(system, psi, times, starts, inputs, plain)


@dataclass(frozen=True)
class Shape:
    """Everything of an effect but its size."""

    pair: tuple[str, str]
    sign: float
    extra: dict[str, float]

    @classmethod
    def draw(cls, rng: np.random.Generator, pair: tuple[str, str]) -> "Shape":
        sign, extra = float(rng.choice((-1.0, 1.0))) if LAWS[pair[0]].signed else 1.0, {}
        if pair[0] == "cogging_torque":
            low, high = (15.0, 45.0) if pair[1] in ("track", "rail") else (4.0, 12.0)
            extra = {"cycles": rng.uniform(low, high), "phase": rng.uniform(-np.pi, np.pi)}
        return cls(pair, sign, {key: float(f"{value:.4g}") for key, value in extra.items()})

    def build(self, magnitude: float) -> Effect:
        name, element = self.pair
        law = LAWS[name]
        # four digits, so that what is told is exactly what is simulated
        main = float(f"{law.neutral + self.sign * magnitude:.4g}")
        return Effect(name, law.kind, element, {law.main: main, **self.extra})


def _tune(probe: Probe, shape: Shape, wanted: float) -> Found | None:
    """Search the effect's size until it changes the rollouts by `wanted` noise sds."""
    largest = LAWS[shape.pair[0]].largest
    magnitude, low, high = 0.03 * largest, 0.0, largest
    tries = 14
    while True:
        tries -= 1
        effect = shape.build(magnitude)
        changed = probe.with_effect(effect)
        reached = probe.size(changed)
        if abs(reached / wanted - 1.0) < 0.05 or not tries:
            break
        low, high = (magnitude, high) if reached < wanted else (low, magnitude)
        magnitude *= np.clip(wanted / max(reached, 1e-9), 0.02, 50.0)  # the change is nearly proportional
        if not low < magnitude < high:
            magnitude = 0.5 * (low + high)
    if not SMALLEST * 0.9 <= reached <= LARGEST * 1.1:
        return None
    left = unabsorbed(probe.system, probe.psi, probe.starts, probe.times, probe.inputs, changed)
    return Found(effect, reached, left)


def _coarse(probe: Probe, wanted: float) -> Found | None:
    """The believed timestep for Euler's method whose error comes closest to `wanted` noise sds."""
    sampling, choices = probe.times[1], []
    for step in COARSE:
        if step > sampling or abs(sampling / step - round(sampling / step)) > 1e-6:
            continue
        model = probe.system.compile(probe.psi, step, "Euler")
        runs = zip(probe.starts, probe.inputs, strict=True)
        reached = probe.size([simulate_believed(model, s, probe.times, u) for s, u in runs])
        if SMALLEST <= reached <= LARGEST:
            choices.append((abs(np.log(reached / wanted)), step, reached))
    if not choices:
        return None
    _, step, reached = min(choices)
    believed = (step, "Euler")
    left = unabsorbed(probe.system, probe.psi, probe.starts, probe.times, probe.inputs, probe.plain, believed)
    truth = {"timestep": probe.system.timestep, "integrator": probe.system.integrator}
    return Found(Effect("numerical_integration", "simulator", "option", truth), reached, left, believed)
