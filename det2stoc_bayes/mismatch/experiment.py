"""Which further recording would tell two explanations apart."""

from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.optimize import Fit

SCALES = (0.0, 0.5, 1.5, 2.0)


@dataclass(frozen=True)
class Proposal:
    """A recording like one that exists with its start or commands scaled, and the evidence it should bring (nats)."""

    text: str
    input: str
    initial_state: dict[str, list[float]]
    expected_gain: float


def propose(a: Fit, b: Fit) -> Proposal:
    """The variation of a recording on which two fits' predictions differ most beyond noise and initial state."""
    best: Proposal | None = None
    for part in ("initial state", "commands"):
        if part == "commands" and a.problem.simulator.model.nu == 0:
            continue
        for scale in SCALES:
            for name, gain, start in _gains(a, b, part, scale):
                if best is None or gain > best.expected_gain:
                    text = (
                        f"Record again as in {name} with its {part} times {scale:g}: the two best explanations "
                        f"should then differ by about {gain:.0f} nats."
                    )
                    command = f"commands of {name}" + (f" times {scale:g}" if part == "commands" else "")
                    best = Proposal(text, command, start, gain)
    return best or Proposal("Record again with other commands and starts.", "", {}, 0.0)


def _gains(a: Fit, b: Fit, part: str, scale: float):
    """Half the whitened squared difference of predictions, per recording's first segment."""
    segments = a.problem.segments
    if part == "commands":
        scaled = tuple(replace(r, ctrl=scale * r.ctrl) for r in segments.recordings)
        segments = replace(segments, recordings=scaled)
    predicted, starts = [], []
    for fit in (a, b):
        problem = replace(fit.problem, segments=segments)
        start = fit.point.start
        if part == "initial state":
            rest = problem.simulator.model.qpos0
            moved = scale * (start.qpos - rest) if start.qpos.shape[1] == start.qvel.shape[1] else start.qpos - rest
            start = replace(start, qpos=rest + moved, qvel=scale * start.qvel)
        starts.append(start)
        predicted.append(problem.simulator.rollout(problem.request(fit.point.z[None], start)))
    r = a.problem.residuals(predicted[0]) - a.problem.residuals(predicted[1])
    if not np.isfinite(r).all():
        return
    lin = a.linear.latent
    x = lin.project(lin.stack(r[..., None]))[..., 0]
    for s, gain in enumerate(0.5 * (x**2).sum(1)):
        name = segments.recordings[segments.recording[s]].name
        start = {"qpos": starts[0].qpos[s].tolist(), "qvel": starts[0].qvel[s].tolist()}
        yield name, float(gain), start
