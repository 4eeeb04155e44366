"""Recordings that a plain MuJoCo loop makes, and the problems that tests pose with them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from conftest import make_study, model_xml, state_columns, write_recording

from det2stoc_bayes.engines.base import Start
from det2stoc_bayes.linearization import Point, start_point
from det2stoc_bayes.mismatch.effects import CATALOGUE, PlacedEffect, Typical
from det2stoc_bayes.optimize import Fit, fit_many
from det2stoc_bayes.problem import Problem, make_problem
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study

SPRING = """
<body name="block"><joint name="slide" type="slide" axis="1 0 0" damping="0.4" stiffness="30"/>
  <geom size="0.1" mass="1.2" contype="0" conaffinity="0"/></body>"""
PENDULUM = """
<body name="rod" pos="0 0 1"><joint name="pivot" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.8" contype="0" conaffinity="0"/></body>"""
SLED = """
<body name="sled"><joint name="run" type="slide" axis="1 0 0"/>
  <geom size="0.1" mass="2" contype="0" conaffinity="0"/></body>"""
MOTOR = '<actuator><motor name="push" joint="run"/></actuator>'
SPRING_PSI = """
[psi.damping]
target = "joint/slide/damping"
prior = { Normal = { loc = 0.4, scale = 0.1 } }
[psi.stiffness]
target = "joint/slide/stiffness"
prior = { Normal = { loc = 30, scale = 3 } }
"""
Loop = Callable[[mujoco.MjModel, mujoco.MjData], None]


def noise_table(position: float, velocity: float | None = None) -> str:
    """The [noise] table."""
    lines = ["[noise]", f'"qpos/*" = {position}'] + ([] if velocity is None else [f'"qvel/*" = {velocity}'])
    return "\n".join(lines) + "\n"


