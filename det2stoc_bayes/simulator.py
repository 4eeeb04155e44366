"""A study's believed model, its uncertain parameters, and an engine that runs it."""

import copy
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines import elements
from det2stoc_bayes.engines.base import Counter, Engine, Request
from det2stoc_bayes.engines.model_names import compile_loose_model, field_of, rows_of
from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.errors import EngineError
from det2stoc_bayes.mismatch.effects.base import Element
from det2stoc_bayes.study import Study, Target


@dataclass(frozen=True)
class FieldAddress:
    """The components of an mjModel field that a target sets."""

    field: str
    places: tuple[tuple[int, ...], ...]  # indices into the field's array, one a component


class Simulator:
    """Fields from psi and from what is known of a recording, and simulations of them."""

    def __init__(self, study: Study, engine: str = "c", num_threads: int = 0):
        self.study = study
        self.model = compile_loose_model(study.model_path, study.folder)
        self.parameters = study.parameters
        self.addresses = tuple(address(self.model, p.target, p.index) for p in study.parameters)
        self.engine = _make_engine(self.model, engine, num_threads)
        known = {t: address(self.model, t, None) for table in study.known.values() for t in table}
        self._known = known
        names = {a.field for a in (*self.addresses, *known.values())}
        self._base = {name: np.asarray(model_field(self.model, name), dtype=float) for name in sorted(names)}

    def on(self, study: Study) -> "Simulator":
        """The same model and engine for other recordings; the study differs in these alone."""
        other = copy.copy(self)
        other.study = study
        return other

    @property
    def counter(self) -> Counter:
        """Simulations run so far."""
        return self.engine.counter

    @property
    def believed(self) -> Float[np.ndarray, " psi"]:
        """Each parameter's value in the model file (its first component's)."""
        return np.array([float(np.asarray(self._base[a.field])[a.places[0]]) for a in self.addresses])

    @property
    def integrator(self) -> str:
        """The believed one, as MJCF spells it."""
        name = str(mujoco.mjtIntegrator(self.model.opt.integrator).name).removeprefix("mjINT_")
        return {"EULER": "Euler", "RK4": "RK4"}.get(name, name.lower())

    @property
    def fingerprint(self) -> str:
        """Of the model, psi with their priors, noise and all recordings: equal where a method's results would be."""
        study, found = self.study, hashlib.sha256()
        model = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, model)
        found.update(model.tobytes())
        known = {
            stem: {str(t): np.asarray(v).tolist() for t, v in table.items()} for stem, table in study.known.items()
        }
        found.update(repr((study.parameters, dict(study.noise), study.measurement, known)).encode())
        for record in (*study.recordings, *study.holdout):
            found.update(repr((record.name, record.columns)).encode())
            for values in (record.time, record.values, record.ctrl):
                found.update(np.ascontiguousarray(values).tobytes())
        return found.hexdigest()

    def fields(
        self, psi: Float[np.ndarray, "sims psi"], names: Sequence[str]
    ) -> dict[str, Float[np.ndarray, "sims ..."]]:
        """Model fields of each simulation; `names` are the recordings they follow, whose known fields win over psi."""
        out = {k: np.broadcast_to(v, (len(psi), *v.shape)).copy() for k, v in self._base.items()}
        for j, where in enumerate(self.addresses):
            for place in where.places:
                out[where.field][(slice(None), *place)] = psi[:, j]
        stems = np.asarray(names)
        for stem, table in self.study.known.items():
            rows = np.flatnonzero(stems == stem)
            for target, value in table.items():
                where = self._known[target]
                flat = (
                    np.broadcast_to(np.ravel(value), (len(where.places),)) if np.size(value) == 1 else np.ravel(value)
                )
                for place, component in zip(where.places, flat, strict=True):
                    out[where.field][(rows, *place)] = component
        return out

    def rollout(self, request: Request) -> Float[np.ndarray, "sims samples columns"]:
        """Predictions of the engine."""
        return self.engine.rollout(request)

    def elements(self, kind: str, columns: tuple[str, ...]) -> list[Element]:
        """The model's elements of a kind that an effect can sit on."""
        if kind == "body":
            return elements.body_elements(self.model, self._resized)
        if kind == "world":
            varied = {a.field for a in (*self.addresses, *self._known.values())}
            return elements.world_elements(self.model, varied)
        if kind == "sensor":
            return elements.sensor_elements(self.model, columns)
        if kind == "joint":
            return elements.joint_elements(self.model, _reached(self.study))
        if kind == "actuator":
            return elements.actuator_elements(self.model)
        if kind == "contact":
            return []  # which geoms touch is seen in recordings alone: `engines.contacts`
        return [Element("simulator", "option")] if kind == "simulator" else []

    @property
    def _resized(self) -> frozenset[int]:
        """Bodies with a geom whose size is known to differ between recordings."""
        places = (place for a in self._known.values() if a.field == "geom_size" for place in a.places)
        return frozenset(int(self.model.geom_bodyid[place[0]]) for place in places)


def _reached(study: Study) -> dict[str, tuple[float, float]]:
    """The least and the largest recorded position of each column of one, by what it is named after."""
    found: dict[str, tuple[float, float]] = {}
    for record in study.recordings:
        for name, values in zip(record.columns, record.values.T, strict=True):
            if name.startswith("qpos/") and np.isfinite(values).any():
                low, high = found.get(name[5:], (np.inf, -np.inf))
                found[name[5:]] = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
    return found


def _make_engine(model: mujoco.MjModel, name: str, num_threads: int) -> Engine:
    if name == "c":
        return MujocoC(model, num_threads)
    if name == "mjx":
        from det2stoc_bayes.engines.mjx import Mjx

        return Mjx(model)
    raise EngineError(f"engine: unknown engine '{name}'; allowed: c, mjx")


def model_field(model: mujoco.MjModel, name: str) -> np.ndarray:
    """A field by the name it has in `mujoco.batch`, as `dof_damping` or `opt.gravity`."""
    holder, _, leaf = name.rpartition(".")
    return np.asarray(getattr(model.opt if holder == "opt" else model, leaf))


def address(model: mujoco.MjModel, target: Target, index: tuple[int, ...] | None) -> FieldAddress:
    """Where a validated target's components are in the model's arrays."""
    field = field_of(target.kind, target.field)
    values = model_field(model, field)
    if target.kind == "opt":
        places = [()] if values.ndim == 0 else [(i,) for i in (index or range(values.shape[0]))]
        return FieldAddress(field, tuple(places))
    rows = rows_of(model, target.kind, target.name, target.field)
    inner = list(np.ndindex(values.shape[1:]))
    chosen = [inner[i] for i in index] if index is not None else inner
    return FieldAddress(field, tuple((int(row), *component) for row in rows for component in chosen))
