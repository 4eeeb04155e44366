"""What an experiment's page shows of recorded episodes and their populations."""

import base64

import numpy as np

from det2stoc_bayes.report.episode_figures import episode_figure, population_rows
from det2stoc_bayes.reproduce.populations import populations_table
from det2stoc_bayes.reproduce.yumi_pusher_scene import SCENE


def model(shift):
    told = {"mean": [0.28 + shift, 0.03], "sd": [0.01, 0.004]}
    episodes = [[0.27 + shift, 0.03], [0.29 + shift, 0.04]]
    about = {"episodes": episodes, "episode_sds": [[0.01, 0.002], [0.02, 0.003]]}
    return {"population": told, "drawn": {"mean": [0.281, 0.034], "sd": [0.009, 0.005]}} | about


SEEDS = [
    {"seed": n, "models": {"baseline 10": {}, "det2stoc 1": model(0.1), "det2stoc 2": model(0.01 * n)}} for n in (0, 1)
]
EXACT = [
    {"drawn": [[0.275, 0.031], [0.285, 0.039]], "mean": [[0.276, 0.03], [0.284, 0.04]],
     "covariance": [np.diag([4e-6, 1e-6]).tolist()] * 2, "population": {"mean": [0.28, 0.035], "sd": [0.008, 0.006]}}
] * 2  # fmt: skip


def test_populations_stand_beside_what_was_drawn():
    """Of the last iteration; where nothing is exact, without."""
    table = populations_table(SCENE, SEEDS, EXACT)
    psi, seed, *found = table["rows"][1]
    assert (psi, seed) == ("friction", "1")
    np.testing.assert_allclose(found, [0.281, 0.009, 0.29, 0.01, 0.28, 0.008])
    assert len(table["rows"]) == 4 and len(table["columns"]) == 8
    assert population_rows(table)[2] == {
        "psi": "com", "seed": "0", "values": ["0.0340 ± 0.0050", "0.0300 ± 0.0040", "0.0350 ± 0.0060"],
    }  # fmt: skip
    assert [len(row) for row in populations_table(SCENE, SEEDS, [])["rows"]] == [6] * 4


def test_episodes_stand_beside_what_they_had_drawn():
    def numbers(values):
        return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])

    _, learned, exact = episode_figure(SEEDS, EXACT, 0, "1")["data"]
    np.testing.assert_allclose(numbers(learned["x"]), [0.275, 0.285] * 2, rtol=1e-6)
    np.testing.assert_allclose(numbers(learned["y"]), [0.27, 0.29, 0.28, 0.30], rtol=1e-6)
    np.testing.assert_allclose(learned["error_y"]["array"], [0.02, 0.04] * 2)
    np.testing.assert_allclose(exact["error_y"]["array"], [0.004] * 4)
