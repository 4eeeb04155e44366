"""Makes files/lerobot: two episodes of an arm as LeRobot 0.6.1 records them (format v3.0).

LeRobot needs PyTorch, an environment of its own:

    uv pip install 'lerobot[dataset]==0.6.1'
    HF_HUB_OFFLINE=1 python lerobot_arm.py
"""

import shutil
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

OUT = Path(__file__).parents[1] / "files" / "lerobot"
RATE, STEPS = 100, 40


def make(folder: Path) -> None:
    """What lerobot-record does: features of a robot and of what commands it, then frame by frame."""
    features = hw_to_dataset_features({"wrist.pos": float, "top": (4, 4, 3)}, OBS_STR, use_video=False)
    features |= {
        "observation.turn": {"dtype": "float32", "shape": (2, 2), "names": None},
        ACTION: {"dtype": "float32", "shape": (2,), "names": {"drive": 0, "row": 1}},  # as its gamepad names them
    }
    data = LeRobotDataset.create("local/arm", RATE, features, root=folder, robot_type="arm", use_videos=False)
    for episode in range(2):
        for row in range(STEPS):
            time = row / RATE
            angle, torque = (1 + episode) * 0.3 * np.sin(5 * time), 0.1 * np.cos(9 * time)
            values = {"wrist.pos": np.degrees(angle), "top": np.zeros((4, 4, 3), np.uint8)}
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], np.float32)
            frame = build_dataset_frame(features, values, OBS_STR)
            frame |= {"observation.turn": turn, ACTION: np.array([torque, row], np.float32), "task": "swing"}
            data.add_frame(frame)
        data.save_episode()
    data.finalize()


def check(folder: Path) -> None:
    """LeRobot's own reader takes it."""
    data = LeRobotDataset("local/arm", root=folder)
    assert (data.num_episodes, len(data), data.meta.info.codebase_version) == (2, 2 * STEPS, "v3.0")
    assert data[STEPS + 1]["observation.turn"].shape == (2, 2)


if __name__ == "__main__":
    shutil.rmtree(OUT, ignore_errors=True)
    make(OUT)
    check(OUT)
    shutil.rmtree(OUT / "images")  # empty folders
    for path in sorted(OUT.rglob("*")):
        print(path.relative_to(OUT), path.stat().st_size)
