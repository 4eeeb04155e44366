"""What MJX cannot simulate: it drops much of it without a word, so that it is refused here, by name."""

import contextlib
import io
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from det2stoc_bayes.engines.mjx_model import COMPILED
from det2stoc_bayes.errors import EngineError
from det2stoc_bayes.mismatch.effects.base import PlacedEffect

# Arrays of mjx.Model that its dynamics never read.
_IGNORED = {
    "dof_dampingpoly",
    "jnt_stiffnesspoly",
    "tendon_stiffnesspoly",
    "tendon_dampingpoly",
    "actuator_cranklength",
}
_GEOMETRY = {"body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0"}
_OPTIONS = {"gravity", "wind", "magnetic", "density", "viscosity", "impratio"}
_Fault = tuple[str, str]


def check_supported(model: mujoco.MjModel) -> None:
    """Raise EngineError for the first thing in the model that MJX would leave out or simulate otherwise."""
    for checks in (_options, _passive, _actuators, _contacts, _sensors):
        for what, allowed in checks(model):
            raise EngineError(f"mjx: {what}; allowed: {allowed}, or the engine c")
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    try:
        mjx.make_data(mjx.put_model(model))
    except NotImplementedError as error:
        raise EngineError(f"mjx: {_one_line(error)}; allowed: what MJX implements, or the engine c") from error


def check_fields(model: mujoco.MjModel, fields: Sequence[str]) -> None:
    """Raise EngineError where a model field cannot vary from simulation to simulation."""
    arrays = _arrays()
    for name in fields:
        holder, _, leaf = name.rpartition(".")
        if (leaf in _OPTIONS) if holder == "opt" else (name in arrays and name not in _IGNORED):
            if name in _GEOMETRY and (model.ntendon or model.neq):
                raise EngineError(
                    f"mjx: {name} varies, and tendons or equality constraints depend on it; "
                    "allowed: fixed geometry, or the engine c"
                )
            continue
        raise EngineError(
            f"mjx: {name} cannot vary or has no effect; allowed: fields that MJX reads as arrays "
            "(mass, inertia, damping, friction, gravity ...), or the engine c"
        )


def check_effect(model: mujoco.MjModel, placed: PlacedEffect) -> None:
    """Raise EngineError for an effect that has no way into MJX."""
    effect = placed.effect
    if effect.changes and effect.in_mjx_fields:
        check_fields(model, [name for name in effect.changes if name not in ("opt.timestep", *COMPILED)])
    elif effect.changes and not effect.uses("joint_force"):
        raise EngineError(f"mjx: effect {placed.label} changes fields as MJX cannot; allowed: the engine c")


def _arrays() -> frozenset[str]:
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return frozenset(f.name for f in mjx.Model.fields() if "jax.Array" in str(f.type))


