"""Models as inline XML and studies made of them, for tests of the engines and of what builds on them."""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
import shapes_plugin  # before the package, whose functions it decorates

from det2stoc_bayes.recording import Recording, StudyWarning
from det2stoc_bayes.study import Study, load_study

OPTION = '<option timestep="0.002" integrator="{integrator}" gravity="0 0 -9.81"/>'
HINGE = """
<body name="arm" pos="0 0 1"><joint name="hinge" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" fromto="0 0 0 0.4 0 -0.3" size="0.03" mass="0.7" contype="0" conaffinity="0"/>
</body>"""
SLIDE = """
<body name="block"><joint name="slide" type="slide" axis="1 0 0.3" damping="0.3" stiffness="20"
  springref="0.1"/>
  <geom size="0.1" mass="1.3" contype="0" conaffinity="0"/></body>"""
CARTPOLE = """
<body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="0.2"/>
  <geom type="box" size="0.1 0.1 0.05" mass="1" contype="0" conaffinity="0"/>
  <body name="pole"><joint name="pivot" axis="0 1 0" damping="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.6" size="0.02" mass="0.2" contype="0" conaffinity="0"/>
</body></body>"""
ARM = """
<body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping="0.3" armature="0.01"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1" contype="0" conaffinity="0"/>
  <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.2" armature="0.005"/>
    <geom type="capsule" fromto="0 0 0 0.25 0 0.05" size="0.025" mass="0.6" contype="0" conaffinity="0"/>
</body></body>"""
FREE = """
<body name="stone" pos="0 0 2"><freejoint name="float"/>
  <geom type="box" size="0.1 0.06 0.03" mass="0.8" contype="0" conaffinity="0"/></body>"""
MOTORS = """
<actuator><motor name="turn" joint="shoulder" gear="2"/>
<position name="servo" joint="elbow" kp="8" kv="0.3"/></actuator>"""
GENERAL = """
<actuator><general name="turn" joint="shoulder" gainprm="1.5" biastype="affine" biasprm="0.2 -1 -0.1"
  ctrlrange="-1 1" ctrllimited="true"/>
<general name="servo" joint="elbow" dyntype="filterexact" dynprm="0.05" gainprm="2"/></actuator>"""


def pytest_runtest_setup() -> None:
    """Every test checks signatures anew."""
    shapes_plugin.CALLS.clear()


def pytest_configure(config: pytest.Config) -> None:
    """Compiled JAX programs are kept from one run of the tests to the next."""
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(config.rootpath / ".pytest_cache" / "jax"))


def model_xml(bodies: str, rest: str = "", integrator: str = "Euler", option: str | None = None) -> str:
    """A whole MJCF around bodies."""
    option = OPTION.format(integrator=integrator) if option is None else option
    return f"<mujoco>{option}<worldbody>{bodies}</worldbody>{rest}</mujoco>"


def write_recording(path: Path, time: Sequence[float], columns: Mapping[str, Sequence[float]]) -> None:
    """A csv with a time column; NaN is an empty cell."""
    lines = [",".join(["time", *columns])]
    for row in zip(time, *columns.values(), strict=True):
        lines.append(",".join("" if np.isnan(v) else repr(float(v)) for v in row))
    path.write_text("\n".join(lines) + "\n")


def make_study(
    folder: Path,
    xml: str,
    toml: str = "",
    recordings: Mapping[str, tuple[Sequence[float], Mapping[str, Sequence[float]]]] | None = None,
) -> Study:
    """A study of an inline MJCF; `toml` are its tables ([psi.*], [noise], [known.*]).

    `recordings`: name -> (time, column -> values). By default one of half a second at rest.
    """
    (folder / "recordings").mkdir(parents=True)
    (folder / "model.xml").write_text(xml)
    (folder / "study.toml").write_text('model = "model.xml"\nrecordings = "recordings/*.csv"\n' + toml)
    if recordings is None:
        time = np.arange(26) * 0.02
        columns = list(state_columns(mujoco.MjModel.from_xml_string(xml)))
        recordings = {"one": (time, {c: np.full(26, float(c.endswith("qw"))) for c in columns})}
    for name, (time, columns) in recordings.items():
        write_recording(folder / "recordings" / f"{name}.csv", time, columns)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StudyWarning)
        return load_study(folder)


def state_columns(model: mujoco.MjModel) -> list[str]:
    """Position and velocity columns of every named joint."""
    out = []
    for j in range(model.njnt):
        name, kind = model.joint(j).name, int(model.jnt_type[j])
        parts = {
            0: ("/x /y /z /qw /qx /qy /qz", "/vx /vy /vz /wx /wy /wz"),
            1: ("/qw /qx /qy /qz", "/wx /wy /wz"),
        }
        for source, suffixes in zip(("qpos", "qvel"), parts.get(kind, ("", "")), strict=True):
            out += [f"{source}/{name}{s}" for s in suffixes.split() or [""]]
    return out


def blank_recording(
    model: mujoco.MjModel,
    time: np.ndarray,
    columns: Sequence[str] | None = None,
    ctrl: np.ndarray | None = None,
) -> Recording:
    """A recording whose values do not matter: it gives times, columns and commands to follow."""
    columns = tuple(state_columns(model)) if columns is None else tuple(columns)
    ctrl = np.zeros((len(time), model.nu)) if ctrl is None else ctrl
    return Recording(
        "blank",
        np.asarray(time, float),
        columns,
        np.zeros((len(time), len(columns))),
        ctrl,
        Path("blank.csv"),
    )


@pytest.fixture
def compiled() -> Callable[..., mujoco.MjModel]:
    """Compiles bodies and the rest of an MJCF."""
    return lambda *args, **options: mujoco.MjModel.from_xml_string(model_xml(*args, **options))
