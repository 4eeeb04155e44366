"""Where a finer integration would have the top of a likelihood: an impact that comes late is made up for by psi."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, newton
from det2stoc_bayes.mismatch.contact.regions import border_unknowns
from det2stoc_bayes.mismatch.contact.top import widened

FARTHEST = 3.0  # sds that it may lead
WORSE = 10.0  # nats: by so much the other top may be away


def no_surer_than_steps(fit: ContactFit) -> ContactFit:
    """The hypothesis, its covariance widened by how far integration of fourth order would lead it in one step.

    As it is where that tells recordings far worse, as where joints are so stiff that it diverges.
    """
    followed = fit.followed
    other = at(followed.integrated(followed.problem.timestep, "rk4"), fit.z)
    if not other.loss < fit.loss + WORSE:
        return fit
    other = replace(other, scales=fit.scales)
    other.__dict__["differences"] = fit.differences
    held = border_unknowns(fit)
    shift = newton(other, held) - newton(fit, held)
    shift = shift if fit.flat is None else fit.flat @ shift
    shift *= min(1.0, FARTHEST / max(float(np.sqrt(shift @ np.linalg.solve(fit.covariance, shift))), 1e-12))
    return widened(fit, fit.z + shift)
