"""Which geoms touch, in states of a simulation."""

from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from det2stoc_bayes.mismatch.effects.base import Element

if TYPE_CHECKING:
    from det2stoc_bayes.problem import Problem

MOST = 400  # states that are looked at


def touching(
    model: mujoco.MjModel, qpos: Float[np.ndarray, "states nq"]
) -> tuple[list[tuple[int, int]], Bool[np.ndarray, "states pairs"]]:
    """Pairs of geoms (lower number first) that touch in some of the states, and in which."""
    data, found = mujoco.MjData(model), []
    for state in qpos:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        geoms = data.contact.geom
        found.append({(int(min(a, b)), int(max(a, b))) for a, b in geoms if min(a, b) >= 0})
    pairs = sorted(set().union(*found)) if found else []
    return pairs, np.array([[p in one for p in pairs] for one in found], bool).reshape(len(found), len(pairs))


def share_in_contact(problem: "Problem") -> float:
    """Share of states in the recordings' short predictions in which something touches; 0 where nothing can."""
    model = problem.simulator.model
    if not may_touch(model):
        return 0.0
    qpos = predicted_states(problem, np.zeros(problem.size)).reshape(-1, model.nq)
    chosen = qpos[:: max(1, len(qpos) // MOST)]
    chosen = chosen[np.isfinite(chosen).all(1)]
    pairs, there = touching(model, chosen)
    return float(there.any(1).mean()) if pairs and len(chosen) else 0.0


def predicted_states(problem: "Problem", z: np.ndarray) -> Float[np.ndarray, "segments samples nq"]:
    """Positions along every segment."""
    request = problem.request(z[None], problem.guess.start)
    return problem.simulator.engine.trajectory(request).qpos


def pair_name(model: mujoco.MjModel, pair: tuple[int, int]) -> str:
    """Both geoms' names in alphabetical order; their bodies' where a geom has none."""

    def name(geom: int) -> str:
        own = model.geom(geom).name
        return own or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"

    return "/".join(sorted((name(pair[0]), name(pair[1]))))


def contact_elements(model: mujoco.MjModel, pairs: list[tuple[int, int]]) -> list[Element]:
    """An element for each pair that touches; the geom that touches fewer, or stands still, is the one to be changed.

    `body`, `qpos`, `dof`: of the free body that takes part, if any. Traits: paired (an explicit pair in the
    model), free, timed (solref is a time constant and a damping ratio), named (both geoms).
    """
    explicit = {
        (int(min(a, b)), int(max(a, b))): k
        for k, (a, b) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))
    }
    often = np.bincount(np.ravel(pairs).astype(int), minlength=model.ngeom) if pairs else np.zeros(model.ngeom)
    out = []
    for pair in pairs:
        moves = [bool(model.body_weldid[model.geom_bodyid[g]]) for g in pair]
        changed = min(range(2), key=lambda i: (often[pair[i]], moves[i]))
        geoms = (pair[1 - changed], pair[changed])
        body = next((int(model.geom_bodyid[g]) for g, m in zip(pair, moves, strict=True) if m), -1)
        at = Element("contact", pair_name(model, pair), geoms=geoms, pair=explicit.get(pair, -1), body=body)
        joint = int(model.body_jntadr[body]) if body >= 0 else -1
        free = joint >= 0 and model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)
        if free:
            at = replace(at, dof=int(model.jnt_dofadr[joint]), qpos=int(model.jnt_qposadr[joint]))
        alone = free and not all(moves)
        solref = model.pair_solref[[at.pair]] if at.pair >= 0 else model.geom_solref[list(pair)]
        named = all(model.geom(g).name and "/" not in model.geom(g).name for g in pair)
        has = {"paired": at.pair >= 0, "free": alone, "timed": (solref[:, 0] > 0).all(), "named": named}
        traits = {trait for trait, on in has.items() if on}
        at = replace(at, geom_names=tuple(model.geom(g).name for g in geoms) if named else ())
        out.append(replace(at, traits=frozenset(traits)))
    return out


def may_touch(model: mujoco.MjModel) -> bool:
    """Whether anything could touch: not where contacts are disabled."""
    kinds = model.geom_contype[:, None] & model.geom_conaffinity[None, :]
    return bool(model.nflex or model.npair or (kinds.any() and model.ngeom > 1)) and not bool(
        model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    )
