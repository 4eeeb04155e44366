"""What of an effect shows in recordings with contact, whose beginnings are not known better than they are measured."""

from dataclasses import replace

import numpy as np
import pytest

from det2stoc_bayes.blind import short_sizing as module
from det2stoc_bayes.blind.laws import Effect
from det2stoc_bayes.blind.probe import draw_probe
from det2stoc_bayes.blind.short_sizing import LEAST, MOST, find_short, told
from det2stoc_bayes.blind.systems import SYSTEMS

PATCH = {"ratio": 2.0, "point": [0.08, 0.04, 0.015], "normal": [0.98, 0.199, 0.0]}


@pytest.fixture(scope="module")
def three():
    """Three recordings of a puck."""
    system = SYSTEMS["puck"].measuring("qpos")
    psi = {"friction": 0.2, "turning": 0.003}
    return draw_probe(np.random.default_rng(0), system, psi, 0.01 * np.arange(system.samples))


@pytest.fixture(scope="module")
def probe(three):
    """The first of them."""
    return three.first()


def test_a_drag_that_has_ended_before_the_recording_begins_does_not_show(probe):
    """It stops the puck within a tenth of a second: the rest is as another friction and start would make it."""
    size, change = told(probe, Effect("quadratic_drag", "body", "puck", {"coefficient": 5.4}))
    assert change > 1.0  # measured: 4.1
    assert size < 0.1  # measured: 0.05


def test_a_weight_that_another_friction_carries_does_not_show(probe):
    """A third more of gravity is a third more of both frictions, far from where they are."""
    size, change = told(probe, Effect("gravity_error", "world", "world", {"change": -3.0}))
    assert change > 3.0  # measured: 10.7
    assert size < LEAST  # measured: 0.15


@pytest.mark.long
def test_a_region_of_other_friction_shows(three):
    """One recording alone may be told by another friction (measured: 0.13)."""
    size, change = told(three, Effect("friction_patch", "contact", "disc/table", PATCH))
    assert LEAST < size < change  # measured: 0.28, 8.5


HIDDEN = {
    "box": (
        SYSTEMS["thrown_box"],
        {"friction": 0.29, "contact_time": 0.025},
        Effect("friction_error", "contact", "board/shell", {"ratio": 0.86}),
    ),
    "board": (
        SYSTEMS["thrown_box"],
        {"friction": 0.381, "contact_time": 0.02033},
        Effect("contact_stiffness", "contact", "board/shell", {"time_constant": 0.01706}),
    ),
    "puck": (
        SYSTEMS["puck"].measuring("qpos"),
        {"friction": 0.2, "turning": 0.003},
        Effect("inertia_error", "body", "puck", {"ratio": [0.2, 0.2, 0.2]}),
    ),
}


@pytest.mark.parametrize("which", HIDDEN)
def test_what_psi_hides_is_found_to_be_hidden(which):
    """A ratio of the friction of a box's only contact is one of psi, the contact's time is psi itself, and a fifth of a
    puck's inertia is five times its turning friction. Measured: 0, 0 and 0.23."""
    system, psi, effect = HIDDEN[which]
    one = draw_probe(np.random.default_rng(0), system, psi, 0.01 * np.arange(system.samples)).first()
    size, change = told(one, effect)
    assert size < LEAST < 1.0 < change


def test_stretches_keep_the_time_of_their_reality(probe):
    """A vibration has another phase in each."""
    rates = {"amplitude": [0.003, 0.0, 0.0], "frequency": 2.5, "phase": 0.3}
    effect = Effect("base_vibration", "world", "world", rates)
    begins = [stretch.times[0] for stretch in module._stretches(probe, effect)]
    assert begins == pytest.approx(0.1 + 0.2 * np.arange(4))


@pytest.mark.parametrize("which", ["effect", "beginning", "psi nearby", "psi far off"])
def test_what_diverges_is_not_told(probe, monkeypatch, which):
    """Of each of four stretches are simulated: the plain model, the effect and twelve beginnings; then psi nearby.

    Of psi far off those that diverge hide nothing.
    """
    run, calls = module.simulate_reality, {"effect": 2, "beginning": 5, "psi nearby": 62, "psi far off": 72}
    count = iter(range(10_000))

    def diverging(*arguments):
        out = run(*arguments)
        bad = next(count) == calls[which]
        return replace(out, columns=np.full_like(out.columns, np.nan)) if bad else out

    monkeypatch.setattr(module, "simulate_reality", diverging)
    size, _ = told(probe, Effect("friction_patch", "contact", "disc/table", PATCH))
    assert np.isnan(size) == (which != "psi far off")


def of_samples(probe, count):
    return replace(probe, times=probe.times[:count], inputs=[u[:count] for u in probe.inputs])


def test_recordings_that_hold_no_stretch_are_refused(probe):
    effect = Effect("friction_patch", "contact", "disc/table", PATCH)
    with pytest.raises(ValueError, match="29 samples; allowed: 30 or more"):
        told(of_samples(probe, 29), effect)
    assert np.isfinite(told(of_samples(probe, 30), effect)[0])


def test_what_is_found_is_neither_small_nor_large(probe, monkeypatch):
    monkeypatch.setattr(module, "SEARCHES", ((0.15, 3),))
    sizes = {find_short(np.random.default_rng(k), probe, ("gravity_tilt", "world")).size for k in range(3)}
    assert all(LEAST <= size <= MOST for size in sizes) and len(sizes) > 1
