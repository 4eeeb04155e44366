"""Effects on what two geoms do to each other.

A contact that the model lists as a pair has parameters of its own. Else the geom that touches fewer others is given
priority, so that its parameters are the contact's, and these start as MuJoCo combines both geoms': the larger
frictions, the mean of the rest weighted by solmix.
"""

from functools import cache

import numpy as np

from det2stoc_bayes.mismatch.effects.base import Effect, EffectParameter, Trial, around
from det2stoc_bayes.priors import Prior

GEOM = ("geom_friction", "geom_solref", "geom_solimp", "geom_condim", "geom_priority")
PAIR = ("pair_friction", "pair_solref", "pair_dim")
MIXED = ("geom_solmix",)
LEAST = 1e-5  # as MuJoCo has it: a friction of 0 is none
RATIOS, SPREAD = (1.1, 2.0, 1 / 1.5), 0.5  # of solref's numbers: those that are tried, and the sd of their logarithm


class OnContact(Effect):
    """Base: another contact, as `changed(p, friction, ...)` has it; friction is sliding, turning, rolling."""

    kind = "contact"
    in_mjx_fields = False

    def forms(self):
        """For geoms, and for pairs that the model lists."""
        return (self, _paired(type(self)))

    def changed(self, p, friction, solref, dim, xp):
        """Friction (..., 3), solref (..., 2) and dimensions (...) with the effect."""
        raise NotImplementedError

    def written(self, p, fields, at, xp):
        """The parameters of the geom that is given priority."""
        return rewritten(self.changed, p, fields, at, xp)


class OfListed(OnContact):
    """What a form for pairs that the model lists writes instead."""

    def written(self, p, fields, at, xp):
        """The pair's parameters."""
        return rewritten_pair(self.changed, p, fields, at, xp)


@cache
def _paired(form):
    """The form of an effect for listed pairs."""
    if issubclass(form, OfListed):
        return form()
    own = {  # of forms that change what contacts have and nothing else: an adhesion has a form of its own
        "needs": form.needs | {"paired"},
        "changes": PAIR if form.changes else (),
        "writes": PAIR if form.writes else (),
        "reads": tuple(field for field in form.reads if field not in MIXED),
        "__doc__": form.__doc__,
        "__module__": form.__module__,
    }
    return type(f"Paired{form.__name__}", (OfListed, form), own)()


class ContactEffect(OnContact):
    """Base of those that are a contact's constants."""

    changes = (*GEOM, *MIXED)

    def fields(self, p, fields, at, xp):
        """The same from the beginning to the end."""
        return self.written(p, fields, at, xp)


def rewritten(change, p, fields, at, xp):
    """Fields of the second geom, which is given priority over the first one."""
    a, b = at.geoms
    friction, solref, solimp = fields["geom_friction"], fields["geom_solref"], fields["geom_solimp"]
    share = fields["geom_solmix"][..., a] / (fields["geom_solmix"][..., a] + fields["geom_solmix"][..., b])
    share = share[..., None]
    own = fields["geom_priority"][..., a] == fields["geom_priority"][..., b]
    over = fields["geom_priority"][..., b] > fields["geom_priority"][..., a]
    own, over = own[..., None], over[..., None]

    def combined(x, both):
        return xp.where(own, both, xp.where(over, x[..., b, :], x[..., a, :]))

    rubbing = combined(friction, xp.maximum(friction[..., a, :], friction[..., b, :]))
    mean = share * solref[..., a, :] + (1 - share) * solref[..., b, :]
    low = xp.minimum(solref[..., a, :], solref[..., b, :])
    positive = (solref[..., a, :1] > 0) & (solref[..., b, :1] > 0)
    ref = combined(solref, xp.where(positive, mean, low))
    imp = combined(solimp, share * solimp[..., a, :] + (1 - share) * solimp[..., b, :])
    dims = fields["geom_condim"][..., None]
    dim = combined(dims, xp.maximum(dims[..., a, :], dims[..., b, :]))[..., 0]
    rubbing, ref, dim = change(p, rubbing, ref, dim, xp)
    first = xp.maximum(fields["geom_priority"][..., a], fields["geom_priority"][..., b]) + 1
    row = np.arange(fields["geom_condim"].shape[-1]) == b
    vectors = {"geom_friction": rubbing, "geom_solref": ref, "geom_solimp": imp}
    numbers = {"geom_condim": dim, "geom_priority": first}
    out = {n: xp.where(row[:, None], v[..., None, :], fields[n]) for n, v in vectors.items()}
    return out | {n: xp.where(row, v[..., None], fields[n]) for n, v in numbers.items()}