def _options(m: mujoco.MjModel) -> Iterator[_Fault]:
    integrator = mujoco.mjtIntegrator(m.opt.integrator)
    if integrator in (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_DISCRETE):
        yield (
            f"option integrator={integrator.name[6:].lower()} is not implemented",
            "Euler, RK4, implicitfast",
        )
    if mujoco.mjtSolver(m.opt.solver) == mujoco.mjtSolver.mjSOL_PGS:
        yield "option solver=PGS is not implemented", "Newton, CG"
    if m.opt.noslip_iterations:
        yield f"option noslip_iterations={m.opt.noslip_iterations} is dropped", "0"
    fluid = m.opt.density > 0 or m.opt.viscosity > 0 or m.opt.wind.any()
    if fluid and integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST:
        yield (
            "option density, viscosity or wind with integrator=implicitfast is not implemented",
            "Euler, RK4",
        )
    off = [
        bool(m.opt.disableflags & f) for f in (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
    ]
    if off[0] != off[1]:
        yield (
            f"option flag {'spring' if off[0] else 'damper'}=disable drops every passive force",
            "both or neither disabled",
        )
    if m.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        yield "option flag sleep=enable is dropped", "disable"
    if m.nflex:
        yield f"flex {_name(m, mujoco.mjtObj.mjOBJ_FLEX, 0)} is not implemented", "rigid bodies"
    if m.nplugin:
        yield "plugins are dropped", "models without plugins"


def _passive(m: mujoco.MjModel) -> Iterator[_Fault]:
    for field, what, allowed in (
        ("dof_dampingpoly", "polynomial damping", "linear damping"),
        ("jnt_stiffnesspoly", "polynomial stiffness", "linear stiffness"),
    ):
        for i in _rows(getattr(m, field)):
            joint = int(m.dof_jntid[i]) if field.startswith("dof") else i
            yield f"joint {_name(m, mujoco.mjtObj.mjOBJ_JOINT, joint)} has {what}, which is dropped", allowed
    for field, what, allowed in (
        ("tendon_dampingpoly", "polynomial damping", "linear damping"),
        ("tendon_stiffnesspoly", "polynomial stiffness", "linear stiffness"),
    ):
        for i in _rows(getattr(m, field)):
            yield f"tendon {_name(m, mujoco.mjtObj.mjOBJ_TENDON, i)} has {what}, which is dropped", allowed
    for i in _rows(m.geom_fluid[:, 0] > 0):
        yield (
            f"geom {_name(m, mujoco.mjtObj.mjOBJ_GEOM, i)} has fluidshape=ellipsoid, which is dropped",
            "fluidshape=none (the inertia-box model)",
        )


def _actuators(m: mujoco.MjModel) -> Iterator[_Fault]:
    def named(i: int) -> str:
        return f"actuator {_name(m, mujoco.mjtObj.mjOBJ_ACTUATOR, i)}"

    for field, what in (
        ("armature", "armature"),
        ("damping", "damping"),
        ("dampingpoly", "polynomial damping"),
    ):
        for i in _rows(getattr(m, f"actuator_{field}")):
            yield (
                f"{named(i)} has {what}, which is dropped",
                f"{what} of the joint" if field != "dampingpoly" else "none",
            )
    for i in _rows(m.actuator_delay):
        yield f"{named(i)} has a delay, which is dropped", "no delay (the effect actuator_delay works)"
    for i in _rows(m.actuator_historyadr >= 0):
        yield f"{named(i)} keeps a history of controls, which is dropped", "nsample=0"
    for i in _rows(m.actuator_actearly):
        yield f"{named(i)} has actearly=true, which is dropped", "actearly=false"
    for i in _rows(m.actuator_ctrlnum != 1):
        yield f"{named(i)} has {m.actuator_ctrlnum[i]} controls", "one control"
    group = np.clip(m.actuator_group, 0, 30)
    for i in _rows(m.opt.disableactuator & (1 << group)):
        yield f"{named(i)} is in a disabled group, which is dropped", "no actuatorgroupdisable"
    for enum, what, values, known in (
        (mujoco.mjtTrn, "transmission", m.actuator_trntype, "JOINT JOINTINPARENT TENDON SITE"),
        (mujoco.mjtDyn, "dynamics", m.actuator_dyntype, "NONE INTEGRATOR FILTER FILTEREXACT MUSCLE"),
        (mujoco.mjtGain, "gain", m.actuator_gaintype, "FIXED AFFINE MUSCLE"),
        (mujoco.mjtBias, "bias", m.actuator_biastype, "NONE AFFINE MUSCLE"),
    ):
        for i, value in enumerate(values):
            label = enum(value).name.split("_", 1)[1]
            if label not in known.split():
                yield (
                    f"{named(i)} has {what} {label.lower()}, not implemented",
                    known.lower().replace(" ", ", "),
                )


def _contacts(m: mujoco.MjModel) -> Iterator[_Fault]:
    for field, what in (("adhesion", "adhesion"), ("surfacevel", "surface velocity")):
        for i in _rows(getattr(m, f"geom_{field}")):
            yield f"geom {_name(m, mujoco.mjtObj.mjOBJ_GEOM, i)} has {what}, which is dropped", "none"
    for i in _rows(m.pair_adhesion):
        yield f"pair {_name(m, mujoco.mjtObj.mjOBJ_PAIR, i)} has adhesion, which is dropped", "none"
    for i in range(m.nnumeric):
        if (name := _name(m, mujoco.mjtObj.mjOBJ_NUMERIC, i)) in ("max_contact_points", "max_geom_pairs"):
            yield f"numeric {name} drops contacts that the C engine keeps", "a model without it"
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco.mjx._src import collision_driver
    flat = {mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD}
    for a, b in ((int(a), int(b)) for a, b, _ in collision_driver.geom_pairs(m)):
        kinds = [mujoco.mjtGeom(m.geom_type[g]) for g in (a, b)]
        where = " and ".join(
            f"{_name(m, mujoco.mjtObj.mjOBJ_GEOM, g)} ({k.name[7:].lower()})"
            for g, k in zip((a, b), kinds, strict=True)
        )
        if not collision_driver.has_collision_fn(*m.geom_type[[a, b]]):
            yield (
                f"geoms {where} can touch, a collision that is not implemented",
                "other shapes, such as a convex mesh",
            )
        if m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and flat & set(kinds):
            yield (
                f"geoms {where} can touch with cone=elliptic, whose derivatives are not finite",
                "cone=pyramidal",
            )


def _sensors(m: mujoco.MjModel) -> Iterator[_Fault]:
    for i in range(m.nsensor):
        name = f"sensor {_name(m, mujoco.mjtObj.mjOBJ_SENSOR, i)}"
        if m.sensor_delay[i] or m.sensor_interval[i, 0] or m.sensor_historyadr[i] >= 0:
            yield f"{name} has a delay, interval or history, which is dropped", "a sensor of the present"
        kind = mujoco.mjtSensor(m.sensor_type[i])
        with contextlib.redirect_stdout(io.StringIO()):
            from mujoco.mjx._src.types import SensorType
        if int(kind) not in {int(s) for s in SensorType}:
            yield (
                f"{name} is of type {kind.name[7:].lower()}, not implemented",
                ", ".join(s.name.lower() for s in SensorType),
            )
        camera = m.sensor_objtype[i] != mujoco.mjtObj.mjOBJ_SITE or m.sensor_dim[i] != 1
        if kind == mujoco.mjtSensor.mjSENS_RANGEFINDER and camera:
            yield f"{name} reads more than one distance, which is dropped", "a site's distance alone"
    # Equality constraints, tendon wrapping, contact sensors and the rest raise in put_model.


def _rows(values: np.ndarray) -> list[int]:
    """Indices of rows that are not all zero."""
    return np.flatnonzero((values != 0).any(axis=tuple(range(1, values.ndim)))).tolist()


def _name(m: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(m, kind, index) or f"{index} (unnamed)"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
