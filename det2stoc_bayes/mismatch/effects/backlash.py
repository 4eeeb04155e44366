"""Play between a drive that holds a position and the load that it moves."""

from det2stoc_bayes.mismatch.effects.base import EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.elements import transmitted
from det2stoc_bayes.mismatch.effects.joint import JointEffect

FULL = 2.0  # prior scale of a coefficient whose column stands at full size
GAPS = (0.003, 0.01, 0.03, 0.1)  # of the typical travel


class Backlash(JointEffect):
    """Within the gap the drive goes where it wants to be and the load is free; at its ends it pushes the load."""

    name, law_text, noun = "backlash", "tau(q + d), d in +-gap/2 where abs(tau) is least", "Backlash"
    law = r"\tau(q + \delta),\ \delta = \arg\min_{|\delta| \le g/2} |\tau(q + \delta)|"
    parameters = (EffectParameter("gap", ("m", "rad"), positive=True),)
    needs = frozenset({"driven", "held"})
    complexity = 2

    def priors(self, typical):
        """Some percent of the travel."""
        return {"gap": normal(0.05 * typical.span)}

    def trials(self, typical):
        """A few gaps: the force that a wide one takes off ends where the drive is at rest."""
        return [Trial(({"gap": f * typical.span},), FULL, one_sided=True) for f in GAPS]

    def joint_force(self, p, s, xp):
        """What the drive gives from where it is, less what it would give at the load's position."""
        stiffness = hold(s.drive, xp)
        at_load, half = transmitted(s.drive, s.q, s.v, xp), 0.5 * p["gap"]
        ahead = xp.clip(at_load / xp.maximum(stiffness, 1e-9), -half, half)
        return transmitted(s.drive, s.q + ahead, s.v, xp) - at_load


def hold(drive, xp):
    """How stiffly a drive holds its joint in a position."""
    return xp.sum(-(drive.gear**2) * (drive.gain[..., 1] * drive.u + drive.bias[..., 1]), -1)
