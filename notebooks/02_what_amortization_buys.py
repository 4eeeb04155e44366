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
# # 2. What amortization buys, and what it costs
#
# NUTS asks the simulator anew for every posterior. An **amortized** method simulates first, lets networks learn from
# the simulations, and then answers for any recordings of the kind without simulating at all. Who has a thousand
# recordings to explain pays once. The bill comes in another currency: the answer is that of the networks.
#
# Two experiments. The first is small enough for an exact answer: a conditional variational autoencoder (CVAE) learns
# $p(s' \mid s, a)$ of a random Gaussian, where the truth is a formula. The second is the method that this package is
# named after, **det2stoc**: it turns a deterministic simulator into a stochastic one.

# %%
import tempfile
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import norm

import det2stoc_bayes as d2s
from det2stoc_bayes.inference import get_method
from det2stoc_bayes.models.pendulum import SYSTEM, TRUTH
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.reproduce import trivariate
from det2stoc_bayes.simulator import Simulator

# %% [markdown]
# ## A density that is known: the trivariate Gaussian
#
# $(s', s, a)$ is Gaussian with a random mean and covariance, so that $p(s' \mid s, a)$ is Gaussian with a mean that
# is linear in $(s, a)$. The CVAE knows nothing of that. Its *decoder* turns $(s, a)$ and a latent number $z \sim N(0,
# 1)$ into a Gaussian over $s'$, its *encoder* guesses which $z$ a transition came from; both are trained to make the
# recorded transitions probable (the evidence lower bound). The density that is learned is $\int p(s' \mid s, a, z)\,
# N(z; 0, 1)\, dz$.
#
# How far it is from the truth has a natural unit: $\mathrm{KL}(\text{exact} \,\|\, \text{learned})$, the nats that
# are lost on each transition by believing the networks.

# %%
settings = trivariate.Settings(num_gaussians=1, num_steps=500, num_samples=20_000)
trained = trivariate.train(3, settings)
random = np.random.default_rng(0)
conditions = trained.truth.sample(random, 20)[:, 1:]
lost = {step: trained.divergences(cvae, conditions) for step, cvae in trained.snapshots.items()}
for step, divergence in lost.items():
    print(f"after {step:4} steps: {divergence.mean():8.4f} nat in the mean, {divergence.max():8.4f} at worst")

# %%
shown = conditions[:3]
mean, variance = trained.truth.conditional(shown)
sd = np.sqrt(variance)
grid = np.linspace(mean - 4 * sd, mean + 4 * sd, 120, axis=1)
figure, axes = plt.subplots(1, 3, figsize=(12, 3))
for k, axis in enumerate(axes):
    for step, cvae in trained.snapshots.items():
        density = np.exp(trained.log_density(cvae, grid[k : k + 1], shown[k : k + 1]))[0]
        axis.plot(grid[k], density, label=f"{step} steps")
    axis.plot(grid[k], norm.pdf(grid[k], mean[k], sd), "k--", label="exact")
    axis.set(title=f"s = {shown[k, 0]:.1f}, a = {shown[k, 1]:.1f}", xlabel="s'")
axes[0].legend()
plt.show()

# %% [markdown]
# **What to see:** an untrained network is broad and in the wrong place; after a hundred steps it is nearly there,
# after five hundred the eye sees no difference, and only the nats above do. `det2stoc reproduce trivariate` does this
# for 20 Gaussians with ten times the data and eight times the steps.
#
# ## det2stoc: a simulator learns to be uncertain
#
# 1. Simulate transitions $(s, a) \to s'$ under many $\psi$ of the prior.
# 2. Train a **decoder** $p(s' \mid s, a, \psi)$ on them: $\psi$ sits where a CVAE has its latent.
# 3. Freeze it. Train an **encoder** on the *recorded* transitions alone. Whatever latent explains them is, by the
#    decoder's upbringing, a $\psi$.
# 4. Simulate again under the $\psi$ that were found, and repeat.
#
# What comes out is a posterior of $\psi$, and a stochastic simulator: sample a latent, step the decoder. Here one
# turn must do; step 4 is what `num_iterations` is for. `alarm` is the probability that $\psi$ lies beyond all that
# was simulated: an amortized posterior cannot look where it never was.

