"""Numbers as people write them: two digits of the uncertainty, powers of ten where they help."""

import math
import re
from collections.abc import Sequence

MISSING = "–"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

type Value = float | None | Sequence[float | None]


def power_of_ten(exponent: int) -> str:
    """`10⁻⁵` as text."""
    return "10" + str(exponent).translate(SUPERSCRIPT)


def number(value: float | None, digits: int = 3) -> str:
    """A number to so many significant digits: `0.0421`, `12,300`, `3.1 × 10⁻⁶`."""
    if value is None or not math.isfinite(value):
        return MISSING
    exponent = _exponent(value)
    if value != 0 and not -4 <= exponent < 6:
        return f"{_fixed(value / 10.0**exponent, digits - 1)} × {power_of_ten(exponent)}"
    return _fixed(value, max(digits - 1 - exponent, 0))


def plus_minus(mean: Value, sd: Value) -> str:
    """`0.310 ± 0.010`: two significant digits of the uncertainty; vectors as `(…, …)`."""
    if isinstance(mean, Sequence):
        sds = sd if isinstance(sd, Sequence) else [sd] * len(mean)
        return "(" + ", ".join(plus_minus(m, s) for m, s in zip(mean, sds, strict=True)) + ")"
    spread = None if sd is None or isinstance(sd, Sequence) or not math.isfinite(sd) else abs(sd)
    if mean is None or not math.isfinite(mean) or not spread:
        return number(mean)
    largest = _exponent(max(abs(mean), spread))
    if -4 <= largest < 5:
        decimals = max(_decimals(spread), 0)
        return f"{_fixed(mean, decimals)} ± {_fixed(spread, decimals)}"
    scale = 10.0**largest
    decimals = max(_decimals(spread / scale), 0)
    return f"({_fixed(mean / scale, decimals)} ± {_fixed(spread / scale, decimals)}) × {power_of_ten(largest)}"


def interval(bounds: Sequence | None) -> str:
    """`[0.290, 0.330]`, to the digits that its width supports; of a vector one after the other."""
    if not bounds or any(bound is None for bound in bounds):
        return MISSING
    if isinstance(bounds[0], Sequence):
        return ", ".join(interval(pair) for pair in bounds)
    low, high = bounds
    spread = (high - low) / 4
    if not math.isfinite(spread) or spread <= 0 or not -4 <= _exponent(max(abs(low), abs(high))) < 5:
        return f"[{number(low)}, {number(high)}]"
    decimals = max(_decimals(spread), 0)
    return f"[{_fixed(low, decimals)}, {_fixed(high, decimals)}]"


def percent(fraction: float | None, decimals: int = 0) -> str:
    """`97 %`; never a rounded 0 % or 100 % of something that is neither."""
    if fraction is None or not math.isfinite(fraction):
        return MISSING
    if decimals == 0 and 0 < fraction < 0.01:
        return "< 1 %"
    if decimals == 0 and 0.995 <= fraction < 1:
        return "> 99 %"
    return f"{_fixed(100 * fraction, decimals)} %"


def nats(value: float | None) -> str:
    """Log evidence or log density: one decimal where that says something."""
    if value is None or not math.isfinite(value):
        return MISSING
    return _fixed(value, 1 if abs(value) < 100 else 0)


def bayes_factor(log10: float | None) -> str:
    """`10²¹⁰`, or the plain ratio where that is readable."""
    if log10 is None or not math.isfinite(log10):
        return MISSING
    return number(10.0**log10, 2) if abs(log10) < 4 else power_of_ten(round(log10))


def tied(text: str) -> str:
    """The text in print: ± and minus signs; numbers, ± and units held together by no-break spaces."""
    text = re.sub(r"(?<![\w.)\]])-(?=[\d.])", "\u2212", text.replace(" +- ", " ± "))
    text = text.replace(" ± ", "\u00a0±\u00a0").replace("N m", "N\u00a0m")
    return re.sub(r"(?<=\d) (?=%|(?:mm|cm|kg|Hz|ms|rad|[mNs])\b)", "\u00a0", text)


def duration(seconds: float) -> str:
    """`41 s`, `3 min 20 s`, `1 h 5 min`."""
    if seconds < 120:
        return f"{number(seconds, 2)} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def _exponent(value: float) -> int:
    return 0 if value == 0 else math.floor(math.log10(abs(value)))


def _decimals(spread: float) -> int:
    """Decimals that show two significant digits of `spread`, after its rounding."""
    return 1 - _exponent(float(f"{spread:.1e}"))


def _fixed(value: float, decimals: int) -> str:
    text = f"{value:,.{decimals}f}"
    if text.startswith("-"):
        text = text[1:] if float(text.replace(",", "")) == 0 else "−" + text[1:]
    return text
