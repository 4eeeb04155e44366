"""Numbers of a diagnosis against the truth: do intervals cover it, and are they narrow?"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Json = Mapping[str, Any]
NARROW = 0.4  # of the value: a wider 95 % interval tells little
NEUTRAL = {"ratio": 1.0}  # the value that means no effect, where it is not zero
ANGLES = ("phase", "direction")


@dataclass(frozen=True)
class Estimates:
    """Of an effect's size, its first parameter but angles: is it covered, relative error, interval width, narrowness.

    `inside` says of every parameter whether its interval holds it, of a vector whether all do: not judged in part.
    """

    covers: bool | None = None
    error: float | None = None
    width: float | None = None
    inside: tuple[bool, ...] = ()

    @property
    def narrow(self) -> bool | None:
        """Whether the width is below NARROW."""
        return None if self.width is None else self.width < NARROW


def compare_parameters(truth: Json, given: Json, judged: Mapping[str, list[int]] | None = None) -> Estimates:
    """Estimates of one effect; of a parameter in `judged` only those components (a scalar's is 0) count.

    Errors and widths are relative to the change from no effect; a vector's to its length.
    """
    given, inside, size = _alike_amplitude(given, truth.get("amplitude")), [], None
    for key, value in truth.items():
        if key in ("timestep", "integrator", "variables", "curve"):  # any that converges is right; no numbers
            continue
        parts = [
            (v, *estimate)
            for i, v in enumerate(value if isinstance(value, list) else [value])
            if i in (judged or {}).get(key, [i]) and (estimate := _part(given.get(key), i)) is not None
        ]
        if key in ANGLES:
            parts = [(v + 2.0 * math.pi * round((m - v) / (2.0 * math.pi)), m, a, b) for v, m, a, b in parts]
        mine = [low <= v <= high for v, _, low, high in parts]
        whole = len(parts) == (len(value) if isinstance(value, list) else 1)
        inside += [all(mine)] if whole else []
        length = math.hypot(*(v - NEUTRAL.get(key, 0.0) for v, *_ in parts))
        if size is None and length > 0.0 and key not in ANGLES:
            error = math.hypot(*(m - v for v, m, *_ in parts))
            size = (all(mine), error / length, math.hypot(*(high - low for *_, low, high in parts)) / length)
    covers, error, width = size or (None, None, None)
    return Estimates(covers, error, width, tuple(inside))


def compare_psi(truth: Mapping[str, float], given: Json) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
    """Of each psi whether mean +- 1.96 sd covers it, and whether that interval is narrow."""
    told = list(_psi(truth, given))
    return tuple(inside for inside, _ in told), tuple(narrow for _, narrow in told)


def _psi(truth: Mapping[str, float], given: Json) -> Iterator[tuple[bool, bool]]:
    for name, value in truth.items():
        after = (given.get(name) or {}).get("after")
        if after and isinstance(after.get("mean"), int | float):
            half = 1.96 * after["sd"]
            yield abs(after["mean"] - value) <= half, 2.0 * half < NARROW * abs(value)


def _part(estimate: Any, index: int) -> tuple[float, float, float] | None:
    """(mean, low, high) of a component; a scalar's interval is [low, high], a vector's a list of such or two lists."""
    if not isinstance(estimate, Mapping) or "interval" not in estimate:
        return None
    mean, interval = estimate["mean"], estimate["interval"]
    if isinstance(mean, int | float):
        return (mean, *interval) if index == 0 else None
    if len(interval) == 2 and len(mean) != 2 and isinstance(interval[0], list):
        return mean[index], interval[0][index], interval[1][index]
    return mean[index], *interval[index]


def _alike_amplitude(given: Json, truth: float | list[float] | None) -> Json:
    """A sin(x + phase) with A on the other side is -A sin(x + phase + pi)."""
    true = truth if isinstance(truth, list) else [truth]
    parts, second = [_part(given.get("amplitude"), i) for i in range(len(true))], _part(given.get("phase"), 0)
    told = [part for part in parts if part is not None]
    if (
        second is None
        or len(told) < len(true)
        or sum((v or 0.0) * m for v, (m, *_) in zip(true, told, strict=True)) >= 0
    ):
        return given
    means, bounds = [-m for m, _, _ in told], [[-high, -low] for _, low, high in told]
    flipped = (
        {"mean": means, "interval": bounds} if isinstance(truth, list) else {"mean": means[0], "interval": bounds[0]}
    )
    turned = {"mean": second[0] + math.pi, "interval": [second[1] + math.pi, second[2] + math.pi]}
    return {**given, "amplitude": flipped, "phase": turned}
