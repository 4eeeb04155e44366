"""A block on a spring that is pushed: its stiffness and its friction are uncertain."""

from pathlib import Path

from det2stoc_bayes.models._recorded import Psi, Recorded

SYSTEM = Recorded(
    model=Path(__file__).with_suffix(".xml"),
    psi={
        "stiffness": Psi("joint/rail/stiffness", 20.0, 4.0, 5.0, 40.0),
        "damping": Psi("joint/rail/damping", 0.5, 0.15, 0.05, 1.5),
    },
    noise={"rail": (0.005, 0.05)},  # 1 sd of position and speed
    start=(0.1, 0.3),
    amplitude=2.0,
    num_recordings=2,
    num_samples=40,
)
TRUTH = {"stiffness": 23.0, "damping": 0.4}


def record(folder: Path) -> Path:
    """A study of recordings under TRUTH."""
    return SYSTEM.write_study(folder, TRUTH)
