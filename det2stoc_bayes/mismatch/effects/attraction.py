"""A pull towards a point in space, as of a magnet or a mass."""

from dataclasses import replace
from itertools import product

import numpy as np

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.body import BodyEffect

WIDE = 2.0  # spreads of the body's own places, as far as points in space are looked for
DISTANCES = (0.4, 1.5, 4.0)  # spreads at which the first ones are: amid the ways of the body, and beyond them
DIRECTIONS = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if sum(map(abs, d)) in (1, 3)])
UNIT = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
CLOSEST = 0.5  # spreads, below which a point's distance is no scale of its own
TINY = 1e-12  # m2: a body in the point itself is not thrown away


class PointEffect(BodyEffect):
    """A force that depends on where a body is; the first parameter says how strong, the last is a point in space."""

    complexity = 4

    def from_normal(self, z, typical, xp=np):
        """Points about where the body is, in spreads of its places; what is strong has no end.

        A string that a body hangs on is ten times as stiff as typical forces make it, of a body that it holds.
        """
        *_, point = self.parameters
        first = len(self.parameters) - 1
        priors = self.priors(typical)
        told = [xp.sinh(z[0]), *(z[i] for i in range(1, first))]
        out = {p.name: priors[p.name].from_normal(told[i], xp) for i, p in enumerate(self.parameters[:-1])}
        parts = [typical.place[i] + WIDE * typical.way * z[first + i] for i in range(3)]
        return {**out, point.name: xp.stack(parts, -1)}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        *others, point = self.parameters
        priors = self.priors(typical)
        z = [float(priors[p.name].to_normal(np.asarray(values[p.name], float))) for p in others]
        z[0] = float(np.arcsinh(z[0]))
        return np.array([*z, *(np.asarray(values[point.name]) - typical.place) / (WIDE * typical.way)])

    def about(self, trial, typical, reach):
        """Points about the trial's, by their distance from the body."""
        point = self.parameters[-1].name
        centre = np.asarray(trial.columns[0][point])
        far = max(float(np.linalg.norm(centre - typical.place)), CLOSEST * typical.way)
        return [replace(trial, columns=({**trial.columns[0], point: tuple(centre + reach * far * d)},)) for d in UNIT]

    def combine(self, trial, coefficients, typical):
        """The trial's own point, its first parameter scaled."""
        first = self.parameters[0].name
        return {**trial.columns[0], first: trial.columns[0][first] * float(coefficients[0])}


class Attraction(PointEffect):
    """Towards a centre, falling with the square of the distance."""

    name, law_text, noun = "attraction", "-S r/abs(r)^3", "An attraction"
    law = r"-S\,\mathbf r/|\mathbf r|^3"
    parameters = (EffectParameter("strength", "N m2", positive=True), EffectParameter("centre", "m", size=3))

    def priors(self, typical):
        """A fraction of the typical force, at a distance of the body's own spread."""
        return {"strength": normal(0.3 * typical.force * typical.way**2), "centre": normal(WIDE * typical.way)}

    def from_normal(self, z, typical, xp=np):
        """The first is the pull where the body is: a centre twice as far has four times the strength."""
        out = super().from_normal(z, typical, xp)
        return {**out, "strength": out["strength"] * (way_to(out["centre"], typical, xp) / typical.way) ** 2}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        farther = way_to(np.asarray(values["centre"], float), typical, np) / typical.way
        return super().to_normal({**values, "strength": np.asarray(values["strength"], float) / farther**2}, typical)

    def trials(self, typical):
        """A few centres around the body."""
        strength = 0.003 * typical.force * typical.way**2
        return [
            Trial(({"strength": strength, "centre": tuple(typical.place + d * typical.way * direction)},))
            for d in DISTANCES
            for direction in DIRECTIONS
        ]

    def body_force(self, p, s, xp):
        """By the distance of the centre of mass."""
        from_centre = s.position - p["centre"]
        square = xp.sum(from_centre**2, -1, keepdims=True) + TINY
        return -p["strength"][..., None] * from_centre / square**1.5


def way_to(point, typical, xp):
    """From the body's middle place to a point, and never less than the body's own spread."""
    return xp.sqrt(xp.sum((point - xp.asarray(typical.place)) ** 2, -1) + typical.way**2)
