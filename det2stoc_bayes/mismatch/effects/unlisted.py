"""Forces on joints whose shape is on no list: a curve over one or two variables, by its values at even knots.

The curve's prior is a Gaussian process (Matern 5/2) in its leading modes, so that its evidence against a listed law is
in closed form as far as predictions are linear in it. Between knots it is cubic convolution (Keys, 1981); beyond them
it stays as it ends.
"""

from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.mismatch.effects.base import SMALL, EffectParameter, Trial, normal
from det2stoc_bayes.mismatch.effects.elements import Array
from det2stoc_bayes.mismatch.effects.joint import JointEffect

NUM_KNOTS = 65
NUM_FIRST, NUM_SECOND = 24, 8  # knots over each of two variables
LENGTH, AMPLITUDE = 0.16, 0.3  # of the range, and of the typical force, where nothing was chosen
KEPT = 0.995  # of the prior's variance, by its leading modes
BEYOND = 3.0  # typical speeds up to which knots lie where no range was given
UNITS = {"position": ("m", "rad"), "velocity": ("m/s", "rad/s"), "time": ("s", "s"), "control": ("1", "1")}


class UnlistedForce(JointEffect):
    """A force of any smooth shape that depends on the joint's position, speed, time or command.

    `reach`: least and largest value of each variable; `lengths`: over which the curve bends, as shares of that range;
    `amplitude`: its prior sd as a share of the typical force. Unknowns are the modes' coefficients.
    """

    name, listed, complexity = "unlisted", False, 9
    noun = "A force on no list"
    variables: ClassVar[tuple[str, ...]]
    counts: ClassVar[tuple[int, ...]]

    def __init__(
        self,
        reach: tuple[tuple[float, float], ...] | None = None,
        lengths: tuple[float, ...] | None = None,
        amplitude: float = AMPLITUDE,
    ):
        self.reach, self.amplitude = reach, amplitude
        self.lengths = lengths or (LENGTH,) * len(self.variables)
        self.modes = leading(self.counts, self.lengths)

    def forms(self):
        """One for each variable, or pair of variables, that it may depend on."""
        return tuple(form() for form in FORMS)

    def along(self, s):
        """The variable, or both."""
        raise NotImplementedError

    def parts(self, p, s, xp) -> tuple[Array, Array]:
        """The knots that the force follows from, and what each of them counts."""
        raise NotImplementedError

    def joint_force(self, p, s, xp):
        """The curve's value."""
        knots, shares = self.parts(p, s, xp)
        return xp.sum(shares * taken(p["curve"], knots, xp), -1)

    # --- prior ------------------------------------------------------------------------------------------------
    @property
    def size(self):
        """Number of modes."""
        return self.modes.shape[1]

    @property
    def told(self) -> Int[np.ndarray, " modes"]:
        """As many knots as there are modes, evenly spread."""
        return np.rint(np.linspace(0, len(self.modes) - 1, self.size)).astype(int)

    @property
    def components(self):
        """Values at some knots stand for the modes."""
        return tuple(f"curve.{i}" for i in self.told)

    def scalars(self, values):
        """Values at these knots."""
        return [values["curve"][..., i] for i in self.told]

    def given(self, typical) -> dict[str, Any]:
        """Where the knots lie, as parameters."""
        usual = {
            "position": typical.reach,
            "velocity": (-BEYOND * typical.speed, BEYOND * typical.speed),
            "time": (0.0, typical.duration),
            "control": (-typical.command, typical.command),
        }
        ends = np.array(self.reach or [usual[name] for name in self.variables]).T
        least, most = ends if len(self.variables) > 1 else ends[:, 0]
        return {"least": least, "most": most}

    def root(self, typical) -> Float[np.ndarray, "knots modes"]:
        """B of values B z at the knots for standard normals z."""
        return self.amplitude * typical.force * self.modes

    def priors(self, typical):
        """Of a single value; together they are as smooth as `root` makes them."""
        return {"curve": normal(self.amplitude * typical.force)}

    def from_normal(self, z, typical, xp=np):
        """Values at the knots, and where these lie."""
        curve = xp.stack(list(z), -1) @ self.root(typical).T
        return {"curve": curve} | {
            name: xp.broadcast_to(xp.asarray(value), (*curve.shape[:-1], *np.shape(value)))
            for name, value in self.given(typical).items()
        }

    def to_normal(self, values, typical):
        """Inverse of `from_normal`; of another curve the coefficients of the closest one."""
        return np.linalg.lstsq(self.root(typical), np.asarray(values["curve"], float), rcond=None)[0]

    def floor(self, typical):
        """No wall."""
        return np.full(self.size, -np.inf)

    def trials(self, typical):
        """All modes together."""
        given = self.given(typical)
        return [Trial(tuple({"curve": column, **given} for column in SMALL * self.root(typical).T))]

    def combine(self, trial, coefficients, typical):
        """The sum of the columns."""
        columns = np.stack([column["curve"] for column in trial.columns], -1)
        return {**trial.columns[0], "curve": columns @ coefficients}


class _OverOne(UnlistedForce):
    """A curve over one variable."""

    counts = (NUM_KNOTS,)

    def __init_subclass__(cls):
        (variable,) = cls.variables
        ends = tuple(EffectParameter(name, UNITS[variable], given=True) for name in ("least", "most"))
        cls.parameters = (EffectParameter("curve", ("N", "N m"), size=NUM_KNOTS), *ends)
        cls.law, cls.law_text = rf"f(\text{{{variable}}})", f"f({variable})"

    def parts(self, p, s, xp):
        """Four knots."""
        return interpolated(self.along(s), p["least"], p["most"], NUM_KNOTS, xp)


