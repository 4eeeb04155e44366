"""The most likely unknowns of a hypothesis on followed recordings, by Gauss-Newton steps.

Some samples make or break a contact, where a derivative is a thousand times the others': finite differences are wide,
errors are Student-t, and a step is kept only if the likelihood itself, which needs no derivative, says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.contact.differences import columns_of
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.scales import Scales, scales_of, scatter
from det2stoc_bayes.problem import Problem

SHORTER, FURTHER, BACK = 0.3, 3.0, 0.1  # of a step that are tried where the whole one is not enough or too much
LITTLE, MUCH = 0.23, 0.75  # of what slopes promise: beyond them, on a parabola, SHORTER or FURTHER gains more
LARGEST_STEP = 2.0  # prior sds at once
ITERATIONS = 10
SETTLED = 0.1  # nats
FARTHEST = 5.0  # prior sds of psi from its median
HOPE = 0.25  # of the nats that are needed: a step that promises less is not tried
NEAR = 0.3  # prior sds within which sensitivities serve for a step


@dataclass(frozen=True, eq=False)
class ContactFit:
    """A hypothesis at its most likely unknowns."""

    followed: Followed
    z: Float[np.ndarray, " size"]
    errors: Float[np.ndarray, "blocks samples columns"]
    scales: Scales
    sizes: Float[np.ndarray, " size"] | None = None  # of finite differences, found at a fit nearby; NaN: not found yet
    known: Float[np.ndarray, "blocks samples columns first"] | None = None  # sensitivities to the first unknowns
    flat: Float[np.ndarray, "size size"] | None = None  # what sds become, as the likelihood's top is flatter than told
    rough: Float[np.ndarray, "size size"] | None = None  # covariance of where the top is
    untold: tuple[int, ...] = ()  # unknowns to which no sensitivities are found

    @property
    def problem(self) -> Problem:
        """The hypothesis."""
        return self.followed.problem

    @cached_property
    def differences(self) -> tuple[Float[np.ndarray, "blocks samples columns size"], Float[np.ndarray, " size"]]:
        """Sensitivities of the prediction to the unknowns, in noise sds, and over which steps they were found.

        By the believed integration: a finer one takes several times as long, and changes hardly what unknowns do.
        """
        if self.followed.problem.timestep is None:
            return columns_of(self.followed, self.z, self.errors, self.sizes, self.known, self.untold)
        plain = self.__dict__.get("as_believed")
        errors = None if plain is None else plain.errors
        return columns_of(self.followed.integrated(None, None), self.z, errors, self.sizes, self.known, self.untold)

    @property
    def steps(self) -> Float[np.ndarray, " size"]:
        """Those of finite differences; sensitivities are not found for them where they are known."""
        known = "differences" not in self.__dict__ and self.sizes is not None and np.isfinite(self.sizes).all()
        return self.sizes if known else self.differences[1]  # pyright: ignore[reportReturnType]

    @property
    def columns(self) -> Float[np.ndarray, "blocks samples columns size"]:
        """Sensitivities of the prediction to the unknowns, in noise sds."""
        return self.differences[0]

    @cached_property
    def losses(self) -> Float[np.ndarray, " blocks"]:
        """-log likelihood of each block."""
        return self.scales.losses(self.errors) + self.followed.volumes

    @property
    def loss(self) -> float:
        """-log posterior, up to a constant."""
        return float(self.losses.sum() + 0.5 * self.z @ self.z)

    @property
    def noise_inflation(self) -> float:
        """Mean square of the scales of columns that have a say: 1 at least, and outliers count little in it."""
        return float(np.mean(self.scales.values[np.isfinite(self.scales.values)] ** 2))

    def weighed(self, columns: Float[np.ndarray, "blocks samples columns k"]) -> Float[np.ndarray, "blocks values k"]:
        """Changes of the prediction in sds of the errors, as iteratively reweighted least squares has them."""
        blocks, samples, places, count = columns.shape
        return (self._roots[..., None] * columns).reshape(blocks, samples * places, count)

    @cached_property
    def _roots(self) -> Float[np.ndarray, "blocks samples columns"]:
        return np.sqrt(self.scales.weights(self.errors))

    @cached_property
    def told(self) -> Float[np.ndarray, "blocks values size"]:
        """Weighed sensitivities to the unknowns."""
        return self.weighed(self.columns)

    def beside(
        self, columns: Float[np.ndarray, "blocks values k"]
    ) -> tuple[Float[np.ndarray, "blocks values k"], Float[np.ndarray, "size k"]]:
        """Weighed changes as far as the unknowns do not make them, and what of these would."""
        share = np.linalg.solve(self.gram, np.einsum("wnk,wnl->kl", self.told, columns))
        return columns - self.told @ share, share

    @cached_property
    def left(self) -> Float[np.ndarray, "blocks values"]:
        """Weighed errors."""
        return self.weighed(np.nan_to_num(self.errors)[..., None])[..., 0]

    @cached_property
    def gram(self) -> Float[np.ndarray, "size size"]:
        """Curvature of the log posterior."""
        return np.einsum("wnk,wnl->kl", self.told, self.told) + np.eye(len(self.z))

    @cached_property
    def slopes(self) -> Float[np.ndarray, "blocks size"]:
        """Each block's pull on the unknowns."""
        return np.einsum("wnk,wn->wk", self.told, self.left)

    @cached_property
    def covariance(self) -> Float[np.ndarray, "size size"]:
        """Of the unknowns: the sandwich of curvature and scatter over blocks, the prior being one more observation."""
        inverse = np.linalg.inv(self.gram)
        spread = inverse @ (scatter(self.slopes, self.followed.recording) + np.eye(len(self.z))) @ inverse
        spread = spread if self.flat is None else self.flat @ spread @ self.flat.T
        return spread + (0.0 if self.rough is None else self.rough)

    @cached_property
    def as_believed(self) -> "ContactFit":
        """The same unknowns under the believed integration."""
        if self.followed.problem.timestep is None:
            return self
        return at(self.followed.integrated(None, None), self.z, self.scales)

    def prepare(self) -> None:
        """What several threads are to read is found before, and once."""
        _ = self.as_believed.errors, self.gram, self.left

    def hearing(self, heard: Bool[np.ndarray, " columns"]) -> "ContactFit":
        """The same by some columns alone."""
        errors = np.where(heard, self.errors, np.nan)
        return ContactFit(self.followed.hearing(heard), self.z, errors, scales_of(errors))

    def only(self, rows: np.ndarray) -> "ContactFit":
        """The same on some recordings, under the scales of all."""
        blocks = np.isin(np.repeat(np.arange(self.problem.segments.count), self.followed.blocks), rows)
        some = ContactFit(self.followed.only(rows), self.z, self.errors[blocks], self.scales)
        some.__dict__["differences"] = self.columns[blocks], self.differences[1]
        return some


