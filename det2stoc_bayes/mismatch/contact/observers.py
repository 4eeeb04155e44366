"""The observer of a study's recordings: how much of each sample's error its simulated states take over."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from det2stoc_bayes.engines.observer import ContactFlow, Observer, Places, forgetting_gains
from det2stoc_bayes.problem import Problem

RATE = 0.5  # noise sds over a sampling interval: sd of a speed that is estimated from positions


def on_rows(problem: Problem, rows: Int[np.ndarray, " rows"]) -> Problem:
    """The hypothesis on some of its recordings, perhaps several times; unknowns of the others stay."""
    whole, guess = problem.segments, problem.guess
    each = {n: getattr(whole, n)[rows] for n in ("recording", "first", "time", "values")}
    guess = replace(guess, start=guess.start[rows], prior_sd=guess.prior_sd[rows])
    return replace(problem, segments=replace(whole, **each), guess=guess)


def make_observer(
    problem: Problem, memory: float, contact: ContactFlow | None = None
) -> tuple[Observer, Float[np.ndarray, "recordings samples columns"]]:
    """The observer, and what noise makes of the innovations, in sds of a sample's noise."""
    segments, model = problem.segments, problem.simulator.model
    places = Places(model, segments.columns)
    noise = places.noise(problem.noise)
    seen = places.seen(segments.observed)
    gains, spread = forgetting_gains(segments.time, seen, noise, sds_of_starts(problem, noise), memory, contact)
    return Observer(gains, segments.values, seen), places.of_columns(spread, segments.values)


def sds_of_starts(problem: Problem, noise: Float[np.ndarray, "nv 2"]) -> Float[np.ndarray, "nv 2"]:
    """sd of recorded starts in tangent coordinates (positions, speeds)."""
    nv, time = problem.simulator.model.nv, problem.segments.time
    interval = np.diff(time, axis=1)
    dt = float(np.median(interval[interval > 0]))
    spread = np.stack([problem.guess.scale[:nv], problem.guess.scale[nv:]], 1)
    sd = np.where(np.isfinite(noise), noise, spread)
    from_positions = np.minimum(RATE * sd[:, 0] / dt, spread[:, 1])
    sd[:, 1] = np.where(np.isfinite(noise[:, 1]), sd[:, 1], from_positions)
    return sd
