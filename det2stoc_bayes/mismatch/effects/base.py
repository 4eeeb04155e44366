"""What an effect is: a law, its parameters, where it can sit, and how it enters a simulation.

An effect is written once, for arrays of either library: `xp` is numpy (many simulations at once, leading axes) or
jax.numpy (one simulation). It enters a simulation through one or more of the hooks `fields` (model fields),
`joint_force`, `body_force`, `control`, `sample_time` / `reading` (sensors) and `options` (the integrator).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.priors import Prior

Array = Any  # numpy or jax array
COLUMN_UNIT = "unit of the column"
Kind = Literal["joint", "body", "actuator", "sensor", "world", "contact", "simulator"]


@dataclass(frozen=True)
class Element:
    """Something in the model that an effect can sit on; `address` are the indices the hooks need."""

    kind: Kind
    name: str
    hinge: bool = False  # rotational: the second of two unit forms
    dof: int = -1
    qpos: int = -1
    body: int = -1
    ctrl: int = -1
    column: str = ""
    unit: str = ""  # of a sensor's column

    @property
    def label(self) -> str:
        """Kind and name, as `joint wrist`."""
        return f"{self.kind} {self.name}"


@dataclass(frozen=True)
class Typical:
    """Magnitudes in the believed model's own simulation, from which an effect's prior scales follow (SI units)."""

    force: float = 1.0
    speed: float = 1.0
    span: float = 1.0
    inertia: float = 1.0
    timestep: float = 0.002
    integrator: str = "Euler"


@dataclass(frozen=True)
class EffectParameter:
    """A parameter's name, its unit (slide form, hinge form) and the value at which the effect is absent.

    A `positive` parameter has a symmetric prior all the same, since Gauss-Newton needs no wall at zero; an effect whose
    fitted value is not positive is rejected.
    """

    name: str
    unit: str | tuple[str, str]
    absent: float = 0.0
    positive: bool = False

    def unit_on(self, element: Element) -> str:
        """The unit on this element, ASCII."""
        if self.unit == COLUMN_UNIT:
            return element.unit
        return self.unit if isinstance(self.unit, str) else self.unit[int(element.hinge)]


@dataclass(frozen=True)
class JointState:
    """Position, speed and time of one joint."""

    q: Array
    v: Array
    t: Array


@dataclass(frozen=True)
class BodyState:
    """World-frame velocity of a body's centre of mass (..., 3) and time."""

    velocity: Array
    t: Array


@dataclass(frozen=True)
class Trial:
    """One group of columns to screen: unit values of the parameters for each column, and how coefficients combine."""

    columns: tuple[Mapping[str, float], ...]


class Effect:
    """Base of every effect. Subclasses set the class attributes and override the hooks they need."""

    name: ClassVar[str]
    kind: ClassVar[Kind]
    law: ClassVar[str]
    law_text: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    changes: ClassVar[tuple[str, ...]] = ()  # model fields that `fields` rewrites
    in_mjx_fields: ClassVar[bool] = True  # whether MJX honours those fields
    complexity: ClassVar[int] = 1  # among equivalent effects the lowest names the class

    # --- priors -----------------------------------------------------------------------------------------------
    def priors(self, typical: Typical) -> Mapping[str, Prior]:
        """Prior of each parameter."""
        raise NotImplementedError

    def from_normal(self, z: Sequence[Array], typical: Typical, xp: Any = np) -> dict[str, Array]:
        """Parameter values from independent standard normals, one a parameter."""
        priors = self.priors(typical)
        return {p.name: priors[p.name].from_normal(zi, xp) for p, zi in zip(self.parameters, z, strict=True)}

    def to_normal(self, values: Mapping[str, float], typical: Typical) -> Float[np.ndarray, " parameters"]:
        """Inverse of `from_normal`."""
        priors = self.priors(typical)
        return np.array([float(priors[p.name].to_normal(np.asarray(values[p.name]))) for p in self.parameters])

    # --- screening --------------------------------------------------------------------------------------------
    def trials(self, typical: Typical) -> list[Trial]:
        """Column groups whose best evidence ranks the effect; by default its first parameter, at 1 % of its scale."""
        first, prior = self.parameters[0], self.priors(typical)[self.parameters[0].name]
        step = 0.01 * float(prior.from_normal(np.array(1.0)) - first.absent)
        return [Trial(({first.name: first.absent + step},))]

    def combine(self, trial: Trial, coefficients: Float[np.ndarray, " columns"], typical: Typical) -> dict[str, float]:
        """Starting values for refinement from a trial's fitted coefficients (in units of its columns)."""
        first, column = self.parameters[0], dict(trial.columns[0])
        step = column[first.name] - first.absent
        return column | {first.name: first.absent + float(coefficients[0]) * step}

    # --- hooks ------------------------------------------------------------------------------------------------
    def fields(self, p: Mapping[str, Array], fields: Mapping[str, Array], at: Element, xp: Any) -> dict[str, Array]:
        """Changed model fields; each has the simulations' axes first, then the field's own."""
        return {}

    def joint_force(self, p: Mapping[str, Array], s: JointState, xp: Any) -> Array:
        """Generalized force on the joint."""
        raise NotImplementedError

    def body_force(self, p: Mapping[str, Array], s: BodyState, xp: Any) -> Array:
        """World-frame force (..., 3) at the body's centre of mass."""
        raise NotImplementedError

    def control(self, p: Mapping[str, Array], u: Array, dt: float, xp: Any) -> Array:
        """What arrives at the actuator, given the command at every step (..., steps)."""
        raise NotImplementedError

    def sample_time(self, p: Mapping[str, Array], t: Array, xp: Any) -> Array:
        """The time whose state a sample stamped t shows."""
        return t

    def reading(self, p: Mapping[str, Array], t: Array, value: Array, xp: Any) -> Array:
        """What is recorded where `value` is the truth."""
        return value

    def memory(self, p: Mapping[str, Array]) -> float:
        """Seconds of command before a start that `control` looks back on."""
        return 0.0

    # --- which hooks an effect uses -----------------------------------------------------------------------------
    @classmethod
    def uses(cls, hook: str) -> bool:
        """Whether the subclass overrides the hook."""
        return getattr(cls, hook) is not getattr(Effect, hook)


@dataclass(frozen=True)
class PlacedEffect:
    """An effect on an element, with the magnitudes that set its prior."""

    effect: Effect
    element: Element
    typical: Typical

    @property
    def label(self) -> str:
        """As `coulomb_friction on joint wrist`."""
        return f"{self.effect.name} on {self.element.label}"

    @property
    def key(self) -> str:
        """As `coulomb_friction[wrist]`, the prefix of its variables in a DataTree."""
        return f"{self.effect.name}[{self.element.name}]"

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.effect.parameters)

    def from_normal(self, z: Sequence[Array], xp: Any = np) -> dict[str, Array]:
        """Parameter values from standard normals."""
        return self.effect.from_normal(z, self.typical, xp)


def onehot(length: int, index: int) -> Float[np.ndarray, " length"]:
    """A row of zeros with a one at `index`."""
    row = np.zeros(length)
    row[index] = 1.0
    return row
