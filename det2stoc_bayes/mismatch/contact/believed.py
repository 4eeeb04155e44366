"""The believed model's fit: psi wherever the prior has it, and how its simulations are led and integrated.

A short memory forgives a wrong psi: such a fit drew its own contact with it. So psi is looked for at a middle memory,
by no derivative, before anything is chosen there. And a lone simulation, which the noise that leads it makes rattle,
favours a psi that rattles less: a wrong friction hid an effect so. So the mean of some foretells, but in that search.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.contact.evolution import evolved
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, fit_followed, within
from det2stoc_bayes.mismatch.contact.flow import Ground
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.pair import MEMORIES, SKETCH, Pair, climbed, paired, remembering_each
from det2stoc_bayes.mismatch.contact.scales import certainty
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.mismatch.contact.telling import telling

MIDDLE = 12.0  # samples: long enough for a wrong psi to show, short enough for a missing effect not to hide a right one
POPULATION, GENERATIONS = 12, 8  # of the search
REGARDS = ((False, 1.0), (True, 1.0), (True, 0.1))  # whether contact holds bodies, and the share of its jolts
MEMBERS = 2  # simulations whose mean foretells
FINER = (2, 4)  # times: contact lasts for a few steps, so that shorter ones tell more than a higher order does
FINER_CERTAIN = 1.5  # standard errors by which they must tell recordings better: each is twice as dear


def believed(followed: Followed, held: Followed) -> Pair:
    """The believed model fitted, under shorter steps than its own where these tell recordings better.

    Its memory and what it regards of contact are those by which it foretells recordings best, of the columns that it
    tells at all.
    """
    middle = followed.remembering(MIDDLE)
    z = searched(middle)
    starts = (z, np.zeros_like(z))  # beside what is missing a search may end at the prior's edge
    middle = middle.averaged(MEMBERS)
    best = min(side_by_side(middle.problem, partial(from_start, middle), starts), key=lambda f: f.loss)
    fits = grounded(climbed(best))
    heard = telling(min(fits, key=lambda f: f.loss))
    # What rattles has led psi astray: each is fitted to what is heard before one is chosen, and hears what it tells.
    told = side_by_side(best.problem, lambda f: fit_followed(f.followed.hearing(heard), f.z, like=f), fits)
    best, whole = min(zip(told, fits, strict=True), key=lambda pair: pair[0].loss)
    both = heard & telling(at(whole.followed, best.z))
    if both.any() and (both != heard).any():
        best = fit_followed(best.followed.hearing(both), best.z, like=best)
    return paired(climbed(finer(best)), held)


def finer(fit: ContactFit) -> ContactFit:
    """Under shorter steps where these tell recordings better, and led by what contact does there."""
    best, step = fit, float(fit.problem.simulator.model.opt.timestep)
    now = fit.problem.timestep or step
    for times in (n for n in FINER if step / n < now):
        fine = fit_followed(best.followed.integrated(step / times, None), best.z, iterations=SKETCH, like=best)
        if certainty(best.losses - fine.losses, fit.followed.recording) < FINER_CERTAIN:
            break
        best = fine
    ground = best.followed.ground
    if best is fit or ground is None:
        return best
    led = best.followed.grounded(Ground(best.problem, best.z, ground.holds, ground.share))
    return min(best, fit_followed(led, best.z, iterations=SKETCH, like=best), key=lambda f: f.loss)


def searched(followed: Followed) -> Float[np.ndarray, " size"]:
    """The likeliest psi that evolution finds in the prior; what recordings have of their own is their population's."""
    start = at(followed, np.zeros(followed.problem.size))
    shared = np.setdiff1d(np.arange(len(start.z)), followed.problem.unknowns.owned)
    if not len(shared):
        return start.z

    def unknowns(x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " unknowns"]:
        z = start.z.copy()
        z[shared] = x
        return within(start, z)

    return evolved(start, unknowns, size=len(shared), sigma=1.0, population=POPULATION, generations=GENERATIONS)


def from_start(followed: Followed, z: Float[np.ndarray, " size"]) -> ContactFit:
    """A few steps from there, and as many with the memory that serves it best."""
    return best_remembered(fit_followed(followed, z, iterations=SKETCH))


def best_remembered(fit: ContactFit) -> ContactFit:
    """The same unknowns with the memory by which they foretell recordings best, and a few steps from there."""
    best = min(remembering_each(fit, MEMORIES), key=lambda f: f.loss)
    return fit_followed(best.followed, fit.z, iterations=SKETCH, like=fit)


def grounded(fit: ContactFit) -> list[ContactFit]:
    """The same hypothesis, led without regard to contact or with one, fitted.

    One is the likeliest as it is, one the likeliest by what that tells at all; without regard it is fitted already.

    What slides is held by its floor and jolted little, though noise that is drawn anew throws simulations of it out of
    the floor; where something is missing, what holds a simulation may not hold the body.
    """
    ground = Ground(fit.problem, fit.z)
    led = [fit.followed.grounded(ground.regarding(*way)) for way in REGARDS]
    begun = [fit, *side_by_side(fit.problem, partial(at, z=fit.z), led)]
    likeliest = min(begun, key=lambda f: f.loss)
    heard = telling(likeliest)
    clearest = min(begun, key=lambda f: f.hearing(heard).loss)
    best = [f for f in begun if f in (fit, likeliest, clearest)]

    def fitted(one: ContactFit) -> ContactFit:
        like = replace(one, sizes=fit.steps)
        return one if one is fit else fit_followed(one.followed, one.z, iterations=SKETCH, like=like)

    return side_by_side(fit.problem, fitted, best)
