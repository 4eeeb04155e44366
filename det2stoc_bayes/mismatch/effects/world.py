"""Effects on everything: gravity and wind."""

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, normal

STANDARD = 9.80665  # m/s2, the Earth's gravity
LEVEL = 1e-12  # squared share of gravity that stays downward at least, where a search leans too far


class GravityTilt(Effect):
    """Gravity leans towards + of an axis: the ground is not level."""

    name, kind, law_text, noun = "gravity_tilt", "world", "g leans by toward_x, toward_y", "A tilt"
    law = r"\hat{\mathbf g} \cdot (\hat{\mathbf x}, \hat{\mathbf y}) = (\sin\alpha, \sin\beta)"
    parameters = (EffectParameter("toward_x", "rad"), EffectParameter("toward_y", "rad"))
    changes = ("opt.gravity",)
    complexity = 2

    def priors(self, typical):
        """A few degrees."""
        return {"toward_x": normal(0.05), "toward_y": normal(0.05)}

    def trials(self, typical):
        """One column an angle."""
        return [Trial(({"toward_x": 5e-4, "toward_y": 0.0}, {"toward_x": 0.0, "toward_y": 5e-4}))]

    def combine(self, trial, coefficients, typical):
        """The two angles add up, small as they are."""
        return {"toward_x": 5e-4 * float(coefficients[0]), "toward_y": 5e-4 * float(coefficients[1])}

    def fields(self, p, fields, at, xp):
        """Gravity under the least rotation that takes -z to (sin x, sin y, -down), by Rodrigues' formula."""
        g, a, b = fields["opt.gravity"], xp.sin(p["toward_x"]), xp.sin(p["toward_y"])
        down = xp.sqrt(xp.maximum(1 - a * a - b * b, LEVEL))
        x, y, z = g[..., 0], g[..., 1], g[..., 2]
        along = (b * x - a * y) / (1 + down)
        turned = down * x - a * z + b * along, down * y - b * z - a * along, down * z + a * x + b * y
        return {"opt.gravity": xp.stack(turned, -1)}


class GravityError(Effect):
    """Gravity is not as strong as believed."""

    name, kind, law_text, noun = "gravity_error", "world", "g_z + change", "A change of gravity"
    law = r"g_z + \Delta"
    parameters = (EffectParameter("change", "m/s2"),)
    changes = ("opt.gravity",)

    def priors(self, typical):
        """A quarter of what is believed, of the Earth's where that is less: it may have been left out altogether."""
        return {"change": normal(0.25 * max(typical.force, STANDARD))}

    def fields(self, p, fields, at, xp):
        """Added to gravity's z."""
        zero = 0.0 * p["change"]
        return {"opt.gravity": fields["opt.gravity"] + xp.stack([zero, zero, p["change"]], -1)}


class SteadyWind(Effect):
    """The air moves."""

    name, kind, law_text, noun = "steady_wind", "world", "wind + velocity", "A steady wind"
    law, needs = r"\mathbf w + \mathbf v", frozenset({"fluid"})
    parameters = (EffectParameter("velocity", "m/s", size=3),)
    changes = ("opt.wind",)

    def priors(self, typical):
        """As fast as the wind or the bodies are."""
        return {"velocity": normal(typical.speed)}

    def fields(self, p, fields, at, xp):
        """Added to the wind."""
        return {"opt.wind": fields["opt.wind"] + p["velocity"]}
