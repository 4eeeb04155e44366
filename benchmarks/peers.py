"""What peers say of concealed studies that `det2stoc blind --plain` has diagnosed, by the same score.

    python benchmarks/peers.py LOG [--seed HEX]

`mujoco.sysid` fits psi and names nothing: whether its 95 % intervals hold the truth, and whether it warns. Sparse
regression (PySINDy's STLSQ) looks for terms in what inverse dynamics at that psi leaves of each joint's force; how many
terms, the Bayesian information criterion on other recordings decides. Every case is drawn again from the log's seed.
Needs the packages of `make bench`; lines go to benchmarks/results/peers.jsonl.
"""

import argparse
import sys
import tempfile
import time
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pysindy
from logs import append
from sysid_silence import Fit, fit_study

from det2stoc_bayes.blind.conceal import ConcealedCase
from det2stoc_bayes.blind.draw import Choice, draw_case
from det2stoc_bayes.blind.proof import read, revision
from det2stoc_bayes.blind.score import score
from det2stoc_bayes.blind.systems import SYSTEMS
from det2stoc_bayes.blind.systems.base import write_field

RESULTS = Path(__file__).parent / "results" / "peers.jsonl"
THRESHOLDS = np.geomspace(0.02, 2.0, 25)  # of standardized terms' coefficients
TRIMMED = 5  # samples at either end, where derivatives are poor
TERMS = {
    "constant_force": lambda q, v, a: np.ones_like(q),
    "joint_spring": lambda q, v, a: q,
    "cubic_stiffness": lambda q, v, a: q**3,
    "viscous_damping": lambda q, v, a: v,
    "quadratic_damping": lambda q, v, a: v * np.abs(v),
    "coulomb_friction": lambda q, v, a: np.sign(v),
    "armature": lambda q, v, a: a,
}


@dataclass(frozen=True)
class Motion:
    """One recording: positions, speeds, accelerations by smoothed differences, and forces left, by joint."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    left: np.ndarray


def motions(folder: Path, pattern: str, psi: Mapping[str, float]) -> tuple[mujoco.MjModel, list[Motion]]:
    """What inverse dynamics at these psi leaves of every joint's force."""
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    for name, entry in tomllib.loads((folder / "study.toml").read_text())["psi"].items():
        write_field(model, entry["target"], psi[name], (entry.get("index") or [None])[0])
    data, found = mujoco.MjData(model), []
    mujoco.mj_setConst(model, data)
    joints = [model.joint(j).name for j in range(model.njnt)]
    for path in sorted(folder.glob(pattern)):
        header, *rows = path.read_text().splitlines()
        at, table = header.split(","), np.loadtxt(rows, delimiter=",")
        q, v = (table[:, [at.index(f"{kind}/{j}") for j in joints]] for kind in ("qpos", "qvel"))
        u = table[:, [at.index(f"ctrl/{model.actuator(i).name}") for i in range(model.nu)]]
        a, left = np.asarray(pysindy.SmoothedFiniteDifference()(v, table[:, 0])), np.zeros_like(v)
        for k in range(len(v)):
            data.qpos[:], data.qvel[:], data.qacc[:], data.ctrl[:] = q[k], v[k], a[k], u[k]
            mujoco.mj_inverse(model, data)
            mujoco.mj_fwdActuation(model, data)
            left[k] = data.qfrc_inverse - data.qfrc_actuator
        kept = slice(TRIMMED, -TRIMMED)
        found.append(Motion(q[kept], v[kept], a[kept], left[kept]))
    return model, found


def sparse_terms(fitted: Sequence[Motion], other: Sequence[Motion], joint: int) -> dict[str, float]:
    """Terms that stay in a joint's force, with their standardized coefficients; which, other recordings decide."""

    def columns(every: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray]:
        rows = [np.stack([t(m.q[:, joint], m.v[:, joint], m.a[:, joint]) for t in TERMS.values()], 1) for m in every]
        return np.concatenate(rows), np.concatenate([m.left[:, joint] for m in every])

    (x, y), (x_other, y_other) = columns(fitted), columns(other)
    scale, size = np.sqrt(np.mean(x**2, 0)) + 1e-12, float(np.sqrt(np.mean(y**2))) + 1e-12
    best, chosen = len(y_other) * np.log(np.mean(y_other**2)), np.zeros(len(TERMS))
    for threshold in THRESHOLDS:
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6)
        model = pysindy.SINDy(optimizer=optimizer, feature_library=pysindy.IdentityLibrary())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that all terms were dropped
            model.fit(x / scale, t=1.0, x_dot=(y / size)[:, None])
        found = np.asarray(model.coefficients())[0]
        error = np.mean((y_other - size * (x_other / scale) @ found) ** 2)
        told = len(y_other) * np.log(error) + np.count_nonzero(found) * np.log(len(y_other))
        if told < best:
            best, chosen = told, found
    return {name: float(c) for name, c in zip(TERMS, chosen, strict=True) if c}


