# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 1. Bayes on a pendulum
#
# A pendulum hangs on a motor. We have a MuJoCo model of it, two short and noisy recordings of how it swung, and two
# numbers in the model that nobody knows well: the friction of its bearing (`damping`) and how strong its motor is
# (`gain`). **What do the recordings say about the two?**
#
# A fit would answer with the one pair of numbers whose simulation comes nearest. That leaves the question that
# matters for everything one does with the simulator afterwards: *which other pairs would have told the recordings
# just as well?* Bayes' theorem answers with a distribution,
#
# $$p(\psi \mid x) \;\propto\; p(x \mid \psi)\; p(\psi),$$
#
# the **posterior**: what is believed of the parameters $\psi$ after the recordings $x$ were seen. On its right stand
# the **likelihood**, how probable the recordings are under each $\psi$, and the **prior**, what was believed before.
#
# We first compute it by hand: two unknowns are few enough to try every pair on a grid. Then two samplers draw from
# the same posterior without a grid, NUTS and emcee, and we hold all three against each other. When two numbers become
# ten, the grid has $40^{10}$ points, and the samplers are what is left.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from scipy.optimize import least_squares

import det2stoc_bayes as d2s
from det2stoc_bayes.models.pendulum import SYSTEM, TRUTH

SEED = 1
folder = Path(tempfile.mkdtemp())
study = d2s.load(SYSTEM.write_study(folder / "pendulum", TRUTH, seed=SEED))
print((study.folder / "study.toml").read_text())

# %% [markdown]
# This is a *study*: a model, recordings, and `study.toml`, which says what is uncertain (`psi`), what was believed
# about it beforehand (`prior`), and how large the measurement noise is. The recordings are simulated under values
# that we know (`TRUTH`), so that we can look at the end whether the posterior holds them. With a real pendulum nobody
# could.

# %%
figure, axes = plt.subplots(2, 2, figsize=(9, 5), sharex=True)
for recording, column in zip(study.recordings, axes.T, strict=True):
    for name, values, axis in zip(recording.columns, recording.values.T, column, strict=True):
        axis.errorbar(recording.time, values, study.noise[name], fmt=".", ms=4, lw=0.7)
        axis.set(ylabel=name, xlabel="time [s]")
    column[0].set_title(recording.name)
figure.suptitle("Two recordings; bars are one standard deviation of the noise")
figure.tight_layout()
plt.show()

# %% [markdown]
# ## The simulator, and the prior
#
# `simulate` swings the model from a start under the recorded commands. Everything that follows asks only one thing of
# a simulator: a $\psi$ and a start go in, a trajectory comes out.

# %%
model = mujoco.MjModel.from_xml_path(str(study.model_path))
data = mujoco.MjData(model)
prior = {p.name: p.prior for p in study.parameters}
noise = np.array([study.noise[name] for name in study.recordings[0].columns])
STEPS = round(float(np.diff(study.recordings[0].time)[0]) / model.opt.timestep)  # simulation steps a sample


def simulate(damping, gain, start, commands):
    """Angle and speed at every sample, (samples, 2)."""
    model.dof_damping[0], model.actuator_gainprm[0, 0] = damping, gain
    mujoco.mj_resetData(model, data)
    data.qpos[0], data.qvel[0] = start
    states = []
    for command in commands:
        states.append((data.qpos[0], data.qvel[0]))
        data.ctrl[0] = command[0]
        mujoco.mj_step(model, data, STEPS)
    return np.array(states)


# %% [markdown]
# ## One unknown: prior, likelihood, posterior
#
# Suppose for a moment that the motor's gain were known. Then each value of `damping` has a simulation, each
# simulation leaves residuals, and Gaussian noise makes their density $\prod_i N(r_i; 0, \sigma_i)$. Times the prior,
# divided by the sum, that is the posterior: nothing more happens in Bayesian inference, ever; the rest is how to get
# by with fewer simulations.
#
# **What to see:** the posterior is narrower than the prior, and lies between the prior's and the likelihood's peaks.

# %%
damping = np.linspace(0.03, 0.13, 101)


def residuals(values, starts):
    """Recorded less simulated of all recordings, in noise sds; `starts` is one state a recording."""
    parts = [
        (r.values - simulate(*values, start, r.ctrl)) / noise for r, start in zip(study.recordings, starts, strict=True)
    ]
    return np.concatenate([p.ravel() for p in parts])


first_samples = [r.values[0] for r in study.recordings]
log_likelihood = np.array([-0.5 * (residuals((d, TRUTH["gain"]), first_samples) ** 2).sum() for d in damping])
log_prior = prior["damping"].log_prob(damping)


def normalized(log_density, step):
    """A density on a grid from its logarithm, up to a constant."""
    density = np.exp(log_density - log_density.max())
    return density / (density.sum() * step)


step = damping[1] - damping[0]
curves = {"prior": log_prior, "likelihood (scaled)": log_likelihood, "posterior": log_likelihood + log_prior}
figure, axis = plt.subplots(figsize=(7, 3.2))
for name, log_density in curves.items():
    axis.plot(damping, normalized(log_density, step), label=name)
