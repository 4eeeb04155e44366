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
# # 3. Reading ArviZ diagnostics
#
# A sampler always returns numbers. Whether these are draws of the posterior is another question, and it cannot be
# answered by looking at a mean and a standard deviation: a chain that never left its first hill has a fine mean and a
# fine standard deviation. This notebook shows what good draws look like, then breaks sampling in four ways on
# purpose, so that you have *seen* each failure once before you meet it in your own fit:
#
# | what is broken | what gives it away |
# |---|---|
# | a chain that is stuck | R-hat, rank plots: chains disagree |
# | too few draws | effective sample size (ESS), Monte-Carlo standard error (MCSE) |
# | divergences | pairs plot: divergent draws crowd where the posterior has a neck |
# | bad mixing | trace and autocorrelation: draws creep |
#
# Everything in ArviZ 1.x is an xarray `DataTree`: groups `posterior`, `sample_stats` ..., with dimensions `chain` and
# `draw`. What `det2stoc fit` writes to `fit.nc` is one, too.

# %%
import tempfile
import warnings
from pathlib import Path

import arviz as az
import jax
import matplotlib.pyplot as plt
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS

import det2stoc_bayes as d2s
from det2stoc_bayes import models
from det2stoc_bayes.psis import bfmi

az.rcParams["plot.backend"] = "matplotlib"
warnings.filterwarnings("ignore", module="arviz")  # what it warns of is what we show
random = np.random.default_rng(3)


def table(tree):
    """R-hat, effective sample sizes and the mean's Monte-Carlo error of every variable, by plain numbers."""
    posterior = tree.posterior.to_dataset()
    rows = {}
    for name, draws in posterior.data_vars.items():
        one = draws.to_dataset()
        rows[name] = {
            "mean": float(draws.mean()),
            "sd": float(draws.std()),
            "r_hat": float(az.rhat(one)[name]),
            "ess_bulk": float(az.ess(one)[name]),
            "ess_tail": float(az.ess(one, method="tail")[name]),
            "mcse": float(az.mcse(one)[name]),
        }
    for name, row in rows.items():
        print(f"{name:12}" + "  ".join(f"{key} {value:9.4g}" for key, value in row.items()))
    return rows


# %% [markdown]
# ## What good draws look like
#
# Gravity's two components on a pair of slides, a study whose posterior is known in closed form.
#
# - **R-hat** compares the scatter *between* chains with the scatter *within* them; where all chains see the same
#   posterior it is 1. Ask for less than 1.01 (Vehtari et al. 2021).
# - **ESS** says how many independent draws would tell as much: in the bulk (means) and in the tails (intervals). Ask
#   for 400 in all (100 a chain with four chains) before R-hat itself can be believed.
# - **MCSE** is how far the mean may be off for want of draws: sd / sqrt(ESS). Print no digit that is smaller.

# %%
folder = Path(tempfile.mkdtemp())
study = d2s.load(models.record("linear_gaussian", folder / "linear_gaussian"))
good = d2s.fit(study, "nuts", num_samples=1200)
good_rows = table(good)

# %% [markdown]
# **What to see:** in a rank plot every chain's draws are ranked among all draws together. Where chains agree each
# curve stays within the band. On the left the marginals of the four chains lie on each other.

# %%
az.plot_rank_dist(good, var_names=["gravity_x", "gravity_z"])
plt.show()

# %% [markdown]
# ## Broken: a stuck chain
#
# A posterior with two hills, and a random walk whose steps are too short to cross the valley. Each chain explores its
# hill perfectly. **Each chain alone looks fine**; that is why one runs several.

# %%
NUM_DRAWS = 1000


def two_hills(x):
    """log density of half N(-3, 0.7) and half N(3, 0.7), up to a constant."""
    return np.logaddexp(-0.5 * ((x + 3) / 0.7) ** 2, -0.5 * ((x - 3) / 0.7) ** 2)


def random_walk(log_density, starts, step, num_draws=NUM_DRAWS):
    """Metropolis' algorithm: a proposal is taken with probability min(1, ratio of densities). (chain, draw)."""
    x = np.array(starts, float)
    height, draws = log_density(x), []
    for _ in range(num_draws):
        proposed = x + step * random.standard_normal(x.shape)
        there = log_density(proposed)
        taken = np.log(random.random(x.shape)) < there - height
        x, height = np.where(taken, proposed, x), np.where(taken, there, height)
        draws.append(x)
    return np.stack(draws, 1)


stuck = az.from_dict({"posterior": {"x": random_walk(two_hills, [-3, -3, -3, 3], 0.8)}})
stuck_rows = table(stuck)
az.plot_rank_dist(stuck)
plt.show()

# %% [markdown]
# **What to see:** the fourth chain's ranks are all at the upper end, its marginal stands alone, and R-hat is far
# above 1.01. The mean in the table is the mean of nothing. *Remedy:* no more draws help; find out why there are two
# hills (is the parameter identified?), start from many places, temper (`smc`), or put in what is known.
#
# ## Broken: too few draws
#
# The same random walk on one hill, but only 60 draws a chain, each much like the one before.

