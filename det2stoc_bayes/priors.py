"""Priors by NumPyro's names and arguments, each also as a monotone map from a standard normal number."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes import quantiles
from det2stoc_bayes.errors import StudyError
from det2stoc_bayes.suggestions import choices

LARGEST = 1e30  # of values within WITHIN sds: beyond it products overflow
WITHIN = 6.0
REQUIRED, OPTIONAL = math.nan, None  # an argument that must be given, and one that may be absent


@dataclass(frozen=True)
class Family:
    """NumPyro's arguments and defaults, the quantile, and scipy's name and words for the same."""

    defaults: Mapping[str, float | None]
    quantile: quantiles.Quantile
    scipy: str
    to_scipy: Any
    positive: tuple[str, ...] = ("scale",)


def _loc_scale(a: Mapping[str, float]) -> dict[str, float]:
    return {"loc": a.get("loc", 0.0), "scale": a["scale"]}


def _ends(a: Mapping[str, float]) -> dict[str, float]:
    return {"loc": a["low"], "scale": a["high"] - a["low"]}


def _truncated(a: Mapping[str, float]) -> dict[str, float]:
    low, high = a.get("low", -math.inf), a.get("high", math.inf)
    return _loc_scale(a) | {"a": (low - a["loc"]) / a["scale"], "b": (high - a["loc"]) / a["scale"]}


_CENTRED = {"loc": 0.0, "scale": 1.0}
_UNIT = {"scale": 1.0}
_GAMMA = {"concentration": REQUIRED, "rate": 1.0}
FAMILIES: dict[str, Family] = {
    "Normal": Family(_CENTRED, quantiles.normal, "norm", _loc_scale),
    "TruncatedNormal": Family(
        _CENTRED | {"low": OPTIONAL, "high": OPTIONAL}, quantiles.truncated_normal, "truncnorm", _truncated
    ),
    "HalfNormal": Family(_UNIT, quantiles.half_normal, "halfnorm", _loc_scale),
    "Uniform": Family({"low": 0.0, "high": 1.0}, quantiles.uniform, "uniform", _ends, ()),
    "LogNormal": Family(
        _CENTRED, quantiles.log_normal, "lognorm", lambda a: {"s": a["scale"], "scale": math.exp(a["loc"])}
    ),
    "LogUniform": Family(
        {"low": REQUIRED, "high": REQUIRED},
        quantiles.log_uniform,
        "loguniform",
        lambda a: {"a": a["low"], "b": a["high"]},
        ("low", "high"),
    ),
    "Exponential": Family({"rate": 1.0}, quantiles.exponential, "expon", lambda a: {"scale": 1 / a["rate"]}, ("rate",)),
    "Laplace": Family(_CENTRED, quantiles.laplace, "laplace", _loc_scale),
    "Cauchy": Family(_CENTRED, quantiles.cauchy, "cauchy", _loc_scale),
    "HalfCauchy": Family(_UNIT, quantiles.half_cauchy, "halfcauchy", _loc_scale),
    "Logistic": Family(_CENTRED, quantiles.logistic, "logistic", _loc_scale),
    "Gumbel": Family(_CENTRED, quantiles.gumbel, "gumbel_r", _loc_scale),
    "Gamma": Family(
        _GAMMA,
        quantiles.gamma,
        "gamma",
        lambda a: {"a": a["concentration"], "scale": 1 / a["rate"]},
        ("concentration", "rate"),
    ),
    "InverseGamma": Family(
        _GAMMA,
        quantiles.inverse_gamma,
        "invgamma",
        lambda a: {"a": a["concentration"], "scale": a["rate"]},
        ("concentration", "rate"),
    ),
    "Beta": Family(
        {"concentration1": REQUIRED, "concentration0": REQUIRED},
        quantiles.beta,
        "beta",
        lambda a: {"a": a["concentration1"], "b": a["concentration0"]},
        ("concentration1", "concentration0"),
    ),
    "StudentT": Family(
        {"df": REQUIRED} | _CENTRED,
        quantiles.student_t,
        "t",
        lambda a: _loc_scale(a) | {"df": a["df"]},
        ("df", "scale"),
    ),
}


@dataclass(frozen=True)
class Prior:
    """One scalar distribution: NumPyro's family name and all its arguments (an absent bound is left out)."""

    family: str
    arguments: Mapping[str, float] = field(hash=False)

    @classmethod
    def parse(cls, spec: Mapping[str, Any], where: str) -> "Prior":
        """From `{"Normal": {"loc": 1, "scale": 2}}`; `where` opens the message of a StudyError."""
        if len(spec) != 1:
            raise StudyError(f"{where}: found {len(spec)} families; allowed: one, as {{ Normal = {{ loc = 1 }} }}")
        ((family, given),) = spec.items()
        if family not in FAMILIES:
            raise StudyError(f"{where}: unknown prior '{family}'; {choices(family, FAMILIES, limit=20)}")
        where = f"{where}.{family}"
        if not isinstance(given, Mapping):
            raise StudyError(f"{where}: found {given!r}; allowed: a table of {', '.join(FAMILIES[family].defaults)}")
        prior = cls(family, _arguments(family, given, where))
        prior._refuse_extremes(where)
        return prior

    def _refuse_extremes(self, where: str) -> None:
        """A prior whose values leave the range of numbers would give results that are none."""
        try:
            with np.errstate(all="ignore"):
                values = np.asarray(self.from_normal(np.array([-WITHIN, 0.0, WITHIN])), float)
        except (ArithmeticError, IndexError, ValueError):
            values = np.array([np.nan])
        if not (np.isfinite(values).all() and np.abs(values).max() < LARGEST):
            told = ", ".join(f"{name} = {value:g}" for name, value in self.arguments.items())
            raise StudyError(f"{where}: found {told}: values beyond {LARGEST:g}; allowed: a prior of moderate values")

    @property
    def distribution(self) -> Any:
        """The NumPyro distribution."""
        import numpyro.distributions

        return getattr(numpyro.distributions, self.family)(**self.arguments)

    @property
    def mean(self) -> float:
        """Expected value; nan or inf where there is none (Cauchy)."""
        return float(self._scipy.mean())

    @property
    def sd(self) -> float:
        """Standard deviation; nan or inf where there is none (Cauchy)."""
        return float(self._scipy.std())

    @property
    def support(self) -> tuple[float, float]:
        """Lowest and highest possible value."""
        low, high = self._scipy.support()
        return float(self.arguments.get("low", low)), float(self.arguments.get("high", high))

    def log_prob(self, x: Float[np.ndarray, "*shape"] | float) -> Float[np.ndarray, "*shape"]:
        """Log density."""
        return np.asarray(self._scipy.logpdf(x))

    def from_normal(self, z: Any, xp: ModuleType = np) -> Any:
        """The value whose rank under this prior is z's under N(0, 1), elementwise for arrays of `xp`.

        `xp` is numpy or jax.numpy. Monotone, finite up to |z| = 30, differentiable: a model can
        draw z ~ N(0, 1) for whatever prior.
        """
        z = xp.asarray(z) * 1.0  # an integer would make its own tails integers
        return FAMILIES[self.family].quantile(dict(self.arguments), z, quantiles.library(xp))

    def to_normal(self, x: Float[np.ndarray, "*shape"] | float) -> Float[np.ndarray, "*shape"]:
        """The inverse of `from_normal`; infinite outside of the support and at its ends."""
        from scipy.special import ndtri_exp

        with np.errstate(divide="ignore"):
            below, above = self._scipy.logcdf(x), self._scipy.logsf(x)
            return np.asarray(np.where(below < above, ndtri_exp(below), -ndtri_exp(above)))

    @property
    def _scipy(self) -> Any:
        return _frozen(self.family, tuple(self.arguments.items()))


