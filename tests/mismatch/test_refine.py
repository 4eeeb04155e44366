"""Refining what screening puts forward, and leading on who went astray."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import ARM, make_study, model_xml
from simulated import PENDULUM, fit, noise_table, place, pose, recordings, spring_problem

from det2stoc_bayes.mismatch import refine as module
from det2stoc_bayes.mismatch.effects import Typical
from det2stoc_bayes.mismatch.evidence import by_chance
from det2stoc_bayes.mismatch.refine import look
from det2stoc_bayes.mismatch.screen import Screened
from det2stoc_bayes.segments import cut

NOISE = [0.002, 0.002, 0.02, 0.02]
STARTS = [([0.6, 0.4], [0.0, 0.0]), ([-0.4, 0.9], [1.0, -1.0]), ([1.2, -0.5], [-2.0, 2.0])]


def loaded(xml: str, mass: float, offset: tuple[float, float, float]) -> str:
    """The arm with a small ball welded to its second link."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.body("lower").add_geom(size=[1e-4, 0, 0], pos=offset, mass=mass, contype=0, conaffinity=0)
    spec.compile()
    return spec.to_xml()


def test_a_payload_beside_an_uncertain_mass(tmp_path):
    """Combined trials put less mass in its place; from there mass and offset run off along their product."""
    xml = model_xml(ARM)
    # The link weighs 0.6 kg.
    made = recordings(loaded(xml, 0.1, (0.22, 0.0, -0.08)), STARTS, 10 * np.arange(100), NOISE)
    toml = '[psi.mass]\ntarget = "body/lower/mass"\nprior = { Normal = { loc = 0.75, scale = 0.12 } }\n'
    problem = pose(make_study(tmp_path / "study", xml, toml + noise_table(*NOISE[1:3]), made))
    typical = Typical(force=0.5, speed=2.0, span=0.08, inertia=0.6)
    pool = [place(problem, name, "lower", typical) for name in ("payload_mass", "com_offset", "mass_error")]
    best, other = look(fit(problem), pool, lambda *_: None).ranked
    assert [r.placed.effect.name for r in (best, other)] == ["payload_mass", "com_offset"]
    assert best.fit.noise_inflation < 1.1  # measured: 0.95; from the combined trials alone it is com_offset
    values = best.placed.from_normal(best.fit.point.z[1:].tolist())
    assert values["mass"] == pytest.approx(0.1, rel=0.1)
    np.testing.assert_allclose(values["offset"], [0.22, 0.0, -0.08], atol=0.02)


@pytest.mark.parametrize("samples", [None, 20])
def test_a_fit_that_keeps_little_of_what_was_promised_is_led_on_by_short_stretches(samples, tmp_path):
    """One at a false optimum is played by one that has taken no step; what keeps its promise stays as it is.

    Where the base follows stretches alone, the way may lead to whole recordings; its end is told on the base's.
    """

    def push(model, data):
        data.qfrc_applied[0] = 2.0 * np.sin(30 * data.qpos[0] + 0.5)

    problem = spring_problem(tmp_path, push=push, noise=1e-3)
    base = fit(problem.on(cut(problem.segments.recordings, samples, problem.segments.columns)))
    ripple = place(base.problem, "cogging_torque", "slide", Typical(force=5.0, speed=1.0, span=0.6, inertia=1.2))
    near = ripple.effect.to_normal({"amplitude": 1.0, "cycles": 29.0, "phase": 0.6}, ripple.typical)
    problem = base.problem.with_effects([ripple])
    stuck = fit(problem, [*base.point.z, *near], max_iterations=0)
    assert stuck.noise_inflation > 5
    promise = Screened(
        ripple, ripple.effect.trials(ripple.typical)[0], 1e4, 0.0, np.zeros(2), np.zeros(base.problem.size)
    )
    led = module._led_on(base, stuck, promise, 1.0)
    assert by_chance(led) and led.problem.segments.key == base.problem.segments.key
    kept = module.gain(base, stuck, 1.0) / module.KEPT
    assert module._led_on(base, stuck, replace(promise, log_evidence=kept - 1.0), 1.0) is stuck
    assert module._led_on(base, led, promise, 1.0) is led


