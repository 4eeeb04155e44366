"""Experiments without the effect, on which sizes are tuned and refits are made; and what is typical in them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from det2stoc_bayes.blind.laws import Effect, Scene
from det2stoc_bayes.blind.reality import Run, simulate_believed, simulate_reality
from det2stoc_bayes.blind.systems import System

PROBES = 3  # experiments of a probe
ATTEMPTS = 200  # at a recording that stays within reach


@dataclass(frozen=True)
class Probe:
    """Experiments: starts (PREROLL before the first sample), inputs, and what is recorded without the effect."""

    system: System
    psi: dict[str, float]
    times: np.ndarray
    starts: list[np.ndarray]
    inputs: list[np.ndarray]
    plain: list[np.ndarray]
    scene: Scene
    varying: tuple[str, ...] = ()  # psi that a refit may set for each experiment
    finer: int = 1  # reality's steps in one believed step

    def with_effects(self, *effects: Effect) -> list[np.ndarray]:
        """What is recorded with effects, without noise."""
        runs = zip(self.starts, self.inputs, strict=True)
        return [simulate_reality(self.system, self.psi, effects, s, self.times, u, self.finer).columns for s, u in runs]

    def first(self) -> "Probe":
        """The first experiment alone."""
        return replace(self, starts=self.starts[:1], inputs=self.inputs[:1], plain=self.plain[:1])

    def change(self, changed: Sequence[np.ndarray]) -> float:
        """RMS difference from the plain recordings in noise sds; infinite where a simulation diverged."""
        noise = self.system.noise()
        with np.errstate(over="ignore", invalid="ignore"):
            squares = [np.mean(((c - p) / noise) ** 2) for c, p in zip(changed, self.plain, strict=True)]
        return float(np.sqrt(np.mean(squares))) if np.isfinite(squares).all() else np.inf


def within_reach(system: System, model: mujoco.MjModel, states: np.ndarray, slack: float) -> bool:
    """Whether all states are finite and their positions within slack times the system's reach."""
    if not np.isfinite(states).all():
        return False
    step = np.empty(model.nv)
    for state in states[::5]:
        mujoco.mj_differentiatePos(model, step, 1.0, model.qpos0, state[: model.nq])
        if (np.abs(step) > slack * np.array(system.reach)).any():
            return False
    return True


def experiment(
    rng: np.random.Generator,
    system: System,
    psi: dict[str, float],
    effects: Sequence[Effect],
    times: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, Run]:
    """Start, inputs and reality's run of one recording that stays within reach, also as the believed model sees it."""
    states_alone = system.measuring("qpos", "qvel")
    model = states_alone.compile(psi)
    for _ in range(ATTEMPTS):
        start, inputs = system.draw_start(rng), system.draw_inputs(rng, times)
        if not within_reach(system, model, simulate_believed(states_alone, model, start, times, inputs), 1.0):
            continue
        run = simulate_reality(system, psi, effects, start, times, inputs)
        if np.isfinite(run.columns).all() and within_reach(system, model, run.states, 1.3):
            return start, inputs, run
    raise ValueError(f"{system.name}: no recording stays within reach")


def draw_probe(
    rng: np.random.Generator,
    system: System,
    psi: dict[str, float],
    times: np.ndarray,
    varying: Sequence[str] = (),
) -> Probe:
    """Experiments with nothing concealed."""
    runs = [experiment(rng, system, psi, (), times) for _ in range(PROBES)]
    scene = typical(system, psi, times, [r for *_, r in runs], [u for _, u, _ in runs])
    starts, inputs, recorded = (list(part) for part in zip(*runs, strict=True))
    return Probe(system, psi, times, starts, inputs, [r.columns for r in recorded], scene, tuple(varying))


def typical(
    system: System, psi: dict[str, float], times: np.ndarray, runs: Sequence[Run], inputs: Sequence[np.ndarray]
) -> Scene:
    """What is typical in these runs."""
    model = system.compile(psi)
    data, seen = mujoco.MjData(model), []
    for run, commands in zip(runs, inputs, strict=True):
        for state, u in zip(run.states[::10], commands[::10], strict=True):
            data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
            data.ctrl[:] = u
            mujoco.mj_forward(model, data)
            seen.append(_snapshot(model, data))
    rms = {key: np.sqrt(np.mean([s[key] ** 2 for s in seen], axis=0)) for key in seen[0]}
    columns = np.concatenate([run.columns for run in runs])
    return Scene(
        model,
        float(times[-1] - times[0]),
        float(np.mean(np.diff(times))),
        {
            model.joint(j).name: {key: float(rms[key][model.jnt_dofadr[j]]) for key in ("speed", "force", "inertia")}
            | {"travel": float(rms["travel"][model.jnt_qposadr[j]])}
            for j in range(model.njnt)
            if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE
        },
        {
            model.body(b).name: {key: float(rms[f"body_{key}"][b]) for key in ("force", "speed", "spin")}
            | {"mass": float(model.body_mass[b]), "extent": _extent(model, b)}
            for b in range(1, model.nbody)
        },
        {
            model.actuator(a).name: {
                "command": float(max(np.abs(u[:, a]).max() for u in inputs)),
                "force": float(rms["actuator_force"][a]),
            }
            for a in range(model.nu)
        },
        dict(zip(system.columns(), columns.std(axis=0).tolist(), strict=True)) | {"time": float(times[-1])},
        _contacts(model, runs) if system.touching else {},
    )


def _contacts(model: mujoco.MjModel, runs: Sequence[Run]) -> dict[str, dict]:
    """For each pair of geoms that touches the share of samples in which it does, and where its body was."""
    data, found, count = mujoco.MjData(model), {}, 0
    for state in np.concatenate([run.states[::2] for run in runs]):
        data.qpos[:] = state[: model.nq]
        mujoco.mj_forward(model, data)
        count += 1
        for one in {"/".join(sorted(model.geom(int(g)).name for g in c.geom)) for c in data.contact}:
            found.setdefault(one, []).append(state[:3].tolist())
    return {name: {"share": len(places) / count, "places": places} for name, places in found.items()}


def _snapshot(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
    inertia, along, about = np.zeros((model.nv, model.nv)), np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    speed, spin = np.zeros(model.nbody), np.zeros(model.nbody)
    for body in range(1, model.nbody):
        mujoco.mj_jacBodyCom(model, data, along, about, body)
        speed[body], spin[body] = np.linalg.norm(along @ data.qvel), np.linalg.norm(about @ data.qvel)
    return {
        "speed": data.qvel.copy(),
        "force": np.abs(data.qfrc_actuator) + np.abs(data.qfrc_bias) + np.abs(data.qfrc_passive),
        "inertia": inertia.diagonal().copy(),
        "travel": data.qpos.copy(),
        "body_speed": speed,
        "body_spin": spin,
        "body_force": model.body_mass * np.linalg.norm(model.opt.gravity),
        "actuator_force": data.actuator_force.copy(),
    }


def _extent(model: mujoco.MjModel, body: int) -> float:
    """How far the body's geoms reach from its centre of mass, roughly half of its length."""
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
    return float(max(np.max(model.geom_aabb[g, 3:]) for g in geoms))