axis.axvline(TRUTH["damping"], color="k", ls=":", label="truth")
axis.set(xlabel="damping [N m s/rad]", ylabel="density", title="One unknown, the gain known")
axis.legend()
plt.show()

# %% [markdown]
# ## Two unknowns, and a trap
#
# On a grid of pairs the recipe is the same. But look at what was slipped in above: each simulation *starts at the
# first sample*, and the first sample is as noisy as all others. A start that is wrong by a noise standard deviation
# is wrong for the whole swing, and the parameters will bend to make up for it.
#
# The honest way treats the start as what it is: unknown, too. It gets a wide prior, and is then *integrated out*,
# since nobody asked for it. For small changes of the start a trajectory is linear in them, $r \approx r_0 -
# J\,\delta$, and with a Gaussian prior $\delta \sim N(0, P)$ the integral has a closed form:
#
# $$r_0 \sim N(0,\; I + J P J^\top).$$
#
# So three simulations a recording and pair instead of one: the start, and one to the side in angle and in speed.

# %%
WIDE = np.array([1.0, 3.0])  # prior sds of a start about the fitted one [rad, rad/s]: much more than the noise
SIDE = np.array([0.01, 0.05])  # steps of the finite differences


def fitted_starts():
    """Where the recordings begin, by least squares over damping, gain and both starts."""
    guess = np.concatenate([[prior["damping"].mean, prior["gain"].mean], *first_samples])
    found = least_squares(lambda u: residuals(u[:2], u[2:].reshape(2, 2)), guess)
    return found.x[2:].reshape(2, 2)


def log_likelihood_of_recording(values, recording, start):
    """The start integrated out: log N(r; 0, I + J P J')."""
    base = simulate(*values, start, recording.ctrl)
    moved = [simulate(*values, start + delta, recording.ctrl) for delta in np.diag(SIDE)]
    r = ((recording.values - base) / noise).ravel()
    jacobian = np.stack([((m - base) / noise).ravel() / s for m, s in zip(moved, SIDE, strict=True)], 1) * WIDE
    inner = np.eye(2) + jacobian.T @ jacobian
    explained = jacobian.T @ r
    return -0.5 * (r @ r - explained @ np.linalg.solve(inner, explained)) - 0.5 * np.linalg.slogdet(inner)[1]


starts = fitted_starts()
dampings, gains = np.linspace(0.035, 0.125, 31), np.linspace(0.8, 1.05, 31)
log_prior_2 = prior["damping"].log_prob(dampings)[:, None] + prior["gain"].log_prob(gains)[None, :]
naive, honest = log_prior_2.copy(), log_prior_2.copy()
for i, d in enumerate(dampings):
    for j, g in enumerate(gains):
        naive[i, j] += -0.5 * (residuals((d, g), first_samples) ** 2).sum()
        honest[i, j] += sum(
            log_likelihood_of_recording((d, g), r, s) for r, s in zip(study.recordings, starts, strict=True)
        )
cell = (dampings[1] - dampings[0]) * (gains[1] - gains[0])
naive, honest = normalized(naive, cell), normalized(honest, cell)


# %% [markdown]
# **What to see:** both are hills of about the same size at different places. The naive one is *sure of something
# else*. Nothing about it looks wrong from the inside: it is the question that was wrong (known starts), not the
# computation.


# %%
def levels(density, masses=(0.95, 0.5)):
    """Heights above which these shares of the probability lie."""
    ordered = np.sort(density.ravel())[::-1]
    return [ordered[np.searchsorted(np.cumsum(ordered) * cell, m)] for m in masses]


def draw_hills(axis):
    axis.contour(dampings, gains, naive.T, levels(naive), colors="C1", linestyles="--")
    axis.contour(dampings, gains, honest.T, levels(honest), colors="C0")
    axis.plot(TRUTH["damping"], TRUTH["gain"], "k*", ms=11)
    axis.set(xlabel="damping [N m s/rad]", ylabel="gain")


figure, axis = plt.subplots(figsize=(6.5, 4.5))
draw_hills(axis)
axis.set_title("50 and 95 % of the posterior: starts known (dashed), integrated out (solid);\nstar: the truth")
plt.show()

# %% [markdown]
# ## The same without a grid
#
# `fit` poses just this problem (prior, likelihood, starts integrated out) and hands it to a method. **NUTS** follows
# the slope of the log posterior like a ball that rolls and is stopped before it turns back. **emcee** needs no
# slopes: a crowd of walkers, each of which proposes a step from where the others are. They have no line of code in
# common with the grid.

# %%
nuts = d2s.fit(study, "nuts", num_samples=400)
emcee = d2s.fit(study, "emcee", num_samples=1000)


def pairs(tree):
    """Draws of (damping, gain)."""
    return np.stack([tree.posterior[name].values.ravel() for name in ("damping", "gain")], 1)


figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharex=True, sharey=True)
for axis, (name, tree) in zip(axes, {"NUTS": nuts, "emcee": emcee}.items(), strict=True):
    axis.plot(*pairs(tree).T, "k.", ms=2, alpha=0.4)
    draw_hills(axis)
    axis.set_title(f"{name}: {len(pairs(tree))} draws, {tree.attrs['simulations']} simulations")