def run(
    xml: str,
    start: tuple[Sequence[float], Sequence[float]],
    steps: np.ndarray,
    *,
    change: Callable[[mujoco.MjModel], None] = lambda model: None,
    push: Loop | None = None,
    ctrl: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Time and states (samples, nq + nv) after `steps` steps; `ctrl` is held from its sample to the next."""
    model = mujoco.MjModel.from_xml_string(xml)
    change(model)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start
    rows, sample = [], -1
    for k in range(int(steps[-1]) + 1):
        if k in steps:
            sample += 1
            rows.append(np.concatenate([data.qpos, data.qvel]))
        if ctrl is not None:
            data.ctrl[:] = ctrl[sample]
        if push is not None:
            data.qfrc_applied[:], data.xfrc_applied[:] = 0.0, 0.0
            push(model, data)
        mujoco.mj_step(model, data)
    return model.opt.timestep * np.asarray(steps), np.array(rows)


def recordings(
    xml: str,
    starts: Sequence[tuple[Sequence[float], Sequence[float]]],
    steps: np.ndarray,
    noise: Sequence[float],
    *,
    seed: int = 0,
    columns: Sequence[str] | None = None,
    ctrl: Sequence[np.ndarray] | None = None,
    **options,
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """One noisy recording a start, as `make_study` takes them; `noise` has one sd a state."""
    rng, model = np.random.default_rng(seed), mujoco.MjModel.from_xml_string(xml)
    names = [c for kind in ("qpos", "qvel") for c in state_columns(model) if c.startswith(kind)]
    out = {}
    for number, start in enumerate(starts):
        commands = None if ctrl is None else ctrl[number]
        time, states = run(xml, start, steps, ctrl=commands, **options)
        states = states + np.asarray(noise) * rng.standard_normal(states.shape)
        table = {c: states[:, j] for j, c in enumerate(names) if columns is None or c in columns}
        if commands is not None:
            table |= {f"ctrl/{model.actuator(a).name}": commands[:, a] for a in range(model.nu)}
        out[f"run_{number}"] = (time, table)
    return out


def spring_problem(folder: Path, noise: float = 0.01, toml: str = SPRING_PSI, **options) -> Problem:
    """Three recordings of a mass on a spring; linear in its start and in forces."""
    starts = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5])]
    made = recordings(model_xml(SPRING), starts, 10 * np.arange(40), (noise, 10 * noise), **options)
    return pose(make_study(folder / "spring", model_xml(SPRING), toml + noise_table(noise, 10 * noise), made))


def pose(study: Study, **options) -> Problem:
    """A study's problem, simulated by one thread."""
    return make_problem(Simulator(study, num_threads=1), **options)


def add_holdout(study: Study, made: Mapping[str, tuple]) -> None:
    """Recordings that are not fitted; the study has to be loaded again."""
    (study.folder / "holdout").mkdir()
    for name, (time, columns) in made.items():
        write_recording(study.folder / "holdout" / f"{name}.csv", time, columns)


def fit(problem: Problem, z: Sequence[float] | None = None, **options) -> Fit:
    """The fit of one hypothesis, which must exist."""
    found = fit_many([(problem, start_point(problem, None if z is None else np.array(z, float)))], **options)[0]
    assert found is not None
    return found


def here(problem: Problem, start: Start | None = None) -> Fit:
    """A hypothesis linearized where it stands, not moved."""
    point = start_point(problem) if start is None else Point(np.zeros(problem.size), start)
    found = fit_many([(problem, point)], max_iterations=0)[0]
    assert found is not None
    return found


def place(problem: Problem, name: str, element: str, typical: Typical | None = None) -> PlacedEffect:
    """An effect of the catalogue on the element of this name."""
    effect = CATALOGUE[name]
    found = [e for e in problem.simulator.elements(effect.kind, problem.segments.columns) if e.name == element]
    return PlacedEffect(effect, found[0], Typical() if typical is None else typical)


def with_values(record: Recording, values: np.ndarray) -> Recording:
    """The same recording with other measured values."""
    return replace(record, values=values)


def jacobians(problem: Problem, z: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (segments, values) and central differences in starts (.., states) and unknowns (.., size)."""
    model, count = problem.simulator.model, problem.segments.count

    def residual(z, start):
        return problem.residuals(problem.simulator.rollout(problem.request(z[None], start)))

    a = []
    for i in range(2 * model.nv):
        change = np.zeros((count, 2 * model.nv))
        change[:, i] = 1e-3
        moved = [residual(z, problem.moved(start, s * change)) for s in (1, -1)]
        a.append((moved[1] - moved[0]) / 2e-3)
    j = [(residual(z - 1e-3 * e, start) - residual(z + 1e-3 * e, start)) / 2e-3 for e in np.eye(len(z))]
    empty = np.zeros((count, problem.weight.shape[1], 0))
    return residual(z, start), np.stack(a, -1), np.stack(j, -1) if j else empty


def dense_evidence(problem: Problem, z: np.ndarray, start: Start, extra: np.ndarray | None = None) -> float:
    """log N(y; ...) of the model linearized here, starts and unknowns N(0, I) integrated out; no algebra is shared.

    `extra` (segments, values, k): further sensitivities, to coefficients with a prior sd of 100.
    """
    r, a, j = jacobians(problem, z, start)
    guess, seen = problem.guess, problem.weight.ravel() > 0
    off = np.concatenate([guess.start.qpos - start.qpos, guess.start.qvel - start.qvel], 1)
    mean = -np.einsum("snk,k->sn", j, z) + np.einsum("snk,sk->sn", a, off)
    total = r.size
    noise = np.where(problem.weight > 0, 1.0 / np.maximum(problem.weight, 1e-300), 1.0).ravel()
    covariance = np.diag(noise**2)
    for s in range(problem.segments.count):
        rows = slice(s * r.shape[1], (s + 1) * r.shape[1])
        covariance[rows, rows] += a[s] @ np.diag(guess.prior_sd[s] ** 2) @ a[s].T
    flat = j.reshape(total, j.shape[-1])
    covariance += flat @ flat.T
    if extra is not None:
        x = extra.reshape(total, extra.shape[-1])
        covariance += 100.0**2 * x @ x.T
    difference = (r - mean).ravel()[seen]
    covariance = covariance[np.ix_(seen, seen)]
    sign, log_det = np.linalg.slogdet(covariance)
    assert sign > 0
    return float(
        -0.5 * (difference @ np.linalg.solve(covariance, difference) + log_det + seen.sum() * np.log(2 * np.pi))
    )
