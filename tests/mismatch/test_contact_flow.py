"""A thrown box: what contact does to the uncertainty of its state, and what that does to the likelihood of a model."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import mujoco
import numpy as np
import pytest
from conftest import make_study

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact.chances import alike, as_the_best
from det2stoc_bayes.mismatch.contact.fit import at
from det2stoc_bayes.mismatch.contact.flow import Ground, Once, contact_flow
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.mimic import mimicking
from det2stoc_bayes.mismatch.contact.pair import Pair
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

XML = """
<mujoco model="thrown">
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 0.1" friction="0.4"/>
    <body name="box" pos="0 0 0.4">
      <freejoint name="toss"/>
      <geom name="shell" type="box" size="0.05 0.04 0.03" mass="0.3" friction="0.4"/>
    </body>
  </worldbody>
</mujoco>
"""
PSI = """
[psi.friction]
target = "geom/floor/friction"
index = [0]
prior = { LogNormal = { loc = -0.9, scale = 0.2 } }
[noise]
"qpos/*" = 5e-4
"""
NOISE, EVERY, SAMPLES = 5e-4, 5, 60
COLUMNS = [f"qpos/toss/{c}" for c in ("x", "y", "z", "qw", "qx", "qy", "qz")]


def throws(count=4, **options):
    model, random, out = mujoco.MjModel.from_xml_string(XML), np.random.default_rng(2), {}
    for name, value in options.items():
        getattr(model.opt, name)[:] = value
    for k in range(count):
        data = mujoco.MjData(model)
        data.qvel[:] = [*random.normal(0, 0.5, 2), 0.0, *random.normal(0, 3, 3)]
        rows = []
        for i in range(EVERY * SAMPLES):
            if i % EVERY == 0:
                rows.append(np.array(data.qpos))
            mujoco.mj_step(model, data)
        values = np.array(rows) + NOISE * random.standard_normal((SAMPLES, 7))
        out[f"throw_{k}"] = 0.002 * EVERY * np.arange(SAMPLES), dict(zip(COLUMNS, values.T, strict=True))
    return out


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return make_problem(Simulator(make_study(tmp_path_factory.mktemp("thrown") / "study", XML, PSI, throws())))


def test_a_free_flight_jolts_nothing_and_an_impact_does(problem):
    followed = Followed(problem, 25.0)
    flow = contact_flow(problem, followed.observer, np.zeros(1))
    found = flow.grown
    low = problem.segments.values[..., 2] < 0.11
    first = np.argmax(low, axis=1)
    for r, j in enumerate(first):
        size = found[r].max()
        assert found[r, 2 : j - 1].max() < 1e-3 * size  # measured: 1e-4, of gyroscopic motion
        assert found[r, j - 1 : j + 12].max() > 10 * found[r, 2 : j - 1].max()
        assert flow.kept[r, 2 : j - 1, :3].min() > 0.999  # of places and speeds in free flight
        assert np.median(flow.kept[r, j + 12 :, 2].min(-1)) < 0.9  # the floor holds heights


def test_members_that_diverge_are_left_out(problem, monkeypatch):
    followed = Followed(problem, 25.0)
    engine, whole = problem.simulator.engine, contact_flow(problem, followed.observer, np.zeros(1))

    def spoilt(request):
        path = type(engine).trajectory(engine, request)
        path.columns[len(problem.segments.time)] = np.nan  # the second member on the first recording
        path.qvel[len(problem.segments.time)] = 1e9
        return path

    monkeypatch.setattr(engine, "trajectory", spoilt)
    flow = contact_flow(problem, followed.observer, np.zeros(1))
    np.testing.assert_array_equal(flow.grown[1:], whole.grown[1:])
    ratio = flow.grown[0].sum() / whole.grown[0].sum()
    assert ratio != 1 and 0.3 < ratio < 3 and np.isfinite(flow.kept).all()


def test_noise_is_foretold_after_impacts_too(problem):
    plain = Followed(problem, 25.0)
    led = plain.grounded(Ground(problem, np.zeros(1)))
    z = problem.simulator.parameters[0].prior.to_normal(np.array([0.4]))
    before, after = (at(f, np.asarray(z, float)).errors for f in (plain, led))
    assert np.nanmean(after**2) == pytest.approx(1, abs=0.25)
    assert np.nanmean(before**2) > 1.2  # measured: 1.35, and 0.84 with jolts


def test_the_likelihood_is_smooth_where_impacts_are_foretold_to_jolt(problem):
    plain = Followed(problem, 25.0)
    ways = np.linspace(-0.02, 0.02, 21)

    def rough(followed):
        heights = np.array([at(followed, np.array([-0.1 + d])).loss for d in ways])
        return np.abs(np.diff(heights, 2)).max()

    assert rough(plain.grounded(Ground(problem, np.zeros(1)))) < 0.2 * rough(plain)


def test_other_regards_of_the_same_ground_are_as_if_found_alone(problem):
    ground = Ground(problem, np.zeros(1))
    shared = [ground.regarding(*way) for way in ((False, 1.0), (True, 0.1))]
    alone = [Ground(problem, np.zeros(1), *way) for way in ((False, 1.0), (True, 0.1))]
    gains = [g.observer(problem.segments, 25.0)[0].gains for g in (*shared, *alone)]
    assert len(ground.first) == 1
    for one, other in zip(gains[:2], gains[2:], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(gains[0], gains[1])


def test_what_threads_ask_for_is_made_once_and_other_things_meanwhile(problem):
    """Each waits for the other's to begin: one after the other they would wait for ever."""
    once, made, begun = Once(), [], Barrier(2, timeout=10)

    def ask(memory):
        def make():
            begun.wait()
            made.append(memory)
            return memory

        return once(problem.segments, memory, make)

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(ask, (6.0, 12.0, 6.0, 12.0))) == [6.0, 12.0, 6.0, 12.0]
    assert sorted(made) == [6.0, 12.0] and len(once) == 2


def test_some_recordings_are_led_as_among_all(problem):
    led = Followed(problem, 25.0).grounded(Ground(problem, np.zeros(1)))
    fit = at(led, np.zeros(1))
    rows = np.array([1, 3])
    np.testing.assert_allclose(fit.followed.only(rows).errors(np.zeros((1, 1)))[0], fit.only(rows).errors, atol=1e-9)


def test_buoyancy_predicts_what_less_gravity_does(tmp_path):
    study = make_study(tmp_path / "study", XML, PSI, throws(gravity=[0, 0, -9.3]))
    problem = make_problem(Simulator(study))
    led = Followed(problem, 25.0).grounded(Ground(problem, np.zeros(1)))
    pool = {p.effect.name: p for p in candidates(problem)}

    def pair(name, z):
        fits = [at(led.with_problem(led.problem.with_effects((pool[name],))), np.array(z)) for _ in range(2)]
        return Pair(*fits)

    z = pool["gravity_error"].effect.to_normal({"change": np.array(0.51)}, pool["gravity_error"].typical)
    right, off = pair("gravity_error", [-0.1, *z]), pair("buoyancy", [-0.098, 0.178])
    wind = pair("quadratic_drag", [-0.095, 0.3])
    assert not alike(off, right)
    same, other = (mimicking(p.fit, right.fit) for p in (off, wind))
    assert alike(Pair(same, same), right) and not alike(Pair(other, other), right)
    assert np.nanmean((same.errors - right.fit.errors) ** 2) < 1e-2 * np.nanmean(
        (off.fit.errors - right.fit.errors) ** 2
    )
    assert [p.placed.effect.name for p in as_the_best([right, off])] == ["gravity_error", "buoyancy"]
