"""Where a region of other friction ends: a border has no derivative, but samples on either side of it can be counted.

A followed simulation forgets soon, so a sample is told by the friction where the body was. Simulations under several
frictions everywhere say what each gains at each sample; of all planes the one is likeliest on whose two sides the best
frictions gain most together.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.contact.evolution import evolved
from det2stoc_bayes.mismatch.contact.fit import ContactFit, at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import BLOCK, FARTHEST
from det2stoc_bayes.mismatch.effects.base import PlacedEffect
from det2stoc_bayes.mismatch.effects.contact import LEAST, FrictionError
from det2stoc_bayes.mismatch.effects.momentary_friction import FrictionPatch

RATIOS = (0.4, 0.55, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8, 2.4)  # of the friction
NUM_TURNS = 24  # directions of a normal on the ground
LEAST_SIDE = 0.03  # of the samples that are on a border's either side
LEAST_WAY, SAME = 0.2, 1e-9  # of where the body was: across a border; between samples of one place
MEMORY = 6.0  # samples: a longer one tells a sample by frictions farther back
NUM_ROUNDS, LEAST_GAIN = 3, 1.0  # in which a border and the rest settle; nats
TURN, SHIFT, GROWTH = 0.15, 0.08, 0.2  # in which a border is looked for: rad, of where the body was, log of ratio - 1
POPULATION, GENERATIONS = 10, 12
ALIKE = 3.0  # nats within which directions are as likely: the middle one of such neighbours is taken


@dataclass(frozen=True, eq=False)
class Border:
    """A plane, the ratio of friction on its normal's side to psi's on the other, and what two gain over one, nats."""

    gain: float
    normal: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]
    ratio: float

    @property
    def values(self) -> dict[str, Any]:
        """Of the effect's parameters."""
        return {"ratio": self.ratio, "point": self.point, "normal": self.normal}


def bordered(fit: ContactFit, *, anew: bool = True) -> ContactFit:
    """A hypothesis with the region of its last effect where it is likeliest beside the other unknowns.

    These are fitted on; a border moves by no derivative. Where it is not looked for `anew` it is moved once. As it is
    where the effect has no region.
    """
    placed = fit.problem.effects[-1] if fit.problem.effects else None
    if placed is None or not isinstance(placed.effect, FrictionPatch):
        return fit
    found = fit
    for k, find in enumerate((_from_afar, *NUM_ROUNDS * [_nearby]) if anew else [_nearby]):
        z = find(found, placed)
        other = found if z is None else fit_followed(fit.followed, z, held=border_unknowns(fit), like=fit)
        if k > 1 and other.loss > found.loss - LEAST_GAIN:
            break
        found = min((found, other), key=lambda f: f.loss)
    return found


def _from_afar(fit: ContactFit, placed: PlacedEffect) -> Float[np.ndarray, " size"] | None:
    """Unknowns with the likeliest border of all; None where there is none."""
    z, plain = fit.z[: -placed.size], fit.problem.with_effects(fit.problem.effects[:-1])
    followed = fit.followed.with_problem(plain).remembering(min(fit.followed.memory, MEMORY))
    border = likeliest_border(at(followed, z), placed)
    return None if border is None else np.concatenate([z, placed.effect.to_normal(border.values, placed.typical)])


def _nearby(fit: ContactFit, placed: PlacedEffect) -> Float[np.ndarray, " size"]:
    """Unknowns with the likeliest border about a fit's by CMA-ES: turned about where the body was, and shifted.

    The ratio goes along, for it is another where the border is.
    """
    values = {n: v[0] for n, v in fit.problem.effect_values(fit.z[None])[-1].items()}
    region, normal = np.array(placed.typical.region), values["normal"]
    middle = region.mean(0) + ((values["point"] - region.mean(0)) @ normal) * normal
    across = np.cross([0.0, 0.0, 1.0], normal)

    def unknowns(x: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " unknowns"]:
        turn, shift, growth = x
        turned = np.cos(TURN * turn) * normal + np.sin(TURN * turn) * across
        point = middle + SHIFT * shift * float(np.ptp(region @ turned)) * turned
        ratio = max(1 + (values["ratio"] - 1) * np.exp(GROWTH * growth), LEAST)
        border = {"ratio": ratio, "point": point, "normal": turned}
        return np.concatenate([fit.z[: -placed.size], placed.effect.to_normal(border, placed.typical)])

    plain = fit.as_believed  # hundreds of simulations of each recording, of which the best is fitted by finer steps
    return evolved(plain, unknowns, size=3, sigma=1.0, population=POPULATION, generations=GENERATIONS)