class OverPosition(_OverOne):
    """A force of any smooth shape in the joint's position."""

    variables = ("position",)

    def along(self, s):
        """Position."""
        return s.q


class OverVelocity(_OverOne):
    """A force of any smooth shape in the joint's speed."""

    variables = ("velocity",)

    def along(self, s):
        """Speed."""
        return s.v


class OverTime(_OverOne):
    """A force on a joint of any smooth shape in time."""

    variables = ("time",)

    def along(self, s):
        """The recorded clock."""
        return s.t


class OverCommand(_OverOne):
    """A force on a joint of any smooth shape in the command of the one actuator that drives it."""

    variables, needs = ("control",), frozenset({"driven"})

    def fits(self, element):
        """With one actuator there is one command."""
        return super().fits(element) and len(element.actuators) == 1

    def along(self, s):
        """The command within its range, or the activation that follows from it."""
        return s.drive.u[..., 0]


class _OverTwo(UnlistedForce):
    """A surface over two variables; in its curve the second one runs fastest."""

    counts, complexity = (NUM_FIRST, NUM_SECOND), 10

    def __init_subclass__(cls):
        slide, hinge = (", ".join(UNITS[v][i] for v in cls.variables) for i in (0, 1))
        ends = tuple(EffectParameter(name, (slide, hinge), size=2, given=True) for name in ("least", "most"))
        cls.parameters = (EffectParameter("curve", ("N", "N m"), size=NUM_FIRST * NUM_SECOND), *ends)
        both = ", ".join(cls.variables)
        cls.law, cls.law_text = rf"f(\text{{{both}}})", f"f({both})"

    def parts(self, p, s, xp):
        """Sixteen knots."""
        first, second = self.along(s)
        rows, high = interpolated(first, p["least"][..., 0], p["most"][..., 0], NUM_FIRST, xp)
        columns, wide = interpolated(second, p["least"][..., 1], p["most"][..., 1], NUM_SECOND, xp)
        knots = NUM_SECOND * rows[..., :, None] + columns[..., None, :]
        shares = high[..., :, None] * wide[..., None, :]
        return knots.reshape((*rows.shape[:-1], -1)), shares.reshape((*rows.shape[:-1], -1))


class OverPositionAndVelocity(_OverTwo):
    """A force of any smooth shape in the joint's position and speed."""

    variables = ("position", "velocity")

    def along(self, s):
        """Position and speed."""
        return s.q, s.v


class OverTimeAndVelocity(_OverTwo):
    """A force of any smooth shape in time and the joint's speed."""

    variables = ("time", "velocity")

    def along(self, s):
        """The recorded clock and the speed."""
        return s.t, s.v


class OverTimeAndPosition(_OverTwo):
    """A force of any smooth shape in time and the joint's position."""

    variables = ("time", "position")

    def along(self, s):
        """The recorded clock and the position."""
        return s.t, s.q


FORMS = (OverPosition, OverVelocity, OverTime, OverCommand)
FORMS += (OverPositionAndVelocity, OverTimeAndVelocity, OverTimeAndPosition)


def leading(counts: tuple[int, ...], lengths: tuple[float, ...]) -> Float[np.ndarray, "knots modes"]:
    """Leading modes of a process of unit variance at even knots, each times its sd."""
    kernel = np.ones((1, 1))
    for count, length in zip(counts, lengths, strict=True):
        kernel = np.kron(kernel, matern(np.linspace(0, 1, count), length))
    variances, modes = np.linalg.eigh(kernel)
    variances, modes = variances[::-1], modes[:, ::-1]
    count = int(np.searchsorted(np.cumsum(variances), KEPT * variances.sum())) + 1
    return modes[:, :count] * np.sqrt(variances[:count])


def matern(x: Float[np.ndarray, " knots"], length: float) -> Float[np.ndarray, "knots knots"]:
    """Correlation of a Matern process with smoothness 5/2 (Rasmussen and Williams, 2006, eq. 4.17)."""
    d = np.sqrt(5.0) * np.abs(x[:, None] - x) / length
    return (1 + d + d**2 / 3) * np.exp(-d)


def interpolated(x: Array, least: Array, most: Array, count: int, xp) -> tuple[Array, Array]:
    """The four of `count` even knots that a curve's value at x follows from, and what each of them counts (..., 4)."""
    at = xp.clip((x - least) / (most - least), 0.0, 1.0) * (count - 1)
    low = xp.nan_to_num(xp.clip(xp.floor(at), 0, count - 2))  # shares stay NaN where a simulation diverged
    u = at - low
    shares = (-0.5 * u + u**2 - 0.5 * u**3, 1 - 2.5 * u**2 + 1.5 * u**3)
    shares += (0.5 * u + 2 * u**2 - 1.5 * u**3, 0.5 * u**3 - 0.5 * u**2)
    knots = xp.clip(low[..., None] + np.arange(-1, 3), 0, count - 1)
    return knots.astype(int), xp.stack(shares, -1)


def taken(values: Array, knots: Array, xp) -> Array:
    """Values (..., count) at the knots of each x (..., k); values that have fewer axes serve all."""
    if values.ndim < knots.ndim:
        return values[knots]
    return xp.take_along_axis(values, knots, -1)
