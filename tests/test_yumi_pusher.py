"""YuMi Pusher: its links are the robot's, the scene is stable, and the pusher brings the box to the goal."""

import csv
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from det2stoc_bayes.models import yumi_pusher, yumi_pusher_mjx
from det2stoc_bayes.models._arm import damped_least_squares
from det2stoc_bayes.models.yumi_pusher_policy import Pusher

with (Path(__file__).parent / "yumi_links.csv").open() as file:
    LINKS = list(csv.DictReader(file))


def numbers(text):
    return np.array(text.split(), float)


@pytest.fixture(scope="module")
def model():
    return yumi_pusher.load_model()


@pytest.fixture(scope="module")
def episodes():
    """32 from psi_0 and as many starts."""
    random = np.random.default_rng(0)
    psi, start = yumi_pusher.PRIOR.draw(random, 32), yumi_pusher.drawn_starts(random, 32)
    return yumi_pusher.simulate(psi, start, lambda _: Pusher(np.random.default_rng(1)), random)


# --- the robot ------------------------------------------------------------------------------------
@pytest.mark.parametrize("link", LINKS, ids=lambda link: link["body"])
def test_links_are_the_robot_s(model, link):
    body = model.body(link["body"])
    assert model.body(body.parentid[0]).name == link["parent"]
    np.testing.assert_allclose(body.pos, numbers(link["pos"]), atol=1e-12)
    quaternion = numbers(link["quat"])
    np.testing.assert_allclose(body.quat, quaternion / np.linalg.norm(quaternion), atol=1e-9)
    assert body.mass[0] == float(link["mass"])
    if float(link["mass"]):
        np.testing.assert_allclose(body.ipos, numbers(link["inertial_pos"]), atol=1e-12)
    if float(link["mass"]) and link["diaginertia"]:
        np.testing.assert_allclose(body.inertia, numbers(link["diaginertia"]), rtol=1e-9)
        turn = numbers(link["inertial_quat"])
        np.testing.assert_allclose(body.iquat, turn / np.linalg.norm(turn), atol=1e-6)
    assert bool(link["joint"]) == bool(body.jntnum[0])


@pytest.mark.parametrize("link", [link for link in LINKS if link["joint"]], ids=lambda link: link["joint"])
def test_joints_are_the_robot_s(model, link):
    joint, axis = model.joint(link["joint"]), numbers(link["axis"])
    assert joint.bodyid[0] == model.body(link["body"]).id
    np.testing.assert_allclose(joint.axis, axis / np.linalg.norm(axis), atol=1e-9)
    np.testing.assert_allclose(joint.range, numbers(link["range"]))
    assert (joint.damping[0], joint.armature[0]) == (float(link["damping"]), 0.04)
    actuator = model.actuator(link["joint"])
    np.testing.assert_allclose(actuator.ctrlrange, numbers(link["ctrlrange"]))
    assert actuator.trnid[0] == joint.id and list(yumi_pusher.JOINTS).index(link["joint"]) == joint.id - 1


def test_the_table_and_the_box_are_the_source_s(model):
    assert model.opt.timestep == 0.004 and yumi_pusher.SUBSTEPS * model.opt.timestep == 0.04
    np.testing.assert_allclose(model.geom("table").size, [0.301, 0.475, 0.005])
    np.testing.assert_allclose(model.geom("table").pos, [0.45, 0, 0.046])
    np.testing.assert_allclose(model.geom("box").size, [0.03, 0.079, 0.105])
    np.testing.assert_allclose(model.geom("block").size, [0.03, 0.075, 0.02])
    assert (model.body("box").mass[0], model.body("block").mass[0]) == (0.054, 0.5)
    np.testing.assert_allclose(model.body("block").pos[1:], [0, -0.085])


# --- how it moves ---------------------------------------------------------------------------------
def test_arms_lose_their_energy_and_hold(model):
    """Gravity is compensated; motors that are told to stand still brake."""
    data = mujoco.MjData(model)
    data.qpos[:] = yumi_pusher.drawn_starts(np.random.default_rng(0), 1)[0, :21]
    data.qvel[6:] = np.random.default_rng(1).normal(0, 0.3, 14)
    energy = []
    for _ in range(500):
        mujoco.mj_step(model, data)
        mujoco.mj_energyVel(model, data)
        energy.append(data.energy[1])
    assert (np.diff(energy) < 1e-6).all() and energy[-1] < 1e-6 < 0.01 < energy[0]
    assert np.abs(data.qvel).max() < 1e-3  # the box's, too


def test_the_scene_stands_wild_commands():
    """Measured: no joint faster than 4 rad/s, no box through the table."""
    random = np.random.default_rng(0)
    psi, start = yumi_pusher.PRIOR.draw(random, 8), yumi_pusher.drawn_starts(random, 8)
    found = yumi_pusher.simulate(psi, start, lambda _: lambda state: random.uniform(-3, 3, (len(state), 14)), random)
    assert np.isfinite(found.full).all()
    assert np.abs(found.full[..., 27:]).max() < 10


def test_the_box_slides_as_coulomb_says(model):
    """Measured: 2 % below mu g, which MuJoCo's soft friction loses."""
    for friction, com in ((0.28, 0.035), (0.15, -0.05)):
        batch = yumi_pusher.prepared(model, np.array([[friction, com]]))
        batch.bind("qpos")[:] = yumi_pusher.drawn_starts(np.random.default_rng(0), 1)[:, :21]
        batch.step(nstep=100)
        batch.bind("qvel")[0, 1] = 0.4
        batch.step(nstep=3)
        before = batch.bind("qvel")[0, 1].copy()
        batch.step(nstep=10)
        assert (before - batch.bind("qvel")[0, 1]) / 0.04 == pytest.approx(friction * 9.81, rel=0.06)


