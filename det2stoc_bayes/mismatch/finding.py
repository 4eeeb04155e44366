"""What a diagnosis found, as it is written to diagnosis.json.

The models below are the one definition: the JSON Schema that ships beside them is generated from them, and a
test holds the two together. Keys may be added anywhere; those listed here are always there.
"""

import json
import math
import os
from functools import cache
from importlib.resources import files
from typing import Annotated, Any, Literal, Self

import numpy as np
from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from det2stoc_bayes.errors import Det2StocError
from det2stoc_bayes.files import atomic_write

CLOCK = "sensor", "time"  # the element that recorded times are
SURE = 0.8  # probability of its equivalence class from which on an effect is named

type Json = None | bool | int | float | str | list[Json] | dict[str, Json]
type Number = float | None
type Numbers = Number | tuple[Number, ...]
ROUNDING = 1e-9


def _within_rounding(value: Any) -> Any:
    """1 for what only rounding puts beyond it: sums of shares, of probabilities."""
    return 1.0 if isinstance(value, float) and 1.0 < value < 1.0 + ROUNDING else value


_LAX = BeforeValidator(_within_rounding)
Probability = Annotated[float, Field(ge=0, le=1), _LAX]
Share = Annotated[float, Field(le=1, description="fraction of the squared whitened residual in excess of noise"), _LAX]


class FindingInvalid(Det2StocError):
    """A diagnosis that breaks the schema of diagnosis.json."""


def plain(value: Any) -> Any:
    """The value in JSON's own types: numpy unwrapped, NaN and infinities as None, keys as text."""
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def variable_name(effect: str, element: str, parameter: str) -> str:
    """Name of an effect's parameter in fit.nc; a `/` in the element becomes `:`, which DataTree requires."""
    return f"{effect}[{element}].{parameter}".replace("/", ":")


class Entry(BaseModel):
    """Base of all parts: frozen, open to further keys, free of numpy and of numbers that JSON lacks."""

    model_config = ConfigDict(frozen=True, extra="allow")

    @model_validator(mode="before")
    @classmethod
    def _plain(cls, data: Any) -> Any:
        return plain(data) if isinstance(data, dict) else data


class Element(Entry):
    kind: str
    name: str

    @property
    def label(self) -> str:
        """`joint wrist`; a name that says no more than its kind is said once."""
        return self.name if self.kind == self.name or (self.kind, self.name) == CLOCK else f"{self.kind} {self.name}"


class ElementShare(Element):
    share: Share | None


class Condition(Entry):
    condition: str
    share: Share | None


class Where(Entry):
    elements: tuple[ElementShare, ...]
    when: tuple[Condition, ...]


class Evidence(Entry):
    log10_bayes_factor: Number = Field(description="best explanation against psi alone")
    noise_inflation: Number = Field(description="variance ratio under the believed model; null: noise inferred")


class Quantity(Entry):
    """A number, or a vector whose mean, sd and interval are lists."""

    mean: Numbers
    sd: Numbers
    interval: tuple[Numbers, ...] | None = Field(description="95 %: [low, high]; of a vector, pairs that hold it whole")
    unit: str


class Curve(Entry):
    """A function that was found: values y and their sds where its variable is x; of two variables x are pairs."""

    x: tuple[Numbers, ...]
    y: tuple[Number, ...]
    y_sd: tuple[Number, ...] = ()
    unit: str = ""


Parameter = Quantity | Curve | str | tuple[str, ...]


class Alternative(Entry):
    """Another explanation; `element` is null for `none`."""

    name: str
    element: Element | None
    probability: Probability


class Moments(Entry):
    mean: Numbers
    sd: Numbers


class Equivalent(Entry):
    """An effect that no recording of the study tells from the one that lists it."""

    name: str
    element: Element
    parameters: dict[str, Parameter]
    psi: dict[str, Moments] = Field(default={}, description="those beyond their sds from the named effect's")


class RecordingPart(Entry):
    """An effect in one recording that was not fitted."""

    recording: str
    explains: Share | None
    kind: Literal["explained", "negligible", "uncertain"] = Field(
        description="uncertain: more of the recording's error stays unexplained than goes with the effect"
    )


class Effect(Entry):
    name: str
    element: Element
    statement: str
    law: str
    probability: Probability
    explains: Share | None
    recordings: Literal["all"] | tuple[str, ...]
    parameters: dict[str, Parameter]
    equivalent: tuple[Equivalent, ...]
    alternatives: tuple[Alternative, ...]
    by_recording: tuple[RecordingPart, ...] = ()
    mirrored: tuple[dict[str, Quantity], ...] = Field(default=(), description="other values that would do as well")