# %%
few = az.from_dict({"posterior": {"x": random_walk(lambda x: -0.5 * x**2, [0.5, -0.5, 1, -1], 1.0, num_draws=60)}})
few_rows = table(few)
enough = az.from_dict({"posterior": {"x": random_walk(lambda x: -0.5 * x**2, [0.5, -0.5, 1, -1], 2.4, num_draws=4000)}})
enough_rows = table(enough)
figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True)
for axis, (title, tree) in zip(axes, {"240 draws": few, "16000 draws": enough}.items(), strict=True):
    draws = tree.posterior["x"].values.ravel()
    running = np.cumsum(tree.posterior["x"].values.T.ravel()) / np.arange(1, draws.size + 1)
    axis.plot(running)
    axis.axhline(0, color="k", ls=":")
    axis.set(title=f"{title}: the running mean", xlabel="draws", xscale="log")
axes[0].set_ylim(-1, 1)
plt.show()

# %% [markdown]
# **What to see:** the truth is 0 ± 1. With few effective draws the running mean still wanders, and MCSE, not the
# posterior's sd, says by how much. R-hat may or may not complain; ESS does. *Remedy:* more draws, as MCSE falls with
# the root of their number.
#
# ## Broken: divergences
#
# NUTS rolls a ball over the log posterior. Where the surface bends more sharply than its step is long, the ball is
# thrown off and the draw is marked *divergent*. The classic place is a funnel: eight groups with a common spread,
# when the spread may be near 0.

# %%
SCORES = np.array([28.0, 8.0, -3.0, 7.0, -1.0, 1.0, 18.0, 12.0])  # Rubin (1981): eight schools
ERRORS = np.array([15.0, 10.0, 16.0, 11.0, 9.0, 11.0, 10.0, 18.0])


def centered():
    """Effects drawn directly from their population."""
    mean = numpyro.sample("mean", dist.Normal(0, 10))
    spread = numpyro.sample("spread", dist.HalfCauchy(5))
    effect = numpyro.sample("effect", dist.Normal(mean, spread).expand([8]))
    numpyro.sample("scores", dist.Normal(effect, ERRORS), obs=SCORES)


def apart():
    """The same population, effects as mean + spread * z: z knows nothing of the spread."""
    mean = numpyro.sample("mean", dist.Normal(0, 10))
    spread = numpyro.sample("spread", dist.HalfCauchy(5))
    z = numpyro.sample("z", dist.Normal(0, 1).expand([8]))
    effect = numpyro.deterministic("effect", mean + spread * z)
    numpyro.sample("scores", dist.Normal(effect, ERRORS), obs=SCORES)


def sampled(model, target):
    """Four chains by NUTS, as an ArviZ tree."""
    mcmc = MCMC(
        NUTS(model, target_accept_prob=target),
        num_warmup=500,
        num_samples=500,
        num_chains=4,
        chain_method="vectorized",
        progress_bar=False,
    )
    mcmc.run(jax.random.key(0), extra_fields=("energy",))
    return az.from_numpyro(mcmc)


funnel, mended = sampled(centered, 0.8), sampled(apart, 0.9)
num_divergent = {
    name: int(tree.sample_stats["diverging"].sum()) for name, tree in {"centred": funnel, "apart": mended}.items()
}
print(num_divergent)
spread_rows = [
    table(az.from_dict({"posterior": {"spread": tree.posterior["spread"].values}})) for tree in (funnel, mended)
]

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharex=True, sharey=True)
for axis, (title, tree) in zip(axes, {"centred": funnel, "apart": mended}.items(), strict=True):
    first, spread = tree.posterior["effect"].values[..., 0], np.log(tree.posterior["spread"].values)
    bad = tree.sample_stats["diverging"].values
    axis.plot(first[~bad], spread[~bad], "k.", ms=2, alpha=0.4)
    axis.plot(first[bad], spread[bad], "C3o", ms=4)
    axis.set(title=f"{title}: {bad.sum()} divergences", xlabel="first effect", ylabel="log spread")
plt.show()

# %% [markdown]
# **What to see:** on the left the funnel is cut off near its neck, and divergent draws (red) crowd there: the sampler
# could not go down. On the right the same posterior, in coordinates in which it is no funnel, reaches deeper.
# *Remedy:* first other coordinates, then a higher `target_accept`; never "drop the divergent draws". This package's
# unknowns are standard normals a priori for the same reason, a psi that varies between recordings included.
#
# Energy tells the same story (**BFMI**, Betancourt 2016): the share of the energy's variance that one step moves
# through. Ask for more than 0.3 in the worst chain. In the figure both curves should be about equally wide.

