"""Effects between a command and the force that an actuator gives."""

from dataclasses import replace

import numpy as np

from det2stoc_bayes.mismatch.effects.base import COMMAND_UNIT, Effect, EffectParameter, Trial, around, normal, onehot
from det2stoc_bayes.mismatch.effects.elements import transmitted
from det2stoc_bayes.priors import Prior

SETTLED = 23.0  # time constants after which a filter has forgotten all but 1e-10
FULL = 2.0  # prior scale of a coefficient whose column stands at full size
SATURATING = (0.9, 0.75, 0.55, 0.35, 0.15)  # of the largest command
DEAD = (0.02, 0.05, 0.1, 0.2, 0.35)
STALLS, SPEEDS = (0.3, 0.6, 0.9, 1.3, 2.0, 4.0), (0.6, 1.2, 2.5, 5.0)  # of the largest force and speed


class ActuatorEffect(Effect):
    """An effect on one actuator."""

    kind = "actuator"


class ActuatorDelay(ActuatorEffect):
    """The command arrives late; before the first command that first one is held."""

    name, law, law_text, noun = "actuator_delay", r"u(t - \tau)", "u(t - delay)", "A delay"
    parameters = (EffectParameter("delay", "s", positive=True),)

    def priors(self, typical):
        """Buses and drives take milliseconds to tens of milliseconds."""
        return {"delay": normal(0.03)}

    def memory(self, p):
        """The longest delay."""
        return float(np.max(p["delay"], initial=0.0))

    def control(self, p, u, t, dt, xp):
        """Linear between steps, so that the motion is continuous in the delay."""
        steps = xp.clip(p["delay"] / dt, 0.0, u.shape[-1] - 2)
        whole = xp.floor(steps)
        late = xp.arange(u.shape[-1]) - whole[..., None].astype(int)
        newer = xp.take_along_axis(u, xp.clip(late, 0, None), -1)
        older = xp.take_along_axis(u, xp.clip(late - 1, 0, None), -1)
        share = (steps - whole)[..., None]
        return (1 - share) * newer + share * older


class ActuatorLag(ActuatorEffect):
    """The command passes a first-order filter, which has settled before the first command."""

    name, law, law_text, noun = "actuator_lag", r"T\,\dot y = u - y", "T dy/dt = u - y", "A lag"
    parameters = (EffectParameter("time_constant", "s", positive=True),)
    complexity = 2

    def priors(self, typical):
        """Drives and valves take milliseconds to tenths of a second."""
        return {"time_constant": normal(0.05)}

    def trials(self, typical):
        """A short one, and full-sized ones, whose shape is another."""
        large = [Trial(({"time_constant": t},), FULL, one_sided=True) for t in (0.02, 0.06, 0.15)]
        return [Trial(({"time_constant": 5e-4},)), *large]

    def memory(self, p):
        """Until the filter has forgotten."""
        return SETTLED * float(np.max(p["time_constant"], initial=0.0))

    def control(self, p, u, t, dt, xp):
        """The filter's mean over each step; its sum over the past by doubling the number of terms."""
        steps = xp.maximum(p["time_constant"] / dt, 1e-12)[..., None]
        keep = xp.exp(-1 / steps)
        past = u - u[..., :1]
        shift = 1
        while shift < u.shape[-1]:
            earlier = xp.concatenate([xp.zeros_like(past[..., :shift]), past[..., :-shift]], -1)
            past = past + xp.exp(-shift / steps) * earlier
            shift *= 2
        before = xp.concatenate([xp.zeros_like(past[..., :1]), (1 - keep) * past[..., :-1]], -1) + u[..., :1]
        return u + (before - u) * steps * (1 - keep)


class ActuatorGain(ActuatorEffect):
    """The command arrives scaled."""

    name, law, law_text, noun = "actuator_gain", r"\rho\,u", "ratio u", "A gain"
    parameters = (EffectParameter("ratio", "1", absent=1.0),)

    def priors(self, typical):
        """Around 1."""
        return {"ratio": Prior("Normal", {"loc": 1.0, "scale": 0.3})}

    def control(self, p, u, t, dt, xp):
        """Scaled."""
        return p["ratio"][..., None] * u


class ActuatorBias(ActuatorEffect):
    """The command arrives shifted."""

    name, law, law_text, noun = "actuator_bias", r"u + b", "u + offset", "An offset"
    parameters = (EffectParameter("offset", COMMAND_UNIT),)
    complexity = 2

    def priors(self, typical):
        """A fraction of the largest command."""
        return {"offset": normal(0.2 * typical.command)}

    def control(self, p, u, t, dt, xp):
        """Shifted."""
        return u + p["offset"][..., None]


