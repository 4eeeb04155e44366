"""Forces on bodies as they move through air."""

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, normal
from det2stoc_bayes.mismatch.effects.vectors import cross

AIR = 1.2  # kg/m3
CAPSULE, ELLIPSOID, CYLINDER, BOX = 3, 4, 5, 6  # mjtGeom; a sphere is 2
ELLIPSOID_POWER = 1.6075  # Knud Thomsen's approximation of an ellipsoid's surface


class BodyEffect(Effect):
    """An effect on a moving body."""

    kind = "body"


class LinearDrag(BodyEffect):
    """Drag on a body's centre of mass, proportional to its speed."""

    name, law, law_text, noun = "linear_drag", r"-c\,\mathbf v", "-c v", "Linear drag"
    parameters = (EffectParameter("coefficient", "N s/m", positive=True),)
    complexity = 2

    def priors(self, typical):
        """At the body's typical speed a fraction of the typical force."""
        return {"coefficient": normal(0.3 * typical.force / typical.speed)}

    def body_force(self, p, s, xp):
        """Against the velocity."""
        return -p["coefficient"][..., None] * s.velocity


class QuadraticDrag(BodyEffect):
    """Drag on a body's centre of mass, growing with the square of its speed."""

    name, law, law_text = "quadratic_drag", r"-c\,|\mathbf v|\,\mathbf v", "-c abs(v) v"
    noun = "Quadratic drag"
    parameters = (EffectParameter("coefficient", "kg/m", positive=True),)
    complexity = 2

    def forms(self):
        """By its coefficient, or by its drag coefficient where the body's size varies between recordings."""
        return self, SizedDrag()

    def priors(self, typical):
        """At the body's typical speed a fraction of the typical force."""
        return {"coefficient": normal(0.3 * typical.force / typical.speed**2)}

    def body_force(self, p, s, xp):
        """Against the velocity through still air."""
        speed = xp.sqrt(xp.sum(s.velocity**2, -1, keepdims=True) + 1e-30)
        return -p["coefficient"][..., None] * speed * s.velocity


class SizedDrag(QuadraticDrag):
    """Quadratic drag by a drag coefficient and the geoms' frontal area, in air of 1.2 kg/m3."""

    law, law_text = r"-\tfrac12\rho A C_d\,|\mathbf v|\,\mathbf v", "-1/2 rho A Cd abs(v) v"
    parameters = (EffectParameter("drag_coefficient", "1", positive=True),)
    needs = frozenset({"sized"})

    def priors(self, typical):
        """Bluff bodies have about 0.5 to 1."""
        return {"drag_coefficient": normal(0.7)}

    def body_force(self, p, s, xp):
        """Against the velocity through still air; the area follows the simulated size."""
        speed = xp.sqrt(xp.sum(s.velocity**2, -1, keepdims=True) + 1e-30)
        factor = 0.5 * AIR * frontal_area(s.shapes, s.sizes, xp) * p["drag_coefficient"]
        return -factor[..., None] * speed * s.velocity


class MagnusLift(BodyEffect):
    """Lift on a body that spins as it flies."""

    name, law_text, noun = "magnus_lift", "S omega x v", "Magnus lift"
    law = r"S\,\boldsymbol\omega\times\mathbf v"
    parameters = (EffectParameter("coefficient", "kg"),)
    complexity = 2

    def priors(self, typical):
        """At the body's typical speed and spin a fraction of the typical force."""
        return {"coefficient": normal(0.3 * typical.force / (typical.speed * typical.spin))}

    def body_force(self, p, s, xp):
        """Across velocity and spin."""
        return p["coefficient"][..., None] * cross(s.spin, s.velocity, xp)


def frontal_area(shapes, sizes, xp):
    """Mean projected area of convex geoms, a quarter of each surface (Cauchy); a sphere's is pi r^2."""
    area = 0.0 * sizes[..., 0, 0]
    for k, shape in enumerate(shapes):
        x, y, z = sizes[..., k, 0], sizes[..., k, 1], sizes[..., k, 2]
        if shape == BOX:
            surface = 8 * (x * y + y * z + z * x)
        elif shape == CAPSULE:
            surface = 4 * np.pi * x * (x + y)
        elif shape == CYLINDER:
            surface = 2 * np.pi * x * (x + 2 * y)
        elif shape == ELLIPSOID:
            powers = (x * y) ** ELLIPSOID_POWER + (y * z) ** ELLIPSOID_POWER + (z * x) ** ELLIPSOID_POWER
            surface = 4 * np.pi * (powers / 3) ** (1 / ELLIPSOID_POWER)
        else:
            surface = 4 * np.pi * x**2
        area = area + surface / 4
    return area
