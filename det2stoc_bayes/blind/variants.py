"""What makes a recording harder than whole, regular states with a noise that is told."""

from dataclasses import dataclass, field, replace

import numpy as np

from det2stoc_bayes.blind.systems import System

VARIANTS = {
    "positions_only": "velocities are not measured",
    "sensors": "gyroscope and accelerometer beside the state or instead of velocities, or a tracked point alone",
    "unknown_noise": "study.toml tells no noise",
    "varying_psi": "one parameter differs from recording to recording",
    "known_values": "one field differs from recording to recording and is known",
    "irregular": "uneven time steps, and dropped samples",
    "outliers": "a few samples are far off",
}
DROPPED = 0.03  # share of cells
OUTLIERS = 4  # in a study, by 15 to 60 noise sds


@dataclass(frozen=True)
class Setting:
    """A system under chosen variants: `varying` maps names of psi to the spread between recordings."""

    system: System
    variants: tuple[str, ...] = ()
    varying: dict[str, float] = field(default_factory=dict)

    def values(self, rng: np.random.Generator, psi: dict[str, float]) -> dict[str, float]:
        """One recording's own parameters: varying psi, and the known field by its path."""
        own = dict(psi)
        for entry in self.system.psi:
            if entry.name in self.varying:
                own[entry.name] = entry.draw(rng, self.varying[entry.name], psi[entry.name])
        if "known_values" in self.variants:
            own[self.system.known] = float(f"{_believed(self.system) * rng.uniform(0.75, 1.35):.4g}")
        return own

    def times(self, rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
        """One recording's sample times."""
        if "irregular" not in self.variants:
            return times
        return np.round(np.concatenate(([0.0], np.cumsum(np.diff(times) * rng.uniform(0.6, 1.4, times.size - 1)))), 5)

    def spoil(self, rng: np.random.Generator, columns: list[np.ndarray]) -> list[np.ndarray]:
        """Noisy columns of all recordings with glitches, and then dropped samples (NaN)."""
        result, noise = [c.copy() for c in columns], self.system.noise()
        if "outliers" in self.variants:
            for _ in range(OUTLIERS):
                spoiled = result[rng.integers(len(result))]
                row, column = rng.integers(spoiled.shape[0]), rng.integers(spoiled.shape[1])
                spoiled[row, column] += rng.choice((-1.0, 1.0)) * rng.uniform(15.0, 60.0) * noise[column]
        if "irregular" in self.variants:
            for spoiled in result:
                spoiled[rng.uniform(size=spoiled.shape) < DROPPED] = np.nan
        return result


def choose(rng: np.random.Generator, system: System, variants: tuple[str, ...]) -> Setting:
    """A system under variants. Raises ValueError for one that is not known, or that the system has nothing for."""
    for name in variants:
        if name not in VARIANTS:
            raise ValueError(f"variant {name!r} is not known; there are {', '.join(VARIANTS)}")
        if name not in possible(system):
            raise ValueError(f"{system.name} has no field that is known for each recording")
    if "sensors" in variants:
        mounted = [("qpos", "imu")] if "positions_only" in variants else [("qpos", "qvel", "imu"), ("qpos", "imu")]
        mounted += [] if "positions_only" in variants else [("tracker",)]
        system = replace(system, measured=mounted[rng.integers(len(mounted))])
    elif "positions_only" in variants:
        system = system.measuring("qpos")
    varying = {}
    if "varying_psi" in variants:
        entry = system.psi[rng.integers(len(system.psi))]
        varying[entry.name] = float(f"{entry.sd() * rng.uniform(0.2, 0.5):.3g}")
    return Setting(system, tuple(variants), varying)


def possible(system: System) -> list[str]:
    """The variants that a system can have."""
    return [name for name in VARIANTS if name != "known_values" or system.known]


def _believed(system: System) -> float:
    kind, name, attribute = system.known.split("/")
    model = system.compile({})
    entry = getattr(model, kind)(name)
    return float(np.ravel(getattr(entry, attribute))[0])
