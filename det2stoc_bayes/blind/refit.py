"""How much of what is recorded the believed model can absorb: a least-squares refit.

Free are psi (one that varies, for each recording), the initial states and, where a rival explanation is given, the
parameters of its effects.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.probe import Probe
from det2stoc_bayes.blind.reality import shifted, simulate_believed, simulate_reality

ITERATIONS = 10
# Tenths of psi's value: only signs are kept, or effects would be seen by the edge of a prior alone.
PSI_RANGE = (-9.8, 1000.0)
ENOUGH = 0.05  # an iteration that lowers the squares by a smaller share is the last


@dataclass(frozen=True)
class Refit:
    """RMS in noise sds that remains, the rival effects at their best parameters, and all unknowns there."""

    left: float
    rivals: tuple[Effect, ...]
    z: np.ndarray


def refit(
    probe: Probe,
    truths: Sequence[np.ndarray],
    rivals: Sequence[Effect] = (),
    believed: tuple[float, str] | None = None,
    enough: float = 0.0,
) -> Refit:
    """Fit the believed model, with `rivals` added to it, to noise-free recordings `truths` of a probe's experiments.

    `believed` is another (timestep, integrator). Stops once less than `enough` remains.
    """
    problem = _Problem(probe, truths, rivals, believed)
    z, damping = problem.initial, 1e-6
    best = problem.residual(z)
    for _ in range(ITERATIONS):  # Levenberg-Marquardt on the normal equations
        slope = problem.jacobian(z)
        normal, gradient = slope.T @ slope, slope.T @ best
        scale = normal.diagonal() + 1e-9
        for _ in range(5):
            trial = problem.clip(z - np.linalg.solve(normal + damping * np.diag(scale), gradient))
            reached = problem.residual(trial)
            if reached @ reached < best @ best:
                break
            damping *= 30.0
        else:
            break
        gain = 1.0 - (reached @ reached) / (best @ best)
        z, best, damping = trial, reached, max(damping / 30.0, 1e-10)
        if gain < ENOUGH or np.sqrt(np.mean(best**2)) <= enough:
            break
    return Refit(float(np.sqrt(np.mean(best**2))), tuple(problem.effects(z)), z)


def absorbable(probe: Probe) -> np.ndarray:
    """Orthonormal directions, in whitened recordings, that psi and the initial states take up to first order."""
    alone = _Problem(probe, probe.plain, (), None)
    return np.linalg.qr(alone.jacobian(alone.initial))[0]


def beside(
    basis: np.ndarray, probe: Probe, changed: Sequence[np.ndarray], reference: Sequence[np.ndarray] | None = None
) -> float:
    """RMS in noise sds that remains of a change to first order; infinite where a simulation diverged.

    The change is from recordings without any effect, or from the reference.
    """
    noise, reference = probe.system.noise(), probe.plain if reference is None else reference
    change = np.concatenate([((c - r) / noise).ravel() for c, r in zip(changed, reference, strict=True)])
    if not np.isfinite(change).all():
        return np.inf
    return float(np.sqrt(np.mean((change - basis @ (basis.T @ change)) ** 2)))


def linear_share(probe: Probe, truths: Sequence[np.ndarray], rivals: Sequence[Effect]) -> list[float]:
    """For each rival the share of what a refit without it leaves that remains with it, to first order.

    From that refit, or from psi as it is where that promises more: a large effect leads psi far away. It tells which
    rivals are worth a refit of their own.
    """
    alone = _Problem(probe, truths, (), None)
    points = [(z, *_left_at(alone, z)) for z in (refit(probe, truths).z, alone.initial)]
    result = []
    for rival in rivals:
        problem = _Problem(probe, truths, (rival,), None)
        own = problem.initial[alone.initial.size :]
        shares = [_share(problem.sensitivities(np.concatenate((z, own))), basis, left) for z, basis, left in points]
        result.append(min(shares))
    return result


def _left_at(problem: "_Problem", z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions that psi and the initial states take up about z, and the residual there without them."""
    basis, left = np.linalg.qr(problem.jacobian(z))[0], problem.residual(z)
    return basis, left - basis @ (basis.T @ left)


def _share(columns: np.ndarray, basis: np.ndarray, target: np.ndarray) -> float:
    """Of a target what remains beside columns that a basis does not take up."""
    columns = columns - basis @ (basis.T @ columns)
    sizes = np.linalg.norm(columns, axis=0)
    columns = columns[:, sizes > 1e-6 * max(sizes.max(), 1e-300)]
    left = target - columns @ np.linalg.lstsq(columns, target, rcond=1e-8)[0]
    return float(np.linalg.norm(left) / np.linalg.norm(target))


