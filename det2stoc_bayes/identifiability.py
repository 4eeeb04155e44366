"""What a study's recordings can and cannot identify, from one quick fit."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.engines.free_flight import Fall, falls
from det2stoc_bayes.errors import SimulationDiverged
from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact.run import fit_believed, touches
from det2stoc_bayes.mismatch.evidence import whitened
from det2stoc_bayes.mismatch.horizon import LARGEST_ERROR, climb
from det2stoc_bayes.mismatch.open_equivalences import open_equivalences
from det2stoc_bayes.mismatch.refine import counted
from det2stoc_bayes.optimize import Fit
from det2stoc_bayes.problem import Problem, make_problem
from det2stoc_bayes.recording import Recording, StudyWarning
from det2stoc_bayes.simulator import Simulator
from det2stoc_bayes.study import Study

IDENTIFIABLE, WEAK = 0.3, 0.9  # posterior sd over prior sd, both of the standard-normal unknown: below it
FAR = 5.0  # noise sds of rms residual: less is no reason to doubt the recording
STILL = 1e-12  # spread over magnitude: that of a constant, but for rounding
ENTANGLED = 0.95  # correlation beyond which two unknowns are found together only

type Verdict = Literal["identifiable", "weak", "not identifiable"]
type Role = Literal["recording", "holdout"]
type Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class CheckedParameter:
    """A psi after the quick fit; `sd_ratio` is its posterior sd over its prior sd."""

    name: str
    mean: float
    sd: float
    sd_ratio: float
    verdict: Verdict
    entangled: tuple[str, ...]  # with these its value can be traded


@dataclass(frozen=True)
class CheckedRecording:
    """A recording; `misfit` is the rms of recorded minus simulated in noise sds, None if not simulated."""

    name: str
    role: Role
    samples: int
    seconds: float
    columns: tuple[str, ...]
    misfit: float | None


@dataclass(frozen=True)
class CheckedColumn:
    """A measured column and 1 sd of its noise, given by the study or estimated from its scatter."""

    name: str
    noise: float
    given: bool


@dataclass(frozen=True)
class Check:
    """All of it. The misfit is that of psi at its prior's median, before anything was fitted."""

    study: Study
    parameters: tuple[CheckedParameter, ...]
    recordings: tuple[CheckedRecording, ...]
    columns: tuple[CheckedColumn, ...]
    noise_inflation: float  # mean squared whitened residual of the quick fit
    alike: tuple[tuple[str, ...], ...]  # effects that these recordings could not tell apart, were they there
    absorbed: tuple[str, ...]  # effects that would pass as psi
    contact: bool = False  # bodies touch: simulations follow the recordings, and effects are not compared
    falls: tuple[Fall, ...] = ()  # of free bodies that touch nothing for a while


def check(study: Study, *, progress: Progress = lambda *_: None) -> Check:
    """Simulate each recording once, then fit psi quickly; SimulationDiverged where nothing stays finite."""
    progress("simulating each recording at the prior's median", 0, 1)
    problem = make_problem(Simulator(study))
    misfit = _misfit(problem)
    progress("simulating each recording at the prior's median", 1, 1)
    columns = problem.segments.columns
    noise = tuple(CheckedColumn(c, float(sd), c in study.noise) for c, sd in zip(columns, problem.noise, strict=True))
    rows = _recordings(study, misfit)
    progress("fitting psi quickly", 0, 1)
    if touches(problem):
        followed = fit_believed(problem, hold_out=False).fit
        progress("fitting psi quickly", 1, 1)
        _warn_led(columns, followed.scales.values)
        found = _parameters(followed.problem, followed.z, followed.covariance)
        return Check(study, found, rows, noise, followed.noise_inflation, (), (), True, falls(problem))
    fit = climb(problem)
    if fit is None:
        raise SimulationDiverged(
            f"{study.model_path}: the simulation diverges from every recorded start; allowed: one that stays "
            "finite (check units, the timestep and the recordings' first samples)"
        )
    progress("fitting psi quickly", 1, 1)
    _warn(fit)
    alike, absorbed = _open(fit, progress)
    found = _parameters(fit.problem, fit.point.z, fit.covariance)
    return Check(study, found, rows, noise, float(fit.noise_inflation), alike, absorbed)


