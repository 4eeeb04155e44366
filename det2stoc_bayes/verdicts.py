"""Whether a run's draws may be trusted, and why: the gates of exact methods, and the distance from a reference."""

from typing import TYPE_CHECKING, Literal

from det2stoc_bayes.errors import listing
from det2stoc_bayes.psis import reliable

if TYPE_CHECKING:
    from det2stoc_bayes.comparison import Reference, Row

MOST_R_HAT, LEAST_ESS, LEAST_TIMES = 1.01, 400, 50  # gates of an exact run: chains, draws, autocorrelation times
LEAST_BFMI = 0.3  # Betancourt 2016
NEAR = (0.6, 0.2, 0.2)  # C2ST, error of means in sds, relative error of sds: an approximation that may stand for it

Verdict = Literal["trust", "trust after refinement", "do not trust", "no posterior"]


def shortcomings(row: "Row") -> list[str]:
    """The gates that an exact run does not pass, each with what was found and what is allowed."""
    found = []
    if row.r_hat is not None and not row.r_hat < MOST_R_HAT:
        found.append(f"R-hat is {row.r_hat:.3g} (allowed: below {MOST_R_HAT})")
    if row.autocorrelation_times is not None and not row.autocorrelation_times > LEAST_TIMES:
        found.append(f"{row.autocorrelation_times:.3g} autocorrelation times (allowed: more than {LEAST_TIMES})")
    if row.ess is None or row.ess < LEAST_ESS:
        said = "no effective draws" if row.ess is None else f"{row.ess:.0f} effective draws"
        found.append(f"{said} (allowed: at least {LEAST_ESS})")
    if row.bfmi is not None and not row.bfmi > LEAST_BFMI:
        found.append(f"BFMI is {row.bfmi:.2g} (allowed: above {LEAST_BFMI})")
    if row.divergences:
        found.append(f"{row.divergences} divergences (allowed: none)")
    return found


def is_near(row: "Row") -> bool:
    """Whether a run's draws may stand for the reference's."""
    found = (row.c2st, row.mean_error, row.sd_error)
    return all(f is not None and f <= most for f, most in zip(found, NEAR, strict=True))


def verdict_of(row: "Row", reference: "Reference | None") -> tuple[Verdict, str]:
    """The verdict on a run that was held against the reference, and why."""
    if row.kind == "no posterior":
        return "no posterior", "what it seeks is another quantity than the posterior of psi"
    return _exact_verdict(row, reference) if row.kind == "exact" else _verdict(row, reference)


def _exact_verdict(row: "Row", reference: "Reference | None") -> tuple[Verdict, str]:
    failed = shortcomings(row)
    if failed:
        return "do not trust", "; ".join(failed)
    if reference is None:
        return "trust", "it passes all gates"
    if row.label == reference.label:
        against, agreeing = reference.contradicting, reference.agreeing
        if against:
            return "do not trust", f"it passes all gates, but {listing(against)} that also passes contradicts it"
        return "trust", "it passes all gates" + (f", and agrees with {listing(agreeing)}" if agreeing else "")
    if row.c2st is None:
        return "trust", f"it passes all gates; its unknowns are others than those of {reference.label}"
    said = f"{_distance(row)} from {reference.label}"
    return (
        ("trust", f"it passes all gates: {said}")
        if is_near(row)
        else ("do not trust", f"it passes all gates, but {said}")
    )


def _verdict(row: "Row", reference: "Reference | None") -> tuple[Verdict, str]:
    """Of an approximation, by the reference where there is one, else by its weights."""
    weighable = row.k_hat is not None and row.k_hat < reliable(max(row.num_weighed, 2))
    told = "" if row.k_hat is None else f"k-hat of its weights is {row.k_hat:.2g}"
    if (row.ess or 0.0) < LEAST_ESS:
        return "do not trust", f"{row.ess or 0.0:.0f} effective draws (allowed: at least {LEAST_ESS})"
    if reference is not None and row.c2st is not None and not reference.contradicting:
        said = f"{_distance(row)} from {reference.label}"
        if is_near(row):
            return "trust", said
        if weighable and not row.refined:
            return "trust after refinement", f"{said}, but {told}: importance weights can correct it"
        return "do not trust", said
    if weighable:
        return ("trust", told) if row.refined else ("trust after refinement", told)
    return "do not trust", told or "there is nothing exact to hold it against, and it has no weights"


def _distance(row: "Row") -> str:
    return (
        f"C2ST {row.c2st:.2f}, means within {row.mean_error:.2g} sd and sds within {100 * (row.sd_error or 0.0):.2g} %"
    )
