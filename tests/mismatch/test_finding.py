"""diagnosis.json: the shipped schema, what it refuses, and numbers that JSON does not have."""

import copy
import io
import json
import math

import numpy as np
import pytest
from pydantic import ValidationError
from rich.console import Console

from det2stoc_bayes.files import atomic_write, replacing
from det2stoc_bayes.finding_tables import finding_tables
from det2stoc_bayes.mismatch import finding as module
from det2stoc_bayes.mismatch.finding import Finding, FindingInvalid, from_json, to_json, write_json

EXAMPLE = {
    "verdict": "mismatch",
    "summary": "Dry friction of 0.31 +- 0.02 N m on joint wrist was left out.",
    "evidence": {"log10_bayes_factor": 210.3, "noise_inflation": 41.0},
    "where": {
        "elements": [{"kind": "joint", "name": "wrist", "share": 0.93}],
        "when": [{"condition": "abs(qvel/wrist) > 0.2", "share": 0.88}],
    },
    "effects": [
        {
            "name": "coulomb_friction",
            "element": {"kind": "joint", "name": "wrist"},
            "statement": "Dry friction of 0.31 +- 0.02 N m on joint wrist is missing.",
            "law": "-F sign(v)",
            "probability": 0.97,
            "explains": 0.78,
            "recordings": "all",
            "parameters": {"force": {"mean": 0.31, "sd": 0.01, "interval": [0.29, 0.33], "unit": "N m"}},
            "equivalent": [],
            "alternatives": [
                {
                    "name": "stribeck_friction",
                    "element": {"kind": "joint", "name": "wrist"},
                    "probability": 0.02,
                }
            ],
        }
    ],
    "candidates": [],
    "experiment": None,
    "fit": {
        "horizon_s": 2.0,
        "heldout_log_density_before": -9120.0,
        "heldout_log_density_after": -310.0,
        "difference": 8810.0,
        "standard_error": 220.0,
        "rollout_rmse_before": {"qpos/wrist": 0.04},
        "rollout_rmse_after": {"qpos/wrist": 0.009},
        "rollout_rmse_noise": {"qpos/wrist": 0.008},
        "unexplained_share": 0.03,
    },
    "psi": {
        "link_mass": {
            "before": {"mean": 1.9, "sd": 0.1},
            "after": {"mean": 1.2, "sd": 0.1},
            "prior_conflict": 0.02,
        }
    },
    "seconds": 41.0,
    "versions": {},
}
CANDIDATE = {"name": "payload_mass", "element": {"kind": "body", "name": "hand"}, "probability": 0.5}
EXPERIMENT = {"text": "Hang it still.", "input": None, "initial_state": {}, "expected_gain": 4.0}


def changed(path: str, value: object) -> dict:
    """The example with one entry replaced, or dropped where the value is `...`."""
    data = copy.deepcopy(EXAMPLE)
    *folders, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    place = data
    for key in folders:
        place = place[key]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return data


def required_paths(value: object, prefix: str = "") -> list[str]:
    """All keys of the example, save those that name a channel, a psi or a parameter."""
    named = ("fit.rollout_", "psi.link_mass", "effects.0.parameters.force")
    paths = []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        path = f"{prefix}{key}"
        is_name = path == "psi.link_mass" or path.startswith("effects.0.parameters.force") and path.endswith("force")
        is_channel = path.startswith(named[0]) and path.count(".") > 1
        if isinstance(value, dict) and not is_name and not is_channel:
            paths.append(path)
        paths += required_paths(item, path + ".")
    return paths


def test_the_documented_example_round_trips() -> None:
    text = to_json(Finding(**EXAMPLE))
    written = json.loads(text)
    assert [effect.pop("by_recording") for effect in written["effects"]] == [[]] * len(EXAMPLE["effects"])
    assert [effect.pop("mirrored") for effect in written["effects"]] == [[]] * len(EXAMPLE["effects"])
    assert written["fit"].pop("heldout_chose") is False
    assert [change.pop("over_equivalents") for change in written["psi"].values()] == [None] * len(EXAMPLE["psi"])
    assert written == EXAMPLE | dict.fromkeys(("belief", "predictive_check", "stacking"))
    assert to_json(from_json(text)) == text


def test_the_shipped_schema_is_what_the_models_say() -> None:
    assert module.schema() == json.loads(json.dumps(module.generate_schema()))


@pytest.mark.parametrize("path", required_paths(EXAMPLE))
def test_a_listed_key_cannot_be_missing(path: str) -> None:
    with pytest.raises(FindingInvalid, match="required property|valid under"):
        from_json(json.dumps(changed(path, ...)))
    with pytest.raises((ValidationError, FindingInvalid)):
        Finding(**changed(path, ...))


@pytest.mark.parametrize("path", ["effects.0.probability", "where.elements.0.share"])
def test_sums_that_rounding_puts_beyond_one_are_one(path: str) -> None:
    found = Finding(**changed(path, 1.0000000000000002))
    assert to_json(found) == to_json(Finding(**changed(path, 1.0)))
    with pytest.raises(ValidationError):
        Finding(**changed(path, 1.001))