def sparse(folder: Path, psi: Mapping[str, float]) -> dict[str, Any]:
    """The terms of all joints as a diagnosis, the strongest first."""
    model, fitted = motions(folder, "recordings/*.csv", psi)
    _, other = motions(folder, "holdout/*.csv", psi)
    found = [
        (abs(c), {"name": name, "element": {"kind": "joint", "name": model.joint(j).name}, "parameters": {}})
        for j in range(model.njnt)
        for name, c in sparse_terms(fitted, other, j).items()
    ]
    effects = [entry for _, entry in sorted(found, key=lambda pair: -pair[0])]
    return {"verdict": "mismatch" if effects else "no_mismatch", "effects": effects}


def peers(case: ConcealedCase) -> dict[str, Any]:
    """What both say of a case."""
    with tempfile.TemporaryDirectory() as name:
        folder, began = case.write(Path(name)), time.perf_counter()
        fit: Fit = fit_study(folder)
        said = sparse(folder, {name: e.value for name, e in fit.estimates.items()})
        inside = [abs(fit.estimates[n].value - v) <= fit.estimates[n].half_width for n, v in case.answer["psi"].items()]
    strongest = said | {"effects": said["effects"][:1]}
    return {
        "sysid": {"inside": sum(inside), "psi": len(inside), "warnings": len(fit.warnings), "misfit": fit.misfit},
        "sparse": {"said": score(case.answer, said).diagnosed, "right": score(case.answer, said).named},
        "strongest": {"right": score(case.answer, strongest).named},
        "seconds": round(time.perf_counter() - began, 1),
    }


def same_case(line: Mapping[str, Any]) -> ConcealedCase | None:
    """A logged case drawn again; None where peers cannot read its study, or this version draws another one."""
    model, told = SYSTEMS[line["answer"]["system"]].compile({}), line["choice"]
    if line["answer"]["variants"] or model.nq != model.njnt or line["kind"] not in ("effect", "pair", "control"):
        return None
    choice = Choice(tuple(told["systems"]), told["plain"], tuple(told["names"]))
    case = draw_case(line["seed"], line["kind"], line["index"], choice)
    return case if (case.seed, case.answer["psi"]) == (line["case_seed"], line["answer"]["psi"]) else None


def main() -> int:
    """Both peers on every case of a log that has no variants and nothing but hinges and slides."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--seed", help="the cases of this seed alone")
    options = parser.parse_args()
    lines = [line for line in read(options.log)[0] if options.seed in (None, line["seed"])]
    heads = ("kind", "concealed", "det2stoc diagnose", "sysid: psi covered, warnings", "sparse regression")
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    totals, count = np.zeros(4, int), 0
    for line in lines:
        case = same_case(line)
        if case is None:
            print(f"{line['kind']} {line['index']}: left out", file=sys.stderr)
            continue
        ours, found = score(line["answer"], line["diagnosis"]), peers(case)
        about = {key: line[key] for key in ("seed", "kind", "index", "case_seed")}
        append(RESULTS, {"commit": revision(), **about, "concealed": ours.truth, "ours": ours.diagnosed, **found})
        fit, said = found["sysid"], found["sparse"]
        cells = (line["kind"], ours.truth, ours.diagnosed, f"{fit['inside']} of {fit['psi']}, {fit['warnings']}")
        print(f"| {' | '.join(cells)} | {said['said']} |", flush=True)
        count += 1
        totals += [ours.named, said["right"], found["strongest"]["right"], fit["inside"] == fit["psi"]]
    print(f"\nRight of {count}: det2stoc {totals[0]}, sparse regression {totals[1]} (by its strongest term alone")
    print(f"{totals[2]}); mujoco.sysid names nothing (all psi covered in {totals[3]}).")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