@lru_cache(maxsize=256)
def _frozen(family: str, arguments: tuple[tuple[str, float], ...]) -> Any:
    from scipy import stats

    entry = FAMILIES[family]
    return getattr(stats, entry.scipy)(**entry.to_scipy(dict(arguments)))


def _finite(value: int | float) -> bool:
    return isinstance(value, int) or math.isfinite(value)


def _arguments(family: str, given: Mapping[str, Any], where: str) -> dict[str, float]:
    """The checked arguments, NumPyro's defaults filled in."""
    entry = FAMILIES[family]
    for name, value in given.items():
        if name not in entry.defaults:
            raise StudyError(f"{where}.{name}: unknown argument; {choices(name, entry.defaults)}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not _finite(value):
            raise StudyError(f"{where}.{name}: found {value!r}; allowed: a finite number")
        if abs(value) > LARGEST:
            raise StudyError(f"{where}.{name}: found {str(value)[:20]}; allowed: at most {LARGEST:g} in size")
        if name in entry.positive and value <= 0:
            raise StudyError(f"{where}.{name}: found {value!r}; allowed: a number above 0")
    merged = {name: given.get(name, default) for name, default in entry.defaults.items()}
    for name, value in merged.items():
        if value is not OPTIONAL and math.isnan(value):
            raise StudyError(f"{where}.{name}: missing; allowed: a finite number ({where} takes {', '.join(merged)})")
    arguments = {name: float(value) for name, value in merged.items() if value is not OPTIONAL}
    low, high = arguments.get("low", -math.inf), arguments.get("high", math.inf)
    if low >= high:
        raise StudyError(f"{where}: found low = {low:g}, high = {high:g}; allowed: low below high")
    if family == "TruncatedNormal":
        _refuse_remote(arguments, low, high, where)
    return arguments


def _refuse_remote(arguments: Mapping[str, float], low: float, high: float, where: str) -> None:
    """Bounds so far from loc that the normal between them is 0 to machine precision leave no distribution."""
    loc, scale = arguments["loc"], arguments["scale"]
    if not quantiles.tail_masses((low - loc) / scale, (high - loc) / scale, quantiles.library(np))[2] > 1e-280:
        raise StudyError(
            f"{where}: found loc = {loc:g}, scale = {scale:g} with bounds {low:g} to {high:g}, more than "
            "35 scales away; allowed: bounds near loc"
        )