@pytest.mark.parametrize(
    "path, value",
    [
        ("verdict", "maybe"),
        ("effects.0.probability", 1.2),
        ("effects.0.probability", 0.6),
        ("effects", []),
        ("verdict", "no_mismatch"),
        ("verdict", "inconclusive"),
        ("seconds", -1.0),
        ("where.elements.0.share", 1.5),
        ("effects.0.recordings", "some"),
    ],
)
def test_wrong_values_are_refused(path: str, value: object) -> None:
    with pytest.raises((ValidationError, FindingInvalid)):
        Finding(**changed(path, value))
    with pytest.raises(FindingInvalid, match=r"diagnosis\.json: \$"):
        from_json(json.dumps(changed(path, value)))


def test_inconclusive_wants_candidates_and_an_experiment() -> None:
    open_question = {**EXAMPLE, "verdict": "inconclusive", "effects": []}
    good = {**open_question, "candidates": [CANDIDATE], "experiment": EXPERIMENT}
    assert Finding(**good).experiment.expected_gain == 4.0
    for broken in ({"candidates": []}, {"experiment": None}, {"effects": EXAMPLE["effects"]}):
        with pytest.raises(FindingInvalid):
            Finding(**{**good, **broken})


def test_numpy_values_and_non_finite_numbers_become_json() -> None:
    data = changed("evidence", {"log10_bayes_factor": np.float32(2.5), "noise_inflation": math.inf})
    data["effects"][0]["parameters"] = {
        "offset": {
            "mean": np.arange(3.0),
            "sd": np.full(3, np.nan),
            "interval": np.zeros((3, 2)),
            "unit": "m",
        },
        "source": "elbow",
        "variables": ["qpos/wrist", "time"],
        "curve": {"x": np.zeros(2), "y": np.ones(2), "unit": "N m"},
    }
    data["seed"] = np.int64(7)
    data["sensitivity"] = [{"size": np.float64("nan")}]
    written = json.loads(to_json(Finding(**data)), parse_constant=pytest.fail)
    assert written["evidence"] == {"log10_bayes_factor": 2.5, "noise_inflation": None}
    assert written["effects"][0]["parameters"]["offset"]["sd"] == [None] * 3
    assert written["effects"][0]["parameters"]["offset"]["interval"] == [[0.0, 0.0]] * 3
    assert written["effects"][0]["parameters"]["curve"]["unit"] == "N m"
    assert written["seed"] == 7 and written["sensitivity"] == [{"size": None}]


def test_a_finding_cannot_be_changed_after_its_check() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Finding(**EXAMPLE).verdict = "no_mismatch"


def test_text_that_is_not_json_is_named() -> None:
    with pytest.raises(FindingInvalid, match="not JSON"):
        from_json("{")


def test_variable_names_hold_no_slash() -> None:
    assert module.variable_name("friction_error", "box/floor", "ratio") == "friction_error[box:floor].ratio"


def test_a_vectors_interval_is_shown_component_by_component() -> None:
    told = copy.deepcopy(EXAMPLE)
    rate = {"mean": [0.5, -0.25], "sd": [0.1, 0.1], "interval": [[0.3, 0.7], [-0.45, -0.05]], "unit": "rad/s"}
    told["effects"][0]["parameters"]["rate"] = rate
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(finding_tables(Finding(**told)))
    shown = console.export_text()
    assert "0.5, -0.25" in shown and "0.3 to 0.7, -0.45 to -0.05" in shown and "0.29 to 0.33" in shown


def test_what_says_no_more_than_its_kind_is_said_once() -> None:
    told = ("world", "world"), ("sensor", "time"), ("joint", "time"), ("sensor", "qpos/time")
    labels = [module.Element(kind=kind, name=name).label for kind, name in told]
    assert labels == ["world", "time", "joint time", "sensor qpos/time"]


def test_a_curve_is_shown_by_its_least_and_largest_value() -> None:
    told = copy.deepcopy(EXAMPLE)
    told["effects"][0]["parameters"]["curve"] = {"x": [0.1, 0.2, 0.3], "y": [0.5, -1.25, 0.0], "unit": "N m"}
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(finding_tables(Finding(**told)))
    shown = console.export_text()
    assert "-1.25 to 0.5" in shown and "x=" not in shown


def test_write_replaces_the_file_whole(tmp_path) -> None:
    path = tmp_path / "new" / "diagnosis.json"
    atomic_write(path, b"old")
    write_json(Finding(**EXAMPLE), path)
    assert from_json(path.read_text("utf-8")).verdict == "mismatch"
    assert [file.name for file in path.parent.iterdir()] == ["diagnosis.json"]


def test_an_error_while_writing_leaves_the_old_file(tmp_path) -> None:
    path = tmp_path / "fit.nc"
    atomic_write(path, "old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
