"""What speaks against a fit, each as a sentence: the model's misfit, a prior that excludes psi, heavy weights."""

import numpy as np

from det2stoc_bayes.identifiability import Check
from det2stoc_bayes.mismatch.evidence import MODEL_ERROR
from det2stoc_bayes.posterior import DataTree
from det2stoc_bayes.psis import reliable, smooth

LEAST_WEIGHED = 100  # draws: the tail of fewer weights says nothing
SURPRISING = 0.01  # p-value of recordings among simulations
ALARM = 0.5  # probability that psi lies beyond what was simulated


def doubts(tree: DataTree) -> list[str]:
    """All that there are."""
    return [doubt for doubt in (misfit(tree), surprising(tree), beyond_prior(tree), unreliable(tree)) if doubt]


def misfit(tree: DataTree) -> str:
    """That the model cannot follow the recordings, in a sentence; empty where it can, or noise was not declared."""
    inflation = tree.attrs.get("noise_inflation", 0.0)
    if not inflation >= MODEL_ERROR:
        return ""
    return (
        f"the model's squared misfit of the recordings is {inflation:.3g} times what their noise explains: intervals "
        "hold only if the model is right, and this speaks against it; `det2stoc diagnose` looks for what it leaves out"
    )


def quick_misfit(checked: Check) -> str:
    """The same of a check, whose fit is a quick one: its widths of psi hold under the model only."""
    given = all(column.given for column in checked.columns)
    if not (given and checked.parameters and checked.noise_inflation >= MODEL_ERROR):
        return ""
    return (
        "`identifiable` says how narrow psi would be if the model were right; after a quick fit the squared misfit is "
        f"{checked.noise_inflation:.3g} x the noise's, which speaks against it: see `det2stoc diagnose`."
    )


def surprising(tree: DataTree) -> str:
    """That recordings are unlike all that an amortized method learned from, in a sentence; empty where they are not."""
    if "surprise" not in tree.children:
        return ""
    told = tree["surprise"].to_dataset()
    if not (p := float(told["p_value"])) <= SURPRISING:
        return ""
    here, usual = float(told["recorded"]), told["simulated"].values
    return (
        f"the recordings are unlike the simulations that were learned from (p = {p:.2g}): their surprise is {here:.3g} "
        f"nat a transition, that of simulations {usual.mean():.3g} +- {usual.std(ddof=1):.2g}; whatever psi is found "
        "is that of a model that does not move so"
    )


def beyond_prior(tree: DataTree) -> str:
    """That psi's truth lies beyond what an amortized method simulated, in a sentence; empty where it does not."""
    if "turns" not in tree.children:
        return ""
    first, *_, last = (float(p) for p in tree["turns"].to_dataset()["alarm"].values[[0, -1]])
    if min(first, last) > ALARM:
        return (
            f"with probability {first:.2g} psi lies beyond all that was simulated under its prior: the prior excludes "
            "it, or the model cannot move as the recordings do"
        )
    if last > ALARM:
        return (
            f"with probability {last:.2g} psi lies beyond all that the last decoder learned from: the turns have not "
            "come to rest; more of them (num_iterations), or more simulations, may"
        )
    return ""


def unreliable(tree: DataTree) -> str:
    """That draws are not those of the exact posterior, by their importance weights; empty where they are, or have none.

    k-hat: Vehtari et al., Pareto smoothed importance sampling (2024).
    """
    found = weights(tree)
    if found is None or found[1] < LEAST_WEIGHED or found[0] < (most := reliable(found[1])):
        return ""
    refined = "k_hat" in tree.attrs
    return (
        f"importance weights of the draws by the exact likelihood have a k-hat of {found[0]:.2g} (reliable below "
        f"{most:.2g}): the draws may not be those of the exact posterior; "
        f"{'' if refined else '--refine psis may correct them, '}nuts, smc or emcee sample it"
    )


def weights(tree: DataTree) -> tuple[float, int] | None:
    """k-hat of a fit's importance weights and how many there were; None of a method that has none."""
    if "k_hat" in tree.attrs:
        return float(tree.attrs["k_hat"]), int(tree.attrs["num_weighed"])
    if "sample_stats" not in tree.children or "log_weight" not in tree["sample_stats"]:
        return None
    found = np.asarray(tree["sample_stats"].to_dataset()["log_weight"].values, float).ravel()
    return smooth(found)[1], len(found)
