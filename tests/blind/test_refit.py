"""What psi and the initial states absorb of an effect, and which other effects make the same recordings."""

from dataclasses import replace

import numpy as np
import pytest

from det2stoc_bayes.blind.conceal import make_case
from det2stoc_bayes.blind.equivalents import accepted
from det2stoc_bayes.blind.laws import LAWS, Effect
from det2stoc_bayes.blind.probe import draw_probe
from det2stoc_bayes.blind.reality import simulate_reality
from det2stoc_bayes.blind.refit import refit
from det2stoc_bayes.blind.sizing import KEPT, all_kept, clash, combinations, find, judged_components
from det2stoc_bayes.blind.systems import SYSTEMS


def probe_of(name, samples=30):
    rng, system = np.random.default_rng(4), SYSTEMS[name]
    return draw_probe(rng, system, system.draw_psi(rng), 0.02 * np.arange(samples))


def test_a_size_is_what_a_refit_leaves():
    probe = probe_of("lift_arm")
    found = find(np.random.default_rng(2), probe, ("com_offset", "jib"), 8.0)
    assert found is not None and found.size == pytest.approx(8.0, rel=0.1)
    assert refit(probe, probe.with_effects(found.effect)).left == pytest.approx(found.size, rel=1e-6)
    # the fit that knows the effect leaves nothing
    start = Effect("com_offset", "body", "jib", {"offset": [1e-3, 1e-3, 1e-3]})
    assert refit(probe, probe.with_effects(found.effect), [start]).left < 0.02


def test_components_that_psi_takes_up_are_not_asked_for():
    """The ball's psi is the wind along x."""
    wind = Effect("steady_wind", "world", "world", {"velocity": [0.5, 0.5, 0.0]})
    assert judged_components(probe_of("ball", samples=100), wind) == {"velocity": [1]}


def test_no_payload_where_its_axes_would_jump():
    """MuJoCo's drag is along the axes of the inertia, which are any where moments are equal."""
    scene = probe_of("ball").scene
    assert not LAWS["payload_mass"].definite(scene, "ball")
    assert "payload_mass" not in {name for name, _ in combinations(probe_of("ball"))}
    scene.model.body("ball").inertia[:] = 1.0, 1.2, 1.5
    assert LAWS["payload_mass"].definite(scene, "ball")
    assert LAWS["payload_mass"].definite(probe_of("arm").scene, "forearm")  # there is no fluid


def test_a_psi_that_varies_absorbs_what_differs_by_recording():
    probe, system = probe_of("pendulum"), SYSTEMS["pendulum"]
    masses = [probe.psi["rod_mass"] * factor for factor in (0.95, 1.0, 1.06)]
    truths = [
        simulate_reality(system, {**probe.psi, "rod_mass": mass}, (), start, probe.times, inputs, 1).columns
        for mass, start, inputs in zip(masses, probe.starts, probe.inputs, strict=True)
    ]
    assert refit(probe, truths).left > 1.0
    assert refit(replace(probe, varying=("rod_mass",)), truths).left < 1e-2


def test_what_is_beyond_its_range_or_psis_own_is_not_concealed():
    probe, rng = probe_of("slider"), np.random.default_rng(2)
    for place in (("viscous_damping", "rail"), ("armature", "rail"), ("mass_error", "carriage")):
        assert find(rng, probe, place, 5.0) is None
    with pytest.raises(ValueError, match="psi cannot absorb"):
        make_case(1, system="slider", effect="armature", num_recordings=2, num_samples=60)


def test_psi_takes_up_what_is_its_own_however_far_it_has_to_go():
    """A damping sixteen times psi's own value beside it is a prior that is wrong, and no effect."""
    probe = probe_of("torsion", samples=60)
    own = next(p.name for p in SYSTEMS["torsion"].psi if p.name == "shaft_damping")
    effect = Effect("viscous_damping", "joint", "shaft", {"coefficient": 16 * probe.psi[own]})
    changed = probe.with_effects(effect)
    assert probe.change(changed) > 10.0
    assert refit(probe, changed).left < 0.5  # measured: 0.17, what finer steps leave


def test_a_pair_has_two_effects_that_stay():
    probe, rng = probe_of("pendulum"), np.random.default_rng(2)
    friction = find(rng, probe, ("coulomb_friction", "pivot"), 8.0)
    stribeck = find(rng, probe, ("stribeck_friction", "pivot"), 8.0)
    stiffening = find(rng, probe, ("cubic_stiffness", "pivot"), 8.0)
    assert friction and stribeck and stiffening
    assert all_kept(probe, [friction, stiffening])
    both = probe.with_effects(friction.effect, stribeck.effect)
    assert refit(probe, both, [stribeck.effect]).left < KEPT
    assert not all_kept(probe, [friction, stribeck])
    assert clash(("actuator_gain", "drive"), ("actuator_bias", "drive"))
    assert not clash(("coulomb_friction", "pivot"), ("cubic_stiffness", "pivot"))


SHAKEN = Effect("base_vibration", "world", "world", {"amplitude": [0.01, 0.005, 0.02], "frequency": 2.1, "phase": 2.3})


@pytest.mark.parametrize(
    ("name", "effect", "rival"),
    [
        ("pendulum", Effect("quadratic_drag", "body", "rod", {"coefficient": 0.2}), "quadratic_damping"),
        ("slider", Effect("sensor_bias", "sensor", "qpos/rail", {"offset": 0.02}), "constant_force"),
        ("slider", Effect("constant_force", "joint", "rail", {"force": 0.8}), "gravity_tilt"),
        ("slider", SHAKEN, "periodic_force"),
        ("slider", Effect("rotating_frame", "world", "world", {"rate": [0.29, -0.58, -0.77]}), "constant_force"),
        ("pendulum", Effect("actuator_bias", "actuator", "drive", {"offset": 0.05}), "constant_force"),
    ],
)
def test_equivalents_make_the_same_recordings(name, effect, rival):
    probe = probe_of(name)
    found = {entry["name"]: entry for entry in accepted(np.random.default_rng(1), probe, effect, 10_000)}
    assert rival in found
    entry = found[rival]
    same = Effect(rival, entry["element"]["kind"], entry["element"]["name"], entry["parameters"])
    assert refit(probe, probe.with_effects(effect), [same]).left < 0.02


@pytest.mark.long
def test_a_large_effect_that_leads_psi_far_away_has_its_equivalent():
    """A payload about a vertical axis is inertia and nothing else; by as much inertia psi alone goes astray."""
    payload = Effect("payload_mass", "body", "rotor", {"mass": 0.4, "offset": [0.15, -0.11, 0.08]})
    found = {e["name"]: e for e in accepted(np.random.default_rng(1), probe_of("furuta", 120), payload, 10_000)}
    assert set(found) == {"armature", "added_mass"}  # mass without weight is inertia, too
    assert found["armature"]["element"]["name"] == "yaw"
    assert found["armature"]["parameters"]["inertia"] == pytest.approx(0.4 * (0.15**2 + 0.11**2), rel=1e-3)


def test_what_can_be_told_apart_is_not_accepted():
    probe = probe_of("cart_pole")
    effect = Effect("coulomb_friction", "joint", "track", {"force": 1.0})
    assert accepted(np.random.default_rng(1), probe, effect, 10_000) == []
