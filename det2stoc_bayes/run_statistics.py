"""What a method's DataTree says of its own run; None where it says nothing."""

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from det2stoc_bayes.posterior import DataTree


def divergences(tree: DataTree) -> int | None:
    """Draws at which a trajectory diverged."""
    if not _has(tree, "sample_stats", "diverging"):
        return None
    return int(tree["sample_stats"].to_dataset()["diverging"].values.sum())


def energies(tree: DataTree) -> Float[np.ndarray, "chain draw"] | None:
    """The Hamiltonian at each draw; None of samplers that have none."""
    if not _has(tree, "sample_stats", "energy"):
        return None
    return np.asarray(tree["sample_stats"].to_dataset()["energy"].transpose("chain", "draw").values, float)


def predictive_p(tree: DataTree) -> float | None:
    """Probability that data of the model would be off by more, mean over draws; None where no sum of squares is known.

    Posterior predictive p-value of the squared misfit with initial states integrated out (Gelman et al. 1996).
    """
    if "constant_data" not in tree.children:
        return None
    known = tree["constant_data"].to_dataset()
    lacking = known["log_peak"] - tree["log_likelihood"].to_dataset()["values"]
    return float(chi2.sf(2 * lacking.sum("recording").values, float(known["free_values"].sum())).mean())


def surprise_p(tree: DataTree) -> float | None:
    """p-value of the recordings among the simulations that an amortized method learned from."""
    return float(tree["surprise"].to_dataset()["p_value"]) if _has(tree, "surprise", "p_value") else None


def autocorrelation_times(tree: DataTree) -> float | None:
    """Autocorrelation times that an ensemble has run for."""
    if not _has(tree, "sample_stats", "autocorrelation_time"):
        return None
    stats = tree["sample_stats"].to_dataset()
    return float(stats["steps"]) / float(stats["autocorrelation_time"].max())


def _has(tree: DataTree, group: str, name: str) -> bool:
    return group in tree.children and name in tree[group].to_dataset()
