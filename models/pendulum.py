"""A driven pendulum with unknown friction in its bearing and an unknown gain of its motor, seen dimly."""

from pathlib import Path

from det2stoc_bayes.models._recorded import Psi, Recorded

SYSTEM = Recorded(
    model=Path(__file__).with_suffix(".xml"),
    psi={
        "damping": Psi("joint/pivot/damping", 0.06, 0.02, 0.005, 0.2),
        "gain": Psi("actuator/drive/gainprm", 1.0, 0.15, 0.3, 1.7, 0),
    },
    noise={"pivot": (0.05, 0.4)},
    start=(0.8, 1.5),
    amplitude=2.0,
    num_recordings=2,
    num_samples=40,
)
TRUTH = {"damping": 0.08, "gain": 0.9}


def record(folder: Path) -> Path:
    """A study of recordings under TRUTH."""
    return SYSTEM.write_study(folder, TRUTH)