def at(followed: Followed, z: Float[np.ndarray, " size"], scales: Scales | None = None) -> ContactFit:
    """The hypothesis at given unknowns, under scales that may be given."""
    z = np.asarray(z, float)
    errors = followed.errors(z[None])[0]
    return ContactFit(followed, z, errors, scales_of(errors) if scales is None else scales)


def sds(gram: Float[np.ndarray, "size size"]) -> Float[np.ndarray, "size size"]:
    """A root of a curvature's inverse, by which draws of unit variance are scattered as the unknowns are."""
    values, vectors = np.linalg.eigh(gram)
    return vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))


def losses_at(fit: ContactFit, z: Float[np.ndarray, "variants size"]) -> Float[np.ndarray, " variants"]:
    """The loss of a fit's hypothesis at other unknowns, each under its own scales."""
    told = [scales_of(e).losses(e).sum() for e in fit.followed.errors(z)]
    return np.array(told) + fit.followed.volumes.sum() + 0.5 * (z**2).sum(1)


def fit_followed(
    followed: Followed,
    z: Float[np.ndarray, " size"] | None = None,
    *,
    held: Sequence[int] = (),
    untold: Sequence[int] = (),
    iterations: int = ITERATIONS,
    others: Sequence[np.ndarray] = (),
    like: ContactFit | None = None,
    settled: float = SETTLED,
    needed: float = 0.0,
) -> ContactFit:
    """The most likely unknowns from `z`, or from the best of it and `others`; those `held` or `untold` stay.

    `like` is a fit nearby, perhaps without the last unknowns, whose sensitivities are not found anew. They are
    found for `iterations` steps, and serve for a second one as well where a step was short. A step that gains less
    than `settled` nats is the last. One that promises less is not tried, nor any where the top promises too small a
    part of the nats that are still `needed`.
    """
    z = np.zeros(followed.problem.size) if z is None else np.array(z, float)
    there = like is not None and like.followed is followed and not len(others) and np.array_equal(like.z, z)
    fit = _own(like) if like is not None and there else _best(followed, np.stack([z, *others]))
    fit = fit if like is None else _taught(fit, like)
    fit, held, again = replace(fit, untold=tuple(untold)), [*held, *untold], False
    goal = fit.loss - needed
    while iterations > 0:
        iterations = iterations if again else iterations - 1
        step, taught = newton(fit, held), fit.known is not None
        if 0.5 * _slope(fit, step) < max(settled, HOPE * (fit.loss - goal)):
            fit = replace(fit, sizes=fit.differences[1], known=None) if taught else fit
            break
        step *= min(1.0, LARGEST_STEP / max(np.abs(step).max(initial=0.0), 1e-12))
        found = _along(fit, step)
        gain, (columns, sizes) = fit.loss - found.loss, fit.differences
        short = np.abs(found.z - fit.z).max(initial=0.0) < NEAR
        serves = short and not taught and iterations > 0 and gain >= settled
        if gain > 0:
            fit = replace(found, sizes=sizes, known=columns if serves else None, untold=fit.untold)
        elif taught:
            fit = replace(fit, sizes=sizes, known=None)
        if gain < settled and not taught:
            break
        again = fit.known is not None
    return fit


