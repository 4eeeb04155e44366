"""A cart with a hanging pole: unknown mass of the pole, friction of its bearing, and gain of the motor; seen dimly."""

from pathlib import Path

from det2stoc_bayes.models._recorded import Psi, Recorded

SYSTEM = Recorded(
    model=Path(__file__).with_suffix(".xml"),
    psi={
        "pole_mass": Psi("body/pole/mass", 0.3, 0.08, 0.05, 0.8),
        "swing_damping": Psi("joint/swing/damping", 0.02, 0.006, 0.002, 0.06),
        "gain": Psi("actuator/push/gainprm", 1.0, 0.15, 0.3, 1.7, 0),
    },
    noise={"track": (0.03, 0.3), "swing": (0.05, 0.5)},
    start=(0.2, 0.8, 0.4, 1.5),
    amplitude=15.0,
    num_recordings=2,
    num_samples=40,
)
TRUTH = {"pole_mass": 0.38, "swing_damping": 0.014, "gain": 1.1}


def record(folder: Path) -> Path:
    """A study of recordings under TRUTH."""
    return SYSTEM.write_study(folder, TRUTH)
