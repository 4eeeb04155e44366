"""A study's recordings as transitions, and simulated ones like them: what amortized methods learn from.

A state is what a sample shows. What else a change is predicted from is the action: the mean command until the next
sample, how the state has changed since the one before (where some speed was not recorded), what is known of the
recording, and the time that passes where it is uneven.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.base import Request
from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.likelihood import align_quaternions
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.recording import Recording
from det2stoc_bayes.segments import Segments, from_pieces, mean_commands
from det2stoc_bayes.starts import StartGuess, guess_starts
from det2stoc_bayes.transitions import Transitions

NUM_TRANSITIONS = 100  # of a recording of median length
STRETCH = 10  # transitions that one simulation gives
FEWEST = 5  # transitions of the shortest recording
LEAST_WHOLE = 0.9  # of simulations: what is learned is learned from those that do not diverge
START_SPREAD = 0.2  # of a coordinate's variation: simulations start about recorded states
EVEN = 1e-6  # of a time step: less is rounding


@dataclass(frozen=True, eq=False)
class StudyTransitions:
    """How a problem's samples are read as transitions."""

    problem: Problem
    every: int  # samples from one state to the next

    @classmethod
    def of(cls, problem: Problem) -> "StudyTransitions":
        """As many samples a step as leave about NUM_TRANSITIONS steps a recording, and FEWEST of the shortest.

        MethodNotApplicable: simulations could not start within a recording, or noise is not Gaussian.
        """
        _refuse(problem)
        study = problem.simulator.study
        every = round(float(np.median([len(r.time) for r in study.recordings])) / NUM_TRANSITIONS)
        shortest = min(len(r.time) for r in (*study.recordings, *study.holdout))
        return cls(problem, max(1, min(every, (shortest - 1) // FEWEST)))

    @property
    def columns(self) -> tuple[str, ...]:
        """What a state consists of."""
        return self.problem.segments.columns

    @cached_property
    def inputs(self) -> tuple[str, ...]:
        """What an action consists of, in order."""
        names = self.problem.simulator.study.names.actuators
        commands = [f"ctrl/{name or i}" for i, name in enumerate(names)]
        before = [f"{c} before" for c in commands] + [f"change of {c} before" for c in self.columns]
        known = [f"known {i}" for i in range(self._known([self.problem.segments.recordings[0].name]).shape[1])]
        steps = ["time step", *(["time step before"] if self.remembers else [])] if self.uneven else []
        return (*commands, *(before if self.remembers else []), *known, *steps)

    @cached_property
    def seconds(self) -> float:
        """From one state to the next; their mean where that is uneven."""
        recordings = self.problem.segments.recordings
        return float(np.concatenate([np.diff(r.time[:: self.every]) for r in recordings]).mean())

    @cached_property
    def remembers(self) -> bool:
        """Whether a state says too little of the motion by itself: some speed was not recorded."""
        speeds = {c for c in self.problem.simulator.study.names.columns if c.startswith("qvel/")}
        return not speeds <= set(self.columns)

    @cached_property
    def uneven(self) -> bool:
        """Whether states are not equally far apart in time."""
        study = self.problem.simulator.study
        steps = np.concatenate([np.diff(r.time[:: self.every]) for r in (*study.recordings, *study.holdout)])
        return bool(np.ptp(steps) > EVEN * steps.mean())

    def recorded(self, recordings: Sequence[Recording] | None = None) -> Transitions:
        """Transitions of recordings, by default the problem's own; their episodes count the recordings."""
        recordings = self.problem.segments.recordings if recordings is None else recordings
        segments = self._cut(recordings, None)
        found = self._rows(segments, segments.values, np.arange(segments.count), segments.recording)
        empty = [r.name for i, r in enumerate(recordings) if not (found.episode == i).any()]
        if empty:
            raise MethodNotApplicable(
                f"{empty[0]}: no successive samples ({self.every} apart) have all of {', '.join(self.columns)}; "
                "allowed: a method that simulates whole recordings, as nuts or laplace"
            )
        return found

    def recorded_by_stretch(self) -> Transitions:
        """The same of the problem's own recordings, as far as stretches tell; episodes count the stretches."""
        segments = self.stretches
        each = np.arange(segments.count)
        return self._rows(segments, segments.values, each, each)

    @cached_property
    def stretches(self) -> Segments:
        """The recordings cut where simulations start."""
        return self._cut(self.problem.segments.recordings, STRETCH)

    @cached_property
    def starts(self) -> StartGuess:
        """Where the stretches begin."""
        return guess_starts(self.problem.simulator.model, self.stretches)

    def simulated(self, psi: Float[np.ndarray, "sims psi"], random: np.random.Generator) -> Transitions:
        """Transitions under the given psi, measurement noise included; simulations start where recordings were.

        SimulationDiverged: too many of them do not stay finite.
        """
        problem, segments, guess = self.problem, self.stretches, self.starts
        simulator = problem.simulator
        which = np.resize(random.permutation(segments.count), len(psi))
        states = guess.scale.shape[0]
        scatter = START_SPREAD * guess.scale * random.standard_normal((len(psi), states))
        start = problem.moved(guess.start[which], scatter)
        names = [segments.recordings[segments.recording[w]].name for w in which]
        fields = simulator.fields(psi, names)
        predicted = simulator.rollout(Request(segments, which, start, fields, (), problem.timestep, problem.integrator))
        whole = np.isfinite(predicted).all((1, 2))
        if whole.mean() < LEAST_WHOLE:
            bad = psi[~whole]
            ranges = ", ".join(
                f"{p.name} {low:.3g} to {high:.3g}"
                for p, low, high in zip(simulator.parameters, bad.min(0), bad.max(0), strict=True)
            )
            raise SimulationDiverged(
                f"{(~whole).mean():.0%} of the simulations to learn from diverge (there: {ranges}); "
                f"allowed: at most {1 - LEAST_WHOLE:.0%}, by narrower priors or a finer timestep"
            )
        predicted = np.where(whole[:, None, None], predicted, np.nan)  # what led there is no ordinary motion either
        recorded = predicted + problem.noise * random.standard_normal(predicted.shape)
        recorded = align_quaternions(recorded, segments.values[which], problem.quaternions)
        for group in problem.quaternions:  # those that were read have unit length
            recorded[..., group] /= np.linalg.norm(recorded[..., group], axis=-1, keepdims=True)
        return self._rows(segments, recorded, which, np.arange(len(psi)))

    def _cut(self, recordings: Sequence[Recording], length: int | None) -> Segments:
        """Every `every`-th sample of recordings, in stretches of about `length` steps that share their ends."""
        pieces: list[tuple[int, int, int]] = []
        for r, record in enumerate(recordings):
            steps = (len(record.time) - 1) // self.every
            parts = 1 if length is None else max(1, round(steps / length))
            edges = np.linspace(0, steps, parts + 1).round().astype(int) * self.every
            pieces += [(r, int(a), int(b) + 1) for a, b in zip(edges[:-1], edges[1:], strict=True) if b > a]
        if not pieces:
            raise MethodNotApplicable(f"no recording has more than {self.every} samples; allowed: longer recordings")
        return from_pieces(recordings, pieces, self.columns, every=self.every)

    def _rows(
        self,
        segments: Segments,
        values: Float[np.ndarray, "rows samples columns"],
        which: Int[np.ndarray, " rows"],
        episode: Int[np.ndarray, " rows"],
    ) -> Transitions:
        """All transitions between finite values, row by row."""
        first = int(self.remembers)
        time, last = segments.time[which], segments.lengths[which] - 1
        state, change = values[:, first:-1], np.diff(values, axis=1)
        given = [self._commands(segments)[which]]
        if self.remembers:
            given = [given[0][:, 1:], given[0][:, :-1], change[:, :-1]]
        change = change[:, first:]
        known = self._known([segments.recordings[r].name for r in segments.recording])[which]
        given.append(np.repeat(known[:, None], state.shape[1], 1))
        if self.uneven:
            steps = np.diff(time, axis=1)
            given += [steps[:, first:, None], *([steps[:, :-1, None]] if self.remembers else [])]
        action = np.concatenate(given, -1)
        place = np.arange(first, values.shape[1] - 1)
        whole = (place < last[:, None]) & np.isfinite(np.concatenate([state, change, action], -1)).all(-1)
        owner = np.broadcast_to(episode[:, None], whole.shape)
        return Transitions(state[whole], action[whole], change[whole], owner[whole])

    def _commands(self, segments: Segments) -> Float[np.ndarray, "segments steps ctrl"]:
        """Mean commands between samples."""
        rows = []
        for r, time in zip(segments.recording, segments.time, strict=True):
            rows.append(mean_commands(segments.recordings[r], time[None, :-1], time[None, 1:])[0])
        return np.stack(rows)

    def _known(self, names: Sequence[str]) -> Float[np.ndarray, "recordings known"]:
        """What is known of recordings, as far as it differs between those of the study."""
        study = self.problem.simulator.study
        of_all = self._fields([r.name for r in (*study.recordings, *study.holdout)])
        return self._fields(names)[:, np.ptp(of_all, axis=0) > 0]

    def _fields(self, names: Sequence[str]) -> Float[np.ndarray, "recordings fields"]:
        simulator = self.problem.simulator
        fields = simulator.fields(np.tile(simulator.believed, (len(names), 1)), names)
        return np.concatenate([np.zeros((len(names), 0)), *(v.reshape(len(names), -1) for v in fields.values())], 1)


def _refuse(problem: Problem) -> None:
    """What transitions cannot be simulated like: states that no sample tells, and noise with heavy tails."""
    simulator = problem.simulator
    allowed = "allowed: a method that simulates whole recordings, as nuts or laplace"
    if simulator.model.na:
        raise MethodNotApplicable(f"the model's actuators have states, which no sample tells; {allowed}")
    if not problem.guess.seen.all():
        raise MethodNotApplicable(f"some joint's position is not recorded; {allowed}")
    if problem.measurement.degrees_of_freedom is not None:
        raise MethodNotApplicable(f"noise is student_t, and learned likelihoods are Gaussian; {allowed}")
