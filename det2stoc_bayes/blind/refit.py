"""How much of a concealed effect psi and the initial states can absorb: a least-squares refit."""

import numpy as np

from det2stoc_bayes.blind.reality import simulate_believed
from det2stoc_bayes.blind.systems import System


def unabsorbed(
    system: System,
    psi: dict[str, float],
    starts: list[np.ndarray],
    times: np.ndarray,
    inputs: list[np.ndarray],
    truths: list[np.ndarray],
    believed: tuple[float, str] | None = None,
) -> float:
    """RMS in noise sds that remains between noise-free truths and the believed model after the refit."""
    noise, psi_count, state = system.noise(), len(system.psi), starts[0].size
    scales = np.array([0.1 * abs(psi[entry.name]) for entry in system.psi])
    step, integrator = believed or (None, None)

    def values(x: np.ndarray) -> dict[str, float]:
        return {entry.name: psi[entry.name] + scales[i] * x[i] for i, entry in enumerate(system.psi)}

    def one(r: int, x: np.ndarray, shift: np.ndarray) -> np.ndarray:
        model = system.compile(values(x), step, integrator)
        columns = simulate_believed(model, starts[r] + noise * shift, times, inputs[r])
        return np.nan_to_num(((columns - truths[r]) / noise).ravel(), nan=1e3, posinf=1e3, neginf=-1e3)

    def split(z: np.ndarray, r: int) -> tuple[np.ndarray, np.ndarray]:
        return z[:psi_count], z[psi_count + r * state : psi_count + (r + 1) * state]

    def residual(z: np.ndarray) -> np.ndarray:
        return np.concatenate([one(r, *split(z, r)) for r in range(len(starts))])

    def jacobian(z: np.ndarray) -> np.ndarray:
        size = truths[0].size
        result = np.zeros((len(starts) * size, z.size))
        for r in range(len(starts)):
            x, shift = split(z, r)
            rows, base = slice(r * size, (r + 1) * size), one(r, x, shift)
            for i in range(psi_count):
                result[rows, i] = (one(r, x + 1e-4 * np.eye(psi_count)[i], shift) - base) / 1e-4
            for i in range(state):
                column = psi_count + r * state + i
                result[rows, column] = (one(r, x, shift + 1e-2 * np.eye(state)[i]) - base) / 1e-2
        return result

    low = np.array([(entry.support()[0] - psi[entry.name]) / scales[i] for i, entry in enumerate(system.psi)])
    high = np.array([(entry.support()[1] - psi[entry.name]) / scales[i] for i, entry in enumerate(system.psi)])
    z = np.zeros(psi_count + len(starts) * state)
    best, damping = residual(z), 1e-6
    for _ in range(6):  # Levenberg-Marquardt on the normal equations
        slope = jacobian(z)
        normal, gradient = slope.T @ slope, slope.T @ best
        for _ in range(4):
            trial = z - np.linalg.solve(normal + damping * np.diag(normal.diagonal() + 1e-12), gradient)
            trial[:psi_count] = np.clip(trial[:psi_count], low, high)
            reached = residual(trial)
            if reached @ reached < best @ best:
                break
            damping *= 30.0
        else:
            break
        gain = 1.0 - (reached @ reached) / (best @ best)
        z, best, damping = trial, reached, max(damping / 30.0, 1e-9)
        if gain < 0.02:
            break
    return float(np.sqrt(np.mean(best**2)))