class _Problem:
    """The unknowns z: psi in tenths of its value, then for each recording its state in small units and its own
    change of the psi that vary, then the rivals' parameters as they are."""

    def __init__(self, probe: Probe, truths, rivals: Sequence[Effect], believed: tuple[float, str] | None) -> None:
        self.probe, self.truths, self.rivals, self.believed = probe, truths, list(rivals), believed
        system, psi, self.noise = probe.system, probe.psi, probe.system.noise()
        self.scales = np.array([0.1 * abs(psi[entry.name]) for entry in system.psi])
        self.model = system.compile(psi)
        self.varying = [i for i, entry in enumerate(system.psi) if entry.name in probe.varying]
        self.num_psi, self.num_state = len(system.psi), 2 * self.model.nv
        self.num_own = self.num_state + len(self.varying)
        self.state_scale = np.repeat([1e-3, 1e-2], self.model.nv)
        self.places = [
            (e, key, i)
            for e, effect in enumerate(self.rivals)
            for key, value in effect.parameters.items()
            if not isinstance(value, str)
            for i in (range(len(value)) if isinstance(value, list) else (None,))
        ]
        first = [_entry(self.rivals[e].parameters[key], i) for e, key, i in self.places]
        own = np.zeros(len(probe.starts) * self.num_own)
        self.initial = np.concatenate((np.zeros(self.num_psi), own, first))

    def effects(self, z: np.ndarray) -> list[Effect]:
        """The rivals at their parameters in z; a size that has no sign stays positive."""
        given = [{k: list(v) if isinstance(v, list) else v for k, v in e.parameters.items()} for e in self.rivals]
        for (e, key, i), value in zip(self.places, z[self.initial.size - len(self.places) :], strict=True):
            law = LAWS[self.rivals[e].name]
            if i is not None:
                given[e][key][i] = float(value)
            else:
                positive = not law.signed and not law.axes and key == next(iter(law.units))
                given[e][key] = float(max(value, 1e-9) if positive else value)
        return [replace(e, parameters=p) for e, p in zip(self.rivals, given, strict=True)]

    def clip(self, z: np.ndarray) -> np.ndarray:
        z[: self.num_psi] = np.clip(z[: self.num_psi], *PSI_RANGE)
        return z

    def residual(self, z: np.ndarray) -> np.ndarray:
        return np.concatenate([self._one(r, z) for r in range(len(self.truths))])

    def jacobian(self, z: np.ndarray) -> np.ndarray:
        """By finite differences; without rivals through the believed model, which is faster."""
        size = self.truths[0].size
        result = np.zeros((len(self.truths) * size, z.size))
        for r in range(len(self.truths)):
            rows, base = slice(r * size, (r + 1) * size), self._one(r, z)
            at = self.num_psi + r * self.num_own
            for column in [*range(self.num_psi), *range(at, at + self.num_own)]:
                step = 1e-2 if at <= column < at + self.num_state else 1e-4
                result[rows, column] = (self._one(r, _moved(z, column, step)) - base) / step
        if self.rivals:
            result[:, z.size - len(self.places) :] = self.sensitivities(z)
        return result

    def sensitivities(self, z: np.ndarray) -> np.ndarray:
        """Columns of the rivals' parameters."""
        result, base = np.zeros((sum(t.size for t in self.truths), len(self.places))), self.residual(z)
        for place, (e, key, _) in enumerate(self.places):
            step = 1e-3 * (float(np.abs(self.rivals[e].parameters[key]).max()) or 1.0)
            moved = _moved(z, z.size - len(self.places) + place, step)
            result[:, place] = (self.residual(moved) - base) / step
        return result

    def _one(self, r: int, z: np.ndarray) -> np.ndarray:
        probe, system = self.probe, self.probe.system
        at = self.num_psi + r * self.num_own
        start = shifted(self.model, probe.starts[r], self.state_scale * z[at : at + self.num_state])
        change = z[: self.num_psi].copy()
        change[self.varying] += z[at + self.num_state : at + self.num_own]
        change = np.clip(change, *PSI_RANGE)
        psi = {e.name: probe.psi[e.name] + self.scales[i] * change[i] for i, e in enumerate(system.psi)}
        if self.rivals:
            run = simulate_reality(system, psi, self.effects(z), start, probe.times, probe.inputs[r], probe.finer)
            columns = run.columns
        else:
            model = system.compile(psi, *(self.believed or (None, None)))
            columns = simulate_believed(system, model, start, probe.times, probe.inputs[r])
        whitened = ((columns - self.truths[r]) / self.noise).ravel()
        return np.nan_to_num(np.clip(whitened, -1e4, 1e4), nan=1e4)


def _entry(value: float | list[float], index: int | None) -> float:
    return float(value[index]) if isinstance(value, list) and index is not None else float(value)  # type: ignore[arg-type]


def _moved(z: np.ndarray, column: int, step: float) -> np.ndarray:
    moved = z.copy()
    moved[column] += step
    return moved
