"""Where and when an effect acts: shares of its work under short readable conditions."""

from dataclasses import dataclass, replace

import numpy as np

from det2stoc_bayes.engines.elements import joint_elements
from det2stoc_bayes.mismatch.response import Response
from det2stoc_bayes.optimize import Fit

QUANTILES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
LEAST_SHARE = 0.8  # of the effect's squared action that a condition must hold
LEAST_CONTRAST = 0.15  # by which that share must exceed the share of time


@dataclass(frozen=True)
class Condition:
    """A rule such as `abs(qvel/wrist) > 0.2`, and the share of the effect's squared action while it holds."""

    text: str
    share: float
    variable: str
    threshold: float
    below: bool = False

    def holds(self, value: np.ndarray) -> np.ndarray:
        """Where the rule holds, given its variable's values."""
        if self.below:
            return value < self.threshold
        return (np.abs(value) if self.text.startswith("abs") else value) > self.threshold


def action(after: Fit, slot: int) -> tuple[np.ndarray, Response]:
    """Squared change of speed that an effect makes in each interval (segments, intervals)."""
    without = [e for k, e in enumerate(after.problem.effects) if k != slot]
    placed = after.problem.effects[slot]
    values = {n: v[0] for n, v in after.problem.effect_values(after.point.z[None])[slot].items()}
    begin = after.problem.num_psi + sum(e.size for e in after.problem.effects[:slot])
    z = np.delete(after.point.z, np.arange(begin, begin + placed.size))
    linear = replace(after.linear, problem=after.problem.with_effects(without), point=replace(after.point, z=z))
    response = Response(replace(after, linear=linear))
    d, e = response.defects([(placed, values)])
    nv = after.problem.simulator.model.nv
    scale = after.problem.guess.scale[nv : 2 * nv]
    work = ((d[:, :, nv : 2 * nv, 0] / scale[:, None].T) ** 2).sum(2)
    if placed.effect.kind == "sensor":
        work = (e[..., 0] ** 2).sum(2)
    return work, response


def conditions(after: Fit, slot: int) -> list[Condition]:
    """The rule that holds most of an effect's action in least of the time; empty if none is telling."""
    work, response = action(after, slot)
    real, total = response.real, work[response.real].sum()
    if not total > 0:
        return []
    best, contrast = None, LEAST_CONTRAST
    for variable, values in _variables(response).items():
        for shape in ("abs({})", "{}"):
            x = np.abs(values) if shape.startswith("abs") else values
            for q in QUANTILES:
                threshold = float(np.quantile(x[real], q))
                inside = (x > threshold) & real
                share, time = work[inside].sum() / total, inside.sum() / real.sum()
                if share >= LEAST_SHARE and share - time > contrast:
                    contrast = share - time
                    text = f"{shape.format(variable)} > {threshold:.3g}"
                    best = Condition(text, float(share), variable, float(f"{threshold:.3g}"))
    return [best] if best else []


def _variables(response: Response) -> dict[str, np.ndarray]:
    """Candidates for a rule at the beginning of each interval."""
    model, segments = response.problem.simulator.model, response.problem.segments
    out = {}
    for joint in joint_elements(model):
        out[f"qvel/{joint.name}"] = response.path.qvel[:, :-1, joint.dof]
        out[f"qpos/{joint.name}"] = response.path.qpos[:, :-1, joint.qpos]
    for a in range(model.nu):
        if model.actuator(a).name:
            held = np.stack(
                [
                    np.interp(t, segments.recordings[r].time, segments.recordings[r].ctrl[:, a])
                    for t, r in zip(segments.time, segments.recording, strict=True)
                ]
            )
            out[f"ctrl/{model.actuator(a).name}"] = held[:, :-1]
    return out
