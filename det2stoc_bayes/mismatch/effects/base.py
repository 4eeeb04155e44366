"""What an effect is: a law, its parameters, where it can sit, and how it enters a simulation.

An effect is written once, for arrays of either library: `xp` is numpy (many simulations at once, leading axes) or
jax.numpy (one simulation). It enters a simulation through one or more of the hooks `fields` (model fields),
`momentary` (model fields rewritten at every step), `joint_force`, `body_force`, `control`, `sample_time` / `reading`
(sensors) and `options` (the integrator).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.mismatch.effects.elements import Array, BodyState, Drive, Element, JointState, Kind, Typical
from det2stoc_bayes.priors import Prior

__all__ = ["Array", "BodyState", "Drive", "Effect", "EffectParameter", "Element", "JointState", "PlacedEffect"]
__all__ += ["Trial", "Typical", "normal", "onehot"]
COLUMN_UNIT = "unit of the column"
COMMAND_UNIT = "unit of u"
AXES = "xyz"
SMALL = 0.01  # of an effect's prior scale, at which columns stand


@dataclass(frozen=True)
class EffectParameter:
    """A parameter's name, its unit (slide form, hinge form) and the value at which the effect is absent.

    A `positive` parameter has a symmetric prior all the same, whose other half a fit never enters (`Effect.floor`); an
    effect that ends at the wall is rejected.
    """

    name: str
    unit: str | tuple[str, str]
    absent: float = 0.0
    positive: bool = False
    size: int = 1  # of a vector, whose values have a last axis; of 3 that is x, y, z
    given: bool = False  # a constant that the law needs, and no unknown

    def unit_on(self, element: Element) -> str:
        """The unit on this element, ASCII."""
        if isinstance(self.unit, str) and self.unit.startswith((COLUMN_UNIT, COMMAND_UNIT)):
            rest = self.unit.removeprefix(COLUMN_UNIT).removeprefix(COMMAND_UNIT)
            return (element.unit or "1") + rest.replace(" per ", "/") if rest else element.unit
        return self.unit if isinstance(self.unit, str) else self.unit[int(element.hinge)]

    @property
    def components(self) -> tuple[str, ...]:
        """A name for each scalar: `offset.x` of a vector in space, `curve.0` of another one."""
        axes = AXES if self.size == len(AXES) else range(self.size)
        return (self.name,) if self.size == 1 else tuple(f"{self.name}.{axis}" for axis in axes)


@dataclass(frozen=True)
class Trial:
    """One group of columns to screen: values of the parameters for each column.

    `sd`: prior scale of the coefficients; 100 where columns stand at 1 % of an effect's scale, 1 for full-sized ones.
    """

    columns: tuple[Mapping[str, Any], ...]
    sd: float = 100.0
    one_sided: bool = False  # a negative coefficient is no such effect


class Effect:
    """Base of every effect. Subclasses set the class attributes and override the hooks they need."""

    name: ClassVar[str]
    kind: ClassVar[Kind]
    law: ClassVar[str]
    law_text: ClassVar[str]
    noun: ClassVar[str] = ""  # how a sentence begins; by default the name
    parameters: ClassVar[tuple[EffectParameter, ...]]
    needs: ClassVar[frozenset[str]] = frozenset()  # traits that an element must have
    changes: ClassVar[tuple[str, ...]] = ()  # model fields that `fields` rewrites
    writes: ClassVar[tuple[str, ...]] = ()  # model fields that `momentary` rewrites
    reads: ClassVar[tuple[str, ...]] = ()  # further model fields that `momentary` looks at
    in_mjx_fields: ClassVar[bool] = True  # whether MJX honours those fields
    complexity: ClassVar[int] = 1  # among equivalent effects the lowest names the class
    listed: ClassVar[bool] = True  # whether it is tried in every study

    def fits(self, element: Element) -> bool:
        """Whether the effect can sit there."""
        return element.kind == self.kind and self.needs <= element.traits

    def forms(self) -> tuple["Effect", ...]:
        """All forms of the effect, which differ in their parameters; the last one that fits an element is used."""
        return (self,)

    def form_on(self, element: Element) -> "Effect":
        """The form that is used on an element, on which the effect fits."""
        return [form for form in self.forms() if form.fits(element)][-1]

    def places(self, element: Element, others: Sequence[Element]) -> tuple[Element, ...]:
        """The element itself, or once for each of the `others` that it may be paired with."""
        return (element,)

    @property
    def unknown(self) -> tuple[EffectParameter, ...]:
        """The parameters that are not given."""
        return tuple(p for p in self.parameters if not p.given)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return sum(p.size for p in self.unknown)

    @property
    def components(self) -> tuple[str, ...]:
        """A name for each unknown."""
        return tuple(c for p in self.unknown for c in p.components)

    def special_cases(self, values: Mapping[str, Any]) -> Mapping[str, Mapping[str, Any]]:
        """Simpler effects that this one comes to, by name, with their values nearest to these."""
        return {}

    def scalars(self, values: Mapping[str, Array]) -> list[Array]:
        """Parameter values as one array for each of `components`."""
        out = []
        for p in self.unknown:
            out += [values[p.name]] if p.size == 1 else [values[p.name][..., i] for i in range(p.size)]
        return out

    # --- priors -----------------------------------------------------------------------------------------------
    def priors(self, typical: Typical) -> Mapping[str, Prior]:
        """Prior of each parameter, of a vector that of each component."""
        raise NotImplementedError

    def from_normal(self, z: Sequence[Array], typical: Typical, xp: Any = np) -> dict[str, Array]:
        """Parameter values from independent standard normals, one a scalar."""
        priors, left, out = self.priors(typical), iter(z), {}
        for p in self.parameters:
            parts = [priors[p.name].from_normal(next(left), xp) for _ in range(p.size)]
            out[p.name] = parts[0] if p.size == 1 else xp.stack(parts, -1)
        return out

    def to_normal(self, values: Mapping[str, Any], typical: Typical) -> Float[np.ndarray, " unknowns"]:
        """Inverse of `from_normal`."""
        priors = self.priors(typical)
        return np.concatenate([np.ravel(priors[p.name].to_normal(np.asarray(values[p.name]))) for p in self.parameters])

    def floor(self, typical: Typical) -> Float[np.ndarray, " unknowns"]:
        """The least that each standard normal may be: where a positive parameter is absent, -inf elsewhere."""
        priors = self.priors(typical)
        with np.errstate(divide="ignore"):
            lowest = [float(priors[p.name].to_normal(p.absent)) if p.positive else -np.inf for p in self.parameters]
        return np.repeat(lowest, [p.size for p in self.parameters])

    # --- screening --------------------------------------------------------------------------------------------
    def trials(self, typical: Typical) -> list[Trial]:
        """Column groups whose best evidence ranks the effect; by default its first parameter's components."""
        first = self.parameters[0]
        step = SMALL * float(self.priors(typical)[first.name].from_normal(np.array(1.0)) - first.absent)
        return [Trial(unit_columns(first, step))]

    def about(self, trial: Trial, typical: Typical, reach: float) -> list[Trial]:
        """Trials about one, at a share of what is between the first ones; none where fits find the rest."""
        return []

    def combine(self, trial: Trial, coefficients: Float[np.ndarray, " columns"], typical: Typical) -> dict[str, Any]:
        """Starting values for refinement from a trial's fitted coefficients (in units of its columns)."""
        first = self.parameters[0]
        steps = [np.asarray(column[first.name]) - first.absent for column in trial.columns]
        value = first.absent + sum(float(c) * step for c, step in zip(coefficients, steps, strict=True))
        return {**trial.columns[0], first.name: float(value) if first.size == 1 else value}

    def force_along(self, p: Mapping[str, Any], s: JointState) -> Array:
        """What the effect comes to as a force on its joint along a trajectory; screening takes it for the effect."""
        return self.joint_force(p, s, np)

    # --- hooks ------------------------------------------------------------------------------------------------
    def fields(self, p: Mapping[str, Array], fields: Mapping[str, Array], at: Element, xp: Any) -> dict[str, Array]:
        """Changed model fields; each has the simulations' axes first, then the field's own."""
        return {}

    def momentary(
        self, p: Mapping[str, Array], fields: Mapping[str, Array], s: JointState, at: Element, xp: Any
    ) -> dict[str, Array]:
        """Model fields for the step that begins, from those that the model has; `s` is the element's joint's."""
        return {}

    def joint_force(self, p: Mapping[str, Array], s: JointState, xp: Any) -> Array:
        """Generalized force on the joint."""
        raise NotImplementedError

    def reaction(self, p: Mapping[str, Array], s: JointState, xp: Any) -> Array:
        """Generalized force on the joint that `s.source` is."""
        raise NotImplementedError

    def anchor(self, p: Mapping[str, Array], q: Array, anchor: Array, xp: Any) -> Array:
        """What `joint_force` remembers of the past, given what it was; at a start it is the position."""
        raise NotImplementedError

    def friction(self, p: Mapping[str, Array], s: JointState, xp: Any) -> Array:
        """Size of dry friction on the joint, by which `momentary` raises its frictionloss."""
        raise NotImplementedError

    def body_force(self, p: Mapping[str, Array], s: BodyState, xp: Any) -> Array:
        """World-frame force (..., 3) at the body's centre of mass; of the world, on each of its bodies."""
        raise NotImplementedError

    def body_torque(self, p: Mapping[str, Array], s: BodyState, xp: Any) -> Array:
        """World-frame torque (..., 3) beside `body_force`."""
        raise NotImplementedError

    def control(self, p: Mapping[str, Array], u: Array, t: Array, dt: Array, xp: Any) -> Array:
        """What arrives at the actuator, given the command and the time at every step (..., steps)."""
        raise NotImplementedError

    def gravity(self, p: Mapping[str, Array], t: Array, xp: Any) -> Array:
        """Acceleration (..., 3) that `momentary` adds to gravity; screening takes it for the effect."""
        raise NotImplementedError

    def swell(self, p: Mapping[str, Array], t: Array, xp: Any) -> Array:
        """Part of the steady wind that `momentary` adds to it; screening takes it for the effect."""
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
        """Number of unknowns."""
        return self.effect.size

    @property
    def unknowns(self) -> tuple[str, ...]:
        """A name for each scalar, as `payload_mass[arm].offset.x`."""
        return tuple(f"{self.key}.{c}" for c in self.effect.components)

    def scalars(self, values: Mapping[str, Array]) -> list[Array]:
        """Parameter values as one array for each of `unknowns`."""
        return self.effect.scalars(values)

    def from_normal(self, z: Sequence[Array], xp: Any = np) -> dict[str, Array]:
        """Parameter values from standard normals."""
        return self.effect.from_normal(z, self.typical, xp)


def normal(scale: float) -> Prior:
    """A signed parameter of this size."""
    return Prior("Normal", {"loc": 0.0, "scale": scale})


def around(value: float, spread: float = 0.7) -> Prior:
    """A positive parameter of this size, give or take a factor of e^spread."""
    return Prior("LogNormal", {"loc": float(np.log(value)), "scale": spread})


def unit_columns(parameter: EffectParameter, step: float, **others: Any) -> tuple[dict[str, Any], ...]:
    """A column for each component of a parameter, `step` away from where the effect is absent."""
    if parameter.size == 1:
        return ({parameter.name: parameter.absent + step, **others},)
    moved = parameter.absent + step * np.eye(parameter.size)
    return tuple({parameter.name: tuple(row), **others} for row in moved)


def onehot(length: int, index: int) -> Float[np.ndarray, " length"]:
    """A row of zeros with a one at `index`."""
    row = np.zeros(length)
    row[index] = 1.0
    return row
