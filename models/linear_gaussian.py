"""A mass on two slides under unknown gravity: a study whose posterior is known in closed form.

Semi-implicit Euler, v += h a, then q += h v, gives after k steps q = q0 + k h v0 + h^2 k (k + 1) / 2 a, which
is linear in the initial state and in gravity. The axes are rotated and measured with different noise, so that
the posterior of the two components of gravity is correlated.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.files import atomic_write
from det2stoc_bayes.problem import Problem

MODEL = Path(__file__).with_suffix(".xml")
AXES = np.array([[0.8, 0.6], [-0.6, 0.8]])  # x and z of the slides' directions
COLUMNS = ("qpos/first", "qpos/second")
TIMESTEP = 0.005
GRAVITY = (0.3, -0.1)  # x and z under which the problem's own recordings are simulated


@dataclass(frozen=True)
class Setting:
    """Prior of gravity's x and z component [m/s^2], noise of the two positions [m], what is recorded."""

    prior_mean: tuple[float, float] = (0.0, 0.2)
    prior_sd: tuple[float, float] = (0.5, 0.4)
    noise: tuple[float, float] = (0.02, 0.05)
    num_recordings: int = 2
    num_samples: int = 30
    steps_per_sample: int = 4


SETTING = Setting()


def draw_gravity(random: np.random.Generator, setting: Setting = SETTING) -> Float[np.ndarray, " 2"]:
    """A gravity from the prior."""
    return np.asarray(setting.prior_mean) + np.asarray(setting.prior_sd) * random.standard_normal(2)


def simulate(
    gravity: Float[np.ndarray, " 2"], random: np.random.Generator, setting: Setting
) -> list[Float[np.ndarray, "samples 2"]]:
    """Noisy positions of each recording, by the recurrence's closed form."""
    out = []
    for _ in range(setting.num_recordings):
        position, velocity = random.normal(0.0, 0.1, 2), random.normal(0.0, 0.3, 2)
        k = np.arange(setting.num_samples)[:, None] * setting.steps_per_sample
        exact = position + k * TIMESTEP * velocity + TIMESTEP**2 * k * (k + 1) / 2 * (AXES @ gravity)
        out.append(exact + np.asarray(setting.noise) * random.standard_normal(exact.shape))
    return out


def write_study(folder: Path, gravity: Sequence[float], *, seed: int = 0, setting: Setting = SETTING) -> Path:
    """A study's folder with recordings simulated under `gravity` (x, z)."""
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    shutil.copyfile(MODEL, folder / "model.xml")
    priors = zip(("gravity_x", "gravity_z"), (0, 2), setting.prior_mean, setting.prior_sd, strict=True)
    tables = [
        f'[psi.{name}]\ntarget = "opt/gravity"\nindex = [{i}]\n'
        f"prior = {{ Normal = {{ loc = {mean}, scale = {sd} }} }}\n"
        for name, i, mean, sd in priors
    ]
    noise = "".join(f'"{column}" = {sd}\n' for column, sd in zip(COLUMNS, setting.noise, strict=True))
    atomic_write(folder / "study.toml", 'model = "model.xml"\n\n' + "\n".join(tables) + "\n[noise]\n" + noise)
    random = np.random.default_rng(seed)
    for r, positions in enumerate(simulate(np.asarray(gravity, float), random, setting)):
        times = np.arange(setting.num_samples) * setting.steps_per_sample * TIMESTEP
        lines = [f"{t:.6f},{a:.17g},{b:.17g}" for t, (a, b) in zip(times, positions, strict=True)]
        atomic_write(folder / "recordings" / f"slide_{r + 1}.csv", "\n".join(["time," + ",".join(COLUMNS), *lines, ""]))
    return folder


def record(folder: Path) -> Path:
    """A study of recordings under one gravity."""
    return write_study(folder, GRAVITY, seed=1)


def with_recordings(problem: Problem, recordings: Sequence[Float[np.ndarray, "samples 2"]]) -> Problem:
    """The same problem with other values in its samples (whole recordings as segments)."""
    segments = problem.segments
    replaced = tuple(replace(r, values=v) for r, v in zip(segments.recordings, recordings, strict=True))
    return problem.on(replace(segments, recordings=replaced, values=np.stack(list(recordings))))


def exact_posterior(
    problem: Problem,
    setting: Setting = SETTING,
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, "2 2"]]:
    """Mean and covariance of gravity: dense conditioning on all samples, initial states integrated out."""
    mean, precision = np.asarray(setting.prior_mean, float), np.diag(1.0 / np.asarray(setting.prior_sd) ** 2)
    shift = precision @ mean
    segments, guess = problem.segments, problem.guess
    for s in range(segments.count):
        k = np.rint((segments.time[s] - segments.time[s, 0]) / TIMESTEP)
        start, curve = np.stack([np.ones_like(k), k * TIMESTEP], 1), TIMESTEP**2 * k * (k + 1) / 2
        for axis in range(2):
            sd = guess.prior_sd[s, [axis, 2 + axis]]
            expected = start @ [guess.start.qpos[s, axis], guess.start.qvel[s, axis]]
            covariance = setting.noise[axis] ** 2 * np.eye(len(k)) + (start * sd**2) @ start.T
            design = curve[:, None] * AXES[axis]
            weighted = np.linalg.solve(covariance, design)
            precision = precision + design.T @ weighted
            shift = shift + weighted.T @ (segments.values[s, :, axis] - expected)
    covariance = np.linalg.inv(precision)
    return covariance @ shift, covariance


def closed_form(problem: Problem) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, "2 2"]]:
    """The same of the unknowns, which are gravity in units of its prior."""
    mean, covariance = exact_posterior(problem)
    sd = np.asarray(SETTING.prior_sd)
    return (mean - np.asarray(SETTING.prior_mean)) / sd, covariance / np.outer(sd, sd)