def border_unknowns(fit: ContactFit) -> list[int]:
    """Which unknowns say where regions end: all of such effects but the ratio."""
    problem = fit.followed.problem
    out, begin = [], problem.num_psi
    for placed in problem.effects:
        out += range(begin + 1, begin + placed.size) if isinstance(placed.effect, FrictionPatch) else ()
        begin += placed.size
    return out


def free_unknowns(fit: ContactFit) -> Int[np.ndarray, " free"]:
    """All unknowns but where regions end, of which the likelihood has no curvature."""
    return np.setdiff1d(np.arange(len(fit.z)), border_unknowns(fit))


def likeliest_border(fit: ContactFit, placed: PlacedEffect) -> Border | None:
    """The plane that tells samples best; None for an effect without a region, or where the body does not move."""
    if not isinstance(placed.effect, FrictionPatch) or not placed.typical.region:
        return None
    plain = fit.as_believed
    everywhere = PlacedEffect(FrictionError().form_on(placed.element), placed.element, placed.typical)
    with np.errstate(all="ignore"):
        errors = plain.followed.errors_with(plain.z, everywhere, [{"ratio": r} for r in RATIOS])
    told = np.stack([plain.scales.each(e).sum(2).ravel() for e in errors])
    sound = (np.nan_to_num(np.abs(errors)) < FARTHEST).all((0, 3)).ravel()  # a simulation that diverges tells nothing
    places = _places(plain, placed)
    there = np.isfinite(places).all(1) & np.isfinite(plain.errors).any(2).ravel() & sound
    told, places = told[:, there], places[there]
    flat = float(np.ptp(places[:, :2], axis=0).max(initial=0.0)) if len(places) else 0.0
    if not flat > 0:
        return None
    turns = np.arange(NUM_TURNS) * np.pi / NUM_TURNS
    found = [b for b in (_best_across(told, places, turn, flat) for turn in turns) if b is not None]
    if not found:
        return None
    best = int(np.argmax([b.gain for b in found]))
    alike = [b.gain > found[best].gain - ALIKE for b in found]
    first, last = best, best
    if all(alike):
        return found[best]
    while alike[first - 1]:
        first -= 1
    while alike[(last + 1) % len(found)]:
        last += 1
    return found[(first + last) // 2 % len(found)]


def _best_across(
    told: Float[np.ndarray, "ratios samples"], places: Float[np.ndarray, "samples 3"], turn: float, flat: float
) -> Border | None:
    """The best plane across a direction of the ground; None where the body hardly moves along it."""
    normal = np.array([np.cos(turn), np.sin(turn), 0.0])
    along = places @ normal
    if np.ptp(along) < LEAST_WAY * flat:
        return None
    order = np.argsort(along, kind="stable")
    gains = told[RATIOS.index(1.0), order] - told[:, order]
    before = np.cumsum(gains, axis=1)
    beyond = before[:, -1:] - before
    sums = (before.max(0) + beyond.max(0))[:-1] - before[:, -1].max()  # what friction gains that is another everywhere
    least = max(int(LEAST_SIDE * len(order)), 1)
    sums[: least - 1] = sums[len(sums) - least + 1 :] = -np.inf
    sums[np.diff(along[order]) <= SAME * np.ptp(along)] = -np.inf  # at one place nothing ends
    if not np.isfinite(sums).any():
        return None
    k = int(sums.argmax())
    border = 0.5 * (along[order[k]] + along[order[k + 1]])
    point = places.mean(0) + (border - places.mean(0) @ normal) * normal
    nearest = -1e-9 * np.abs(np.log(RATIOS))  # of frictions that gain the same
    here, there = (RATIOS[int((x[:, k] + nearest).argmax())] for x in (before, beyond))
    between = (here - 1) * (there - 1) < 0  # so psi was fitted to both sides, and is either's as well
    fewer = 2 * (k + 1) < len(order)  # samples on this side, which then is the region
    nearer = abs(np.log(here)) > abs(np.log(there))  # beyond: there psi stays, as friction is nearer to what it was
    if fewer if between else nearer:
        normal, here, there = -normal, there, here
    return Border(float(sums.max()), normal, point, there / here if between else there)


def _places(fit: ContactFit, placed: PlacedEffect) -> Float[np.ndarray, "samples 3"]:
    """Where the moving body was at each sample, in the order of blocks; NaN where there is none."""
    first = placed.element.qpos
    path = fit.followed.path(fit.z).qpos[:, 1:, first : first + 3]
    room = fit.followed.blocks * BLOCK - path.shape[1]
    return np.pad(path, ((0, 0), (0, room), (0, 0)), constant_values=np.nan).reshape(-1, 3)