class Experiment(Entry):
    """What to record so that the candidates part."""

    text: str
    input: Json
    initial_state: Json
    expected_gain: Number


class Fit(Entry):
    """How well held-out rollouts are predicted; before: psi refitted alone; after: with the effects too."""

    horizon_s: Number
    heldout_log_density_before: Number
    heldout_log_density_after: Number
    difference: Number
    standard_error: Number
    rollout_rmse_before: dict[str, Number]
    rollout_rmse_after: dict[str, Number]
    rollout_rmse_noise: dict[str, Number]
    unexplained_share: Share | None
    heldout_chose: bool = Field(default=False, description="held-out recordings also decided between explanations")


class PsiChange(Entry):
    before: Moments
    after: Moments
    prior_conflict: Numbers = Field(description="tail probability of the posterior under the prior")
    over_equivalents: tuple[Number, Number] | None = Field(default=None, description="95 % after, whichever it is")


class BeliefOf(Entry):
    """How a posterior was drawn."""

    method: Literal["laplace", "laplace+psis", "adapted", "smc", "nuts"]
    k_hat: Number = Field(description="tail of the importance weights: reliable below 0.7, at most 10; null: none")
    draws: int
    evaluations: int = Field(description="simulations of all recordings that it took")


class Beliefs(Entry):
    before: BeliefOf
    after: BeliefOf


class PredictiveCheck(Entry):
    """Whether the corrected simulator makes errors as large as those that it leaves."""

    p_value: Number
    worst_channel: str | None


def _verdict_rules(schema: dict[str, Any]) -> None:
    """What each verdict asks of the lists, said in JSON Schema (pydantic's fields cannot)."""
    some, none = {"minItems": 1}, {"maxItems": 0}
    sure = {"items": {"properties": {"probability": {"minimum": SURE}}}}
    rules = {
        "mismatch": {"effects": some | sure},
        "no_mismatch": {"effects": none},
        "inconclusive": {"effects": none, "candidates": some, "experiment": {"type": "object"}},
    }
    schema["allOf"] = [
        {"if": {"properties": {"verdict": {"const": verdict}}}, "then": {"properties": asked}}
        for verdict, asked in rules.items()
    ]


class Finding(Entry):
    """diagnosis.json as an object; `Finding(**mapping)` validates, numpy values are welcome."""

    model_config = ConfigDict(title="diagnosis.json", json_schema_extra=_verdict_rules)

    verdict: Literal["mismatch", "no_mismatch", "inconclusive"]
    summary: str
    evidence: Evidence
    where: Where
    effects: tuple[Effect, ...]
    candidates: tuple[Alternative, ...]
    experiment: Experiment | None
    fit: Fit
    psi: dict[str, PsiChange]
    seconds: Annotated[float, Field(ge=0)]
    versions: dict[str, str]
    belief: Beliefs | None = None
    predictive_check: PredictiveCheck | None = None
    stacking: dict[str, Number] | None = Field(default=None, description="weights by left-out recordings")

    @model_validator(mode="after")
    def _keeps_to_its_verdict(self) -> Self:
        _check(json.loads(self.model_dump_json()))
        return self


@cache
def schema() -> dict[str, Any]:
    """The JSON Schema of diagnosis.json that ships with the package."""
    return json.loads((files("det2stoc_bayes.mismatch") / "schema" / "diagnosis.schema.json").read_text("utf-8"))


def generate_schema() -> dict[str, Any]:
    """The schema as the models say it; the shipped file is this, `json.dumps(..., indent=2)`."""
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return dialect | Finding.model_json_schema(mode="validation")


def _check(data: Any) -> None:
    if (error := best_match(Draft202012Validator(schema()).iter_errors(data))) is not None:
        raise FindingInvalid(f"diagnosis.json: {error.json_path}: {error.message[:400]}")


def to_json(finding: Finding) -> str:
    """The text of diagnosis.json: checked, with finite numbers or null, ending in a newline."""
    data = finding.model_dump(mode="json")
    _check(data)
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def from_json(text: str) -> Finding:
    """The finding that `to_json` wrote; anything else raises FindingInvalid and says where it departs."""
    try:
        data = json.loads(text)
    except ValueError as error:
        raise FindingInvalid(f"diagnosis.json: not JSON: {error}") from error
    _check(data)
    return Finding.model_validate(data)


def write_json(finding: Finding, path: str | os.PathLike[str]) -> None:
    """Write diagnosis.json, whole or not at all."""
    atomic_write(path, to_json(finding))