# %%
folder = Path(tempfile.mkdtemp())
study = d2s.load(SYSTEM.write_study(folder / "pendulum", TRUTH, seed=1))
learned = d2s.fit(study, "det2stoc", num_samples=400, num_iterations=1, num_simulated=2000, num_steps=1200)
exact = d2s.fit(study, "emcee", num_samples=1000)
turn = learned.turns.to_dataset().isel(turn=-1)
for k, name in enumerate(turn["psi"].values):
    print(f"{name:8} simulated {float(turn['simulated_mean'][k]):.3f} ± {float(turn['simulated_sd'][k]):.3f}", end=", ")
    print(f"found {float(turn['population_mean'][k]):.3f}")
print(f"alarm {float(turn['alarm']):.2f}, surprise of the recordings: p = {float(learned.surprise['p_value']):.2f}")

# %%
names = list(TRUTH)


def moments(tree):
    """Mean and sd of each psi."""
    draws = np.stack([tree.posterior[n].values.ravel() for n in names], 1)
    return draws.mean(0), draws.std(0)


figure, axes = plt.subplots(1, 2, figsize=(10, 3.2))
for axis, name in zip(axes, names, strict=True):
    prior = next(p.prior for p in study.parameters if p.name == name)
    x = prior.mean + prior.sd * np.linspace(-3, 3, 200)
    axis.plot(x, np.exp(prior.log_prob(x)), label="prior")
    for label, tree in {"det2stoc": learned, "emcee (exact)": exact}.items():
        axis.hist(tree.posterior[name].values.ravel(), 25, density=True, alpha=0.5, label=label)
    axis.axvline(TRUTH[name], color="k", ls=":", label="truth")
    axis.set_xlabel(name)
axes[0].legend()
plt.show()
(_, sd_learned), (_, sd_exact) = moments(learned), moments(exact)
wider = sd_learned / sd_exact
print("det2stoc's sds, in exact ones:", dict(zip(names, wider.round(2).tolist(), strict=True)))
print("simulations: det2stoc", learned.attrs["simulations"], " emcee", exact.attrs["simulations"])

# %% [markdown]
# **What to see:** both hold the truth; det2stoc's posterior is *wider*. That is a cost, and it has a reason that no
# training mends: det2stoc looks at transitions, one at a time, from a noisy state to the next noisy state. The exact
# likelihood looks at whole swings, along which a wrong friction adds up. What the noise hides in one step it cannot
# hide in forty.
#
# ## The stochastic simulator
#
# Each rollout holds one latent, as a real pendulum holds one friction. The spread of the rollouts is what is not
# known.

# %%
simulator = d2s.learned_simulator(learned)
recording = study.recordings[0]
num_steps = 20
start = np.tile(recording.values[:1], (100, 1))
actions = np.tile(recording.ctrl[None, :num_steps], (100, 1, 1))
rollouts = simulator.rollout(jax.random.key(0), start, actions)
figure, axis = plt.subplots(figsize=(7, 3.2))
axis.plot(recording.time[: num_steps + 1], rollouts[:40, :, 0].T, "C0", lw=0.5, alpha=0.5)
axis.plot(recording.time[: num_steps + 1], recording.values[: num_steps + 1, 0], "k.", label="recorded")
axis.set(xlabel="time [s]", ylabel="angle [rad]", title="Rollouts of the learned simulator")
axis.legend()
plt.show()
inside = np.mean(np.abs(recording.values[: num_steps + 1, 0] - rollouts[..., 0].mean(0)) < 3 * rollouts[..., 0].std(0))

# %% [markdown]
# ## The bill
#
# `train` learns once, `apply` answers for other recordings of the same kind. After training a posterior takes no
# simulation at all; the few hundred below are for the *importance weights*, with which the exact likelihood checks
# the answer (notebook 4 is about them). An exact method pays the same for each set of recordings.
#
# **What to see:** the curves part at once, since here one exact fit costs about as many simulations as the training.
# Where networks need a million simulations, as those of a robot with contact do, the curves cross far to the right,
# and left of the crossing amortization is a waste. You know the two numbers beforehand: the training's simulations,
# and those of one exact fit. (Time to train counts, too, and the networks' error does not shrink with the number of
# recordings.)

