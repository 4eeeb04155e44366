"""Held-out rollouts of a study under Coulomb and viscous friction alone: what a diagnosis has to beat.

A copy of the study gets the joint's frictionloss as one more psi; all of psi is fitted to whole recordings, and the
rollout error on held-out ones is printed. python benchmarks/coulomb_viscous.py [STUDY --joint NAME]
"""

import argparse
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import det2stoc_bayes as d2s
from det2stoc_bayes.linearization import start_point
from det2stoc_bayes.mismatch.heldout import held_out
from det2stoc_bayes.mismatch.horizon import climb
from det2stoc_bayes.optimize import fit_many
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

TABLE = """
[psi.dry_friction]
target = "joint/{joint}/frictionloss"
prior = {{ HalfNormal = {{ scale = {scale} }} }}
"""


def main() -> int:
    """The fit and its errors."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("study", type=Path, help="one whose joint has damping, as servo_xl330")
    parser.add_argument("--joint", default="hinge")
    parser.add_argument("--scale", type=float, default=0.1, help="of the friction's prior [N m]")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        copy = Path(folder) / "study"
        shutil.copytree(options.study, copy)
        with (copy / "study.toml").open("a", encoding="utf-8") as file:
            file.write(TABLE.format(joint=options.joint, scale=options.scale))
        problem = make_problem(Simulator(d2s.load(copy)))
        first = climb(problem)
        z = None if first is None else first.point.z
        fit = fit_many([(problem, start_point(problem, z))], tolerance=0.5, max_iterations=20)[0]
        if fit is None:
            print("no simulation stays finite", file=sys.stderr)
            return 1
        for name, value in problem.constrained(fit.point.z).items():
            print(f"{name} = {value:.4g}")
        for column, error in zip(problem.segments.columns, held_out(fit).rmse, strict=True):
            print(f"held-out rollouts, rmse of {column}: {error:.4g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