def rewritten_pair(change, p, fields, at, xp):
    """Fields of a listed pair, whose friction has two directions to slide, one to turn and two to roll."""
    friction, row = fields["pair_friction"], np.arange(fields["pair_dim"].shape[-1]) == at.pair
    rubbing, ref, dim = change(
        p,
        friction[..., at.pair, :][..., 1:4],
        fields["pair_solref"][..., at.pair, :],
        fields["pair_dim"][..., at.pair],
        xp,
    )
    ratio = rubbing[..., :1] / xp.maximum(friction[..., at.pair, 1:2], LEAST)
    both = friction[..., at.pair, :2] * ratio
    rubbing = xp.concatenate([both, rubbing[..., 1:2], rubbing[..., 2:], rubbing[..., 2:]], -1)
    return {
        "pair_friction": xp.where(row[:, None], rubbing[..., None, :], friction),
        "pair_solref": xp.where(row[:, None], ref[..., None, :], fields["pair_solref"]),
        "pair_dim": xp.where(row, dim[..., None], fields["pair_dim"]),
    }


def slid(friction, ratio, xp):
    """Friction with another share of its sliding part."""
    return xp.concatenate([xp.maximum(friction[..., :1] * ratio[..., None], LEAST), friction[..., 1:]], -1)


class FrictionError(ContactEffect):
    """Sliding friction is not as large as believed."""

    name, law, law_text, noun = "friction_error", r"\rho\,\mu", "ratio mu", "A change of contact friction"
    parameters = (EffectParameter("ratio", "1", absent=1.0),)

    def priors(self, typical):
        """Around 1."""
        return {"ratio": Prior("Normal", {"loc": 1.0, "scale": 0.4})}

    def changed(self, p, friction, solref, dim, xp):
        """Scales the sliding part."""
        return slid(friction, p["ratio"], xp), solref, dim


class TurningFriction(ContactEffect):
    """Base of friction against turning: what is added to the `part` of friction that `directions` of contact bring."""

    parameters = (EffectParameter("coefficient", "m", positive=True),)
    complexity = 2
    part, directions, share = 1, 4, 0.2  # of the body's size

    def priors(self, typical):
        """A fraction of the body's size."""
        return {"coefficient": Prior("Normal", {"loc": 0.0, "scale": self.share * typical.span})}

    def changed(self, p, friction, solref, dim, xp):
        """Adds to its part; a contact of enough directions has one."""
        more = xp.maximum(p["coefficient"][..., None], 0.0) * (np.arange(3) == self.part)
        return friction + more, solref, xp.maximum(dim, self.directions)


class TorsionalFriction(TurningFriction):
    """Turning on the spot is resisted, too."""

    name, law, law_text = "torsional_friction", r"\mu_t\,N", "a torque of coefficient N against turning on the spot"
    noun = "Torsional friction"
    part, directions, share = 1, 4, 0.2


class RollingFriction(TurningFriction):
    """Rolling is resisted, too."""

    name, law, law_text = "rolling_friction", r"\mu_r\,N", "a torque of coefficient N against rolling"
    noun = "Rolling friction"
    part, directions, share = 2, 6, 0.1


class SolrefEffect(ContactEffect):
    """Base of another number of solref: its parameter is the number itself, so that no value stands for absence."""

    place = 0
    needs = frozenset({"timed"})

    def priors(self, typical):
        """About what is believed."""
        return {self.parameters[0].name: around(abs(typical.solref[self.place]), SPREAD)}

    def trials(self, typical):
        """A little more than is believed, and much more or less: contact makes a little's difference rough."""
        name, believed = self.parameters[0].name, abs(typical.solref[self.place])
        return [Trial(({name: believed * ratio},), sd=min(SPREAD / abs(np.log(ratio)), 1.0)) for ratio in RATIOS]

    def combine(self, trial, coefficients, typical):
        """The same in proportion."""
        name, believed = self.parameters[0].name, abs(typical.solref[self.place])
        step = np.log(float(trial.columns[0][name]) / believed)
        return {name: believed * float(np.exp(np.clip(step * coefficients[0], -1.5, 1.5)))}


class ContactStiffness(SolrefEffect):
    """The contact is softer or harder than believed."""

    name, law, law_text = "contact_stiffness", r"t_c", "the time constant of contact"
    noun, place = "Another time constant of contact", 0
    parameters = (EffectParameter("time_constant", "s"),)

    def changed(self, p, friction, solref, dim, xp):
        """solref's first number."""
        return friction, xp.concatenate([p["time_constant"][..., None], solref[..., 1:]], -1), dim


class RestitutionError(SolrefEffect):
    """The contact bounces more or less than believed."""

    name, law, law_text = "restitution_error", r"\zeta", "the damping ratio of contact"
    noun, place = "Another damping ratio of contact", 1
    parameters = (EffectParameter("damping_ratio", "1"),)

    def changed(self, p, friction, solref, dim, xp):
        """solref's second number."""
        return friction, xp.concatenate([solref[..., :1], p["damping_ratio"][..., None]], -1), dim