# %%
OTHER = {"damping": 0.05, "gain": 1.1}  # psi of other recordings
amortized = get_method("det2stoc")
problem = make_problem(Simulator(study))
before = problem.simulator.counter.simulations
kept = amortized.train(problem, 0, num_simulated=2000, num_steps=1200)
once = problem.simulator.counter.simulations - before
other = d2s.load(SYSTEM.write_study(folder / "other", OTHER, seed=1))  # the same starts and commands
answer = amortized.apply(kept, make_problem(Simulator(other)), 0, num_samples=200)
each, every = int(answer.attrs["simulations"]), int(exact.attrs["simulations"])
count = np.arange(1, 41)
figure, axis = plt.subplots(figsize=(7, 3.2))
axis.plot(count, count * every, label="emcee")
axis.plot(count, once + count * each, label="det2stoc, trained once (with weights)")
axis.plot(count, np.full(len(count), once), "--", label="det2stoc, trained once (without)")
axis.set(xlabel="sets of recordings", ylabel="simulations", yscale="log")
axis.legend()
plt.show()
print(f"once {once}, then {each} a set; emcee {every} a set")


def told(title, tree):
    """A posterior beside OTHER; how many of its own sds the truth is away."""
    mean, sd = moments(tree)
    away = np.abs(np.array([OTHER[n] for n in names]) - mean) / sd
    for name, m, s, a in zip(names, mean, sd, away, strict=True):
        print(f"{title}: {name} {m:.3f} ± {s:.3f}, truth {OTHER[name]}, {a:.1f} sds away")
    return away


away = told("other recordings", answer)

# %% [markdown]
# ## Exercises
#
# 1. How many nats a transition does the trivariate CVAE lose if it is trained for 100 steps only? What would a
#    Gaussian lose that has the right mean and twice the right sd?
# 2. Is det2stoc's posterior *calibrated*, though wide? Where does the truth lie in it, in its own sds?
# 3. "Other recordings of the same kind" was meant strictly: other values, the same starts and commands. Write a study
#    with other starts and commands (`seed=5`), and apply what was learned to it. What goes wrong, and what would tell
#    you?
#
# What to raise: `num_simulated` (10 000 by default), `num_steps` (4000), `num_iterations` (3).
#
# ## Answers

# %%
# 1. KL(N(0, 1) || N(0, 2)) = log 2 + 1/8 - 1/2.
twice = np.log(2) + 1 / 8 - 1 / 2
print(f"100 steps: {lost[100].mean():.4f} nat; twice the sd: {twice:.3f} nat")

# %%
# 2. One recording is one trial: `det2stoc calibrate STUDY --method det2stoc` makes hundreds, and tests them.
off = {name: (TRUTH[name] - m) / s for name, m, s in zip(names, *moments(learned), strict=True)}
print({name: round(float(v), 2) for name, v in off.items()})

# %%
# 3. The decoder is asked about states and commands that it never saw, and answers all the same, as sure as ever. What
#    tells are the importance weights: they ask the exact likelihood. Draws of which a few carry all the weight are
#    worth those few.
elsewhere = d2s.load(SYSTEM.write_study(folder / "elsewhere", OTHER, seed=5))
far = amortized.apply(kept, make_problem(Simulator(elsewhere)), 0, num_samples=200)
away_there = told("another plan", far)
worth = {}
for name, tree in {"the same plan": answer, "another plan": far}.items():
    log_weight = tree.sample_stats["log_weight"].values.ravel()
    weight = np.exp(log_weight - log_weight.max())
    worth[name] = float(weight.sum() ** 2 / (weight**2).sum())
print({name: f"{value:.1f} effective of {weight.size} draws" for name, value in worth.items()})

# %%
# What this notebook claims, checked.
assert lost[0].mean() > 20 * lost[500].mean() and lost[500].mean() < 0.05
assert (wider > 1).all()
assert all(abs(v) < 3 for v in off.values())
assert (learned.turns["alarm"].values < 0.5).all()
assert inside > 0.8
assert 0.3 < once / every < 3 and once + 20 * each < 20 * every
assert (away < 3.5).all()
assert worth["another plan"] < worth["the same plan"]
