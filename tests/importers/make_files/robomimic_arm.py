"""Makes files/robomimic.hdf5: an arm of robosuite 1.4.1, recorded by its wrapper, by robomimic 0.3.0's scripts.

robomimic needs PyTorch, an environment of its own; what else these two releases ask for is not called here:

    uv pip install torch h5py psutil tqdm termcolor tensorboardX imageio imageio-ffmpeg matplotlib scipy numba \
        mujoco==3.17.0 opencv-python-headless six 'numpy<2.3'
    uv pip install --no-deps robomimic==0.3.0 robosuite==1.4.1 pynput
    python robomimic_arm.py
"""

import json
import os
import runpy
import sys
import tempfile
from collections import OrderedDict
from pathlib import Path
from types import ModuleType, SimpleNamespace

os.environ |= {"MUJOCO_GL": "disable", "PYNPUT_BACKEND": "dummy"}  # neither window nor keyboard
sys.modules["mujoco_py"] = ModuleType("mujoco_py")  # robomimic 0.3.0 imports it even where robosuite has mujoco

import numpy as np  # noqa: E402
import robomimic.utils.file_utils as files  # noqa: E402
import robosuite  # noqa: E402
from robomimic.utils.dataset import SequenceDataset  # noqa: E402
from robosuite.environments.base import MujocoEnv  # noqa: E402
from robosuite.models.base import MujocoXML  # noqa: E402
from robosuite.models.tasks import Task  # noqa: E402
from robosuite.scripts.collect_human_demonstrations import gather_demonstrations_as_hdf5  # noqa: E402
from robosuite.utils.observables import Observable, sensor  # noqa: E402
from robosuite.wrappers import DataCollectionWrapper  # noqa: E402

OUT = Path(__file__).parents[1] / "files" / "robomimic.hdf5"
ARM = """<mujoco>
  <asset><material name="steel"/></asset>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="wrist" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 -0.3" size="0.03" mass="0.7" contype="0" conaffinity="0"
        material="steel"/>
      <site name="tip" pos="0.4 0 -0.3"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="wrist"/></actuator>
</mujoco>
"""
RATE, STEPS = 30, 30  # robosuite makes 16 steps of 2 ms a row of that, so rows come every 32 ms


class OneJointArm(MujocoEnv):
    """robosuite knows environments by their classes' names; its robot is one joint, moved by torque."""

    start = 0.0
    robots = (SimpleNamespace(robot_model=SimpleNamespace(naming_prefix="robot0_")),)
    action_spec = (np.array([-1.0]), np.array([1.0]))
    action_dim = 1

    def __init__(self, reward_shaping=False, use_object_obs=True, use_camera_obs=False, camera_depths=False, **kwargs):
        super().__init__(**kwargs)

    def _load_model(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.xml"
            path.write_text(ARM)
            self.model = Task(mujoco_arena=MujocoXML(str(path)), mujoco_robots=[])

    def _reset_internal(self):
        super()._reset_internal()
        self.sim.data.qpos[:] = self.start

    def _setup_observables(self):
        @sensor(modality="robot0_proprio")
        def joint_pos(cache):
            return np.array(self.sim.data.qpos)

        @sensor(modality="robot0_proprio")
        def joint_vel(cache):
            return np.array(self.sim.data.qvel)

        @sensor(modality="object")
        def tip(cache):
            return np.array(self.sim.data.get_site_xpos("tip"))

        seen = {"robot0_joint_pos": joint_pos, "robot0_joint_vel": joint_vel, "tip": tip}
        return OrderedDict((name, Observable(name, read, sampling_rate=RATE)) for name, read in seen.items())

    def reward(self, action=None):
        return 0.0

    def _check_success(self):
        return True  # only successful demonstrations are gathered


def script(name: str, *arguments: str) -> None:
    """Run a script of robomimic as `python -m` does."""
    sys.argv = [name, *arguments]
    runpy.run_module(f"robomimic.scripts.{name}", run_name="__main__")


def make(folder: Path) -> Path:
    """Record, gather, convert, and extract observations, as robomimic's documentation says for robosuite's files."""
    config = {"env_name": "OneJointArm", "control_freq": RATE}
    env = DataCollectionWrapper(
        robosuite.make(**config, has_offscreen_renderer=False, ignore_done=True), str(folder / "raw")
    )
    for number in range(2):
        OneJointArm.start = 0.4 + 0.2 * number
        env.reset()
        for row in range(STEPS):
            env.step(np.array([0.1 * np.cos(9 * row / RATE) * (1 + number)]))
    env.close()
    gather_demonstrations_as_hdf5(str(folder / "raw"), str(folder), json.dumps(config))
    np.random.seed(0)  # noqa: NPY002 - of the split into training and validation
    script("conversion.convert_robosuite", "--dataset", str(folder / "demo.hdf5"))
    more = ("--output_name", OUT.name, "--done_mode", "2")
    script("dataset_states_to_obs", "--dataset", str(folder / "demo.hdf5"), *more)
    return folder / OUT.name


def check(path: Path) -> None:
    """robomimic's own readers take it."""
    print(files.get_env_metadata_from_dataset(str(path)))
    keys = ["robot0_joint_pos", "robot0_joint_vel", "object"]
    data = SequenceDataset(str(path), obs_keys=keys, dataset_keys=["actions"], hdf5_cache_mode=None)
    assert len(data) == 2 * STEPS and data[0]["obs"]["object"].shape == (1, 3)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        made = make(Path(place))
        check(made)
        OUT.write_bytes(made.read_bytes())
    print(OUT, OUT.stat().st_size)