class ActuatorDeadZone(ActuatorEffect):
    """Small commands do nothing; the others arrive diminished by the width."""

    name, law_text, noun = "actuator_dead_zone", "sign(u) max(abs(u) - width, 0)", "A dead zone"
    law = r"\operatorname{sign}(u)\,\max(|u| - w, 0)"
    parameters = (EffectParameter("width", COMMAND_UNIT, positive=True),)
    complexity = 2

    def priors(self, typical):
        """A fraction of the largest command."""
        return {"width": normal(0.2 * typical.command)}

    def trials(self, typical):
        """A few widths."""
        return [Trial(({"width": f * typical.command},), FULL) for f in DEAD]

    def control(self, p, u, t, dt, xp):
        """Moved towards 0 by the width."""
        width = xp.maximum(p["width"], 0.0)[..., None]
        return u - xp.clip(u, -width, width)


class ActuatorSaturation(ActuatorEffect):
    """Large commands are clipped."""

    name, law_text, noun = "actuator_saturation", "clip(u, -limit, limit)", "Saturation"
    law = r"\operatorname{clip}(u, -L, L)"
    parameters = (EffectParameter("limit", COMMAND_UNIT, absent=np.inf),)
    complexity = 2

    def priors(self, typical):
        """Somewhat below the largest command."""
        return {"limit": around(0.7 * typical.command)}

    def trials(self, typical):
        """A few limits."""
        return [Trial(({"limit": f * typical.command},), FULL, one_sided=True) for f in SATURATING]

    def combine(self, trial, coefficients, typical):
        """The trial's own limit."""
        return dict(trial.columns[0])

    def control(self, p, u, t, dt, xp):
        """Clipped."""
        limit = p["limit"][..., None]
        return xp.clip(u, -limit, limit)


class ActuatorGainDrift(ActuatorEffect):
    """The actuator fades with time, as one that warms up."""

    name, law, law_text, noun = "actuator_gain_drift", r"e^{-r t}\,u", "exp(-rate t) u", "A fading gain"
    parameters = (EffectParameter("rate", "1/s"),)
    complexity = 2

    def priors(self, typical):
        """A fraction over a recording."""
        return {"rate": normal(0.3 / typical.duration)}

    def control(self, p, u, t, dt, xp):
        """Scaled by the factor of the step's middle, for which it is held."""
        return xp.exp(-p["rate"][..., None] * (t + 0.5 * xp.asarray(dt)[..., None])) * u


class TorqueSpeedLimit(ActuatorEffect):
    """The force that an actuator can give in its direction of motion falls linearly with its speed."""

    name, law_text, noun = "torque_speed_limit", "F <= stall (1 - v/no_load_speed) along v", "A limit of torque"
    law = r"F \le F_s\,(1 - v/v_0)"
    parameters = (
        EffectParameter("stall", ("N", "N m"), absent=np.inf),
        EffectParameter("no_load_speed", ("m/s", "rad/s"), absent=np.inf),
    )
    needs = frozenset({"driven"})
    writes, reads = ("actuator_forcerange", "actuator_forcelimited"), ("actuator_gear",)
    complexity = 3

    def priors(self, typical):
        """Such that the largest forces and speeds of the believed model are near the limit."""
        return {"stall": around(typical.peak_force), "no_load_speed": around(2 * typical.peak_speed)}

    def trials(self, typical):
        """A few limits."""
        pairs = [(stall * typical.peak_force, v * typical.peak_speed) for stall in STALLS for v in SPEEDS]
        return [Trial(({"stall": a, "no_load_speed": b},), FULL, one_sided=True) for a, b in pairs]

    def combine(self, trial, coefficients, typical):
        """The trial's own limits."""
        return dict(trial.columns[0])

    def momentary(self, p, fields, s, at, xp):
        """The actuator's force range at its present speed, within the one that it has."""
        limited, ranges = fields["actuator_forcelimited"], fields["actuator_forcerange"]
        lower, upper = range_at(p, fields["actuator_gear"][..., at.actuators[0], 0] * s.v, xp)
        place = onehot(limited.shape[-1], at.actuators[0]) > 0
        low = xp.where(limited, xp.maximum(ranges[..., 0], lower[..., None]), lower[..., None])
        high = xp.where(limited, xp.minimum(ranges[..., 1], upper[..., None]), upper[..., None])
        changed = xp.where(place[:, None], xp.stack([low, high], -1), ranges)
        return {"actuator_forcerange": changed, "actuator_forcelimited": limited | place}

    def force_along(self, p, s):
        """What the limit takes from the joint."""
        assert s.drive is not None, "an actuator drives this joint"
        lower, upper = range_at(p, s.drive.gear[..., 0] * s.v, np)
        low, high = np.maximum(s.drive.low, lower[..., None]), np.minimum(s.drive.high, upper[..., None])
        limited = replace(s.drive, low=low, high=high)
        return transmitted(limited, s.q, s.v, np) - transmitted(s.drive, s.q, s.v, np)


def range_at(p, speed, xp):
    """The least and the largest force that an actuator with a torque-speed limit gives at a speed."""
    relative = speed / p["no_load_speed"]
    return -p["stall"] * xp.clip(1 + relative, 0.0, 1.0), p["stall"] * xp.clip(1 - relative, 0.0, 1.0)