def _taught(fit: ContactFit, like: ContactFit) -> ContactFit:
    """A fit with what is known of its sensitivities from another: over which steps, and close to it they themselves."""
    count, found = len(like.z), "differences" in like.__dict__
    steps = like.differences[1] if found or like.sizes is None else like.sizes
    sizes = np.concatenate([steps, np.full(len(fit.z) - count, np.nan)])
    same = fit.errors.shape == like.errors.shape and not like.untold and fit.followed.leads_as(like.followed)
    near = same and np.abs(fit.z[:count] - like.z).max(initial=0.0) < NEAR
    return replace(fit, sizes=sizes, known=like.columns if found and near else None)


def _along(fit: ContactFit, step: Float[np.ndarray, " size"]) -> ContactFit:
    """The likeliest of what lies along a step, which is often too short where sensitivities to both sides disagree."""

    def after(part: float) -> ContactFit:
        return fits_at(fit.followed, within(fit, fit.z + part * step)[None])[0]

    whole = after(1.0)
    gain, promised = fit.loss - whole.loss, _slope(fit, whole.z - fit.z)
    if LITTLE * promised < gain < MUCH * promised:
        return whole
    if gain >= MUCH * promised > 0:
        return min((whole, after(FURTHER)), key=lambda f: f.loss)
    best = min((whole, after(SHORTER)), key=lambda f: f.loss)
    return best if best.loss < fit.loss else min((best, after(BACK)), key=lambda f: f.loss)


def _slope(fit: ContactFit, step: Float[np.ndarray, " size"]) -> float:
    """Nats that a step gains to first order; twice what it does where it leads to a parabola's top."""
    return float((fit.slopes.sum(0) - fit.z) @ step)


def _own(fit: ContactFit) -> ContactFit:
    """The same under the scales of its own errors."""
    return ContactFit(fit.followed, fit.z, fit.errors, scales_of(fit.errors))


def _best(followed: Followed, z: Float[np.ndarray, "variants size"]) -> ContactFit:
    """The likeliest of these unknowns."""
    return min(fits_at(followed, z), key=lambda f: f.loss)


def fits_at(followed: Followed, z: Float[np.ndarray, "variants size"]) -> list[ContactFit]:
    """The hypothesis at each of these unknowns, simulated together."""
    return [ContactFit(followed, one, e, scales_of(e)) for one, e in zip(z, followed.errors(z), strict=True)]


def newton(fit: ContactFit, held: Sequence[int]) -> Float[np.ndarray, " size"]:
    """The Gauss-Newton step of all unknowns but those `held`."""
    free = np.setdiff1d(np.arange(len(fit.z)), np.asarray(held, int))
    step = np.zeros(len(fit.z))
    if len(free):
        pull = fit.slopes.sum(0) - fit.z
        step[free] = np.linalg.solve(fit.gram[np.ix_(free, free)], pull[free])
    return step


def within(fit: ContactFit, z: np.ndarray) -> np.ndarray:
    """Within the prior's digits, or the fit's place beyond them, and where an effect's parameters may be."""
    problem = fit.followed.problem
    psi = np.arange(problem.size) < problem.num_psi
    low, high = np.minimum(fit.z, -FARTHEST), np.maximum(fit.z, FARTHEST)
    return np.maximum(np.where(psi, np.clip(z, low, high), z), problem.floor)
