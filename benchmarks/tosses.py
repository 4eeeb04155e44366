"""Open-loop rollouts of held-out recordings of a free body from their first sample, by several models of one scene.

python benchmarks/tosses.py STUDY [MODEL.xml ...]: the study's own model, the same with --friction and --solref for
every geom (contact tuned by hand), and other models, as a diagnosis's patched.xml (an effects.py beside it takes part).
"""

import argparse
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np

import det2stoc_bayes as d2s
from det2stoc_bayes.recording import Recording


def module_beside(model: Path) -> ModuleType | None:
    """effects.py beside a model, if there is one."""
    path = model.parent / "effects.py"
    spec = importlib.util.spec_from_file_location("effects", path) if path.is_file() else None
    if spec is None or spec.loader is None:
        return None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def error(model: mujoco.MjModel, record: Recording, effects: ModuleType | None) -> float:
    """Mean distance [m] of the first free body's place from the recorded one."""
    joint = next(j for j in range(model.njnt) if model.jnt_type[j] == int(mujoco.mjtJoint.mjJNT_FREE))
    name = model.joint(joint).name
    values = dict(zip(record.columns, record.values.T, strict=True))
    data, q, v = mujoco.MjData(model), int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    data.qpos[q : q + 7] = [values[f"qpos/{name}/{p}"][0] for p in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    data.qvel[v : v + 6] = [values[f"qvel/{name}/{p}"][0] for p in ("vx", "vy", "vz", "wx", "wy", "wz")]
    place = np.stack([values[f"qpos/{name}/{p}"] for p in "xyz"], -1)
    data.time = record.time[0]
    if effects is not None:
        effects.reset(model, data)
    out = []
    for t, there in zip(record.time[1:], place[1:], strict=True):
        while data.time < t - 0.5 * model.opt.timestep:
            data.qfrc_applied[:], data.xfrc_applied[:] = 0.0, 0.0
            if effects is not None:
                effects.control(model, data)
            mujoco.mj_step(model, data)
        out.append(np.linalg.norm(data.qpos[q : q + 3] - there))
    return float(np.mean(out))


def main() -> int:
    """Mean over held-out recordings of each model's mean error."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("study", type=Path)
    parser.add_argument("models", nargs="*", type=Path, help="other models, as patched.xml of diagnoses")
    parser.add_argument("--friction", type=float, default=0.18)
    parser.add_argument("--solref", type=float, nargs=2, default=(0.006, 0.7))
    options = parser.parse_args()
    study = d2s.load(options.study)
    if not study.holdout:
        print(f"error: {options.study}: no held-out recordings; needed: holdout/*.csv", file=sys.stderr)
        return 2
    believed, tuned = (mujoco.MjModel.from_xml_path(str(study.model_path)) for _ in range(2))
    tuned.geom_friction[:, 0], tuned.geom_solref[:] = options.friction, options.solref
    found: dict[str, tuple[mujoco.MjModel, ModuleType | None]] = {}
    found |= {str(study.model_path): (believed, None), "tuned by hand": (tuned, None)}
    for path in options.models:
        found[str(path)] = mujoco.MjModel.from_xml_path(str(path)), module_beside(path)
    for name, (model, effects) in found.items():
        errors = [error(model, record, effects) for record in study.holdout]
        se = np.std(errors, ddof=1) / np.sqrt(len(errors)) if len(errors) > 1 else np.nan
        print(f"{1e3 * np.mean(errors):.1f} +- {1e3 * se:.1f} mm over {len(errors)} recordings: {name}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