def test_a_block_off_the_middle_does_not_throw_the_box_over(model):
    """Its mass would, 2 mm beyond the box's edge, if the block did not stand on the table as well."""
    alone = mujoco.MjSpec.from_file(str(yumi_pusher.MODEL))
    alone.delete(next(p for p in alone.pairs if p.name == "table_block"))
    for one, standing in ((model, True), (alone.compile(), False)):
        batch = yumi_pusher.prepared(one, np.array([[0.28, 0.035]]))
        batch.step(nstep=300)
        quaternion = batch.bind("qpos")[0, 3:7]
        upright = 1 - 2 * (quaternion[1] ** 2 + quaternion[2] ** 2)
        assert upright > 0.999 if standing else upright < 0.5


# --- arms and states ------------------------------------------------------------------------------
def test_arms_are_where_mujoco_says(model):
    random, data = np.random.default_rng(0), mujoco.MjData(model)
    joints = random.normal(0, 0.7, (4, 14))
    for i, (side, arm) in enumerate(zip(yumi_pusher.SIDES, yumi_pusher.arms(), strict=True)):
        own = slice(7 * i, 7 * i + 7)
        places, turns, jacobians = arm.pose(joints[:, own])
        for q, place, turn, jacobian in zip(joints, places, turns, jacobians, strict=True):
            data.qpos[7:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            both = np.zeros((6, model.nv))
            mujoco.mj_jacSite(model, data, both[:3], both[3:], model.site(f"{side}_tip").id)
            np.testing.assert_allclose(place, data.site(f"{side}_tip").xpos, atol=1e-12)
            np.testing.assert_allclose(turn.ravel(), data.site(f"{side}_tip").xmat, atol=1e-12)
            np.testing.assert_allclose(jacobian, both[:, 6:][:, own], atol=1e-12)


def test_damped_least_squares_is_least():
    random = np.random.default_rng(0)
    jacobian, wanted, aside = random.normal(size=(3, 6, 7)), random.normal(size=(3, 6)), random.normal(size=(3, 7))
    found = damped_least_squares(jacobian, wanted, aside, 0.1)
    for j, w, a, f in zip(jacobian, wanted, aside, found, strict=True):
        stacked, target = np.concatenate([j, 0.1 * np.eye(7)]), np.concatenate([w, 0.1 * a])
        np.testing.assert_allclose(f, np.linalg.lstsq(stacked, target)[0], atol=1e-9)


def test_noise_is_as_it_is_told():
    random = np.random.default_rng(0)
    full = yumi_pusher.drawn_starts(random, 1)
    turn = np.array([0.5, 0.1, -0.3, 0.8])
    full[:, 3:7] = turn / np.linalg.norm(turn)
    state = yumi_pusher.state_of(full)
    rows = np.repeat(state, 4000, 0)
    noisy = yumi_pusher.measured(rows, random)
    expected = yumi_pusher.noise_variance(state)[0]
    assert set(np.flatnonzero(expected < 1e-12)) <= set(range(28, 54))
    np.testing.assert_allclose(noisy.var(0), expected, rtol=0.12, atol=1e-11)  # 5 standard errors of 4000 draws
    np.testing.assert_allclose(np.linalg.norm(noisy[:, 31:35], axis=1), 1.0)
    assert sum(block.stop - block.start for block in yumi_pusher.BLOCKS.values()) == len(yumi_pusher.STATE) == 60


# --- the pusher -----------------------------------------------------------------------------------
def test_the_box_comes_to_the_goal(episodes):
    """Measured: in 95.5 % of 1000 episodes."""
    assert yumi_pusher.at_goal(episodes.states).mean() >= 0.8
    assert np.linalg.norm(episodes.states[:, 0, 42:44] - yumi_pusher.GOAL, axis=1).min() > 0.05


def test_both_arms_push(episodes):
    """The one on whose side the box starts; it leaves home, the other hardly."""
    moved = np.ptp(episodes.full[:, :, 7:21], axis=1).reshape(-1, 2, 7).max(2)
    right = (episodes.states[:, 0, 43] < 0).astype(int)
    rows = np.arange(len(right))
    assert 0 < right.mean() < 1
    assert (moved[rows, right] > 0.3).all() and (moved[rows, 1 - right] < 0.1).all()


def test_commands_lead_from_state_to_state(episodes):
    """From any sample on, the recorded command gives the next one."""
    k, psi = 40, yumi_pusher.PRIOR.draw(np.random.default_rng(0), 32)
    found = yumi_pusher.simulate(
        psi, episodes.full[:, k], lambda rows: lambda _: episodes.actions[rows, k], np.random.default_rng(1),
        num_steps=1,
    )  # fmt: skip
    np.testing.assert_allclose(found.full[:, 1], episodes.full[:, k + 1], atol=1e-4)  # solvers start anew: 1e-6


# --- MJX ------------------------------------------------------------------------------------------
@pytest.mark.long
def test_mjx_is_the_c_engine(monkeypatch):
    random, psi = np.random.default_rng(0), np.array([[0.28, 0.035]])
    start = yumi_pusher.drawn_starts(random, 1)
    monkeypatch.setattr(yumi_pusher, "load_model", yumi_pusher_mjx.reduced_model)
    c = yumi_pusher.simulate(psi, start, lambda _: Pusher(np.random.default_rng(5)), random, num_steps=40)
    with jax.enable_x64(True):
        found = yumi_pusher_mjx.simulate(psi, start, c.actions)
    off = np.abs(found - c.full)[0]
    assert off[:20].max() < 1e-5  # until the fingers touch the box
    assert off[:, :21].max() < 5e-3 and np.linalg.norm(c.full[0, -1, :2] - c.full[0, 0, :2]) > 0.02
