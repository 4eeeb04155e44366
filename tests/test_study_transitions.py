"""Recordings and simulations of a study as transitions."""

import numpy as np
import pytest
from conftest import make_study, model_xml
from simulated import MOTOR, SLED, SPRING, SPRING_PSI, noise_table, pose, recordings

from det2stoc_bayes.errors import MethodNotApplicable, SimulationDiverged
from det2stoc_bayes.study_transitions import STRETCH, StudyTransitions
from det2stoc_bayes.transitions import Transitions

NOISE = (0.002, 0.01)
MASS_PSI = '[psi.mass]\ntarget = "body/sled/mass"\nprior = { Normal = { loc = 2.0, scale = 0.2 } }\n'


STEPS = 10 * np.arange(61)


def spring(folder, columns=None, steps=STEPS, toml=""):
    starts = [([0.3], [0.0]), ([-0.2], [1.0]), ([0.1], [-1.5])]
    made = recordings(model_xml(SPRING), starts, steps, NOISE, columns=columns)
    return pose(make_study(folder / "spring", model_xml(SPRING), SPRING_PSI + toml + noise_table(*NOISE), made))


def sled(folder):
    """Pushed by steps of command that come between the samples that are read."""
    ctrl = [np.repeat([[1.0], [-2.0], [0.5]], 80, 0), np.repeat([[-1.0], [3.0], [0.0]], 80, 0)]
    made = recordings(model_xml(SLED, MOTOR), [([0.0], [0.0])] * 2, np.arange(240), (0.0, 0.0), ctrl=ctrl)
    return pose(make_study(folder / "sled", model_xml(SLED, MOTOR), MASS_PSI + noise_table(1e-4, 1e-3), made))


def test_states_and_changes_are_those_recorded(tmp_path):
    problem = spring(tmp_path)
    found = StudyTransitions.of(problem)
    rows = found.recorded()
    assert found.every == 1 and not found.remembers and not found.uneven
    assert rows.action.shape == (180, 0) and found.inputs == ()
    assert found.seconds == pytest.approx(10 * problem.simulator.model.opt.timestep)
    for r, record in enumerate(problem.segments.recordings):
        mine = rows.episode == r
        np.testing.assert_array_equal(rows.state[mine], record.values[:-1])
        np.testing.assert_array_equal(rows.change[mine], np.diff(record.values, axis=0))


def test_a_long_recording_is_thinned_and_commands_are_averaged(tmp_path):
    """A constant mass under mean commands: dv = u dt / m, whatever falls between the samples."""
    problem = sled(tmp_path)
    found = StudyTransitions.of(problem)
    assert found.every == 2
    rows = found.recorded()
    dt = 2 * problem.simulator.model.opt.timestep
    np.testing.assert_allclose(rows.change[:, 1], rows.action[:, 0] * dt / 2.0, atol=1e-9)
    assert found.inputs == ("ctrl/push",)
    assert len(np.unique(rows.action)) > 4  # means of two commands are among them


def test_positions_alone_carry_the_step_before(tmp_path):
    problem = spring(tmp_path, columns=["qpos/slide"])
    found = StudyTransitions.of(problem)
    rows = found.recorded()
    assert found.remembers
    first, values = rows.episode == 0, problem.segments.recordings[0].values[:, 0]
    np.testing.assert_array_equal(rows.state[first, 0], values[1:-1])
    np.testing.assert_array_equal(rows.action[first, 0], np.diff(values)[:-1])
    np.testing.assert_array_equal(rows.change[first, 0], np.diff(values)[1:])


def test_positions_at_uneven_times_carry_both_steps(tmp_path):
    problem = spring(tmp_path, columns=["qpos/slide"], steps=np.cumsum(np.tile([7, 10, 13], 21)) - 7)
    found = StudyTransitions.of(problem)
    rows = found.recorded()
    assert found.inputs == ("change of qpos/slide before", "time step", "time step before")
    time = problem.segments.recordings[0].time
    first = rows.episode == 0
    np.testing.assert_allclose(rows.action[first, 1], np.diff(time)[1:])
    np.testing.assert_allclose(rows.action[first, 2], np.diff(time)[:-1])


def test_what_cannot_be_simulated_alike_is_refused(tmp_path):
    with pytest.raises(MethodNotApplicable, match="position is not recorded"):
        StudyTransitions.of(spring(tmp_path / "speed", columns=["qvel/slide"]))
    heavy = '[likelihood]\nnoise = "student_t"\n'
    with pytest.raises(MethodNotApplicable, match="student_t"):
        StudyTransitions.of(spring(tmp_path / "heavy", toml=heavy))


def test_dropped_samples_and_uneven_times(tmp_path):
    problem = spring(tmp_path, steps=np.cumsum(np.tile([7, 10, 13], 21)) - 7)
    record = problem.segments.recordings[0]
    holed = record.values.copy()
    holed[5, 0] = np.nan
    found = StudyTransitions.of(problem)
    assert found.uneven
    rows = found.recorded([type(record)(**{**vars(record), "values": holed})])
    assert len(rows) == len(record.time) - 1 - 2
    kept = np.delete(np.arange(len(record.time) - 1), [4, 5])
    np.testing.assert_allclose(rows.action[:, 0], np.diff(record.time)[kept])


def test_nothing_in_succession_is_an_error(tmp_path):
    problem = spring(tmp_path)
    record = problem.segments.recordings[1]
    holed = record.values.copy()
    holed[::2] = np.nan
    with pytest.raises(MethodNotApplicable, match="run_1.*qpos/slide, qvel/slide.*allowed"):
        StudyTransitions.of(problem).recorded([type(record)(**{**vars(record), "values": holed})])


def test_what_is_known_of_recordings_is_an_input(tmp_path):
    known = '[known.run_1]\n"body/block/mass" = 2.5\n'
    found = StudyTransitions.of(spring(tmp_path, toml=known))
    rows = found.recorded()
    assert rows.action.shape[1] == 1 and found.inputs == ("known 0",)
    np.testing.assert_array_equal(rows.action[:, 0], np.where(rows.episode == 1, 2.5, 1.2))


@pytest.mark.parametrize("columns", [None, ["qpos/slide"]])
def test_simulated_ones_are_like_those_recorded(tmp_path, columns):
    """Under the true psi a linear prediction that simulations teach leaves of recordings what it leaves of them."""
    problem = spring(tmp_path, columns=columns)
    found = StudyTransitions.of(problem)
    psi = np.tile([0.4, 30.0], (400, 1))
    simulated, real = found.simulated(psi, np.random.default_rng(0)), found.recorded()
    assert len(simulated) == pytest.approx(400 * (STRETCH - found.remembers), rel=0.1)
    assert len(np.unique(simulated.episode)) == 400

    def inputs(rows: Transitions) -> np.ndarray:
        return np.concatenate([rows.given, np.ones((len(rows), 1))], 1)

    gain = np.linalg.lstsq(inputs(simulated), simulated.change, rcond=None)[0]
    left = [(rows.change - inputs(rows) @ gain).std(0) for rows in (simulated, real)]
    np.testing.assert_allclose(left[1], left[0], rtol=0.2)  # 180 rows: a standard error of 5 %


def test_simulations_that_diverge_are_no_material(tmp_path):
    """Explosive damping: the few that stay finite would teach what is not the prior's."""
    transitions = StudyTransitions.of(spring(tmp_path))
    psi = np.tile([[-4e4, 30.0]], (20, 1))
    with pytest.raises(SimulationDiverged, match="100% of the simulations to learn from diverge.*damping -4e"):
        transitions.simulated(psi, np.random.default_rng(0))
