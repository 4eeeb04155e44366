"""Data sets of robot learning: Minari's library writes its own here, files/ has those of LeRobot's and robomimic's."""

import json
import shutil
from pathlib import Path

import gymnasium as gym
import h5py
import minari
import mujoco
import numpy as np
import pyarrow as pa
import pytest
from importing_arm import ANGLE, SPEED, TIME, TORQUE
from minari.data_collector import EpisodeBuffer
from pyarrow import parquet

FILES = Path(__file__).parent / "files"
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")  # of authors and links that are not given
DRIVEN = ("--unit", "qpos/*=rad", "--unit", "ctrl/*=model")


class Arm(gym.Env):
    """The arm's motion, a row a step; episodes differ by what is added to the angle."""

    observation_space = gym.spaces.Dict(
        {"pose": gym.spaces.Box(-20, 20, (2,), np.float64), "picture": gym.spaces.Box(0, 255, (4, 4, 3), np.uint8)}
    )
    action_space = gym.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self):
        self.number, self.row = -1, 0

    def seen(self):
        picture = np.full((4, 4, 3), self.row, np.uint8)
        return {"pose": np.array([ANGLE[self.row] + self.number, SPEED[self.row]]), "picture": picture}

    def known(self):
        return {"row": self.row, "state": {"qpos": np.array([ANGLE[self.row] + self.number])}}

    def reset(self, *, seed=None, options=None):
        self.number, self.row = self.number + 1, 0
        return self.seen(), self.known()

    def step(self, action):
        self.row += 1
        return self.seen(), 0.0, False, self.row == len(TIME) - 1, self.known()


@pytest.fixture
def minari_place(place, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(place.folder / "sets"))
    return place


def test_minari_episodes(minari_place):
    place = minari_place
    collector = minari.DataCollector(Arm(), record_infos=True)
    for number in range(11):
        collector.reset()
        for torque in TORQUE[: -1 if number == 10 else 5]:  # all but the last are cut short
            collector.step(np.array([torque]))
    collector.create_dataset("arm/swing-v0")
    more = ("--column", "qvel/wrist=observations/pose/1", "--column", "ctrl/drive=actions/0", "--unit", "qvel/*=rad/s")
    more = (*more, "--column", "qpos/wrist=infos/state/qpos/0", *DRIVEN)
    code, said = place.imported("minari", "sets/arm/swing-v0", *more)
    assert code == 2 and "give --period" in said[-1]
    code, said = place.imported("minari", "sets/arm/swing-v0", *more, "--period", "0.01", "--holdout", "episode_9")
    assert code == 0, said
    _, rows = place.recording("episode_10")
    np.testing.assert_allclose(rows[:, :3], np.column_stack([TIME, ANGLE + 10, SPEED]), atol=1e-9)
    np.testing.assert_allclose(rows[:-1, 3], TORQUE[:-1])
    assert np.isnan(rows[-1, 3])
    _, rows = place.recording("episode_2")
    np.testing.assert_allclose(rows[:, 1], ANGLE[:6] + 2)
    told = (place.out / "SOURCE.md").read_text()
    assert "not taken: observations/pose/0, infos/row\n" in told  # no picture


def buffer(steps: int, observations: int) -> EpisodeBuffer:
    """An episode as one steps without a collector: no information on its first observation."""
    return EpisodeBuffer(
        observations={"pose": list(np.column_stack([ANGLE, SPEED])[:observations])},
        actions=list(TORQUE[:steps, None]),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * steps,
        infos={"qpos": list(ANGLE[1 : steps + 1])},
    )


def made_of(episode: EpisodeBuffer) -> None:
    space = gym.spaces.Dict({"pose": Arm.observation_space["pose"]})
    minari.create_dataset_from_buffers("arm-v0", [episode], observation_space=space, action_space=Arm.action_space)


def test_minari_infos_of_steps_alone_belong_to_what_was_seen_after_them(minari_place):
    place = minari_place
    made_of(buffer(39, 40))
    more = ("--column", "qpos/wrist=infos/qpos", "--column", "qvel/wrist=observations/pose/1", "--unit", "qvel/*=rad/s")
    code, said = place.imported("minari", "sets/arm-v0", *more, *DRIVEN, "--period", "0.01")
    assert code == 0, said
    _, rows = place.recording("episode_0")
    assert np.isnan(rows[0, 1])
    np.testing.assert_allclose(rows[1:], np.column_stack([TIME, ANGLE, SPEED])[1:], atol=1e-9)


def test_minari_with_as_many_observations_as_actions_is_refused(minari_place):
    made_of(buffer(39, 39))
    more = ("--column", "qpos/wrist=observations/pose/0", *DRIVEN, "--period", "0.01")
    code, said = minari_place.imported("minari", "sets/arm-v0", *more)
    assert code == 2 and "found 39 observations and 39 actions; allowed: one observation more" in said[-1]


LEROBOT = (
    "--column", "qpos/wrist=observation.state/wrist.pos", "--column", "ctrl/drive=action/drive",
    "--unit", "qpos/*=deg", "--unit", "ctrl/*=model", "--phase", "after",
)  # fmt: skip


