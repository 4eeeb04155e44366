"""Poses for the replay: those of the positions that were recorded, or of the simulators' states."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import PENDULUM, add_holdout, fit, noise_table, pose, recordings

from det2stoc_bayes.mismatch import result
from det2stoc_bayes.mismatch.heldout import held_out
from det2stoc_bayes.mismatch.replay import MOST_FRAMES, replay, states_of
from det2stoc_bayes.study import load_study

PSI = '[psi.damping]\ntarget = "joint/pivot/damping"\nprior = { Normal = { loc = 0.05, scale = 0.02 } }\n'
TIP = '<sensor><framepos name="tip" objtype="geom" objname="tip"/></sensor>'
ROD = PENDULUM.replace("<geom ", '<geom name="tip" ')
STARTS = [([0.5], [0.0]), ([-0.8], [1.0])]


def _diagnosed(folder, made, held, noise):
    """A fit, its rollouts of fitted and held-out recordings."""
    study = make_study(folder, model_xml(ROD, TIP), PSI + noise, made)
    add_holdout(study, held)
    before = fit(pose(load_study(folder)))
    study = before.problem.simulator.study
    paths, others = result.fitted_paths(before), held_out(before).rollouts
    runs = result.rollouts(before, paths, paths, study.recordings, "recordings", [])
    return before, runs | result.rollouts(before, others, others, study.holdout, "holdout", [])


def _made(seed, starts):
    return recordings(model_xml(ROD, TIP), starts, 10 * np.arange(400), (1e-3, 1e-2), seed=seed)


def test_recorded_positions_give_the_poses(tmp_path) -> None:
    made, held = _made(1, STARTS), {f"later_{k}": v for k, v in _made(2, STARTS[:1]).items()}
    time, columns = next(iter(made.values()))
    angle = np.array(columns["qpos/pivot"])
    angle[10], angle[50:90] = np.nan, np.nan
    first = next(iter(made))
    made[first] = (time, dict(columns) | {"qpos/pivot": angle})
    before, runs = _diagnosed(tmp_path / "study", made, held, noise_table(1e-3, 1e-2))
    groups = replay(before.problem.simulator, runs, lambda _: pytest.fail("positions were recorded"))
    motion = groups[f"replay/motions/{first}"]
    assert set(motion.data_vars) == {"recorded", "before"}  # before and after are the same
    assert motion.sizes["frame"] == MOST_FRAMES and set(groups) >= {f"replay/motions/{name}" for name in runs}
    poses = motion["recorded"].values[:, 0]
    seen, at = np.isfinite(poses).all(1), motion["time"].values
    gap = (at > time[50] - 1e-9) & (at < time[90] - 1e-9)
    assert not seen[gap].any() and seen[~gap].all()  # the lone sample is bridged
    turned = np.interp(at, time[np.isfinite(angle)], angle[np.isfinite(angle)])
    np.testing.assert_allclose(
        poses[seen, 3:], np.stack([np.cos(turned / 2), 0 * at, np.sin(turned / 2), 0 * at], 1)[seen], atol=1e-4
    )
    np.testing.assert_allclose(poses[seen, :3], [[0, 0, 1]] * int(seen.sum()), atol=1e-6)


def test_sensors_alone_give_the_simulators_alone(tmp_path) -> None:
    made, held = _made(1, STARTS), {f"later_{k}": v for k, v in _made(2, STARTS[:1]).items()}

    def tips(of):
        return {n: (t, {"sensor/tip/0": -0.25 * np.sin(c["qpos/pivot"])}) for n, (t, c) in of.items()}

    before, runs = _diagnosed(tmp_path / "study", tips(made), tips(held), '[noise]\n"sensor/*" = 1e-3\n')
    groups = replay(before.problem.simulator, runs, states_of(before, before, None))
    for name, rollout in runs.items():
        motion = groups[f"replay/motions/{name}"]
        assert set(motion.data_vars) == {"before"}
        # The middle of the rod, which the sensor saw.
        sine = 2 * motion["before"].values[:, 0, 3] * motion["before"].values[:, 0, 5]
        told = np.interp(motion["time"].values, rollout["time"].values, rollout["before"].values[:, 0])
        np.testing.assert_allclose(-0.25 * sine, told, atol=2e-5)
