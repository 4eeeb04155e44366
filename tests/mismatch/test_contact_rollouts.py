"""What is foretold of stretches may contradict an explanation that tells each sample from those before."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, SLIDING, XML, slides

from det2stoc_bayes.mismatch.contact import rollouts
from det2stoc_bayes.mismatch.contact.fit import at
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

HEARD, RATTLES = "qvel/glide/vx", "qvel/glide/wz"


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        ({HEARD: 4.0}, {HEARD: 1.0}, ()),
        # a column at twice its error beside another that is told: much is left
        ({HEARD: 4.0, "qpos/glide/x": 2.0}, {HEARD: 1.0, "qpos/glide/x": 4.0}, ("qpos/glide/x",)),
        # next to nothing is left of all that was
        ({HEARD: 40.0, "qpos/glide/x": 2.0}, {HEARD: 1.0, "qpos/glide/x": 4.0}, ()),
        ({HEARD: 4.0, "qpos/glide/x": 4.0}, {HEARD: 3.0, "qpos/glide/x": 4.5}, ()),
        ({HEARD: 4.0, RATTLES: 4.0}, {HEARD: 3.0, RATTLES: 9.0}, ()),  # what is not heard says nothing
        ({HEARD: 4.0, "qpos/glide/x": 2.0}, {HEARD: 1.0, "qpos/glide/x": np.nan}, ()),
    ],
)
def test_a_column_that_is_foretold_worse_contradicts_what_leaves_much(tmp_path, monkeypatch, before, after, worse):
    problem = make_problem(Simulator(make_study(tmp_path / "study", XML.format(0.02), PSI, slides(count=2))))
    columns = problem.segments.columns
    followed = Followed(problem).hearing(np.isin(columns, SLIDING))
    fits = [at(followed, np.array([z])) for z in (0.0, 0.1)]
    told = {id(f): problem.noise * [e.get(c, 1.0) for c in columns] for f, e in zip(fits, (before, after), strict=True)}
    monkeypatch.setattr(rollouts, "rollouts", lambda fit: SimpleNamespace(rmse=lambda: told[id(fit)]))
    assert rollouts.told_worse(*fits) == worse
