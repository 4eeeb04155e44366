"""A string that ties a body to a point in space."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.effects.attraction import DIRECTIONS, WIDE, PointEffect, way_to
from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, normal

NEAR = 1.5  # spreads of the body's own places, from the first anchors that are tried
SLACK = (-0.7, 0.0, 0.7)  # spreads by which the string is longer than the way to the body's middle place
LEAST = 0.05  # spreads: the shortest string that is tried
TINY = 1e-12  # m2


class Tether(PointEffect):
    """An elastic string: it pulls when it is longer than its length, and never pushes."""

    name, law_text, noun = "tether", "-k max(abs(r) - L, 0) r/abs(r)", "A tether"
    law = r"-k\,\max(|\mathbf r| - L, 0)\,\mathbf r/|\mathbf r|"
    parameters = (
        EffectParameter("stiffness", "N/m", positive=True),
        EffectParameter("length", "m"),
        EffectParameter("anchor", "m", size=3),
    )

    def priors(self, typical):
        """Over the body's own spread a fraction of the typical force; a string about as long as the way to the body."""
        way = typical.way
        return {"stiffness": normal(0.5 * typical.force / way), "length": normal(way), "anchor": normal(WIDE * way)}

    def from_normal(self, z, typical, xp=np):
        """The second is by how much, in spreads, the string is longer than the way, if it is not much."""
        out = super().from_normal(z, typical, xp)
        way = way_to(out["anchor"], typical, xp)
        return {**out, "length": way * xp.exp(out["length"] / way)}

    def to_normal(self, values, typical):
        """Inverse of `from_normal`."""
        way = way_to(np.asarray(values["anchor"], float), typical, np)
        return super().to_normal({**values, "length": way * np.log(np.asarray(values["length"], float) / way)}, typical)

    def trials(self, typical):
        """A few anchors around the body, each with strings that are taut for more or less of the way."""
        stiffness, way = 0.005 * typical.force / typical.way, typical.way
        ends = [(tuple(typical.place + NEAR * way * d), NEAR * way * float((d @ d) ** 0.5)) for d in DIRECTIONS]
        tried = [(anchor, far + slack * way) for anchor, far in ends for slack in SLACK]
        tried += [(tuple(typical.place), f * way) for f in (0.3, 0.8)]
        return [Trial(({"stiffness": stiffness, "length": length, "anchor": anchor},)) for anchor, length in tried]

    def about(self, trial, typical, reach):
        """Anchors about the trial's by strings as taut as its own, and strings of other lengths."""
        (values,) = trial.columns
        way = np.linalg.norm(np.asarray(values["anchor"]) - typical.place)
        out = []
        for moved in super().about(trial, typical, reach):
            farther = np.linalg.norm(np.asarray(moved.columns[0]["anchor"]) - typical.place) - way
            length = max(values["length"] + farther, LEAST * typical.way)
            out.append(replace(moved, columns=({**moved.columns[0], "length": length},)))
        lengths = (max(values["length"] + sign * reach * typical.way, LEAST * typical.way) for sign in (-1.0, 1.0))
        return [*out, *(replace(trial, columns=({**values, "length": length},)) for length in lengths)]

    def body_force(self, p, s, xp):
        """Towards the anchor, by the centre of mass's distance."""
        from_anchor = s.position - p["anchor"]
        distance = xp.sqrt(xp.sum(from_anchor**2, -1, keepdims=True) + TINY)
        longer = xp.maximum(distance - p["length"][..., None], 0.0)
        return -p["stiffness"][..., None] * longer * from_anchor / distance
