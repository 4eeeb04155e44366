"""A diagnosis made up: an arm of two joints whose wrist has a dry friction that the model lacks."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from det2stoc_bayes.report import diagnosis_page

CHANNELS = ("qpos/shoulder", "qpos/wrist", "qvel/shoulder", "qvel/wrist")
NOISE = np.array([0.002, 0.008, 0.02, 0.05])
UNITS = ("rad", "rad", "rad/s", "rad/s")
WRIST = {"kind": "joint", "name": "wrist"}


def make_finding(verdict: str) -> dict[str, Any]:
    """The content of diagnosis.json for a verdict."""
    finding: dict[str, Any] = {
        "verdict": verdict,
        "summary": "Dry friction of 0.31 ± 0.01 N m on joint wrist was left out; "
        "with it the held-out error falls by 78 %.",
        "evidence": {"log10_bayes_factor": 210.3, "noise_inflation": 41.0},
        "where": {
            "elements": [WRIST | {"share": 0.93}, {"kind": "joint", "name": "shoulder", "share": 0.05}],
            "when": [{"condition": "abs(qvel/wrist) > 0.8", "share": 0.88}],
        },
        "effects": [_effect()],
        "candidates": [],
        "experiment": None,
        "fit": _fit_numbers(),
        "psi": {
            "link_mass": {
                "before": {"mean": 1.9, "sd": 0.1},
                "after": {"mean": 1.2, "sd": 0.1},
                "prior_conflict": 0.02,
            },
            "damping": {
                "before": {"mean": 0.08, "sd": 0.001},
                "after": {"mean": 0.05, "sd": 0.002},
                "prior_conflict": 0.61,
            },
        },
        "negligible": [{"name": "sensor_bias", "element": {"kind": "sensor", "name": "qpos/wrist"}, "explains": 0.004}],
        "seconds": 41.0,
        "seed": 0,
        "versions": {"mujoco": "3.17.0", "det2stoc-bayes": "0.1.0"},
    }
    if verdict != "mismatch":
        finding |= {"effects": []}
    if verdict == "no_mismatch":
        finding |= _nothing_found()
    if verdict == "inconclusive":
        finding |= _open_question()
    return finding


def _effect() -> dict[str, Any]:
    return {
        "name": "coulomb_friction",
        "element": WRIST,
        "statement": "Dry friction of 0.31 ± 0.01 N m on joint wrist is missing.",
        "law": "-F sign(v)",
        "probability": 0.97,
        "explains": 0.78,
        "recordings": "all",
        "by_recording": [
            {"recording": "swing_1", "explains": 0.81, "kind": "explained"},
            {"recording": "swing_2", "explains": -0.2, "kind": "uncertain"},
        ],
        "parameters": {"force": {"mean": 0.31, "sd": 0.01, "interval": [0.29, 0.33], "unit": "N m"}},
        "equivalent": [],
        "alternatives": [
            {"name": "stribeck_friction", "element": WRIST, "probability": 0.02},
            {"name": "unlisted", "element": WRIST, "probability": 0.01},
        ],
    }


def _fit_numbers() -> dict[str, Any]:
    return {
        "horizon_s": 2.0,
        "heldout_log_density_before": -9120.0,
        "heldout_log_density_after": -310.0,
        "difference": 8810.0,
        "standard_error": 220.0,
        "rollout_rmse_before": dict(zip(CHANNELS, (0.0031, 0.04, 0.022, 0.31), strict=True)),
        "rollout_rmse_after": dict(zip(CHANNELS, (0.0021, 0.009, 0.0202, 0.052), strict=True)),
        "rollout_rmse_noise": dict(zip(CHANNELS, NOISE.tolist(), strict=True)),
        "unexplained_share": 0.03,
        "heldout_chose": True,
    }


def _nothing_found() -> dict[str, Any]:
    return {
        "summary": "No physics is missing that these recordings could show: "
        "rollouts of 2.0 s miss the held-out samples by the noise alone.",
        "evidence": {"log10_bayes_factor": -1.2, "noise_inflation": 1.01},
        "where": {"elements": [], "when": []},
        "fit": _fit_numbers() | {"rollout_rmse_before": dict(zip(CHANNELS, (0.002, 0.0081, 0.02, 0.051), strict=True))},
        "sensitivity": [{"name": "coulomb_friction", "element": WRIST, "size": 0.0042, "unit": "N m"}],
    }


def _open_question() -> dict[str, Any]:
    return {
        "summary": "A mismatch at body hand explains 91 % of the error, but a payload and a wrong mass "
        "cannot be told apart.",
        "where": {"elements": [{"kind": "body", "name": "hand", "share": 0.91}], "when": []},
        "candidates": [
            {
                "name": name,
                "element": {"kind": "body", "name": "hand"},
                "probability": p,
                "parameters": {"mass": {"mean": 0.2, "sd": 0.013, "interval": [0.17, 0.23], "unit": "kg"}},
            }
            for name, p in (("payload_mass", 0.55), ("mass_error", 0.41))
        ],
        "experiment": {
            "text": "Swing the wrist fast with the shoulder held at 90 degrees; "
            "a payload shifts the period, a mass error does not.",
            "input": {"ctrl/wrist": "chirp, 0.5 to 4 Hz, amplitude 2 N m, 5 s"},
            "initial_state": {"qpos/shoulder": 1.57, "qpos/wrist": 0.0},
            "expected_gain": 6.31,
        },
    }


def make_fit(verdict: str, *, num_recordings: int = 4, num_samples: int = 900) -> xr.DataTree:
    """A fit as the diagnosis hands it over; two of the recordings are held out."""
    rng = np.random.default_rng(0)
    by_recording = (("chain", "draw", "recording"), 0.3 + 0.02 * rng.standard_normal((4, 250, 3)))
    grip = xr.Dataset({"grip": by_recording}, coords={"recording": ["drop_01", "drop_02", "drop_03"]})
    nodes: dict[str, xr.Dataset] = {
        "/before/posterior": _posterior(rng, link_mass=(1.9, 0.1), damping=(0.08, 0.001)),
        "/after/posterior": _posterior(rng, link_mass=(1.2, 0.1), damping=(0.05, 0.002)),
        "/before/prior": _posterior(rng, link_mass=(1.0, 0.4), damping=(0.06, 0.02)),
        "/screening": _screening(rng, verdict),
    }
    for which in ("before", "after"):
        nodes[f"/{which}/posterior"] = nodes[f"/{which}/posterior"].merge(grip)
    if verdict == "mismatch":
        force = _posterior(rng, **{"coulomb_friction[wrist].force": (0.31, 0.01)})
        force["coulomb_friction[wrist].force"].attrs["unit"] = "N m"
        nodes["/after/posterior"] = nodes["/after/posterior"].merge(force)
    for k in range(num_recordings):
        role = "holdout" if k < 2 else "recordings"
        nodes[f"/rollouts/swing_{k:02d}"] = _rollout(rng, num_samples, role, wrong=verdict != "no_mismatch")
    nodes |= _shapes()
    for k, positions in ((0, True), (1, False)):  # of the second one only sensors were recorded
        nodes[f"/replay/motions/swing_{k:02d}"] = _motion(nodes[f"/rollouts/swing_{k:02d}"], positions)
    return xr.DataTree.from_dict(nodes)


def _posterior(rng: np.random.Generator, **moments: tuple[float, float]) -> xr.Dataset:
    draws = {
        name: (("chain", "draw"), mean + sd * rng.standard_normal((4, 250))) for name, (mean, sd) in moments.items()
    }
    return xr.Dataset(draws)


def _rollout(rng: np.random.Generator, num_samples: int, role: str, *, wrong: bool) -> xr.Dataset:
    time = 0.01 * np.arange(num_samples)
    phase = rng.uniform(0, 6)
    swing = np.exp(-0.1 * time) * np.sin(2 * time + phase)
    truth = np.stack([0.5 * swing, swing, np.gradient(0.5 * swing, time), np.gradient(swing, time)], axis=1)
    slip = 0.08 * np.exp(-0.05 * time) * np.sin(2 * time + phase + 1.1) * (1.0 if wrong else 0.0)
    before = truth + np.stack([0.02 * slip, slip, 0.03 * slip, 2 * slip], axis=1)
    observed = truth + NOISE * rng.standard_normal(truth.shape)
    observed[num_samples // 3 : num_samples // 3 + 15, 1] = np.nan
    sampled = ("sample", "channel")
    return xr.Dataset(
        {
            "observed": (sampled, observed),
            "before": (sampled, before),
            "after": (sampled, truth),
            "residual_before": (sampled, (observed - before) / NOISE),
            "residual_after": (sampled, (observed - truth) / NOISE),
            "noise_sd": ("channel", NOISE),
            "condition": ("sample", np.abs(truth[:, 3]) > 0.8 if wrong else np.zeros(num_samples, bool)),
        },
        coords={"time": ("sample", time), "channel": list(CHANNELS), "unit": ("channel", list(UNITS))},
        attrs={"role": role},
    )


def _shapes() -> dict[str, xr.Dataset]:
    """A floor, two links, and a hand that is a mesh."""
    upright = [1.0, 0.0, 0.0, 0.0]
    rows = [
        ("plane", -1, [0, 0, 1], [0, 0, -1.2], [0.5, 0.5, 0.5, 1], 0, 0),
        ("capsule", 0, [0.04, 0.25, 0], [0, 0, -0.25], [0.2, 0.4, 0.7, 1], 0, 0),
        ("box", 1, [0.03, 0.03, 0.2], [0, 0, -0.2], [0.5, 0.5, 0.5, 1], 0, 0),
        ("mesh", 1, [0, 0, 0], [0, 0, -0.4], [0.9, 0.6, 0.2, 0.8], 4, 4),
    ]
    kind, body, size, position, colour, vertices, faces = zip(*rows, strict=True)
    shapes = {
        "kind": ("geom", list(kind)),
        "of_body": ("geom", list(body)),
        "size": (("geom", "size_part"), np.array(size, float)),
        "position": (("geom", "position_part"), np.array(position, float)),
        "quaternion": (("geom", "quaternion_part"), np.array([upright] * len(rows))),
        "colour": (("geom", "colour_part"), np.array(colour, float)),
        "num_vertices": ("geom", list(vertices)),
        "num_faces": ("geom", list(faces)),
    }
    corners = 0.08 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float32)
    mesh = {"vertices": (("vertex", "xyz"), corners)}
    mesh["faces"] = (("face", "corner"), np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32))
    return {"/replay/shapes": xr.Dataset(shapes, {"bodies": ["upper", "lower"]}), "/replay/meshes": xr.Dataset(mesh)}


def _motion(rollout: xr.Dataset, positions: bool) -> xr.Dataset:
    """Poses of an arm of two links that turn about the y axis."""
    at = slice(None, None, 3)
    names = {"observed": "recorded"} if positions else {}
    names |= {"before": "before", "after": "after"}
    poses = {}
    for source, name in names.items():
        shoulder, wrist = rollout[source].values[at, :2].T
        elbow = -0.5 * np.stack([np.sin(shoulder), 0 * shoulder, np.cos(shoulder)], 1)
        bodies = []
        for place, angle in ((0 * elbow, shoulder), (elbow, shoulder + wrist)):
            turn = np.stack([np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle], 1)
            bodies.append(np.concatenate([place, turn], 1))
        poses[name] = (("frame", "body", "pose"), np.stack(bodies, 1).astype(np.float32))
    return xr.Dataset(poses, {"time": ("frame", rollout["time"].values[at])})


def _screening(rng: np.random.Generator, verdict: str) -> xr.Dataset:
    names = ["coulomb_friction", "stribeck_friction", "sensor_bias", *(f"effect_{i}" for i in range(40))]
    evidence = np.concatenate([[484.0, 480.1, 9.0], -rng.gamma(2, 1, 40)])
    probability = np.concatenate([[0.97, 0.02, 0.0], np.full(40, 1e-6)])
    if verdict == "no_mismatch":
        evidence, probability = evidence * 0 - 1.3, probability * 0 + 0.001
    kinds = ["joint", "joint", "sensor"] + ["joint"] * 40
    elements = ["wrist", "wrist", "qpos/wrist"] + ["shoulder"] * 40
    size = ["0.31 N m", "0.30 N m", "0.9 mrad"] + [""] * 40
    columns = {"name": names, "kind": kinds, "element": elements, "size": size}
    columns |= {"log_evidence": evidence, "probability": probability}
    return xr.Dataset({key: ("candidate", value) for key, value in columns.items()})


@pytest.fixture(scope="module", params=["mismatch", "no_mismatch", "inconclusive"])
def verdict(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def finding(verdict: str) -> dict[str, Any]:
    return make_finding(verdict)


@pytest.fixture
def fit(verdict: str) -> xr.DataTree:
    return make_fit(verdict)


@pytest.fixture(scope="module")
def html(verdict: str) -> str:
    return diagnosis_page(make_finding(verdict), make_fit(verdict), study_name="arm")


@pytest.fixture(scope="module")
def half_open() -> str:
    """The page of a finding that names one effect and cannot tell what else is missing."""
    told = make_finding("mismatch") | {k: v for k, v in _open_question().items() if k in ("candidates", "experiment")}
    return diagnosis_page(told, make_fit("mismatch"), study_name="arm")


@pytest.fixture(scope="module")
def open_question() -> tuple[dict[str, Any], xr.DataTree]:
    """A finding that cannot tell two candidates apart, and its arrays."""
    return make_finding("inconclusive"), make_fit("inconclusive")