# %%
energy_share = {
    name: bfmi(tree.sample_stats["energy"].values) for name, tree in {"centred": funnel, "apart": mended}.items()
}
print({name: round(share, 2) for name, share in energy_share.items()})
az.plot_energy(funnel)
plt.show()

# %% [markdown]
# ## Broken: bad mixing
#
# Steps that are too short and steps that are too long have the same symptom: draw after draw is nearly the one
# before, in one case since it hardly moved, in the other since the proposal was refused. In between there is a step
# that works.

# %%
walks = {
    f"step {step:g}": az.from_dict({"posterior": {"x": random_walk(lambda x: -0.5 * x**2, [0, 0.5, -0.5, 1], step)}})
    for step in (0.05, 2.4, 60.0)
}
figure, axes = plt.subplots(3, 2, figsize=(10, 6))
mixing = {}
for row, (title, tree) in zip(axes, walks.items(), strict=True):
    x = tree.posterior["x"].values
    mixing[title] = float(az.ess(tree.posterior.to_dataset())["x"])
    row[0].plot(x[0], lw=0.6)
    row[0].set(title=f"{title}: {mixing[title]:.0f} effective of {x.size} draws", ylim=(-4, 4))
    centred = x[0] - x[0].mean()
    correlation = np.correlate(centred, centred, "full")[x.shape[1] - 1 :] / (centred @ centred)
    row[1].bar(np.arange(100), correlation[:100], width=1)
    row[1].set(title="autocorrelation", ylim=(-0.3, 1))
figure.tight_layout()
plt.show()

# %% [markdown]
# **What to see:** a good trace looks like noise without memory; its autocorrelation falls to 0 within a few draws.
# The upper trace is a slow wave, the lower one a staircase. *Remedy:* tune the step (NUTS does), rotate and scale the
# coordinates, or use a method with gradients.
#
# ## emcee: judge by autocorrelation time
#
# The walkers of an ensemble propose from each other's places. They are no independent chains, so R-hat between them
# means nothing, however fine it looks. What counts is how many **autocorrelation times** the run lasted: ask for 50.

# %%
ensemble = d2s.fit(study, "emcee")
stats = ensemble.sample_stats
num_times = float(stats["steps"]) / float(np.max(stats["autocorrelation_time"].values))
print(f"{int(stats['steps'])} steps = {num_times:.0f} autocorrelation times; converged: {bool(stats['converged'])}")

# %% [markdown]
# ## Exercises
#
# 1. Move the two hills to ±1.2. Does the random walk cross now? What is R-hat?
# 2. How many draws of the walk with step 2.4 give the mean to two digits (MCSE below 0.005)?
# 3. Run the centred model with `target_accept` 0.99. Do the divergences go? Does the smallest spread that it reaches?
#
# What to raise: 500 draws a chain (NumPyro's default is 1000), `num_samples` of `fit` (1000 by default).
#
# ## Answers

# %%
# 1. The hills touch: chains cross, and R-hat falls to about 1.
near = az.from_dict(
    {
        "posterior": {
            "x": random_walk(
                lambda x: np.logaddexp(-0.5 * ((x + 1.2) / 0.7) ** 2, -0.5 * ((x - 1.2) / 0.7) ** 2),
                [-1.2, -1.2, -1.2, 1.2],
                1.5,
                4000,
            )
        }
    }
)
near_rows = table(near)

# %%
# 2. MCSE = sd / sqrt(ESS), and ESS grows with the draws: scale up from the run above.
efficiency = enough_rows["x"]["ess_bulk"] / 16_000
print(f"one effective draw in {1 / efficiency:.1f}: {(1 / 0.005) ** 2 / efficiency:,.0f} draws")

# %%
# 3. Fewer divergences; but smaller steps in a funnel are a patch: compare how deep each goes.
careful = sampled(centered, 0.99)
num_divergent["centred, 0.99"] = int(careful.sample_stats["diverging"].sum())
print(num_divergent)
for name, tree in {"centred": funnel, "centred, 0.99": careful, "apart": mended}.items():
    print(f"{name:15} smallest spread {float(tree.posterior['spread'].min()):.3f}")

# %%
# What this notebook claims, checked.
assert all(row["r_hat"] < 1.015 and row["ess_bulk"] > 400 for row in good_rows.values())
assert stuck_rows["x"]["r_hat"] > 1.5
assert few_rows["x"]["ess_bulk"] < 100 < enough_rows["x"]["ess_bulk"]
assert abs(enough_rows["x"]["mean"]) < 4 * enough_rows["x"]["mcse"]
assert num_divergent["centred"] > 5 * max(num_divergent["apart"], 1)
assert spread_rows[0]["spread"]["ess_bulk"] < spread_rows[1]["spread"]["ess_bulk"]
assert energy_share["centred"] < energy_share["apart"]
assert mixing["step 0.05"] < 100 and mixing["step 60"] < 100 < mixing["step 2.4"]
assert num_times > 50 and bool(stats["converged"])
assert near_rows["x"]["r_hat"] < 1.05