figure.tight_layout()
plt.show()

# %% [markdown]
# **What to see:** half of the points lie within the inner solid line, and one in twenty outside of the outer one.
# Draws *are* the posterior in a form that can be used: the mean of any function of $\psi$ is the mean over the draws,
# whatever the function. The table says in numbers how well the three agree.

# %%
grid_mean = np.array([(honest.sum(1) * cell * dampings).sum(), (honest.sum(0) * cell * gains).sum()])
grid_sd = np.sqrt(
    [
        (honest.sum(1) * cell * (dampings - grid_mean[0]) ** 2).sum(),
        (honest.sum(0) * cell * (gains - grid_mean[1]) ** 2).sum(),
    ]
)
print(f"{'':8}{'damping':>20}{'gain':>20}")
print("truth   " + "".join(f"{TRUTH[n]:20.4f}" for n in ("damping", "gain")))
print("grid    " + "".join(f"{m:12.4f} ±{s:6.4f}" for m, s in zip(grid_mean, grid_sd, strict=True)))
for name, tree in {"NUTS": nuts, "emcee": emcee}.items():
    draws = pairs(tree)
    print(f"{name:8}" + "".join(f"{m:12.4f} ±{s:6.4f}" for m, s in zip(draws.mean(0), draws.std(0), strict=True)))

# %% [markdown]
# ## Exercises
#
# 1. Make the noise half as large in `study.toml` as it is (fit the study again after `write_text`). What happens to
#    the posterior's width, and what tells you that something is wrong?
# 2. A 95 % region holds the truth 95 times in 100, *if all assumptions hold*. Write a loop over recordings of 10
#    other seeds, fit each by `laplace` (a Gaussian at the peak, cheap), and count how many 95 % regions hold `TRUTH`.
# 3. Which of the two recordings tells more about `gain`? Compute the honest grid for each alone.
#
# What to raise where more time is given: `num_samples` of `nuts` (400 here), and the grid's 31 values a side.
#
# ## Answers

# %%
# 1. Intervals shrink though nothing more is known; the misfit says so: it is four times what such noise would leave.
text = (study.folder / "study.toml").read_text()
quieter = folder / "quieter"
SYSTEM.write_study(quieter, TRUTH, seed=SEED)
(quieter / "study.toml").write_text(text.replace("= 0.05\n", "= 0.025\n").replace("= 0.4\n", "= 0.2\n"))
believed = d2s.fit(study, "laplace")
overconfident = d2s.fit(d2s.load(quieter), "laplace")
narrowing = pairs(overconfident).std(0) / pairs(believed).std(0)
print(f"widths shrink to {narrowing.round(2)} of what they were; misfit over noise, less chance:")
print(f"  as declared {believed.attrs['noise_inflation']:.2f}, declared too small", end=" ")
print(f"{overconfident.attrs['noise_inflation']:.2f}")

# %%
# 2. Distance of the truth from the middle in the posterior's own units; a Gaussian's 95 % region of two numbers ends
#    at chi-squared 5.99. Of ten, more than two misses would be a surprise (1.2 %).
inside = []
for seed in range(10, 20):
    tree = d2s.fit(d2s.load(SYSTEM.write_study(folder / f"seed_{seed}", TRUTH, seed=seed)), "laplace")
    draws = pairs(tree)
    off = np.array([TRUTH["damping"], TRUTH["gain"]]) - draws.mean(0)
    inside.append(off @ np.linalg.solve(np.cov(draws.T), off) < 5.99)
print(f"{sum(inside)} of {len(inside)} regions hold the truth")

# %%
# 3. The recording in which the motor works hardest against gravity: compare the widths.
alone = []
for recording, start in zip(study.recordings, starts, strict=True):
    log_density = (
        log_prior_2
        + np.array([[log_likelihood_of_recording((d, g), recording, start) for g in gains[::2]] for d in dampings[::2]])
        .repeat(2, 0)
        .repeat(2, 1)[:31, :31]
    )
    density = normalized(log_density, cell).sum(0) * cell
    mean = (density * gains).sum()
    alone.append(float(np.sqrt((density * (gains - mean) ** 2).sum())))
    print(f"{recording.name}: gain {mean:.3f} ± {alone[-1]:.3f}")
print(f"both: {grid_mean[1]:.3f} ± {grid_sd[1]:.3f}")

# %%
# What this notebook claims, checked.
for name, tree in {"NUTS": nuts, "emcee": emcee}.items():
    draws = pairs(tree)
    assert (np.abs(draws.mean(0) - grid_mean) < 0.3 * grid_sd).all(), name
    assert (np.abs(draws.std(0) / grid_sd - 1) < 0.25).all(), name
    off = np.array([TRUTH["damping"], TRUTH["gain"]]) - draws.mean(0)
    assert off @ np.linalg.solve(np.cov(draws.T), off) < 9.2, "the truth lies outside of the 99 % region"
assert (narrowing < 0.7).all() and overconfident.attrs["noise_inflation"] > 2
assert sum(inside) >= 7
assert grid_sd[1] < min(alone)