def _open(fit: Fit, progress: Progress) -> tuple[tuple[tuple[str, ...], ...], tuple[str, ...]]:
    """Labels of effects that stay open."""
    pool = candidates(fit.problem)
    found = open_equivalences(fit, pool, counted(progress, "comparing effects", len(pool)))
    return tuple(tuple(p.label for p in g) for g in found.groups), tuple(p.label for p in found.absorbed)


def _warn(fit: Fit) -> None:
    """A fit that stalled; recordings that it is far from, over stretches as long as it can be asked to predict."""
    if fit.end == "stalled":
        told = "the quick fit stalled where its steps promise more than they give, as about rest or a contact"
        warnings.warn(f"psi: {told}: means and sds are rough", StudyWarning, stacklevel=3)
    segments, noise = fit.problem.segments, fit.problem.noise
    errors, spread = whitened(fit) * noise, np.nanstd(segments.values, axis=(0, 1))
    moves = spread > STILL * np.nanmax(np.abs(segments.values), axis=(0, 1))
    for r, recording in enumerate(segments.recordings):
        own = errors[segments.recording == r]
        seen = np.isfinite(own).any((0, 1))
        rms = np.sqrt(np.nanmean(np.where(seen, own, 0.0) ** 2, axis=(0, 1)))
        share = np.where(seen & (rms > FAR * noise), rms / np.maximum(spread, 1e-300), 0.0)
        if share.max() > LARGEST_ERROR:
            j = int(np.argmax(share))
            of = f"{share[j]:.0%} of its spread" if moves[j] else "and it never moves"
            far = f"misses {segments.columns[j]} by {rms[j] / noise[j]:.3g} noise sds, {of}"
            message = f"{recording.name}: the model cannot follow it: fitted, it {far} (units? signs? names?)"
            warnings.warn(message, StudyWarning, stacklevel=3)


def _warn_led(columns: Sequence[str], scales: Float[np.ndarray, " columns"]) -> None:
    """Columns that are foretold badly though simulations are led along the recordings."""
    for column, scale in zip(columns, scales, strict=True):
        if np.isfinite(scale) and scale > FAR:
            far = f"though led along the recordings, the model foretells it {scale:.3g} noise sds off"
            warnings.warn(f"{column}: {far} (units? signs? names?)", StudyWarning, stacklevel=3)


def _misfit(problem: Problem) -> dict[str, float]:
    """Recording -> rms of its whitened residual at the prior's median; inf where the simulation diverges."""
    request = problem.request(np.zeros((1, problem.size)), start_point(problem).start)
    whitened = problem.residuals(problem.simulator.rollout(request)) * problem.weight
    out = {}
    for s, r in enumerate(problem.segments.recording):
        seen = whitened[s][problem.weight[s] > 0]
        finite = len(seen) and np.isfinite(seen).all()
        out[problem.segments.recordings[r].name] = float(np.sqrt(np.mean(seen**2))) if finite else np.inf
    return out


def _recordings(study: Study, misfit: dict[str, float]) -> tuple[CheckedRecording, ...]:
    def row(r: Recording, role: Role) -> CheckedRecording:
        seconds = float(r.time[-1] - r.time[0])
        return CheckedRecording(r.name, role, len(r.time), seconds, r.columns, misfit.get(r.name))

    return (*(row(r, "recording") for r in study.recordings), *(row(r, "holdout") for r in study.holdout))


def _parameters(
    problem: Problem, z: Float[np.ndarray, " size"], covariance: Float[np.ndarray, "size size"]
) -> tuple[CheckedParameter, ...]:
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    middle, above, below = problem.psi(np.stack([z, z + sd, z - sd]))
    out, blocks = [], problem.unknowns.blocks
    for k, block in enumerate(blocks):
        p, j = block.parameter, block.begin
        ratio = float(sd[j])  # of a standard normal, whose prior sd is 1
        verdict: Verdict = "identifiable" if ratio < IDENTIFIABLE else "weak" if ratio < WEAK else "not identifiable"
        others = tuple(b.parameter.name for b in blocks if b is not block and abs(correlation[j, b.begin]) > ENTANGLED)
        spread = float(abs(above[k] - below[k]) / 2)
        out.append(CheckedParameter(p.name, float(middle[k]), spread, ratio, verdict, others))
    return tuple(out)
