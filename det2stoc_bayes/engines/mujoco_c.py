"""The C engine: many simulations at once on all cores through `mujoco.batch`."""

import copy
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import astuple, replace
from threading import Event, Lock

import mujoco
import numpy as np
from jaxtyping import Float, Int
from joblib import cpu_count

from det2stoc_bayes.engines.base import Counter, Request, Trajectory
from det2stoc_bayes.engines.contacts import may_touch
from det2stoc_bayes.engines.mujoco_chunk import Chunk, num_before
from det2stoc_bayes.engines.mujoco_steps import is_stepped
from det2stoc_bayes.engines.quiet import QUIET, UNTIMED

MAX_SIMULATIONS = 4096
MAX_PERSISTENT = 512  # simulations that keep an MjData each (some 10 KB),
MAX_TOUCHING = 96  # and where bodies may touch (some 25 KB) for each thread: of more none stays in a cache
MAX_RECORDED = 24_000_000  # numbers held at once by each thread of Python: about 200 MB
WORKING = 8  # numbers a step that what acts on commands takes beside
HALT: ContextVar[Event | None] = ContextVar("halt", default=None)  # once set, no simulation begins: CancelledError
_COUNTING = Lock()


class MujocoC:
    """Batched simulation in C. Forces that depend on the state are held over a timestep."""

    name = "c"

    def __init__(self, model: mujoco.MjModel, num_threads: int = 0):
        self._models: dict[tuple[float | None, str | None], mujoco.MjModel] = {(None, None): _prepared(model)}
        self.threads = num_threads or cpu_count()
        self.users = 1  # threads of Python that simulate at once
        self.counter = Counter()

    @contextmanager
    def shared_by(self, users: int) -> Iterator[None]:
        """So many threads of Python simulate at once, and share the cores."""
        self.users = users
        try:
            yield
        finally:
            self.users = 1

    def rollout(self, request: Request) -> Float[np.ndarray, "sims samples columns"]:
        """Predicted values at the sample times; NaN where a simulation diverged."""
        return self.trajectory(request, states=False).columns

    def trajectory(self, request: Request, *, states: bool = True) -> Trajectory:
        """Predicted values and states at the sample times.

        Simulations that are stepped one by one, or have forces on bodies, run apart: others need not wait for them.
        """
        ways = _ways(request)
        groups = [np.flatnonzero(ways == way) for way in np.unique(ways)]
        if len(groups) < 2 or any(np.ptp(ways[e.rows]) for e in request.effects if len(ways[e.rows])):
            return self._in_chunks(request, states)
        parts = [self._in_chunks(_only(request, rows), states) for rows in groups]
        back = np.argsort(np.concatenate(groups))
        return Trajectory(*(x[back] for x in astuple(_joined(parts))))

    def _in_chunks(self, request: Request, states: bool) -> Trajectory:
        """Chunks that fit in memory, one after the other."""
        model = self._model(request.timestep, request.integrator)
        steps = request.segments.steps(model.opt.timestep)[request.which]
        acting = any(e.placed.effect.uses("control") for e in request.effects)
        width = model.nq + model.nv + model.nu + model.nsensordata + WORKING * acting
        threads = max(self.threads // self.users, 1)
        most = MAX_SIMULATIONS
        if any(e.placed.effect.uses("body_force") for e in request.effects):
            most = MAX_TOUCHING * threads if may_touch(model) else MAX_PERSISTENT
        length = steps.max(initial=1) + num_before(request.effects, model.opt.timestep)
        size = int(np.clip(MAX_RECORDED // (width * length), 1, most))
        parts = []
        for begin in range(0, len(steps), size):
            if (halt := HALT.get()) is not None and halt.is_set():
                raise CancelledError
            rows = slice(begin, min(begin + size, len(steps)))
            with QUIET, UNTIMED:
                parts.append(Chunk(model, request, rows, int(steps[rows].max()), threads).run(states))
            with _COUNTING:
                self.counter.simulations += rows.stop - rows.start
                self.counter.steps += (rows.stop - rows.start) * int(steps[rows].max())
        return parts[0] if len(parts) == 1 else _joined(parts)

    def _model(self, timestep: float | None, integrator: str | None) -> mujoco.MjModel:
        key = (timestep, integrator)
        if key not in self._models:
            model = copy.copy(self._models[None, None])
            if timestep is not None:
                model.opt.timestep = timestep
            if integrator is not None:
                model.opt.integrator = mujoco.mjtIntegrator.__members__[f"mjINT_{integrator.upper()}"]
            self._models[key] = model
        return self._models[key]


def _joined(parts: Sequence[Trajectory]) -> Trajectory:
    return Trajectory(*(np.concatenate(x) for x in zip(*map(astuple, parts), strict=True)))


def _ways(request: Request) -> Int[np.ndarray, " sims"]:
    """How each simulation has to be run: 0 in C alone, 1 step by step, 2 with bodies placed before each step."""
    ways = np.zeros(len(request.which), int)
    for e in request.effects:
        way = 2 if e.placed.effect.uses("body_force") else int(is_stepped(e))
        ways[e.rows] = np.maximum(ways[e.rows], way)
    return ways


def _only(request: Request, rows: Int[np.ndarray, " rows"]) -> Request:
    """Some simulations of a request; those of an effect are all among them, or none is."""
    place = np.full(len(request.which), -1)
    place[rows] = np.arange(len(rows))
    effects = []
    for e in request.effects:
        begin = place[e.rows.start] if e.rows.stop > e.rows.start else -1
        if begin >= 0:
            effects.append(replace(e, rows=slice(int(begin), int(begin) + e.rows.stop - e.rows.start)))
    fields = {name: values[rows] for name, values in request.fields.items()}
    return replace(request, which=request.which[rows], start=request.start[rows], fields=fields, effects=tuple(effects))


def _prepared(model: mujoco.MjModel) -> mujoco.MjModel:
    # A simulation that diverges must stay diverged, not start again from qpos0.
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if not may_touch(model):  # MuJoCo would look for contacts at every step: a tenth of its time
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    sleeps = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP)
    if model.ntree == 1 and not sleeps:  # one tree is one island: finding it takes a sixth of a step in contact
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model
