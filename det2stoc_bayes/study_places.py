"""Which numbers of the model a study's targets mean, and whether psi and what is known mean the same."""

import warnings
from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING

from det2stoc_bayes.engines.model_names import rows_of
from det2stoc_bayes.recording import StudyWarning

if TYPE_CHECKING:
    # Dotted names, so that the checker of the tests can look them up.
    import mujoco

    import det2stoc_bayes.study


def places(target: "det2stoc_bayes.study.Target", model: "mujoco.MjModel") -> list[tuple[str, str, int]]:
    """Kind, field and row of each place that a target means."""
    return [(target.kind, target.field, int(row)) for row in rows_of(model, target.kind, target.name, target.field)]


def warn_of_known(
    parameters: "Sequence[det2stoc_bayes.study.Parameter]",
    known: "Mapping[str, Mapping[det2stoc_bayes.study.Target, object]]",
    model: "mujoco.MjModel",
    source: str,
) -> None:
    """That what is known of a recording stands there in the place of a psi."""
    for p, (stem, given) in product(parameters, known.items()):
        mine = set(places(p.target, model))
        for target in (t for t in given if mine.intersection(places(t, model))):
            warnings.warn(
                f"{source}: known.{stem}.'{target}' stands in the place of psi.{p.name} in that recording",
                StudyWarning,
                stacklevel=3,
            )
