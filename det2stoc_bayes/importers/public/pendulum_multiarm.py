"""Free swings of one arm of the multi-arm pendulum (Kaheman et al., arXiv:2205.06231)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from det2stoc_bayes.importers.base import SourceError, numbers
from det2stoc_bayes.importers.public.base import Converted, Dataset
from det2stoc_bayes.importers.write import Table

FILE = "ParameterEstimation/SinglePendulum/SinglePendulumDataForParameterEstimation.mat"
EVERY = 4  # of the samples at 1 kHz
MODEL = """<mujoco model="pendulum_multiarm">
  <option timestep="0.002" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.00022"/>
      <inertial pos="0 0 -0.1478" mass="0.1476" diaginertia="1.1e-4 1.1e-4 1.1e-5"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0 0 -0.25" size="0.008" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""
STUDY = """model = "model.xml"
recordings = "recordings/*.csv"
holdout = "holdout/*.csv"

[psi.inertia]
target = "body/arm/inertia"
index = [1]
prior = { TruncatedNormal = { loc = 0.00011, scale = 4e-05, low = 1e-06 } }

[psi.damping]
target = "joint/hinge/damping"
prior = { TruncatedNormal = { loc = 0.00022, scale = 0.00015, low = 0.0 } }

[noise]
"qpos/*" = 4e-05
"qvel/*" = 0.03
"""
SOURCE = """Free swings of one pendulum arm on a bench whose cart was clamped (K. Kaheman et al., "The Experimental
Multi-Arm Pendulum on a Cart", arXiv:2205.06231).

- Angle by an encoder at 1 kHz; speed as the authors filtered it (median, wavelets). Their four identification segments
  are `recordings`, their two validation segments `holdout`.
- Converted: every fourth sample; `qpos/hinge` = angle - pi, so 0 hangs down; `qvel/hinge` = speed. Units rad, rad/s, s.
- Noise: angle 4e-5 rad, speed 0.03 rad/s. Masses, lengths and prior means are the authors' identified values."""


def convert(files: Mapping[str, Path]) -> Converted:
    """Y_id and Y_vad are cells of (angle, speed) rows, Time_id and Time_vad of their times."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(files[FILE])
    except (ValueError, OSError, TypeError, NotImplementedError, MatReadError) as error:
        reason = " ".join(str(error).split())
        raise SourceError(
            f"{Path(FILE).name}: cannot be read: {reason}; allowed: a MATLAB file up to version 7"
        ) from error
    swings = []
    for part in ("id", "vad"):
        for key in (f"Y_{part}", f"Time_{part}"):
            if key not in content:
                raise SourceError(f"{Path(FILE).name}: no {key}; allowed: the file of the pinned commit")
        pairs = zip(content[f"Y_{part}"].ravel(), content[f"Time_{part}"].ravel(), strict=True)
        swings.append([_swing(y, t) for y, t in pairs])
    fitted, held = swings
    named = [(f"swing_{i}", table) for i, table in enumerate(fitted + held, 1)]
    return Converted(dict(named[: len(fitted)]), dict(named[len(fitted) :]), STUDY)


def _swing(values: object, times: object) -> Table:
    state, time = numbers(values, "Y"), numbers(times, "Time").ravel()
    if state.shape != (2, len(time)):
        raise SourceError(
            f"{Path(FILE).name}: found {state.shape} numbers at {len(time)} times; allowed: two rows of them"
        )
    rows = np.column_stack([time - time[0], state[0] - np.pi, state[1]])[::EVERY]
    return Table(("time", "qpos/hinge", "qvel/hinge"), rows)


DATASET = Dataset(
    name="pendulum_multiarm",
    repository="dynamicslab/MultiArm-Pendulum",
    commit="e99a7e13fe2adc8fc647321a156b6cb59a48a698",
    files=(FILE,),
    license="MIT, Copyright (c) 2022 dynamicslab",
    model=MODEL,
    source=SOURCE,
    convert=convert,
)