@pytest.mark.parametrize(
    ("names", "asked"),
    [
        (("viscous_damping", "cogging_torque", "constant_force"), (0, 1)),
        (("viscous_damping", "constant_force", "quadratic_damping", "cogging_torque"), (0, 1, 2)),
    ],
)
def test_not_the_first_alone_is_led_on_until_one_explains(names, asked, tmp_path, monkeypatch):
    """The truth is astray: in second place it is found, and who is behind it left alone; in fourth it is too late."""

    def push(model, data):
        data.qfrc_applied[0] = 2.0 * np.sin(30 * data.qpos[0] + 0.5)

    base, typical = fit(spring_problem(tmp_path, push=push, noise=1e-3)), Typical(5.0, 1.0, 0.6, 1.2)
    placed = [place(base.problem, name, "slide", typical) for name in names]
    truth = placed[names.index("cogging_torque")]
    near = truth.effect.to_normal({"amplitude": 6.0, "cycles": 29.0, "phase": 0.6}, typical)
    ends = [near if p is truth else [3.0] for p in placed]
    stuck = [
        fit(base.problem.with_effects([p]), [*base.point.z, *z], max_iterations=0)
        for p, z in zip(placed, ends, strict=True)
    ]
    monkeypatch.setattr(module, "race", lambda *_, **__: stuck)
    real, led = module._led_on, []

    def led_on(base, fit, lead, share):
        led.append(lead.placed.effect.name)
        return real(base, fit, lead, share)

    anew = []
    monkeypatch.setattr(module, "_led_on", led_on)
    monkeypatch.setattr(module, "_from_leader", lambda base, leader, fit, share: anew.append(fit) or fit)
    none = np.zeros(base.problem.size)
    promised = [
        Screened(p, p.effect.trials(typical)[0], 1e4 - i, 0.0, np.zeros(len(p.effect.trials(typical)[0].columns)), none)
        for i, p in enumerate(placed)
    ]
    slot = module._refined(base, promised, (), len(placed), lambda *_: None, None)
    assert led == [names[i] for i in asked] == [f.problem.effects[-1].effect.name for f in anew]
    assert by_chance(slot.ranked[0].fit) is (truth.effect.name in led)


def test_who_went_astray_starts_anew_from_where_the_leader_ended(tmp_path):
    """A string that is taut for a part of the way; a spring takes up the most of it, and leaves the rest to be told."""
    anchor, length, stiffness = np.array([-0.5, 0.0, 1.0]), 0.45, 3.0

    def push(model, data):
        way = data.xipos[1] - anchor
        distance = np.linalg.norm(way)
        data.xfrc_applied[1, :3] = -stiffness * max(distance - length, 0.0) * way / distance

    xml, starts = model_xml(PENDULUM), [([0.8], [0.0]), ([-1.0], [1.0]), ([0.3], [-2.0])]
    made = recordings(xml, starts, 10 * np.arange(100), (1e-3, 1e-2), push=push)
    problem = pose(make_study(tmp_path / "study", xml, noise_table(1e-3, 1e-2), made))
    base, body = fit(problem), Typical(force=1.0, speed=1.0, span=0.2, place=(0.0, 0.0, 0.8), way=0.15)
    string, spring = (
        place(problem, "tether", "rod", body),
        place(problem, "joint_spring", "pivot", Typical(1.0, 1.0, 0.5)),
    )
    leader = fit(problem.with_effects([spring]))
    astray = problem.with_effects([string])
    lost = fit(astray, [*base.point.z, *np.full(string.size, 0.3)], max_iterations=0)
    assert module.gain(base, leader, 1.0) > module.gain(base, lost, 1.0)
    found = module._from_leader(base, leader, lost, 1.0)
    assert by_chance(found)
    assert module.gain(base, found, 1.0) > module.gain(base, leader, 1.0) + 50.0
    assert module._from_leader(base, lost, leader, 1.0) is leader  # who is ahead stays as it is