def test_lerobot_episodes(place):
    assert json.loads((FILES / "lerobot" / "meta" / "info.json").read_text())["codebase_version"] == "v3.0"
    code, said = place.imported("lerobot", FILES / "lerobot", *LEROBOT, "--holdout", "episode_001")
    assert code == 0, said
    header, rows = place.recording("episode_000")
    assert header == ["time", "qpos/wrist", "ctrl/drive"]
    np.testing.assert_array_equal(rows[:, 0], np.round(TIME, 9))  # though the file has them as float32
    np.testing.assert_allclose(rows[:, 1:], np.column_stack([ANGLE, TORQUE]), atol=1e-8, rtol=1e-6)  # which these are
    assert (place.out / "holdout" / "episode_001.csv").is_file()
    turn = ", ".join(f"observation.turn/{i}" for i in range(4))
    assert f"not taken: {turn}, action/row\n" in (place.out / "SOURCE.md").read_text()


def test_lerobot_stamps_off_the_grid_are_taken_as_they_are(place):
    folder = place.folder / "dataset"
    shutil.copytree(FILES / "lerobot", folder)
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    content = parquet.read_table(path)
    late = np.tile(TIME + 1e-3 * np.sin(TIME), 2).astype(np.float32)
    place_of = content.schema.get_field_index("timestamp")
    parquet.write_table(content.set_column(place_of, "timestamp", pa.array(late)), path)
    code, said = place.imported("lerobot", "dataset", *LEROBOT)
    assert code == 0, said
    np.testing.assert_allclose(place.recording("episode_001")[1][:, 0], late[:40], atol=1e-9)


ROBOMIMIC = (
    "--column", "qpos/wrist=obs/robot0_joint_pos", "--column", "qvel/wrist=states/2",
    "--column", "ctrl/drive=actions/0", "--unit", "qvel/*=rad/s", *DRIVEN,
)  # fmt: skip


@pytest.mark.parametrize("demo", ["demo_1", "demo_2"])
def test_robomimic_demonstrations(place, demo):
    with h5py.File(FILES / "robomimic.hdf5") as file:
        (place.folder / "arm.xml").write_text(str(file[f"data/{demo}"].attrs["model_file"]))
    code, said = place.imported("robomimic", FILES / "robomimic.hdf5", *ROBOMIMIC)
    assert code == 0, said
    _, rows = place.recording(demo)
    time = 0.032 * np.arange(30)  # not a thirtieth of a second, which control_freq says
    np.testing.assert_allclose(rows[:, 0], time, atol=1e-9)
    gain = {0.4: 0.1, 0.6: 0.2}[round(rows[0, 1], 9)]  # episodes are gathered in any order
    np.testing.assert_allclose(rows[:, 3], gain * np.cos(0.3 * np.arange(30)))
    assert "rows at the times in states" in (place.out / "SOURCE.md").read_text()
    model = mujoco.MjModel.from_xml_path(str(place.folder / "arm.xml"))
    data = mujoco.MjData(model)
    (data.qpos[0], data.qvel[0]), seen = rows[0, 1:3], []
    for row in rows:  # controls act from their row on
        seen.append([data.time, data.qpos[0], data.qvel[0]])
        data.ctrl[0] = row[3]
        mujoco.mj_step(model, data, 16)
    np.testing.assert_allclose(rows[:, :3], seen, atol=1e-9)


def changed(place, change) -> None:
    shutil.copy(FILES / "robomimic.hdf5", place.folder / "demos.hdf5")
    with h5py.File(place.folder / "demos.hdf5", "a") as file:
        change(file["data"])


def without_states(data):
    for demo in data.values():
        del demo["states"]


def test_robomimic_without_states_comes_at_control_freq_or_at_the_period_that_is_given(place):
    more = [text.replace("states/2", "obs/robot0_joint_vel") for text in ROBOMIMIC]
    changed(place, without_states)
    code, said = place.imported("robomimic", "demos.hdf5", *more, "--only", "demo_2")
    assert code == 0, said
    np.testing.assert_allclose(place.recording("demo_2")[1][:, 0], np.arange(30) / 30, atol=1e-9)
    assert "control_freq 30 Hz" in (place.out / "SOURCE.md").read_text()
    shutil.rmtree(place.out)
    changed(place, lambda data: (without_states(data), data.attrs.__delitem__("env_args")))
    code, said = place.imported("robomimic", "demos.hdf5", *more)
    assert code == 2 and "give --period" in said[-1]
    assert place.imported("robomimic", "demos.hdf5", *more, "--period", "0.032")[0] == 0


def test_robomimic_states_that_go_back_are_refused(place):
    def back(data):
        data["demo_1/states"][3, 0] = 0.0

    changed(place, back)
    code, said = place.imported("robomimic", "demos.hdf5", *ROBOMIMIC)
    assert code == 2 and "demo_1: states/0, the time: row 4" in said[-1] and "--period" in said[-1]
    assert place.imported("robomimic", "demos.hdf5", *ROBOMIMIC, "--period", "0.032")[0] == 0
