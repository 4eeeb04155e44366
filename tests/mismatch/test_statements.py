"""Numbers and sentences for readers."""

import numpy as np
import pytest
from simulated import fit, place, spring_problem

from det2stoc_bayes.mismatch.effects import CATALOGUE, Element, PlacedEffect, Typical
from det2stoc_bayes.mismatch.evidence import widened
from det2stoc_bayes.mismatch.finding import Alternative, Quantity
from det2stoc_bayes.mismatch.statements import draws, likeliest, parameters, quantity, rounded, statement


def number(mean, sd, unit="N m"):
    return Quantity(mean=mean, sd=sd, interval=[mean - 2 * sd, mean + 2 * sd], unit=unit)


@pytest.mark.parametrize(
    ("mean", "sd", "unit", "text"),
    [
        (0.3104, 0.0121, "N m", "0.310 +- 0.012 N m"),
        (152.7029, 0.37, "N/m3", "152.70 +- 0.37 N/m3"),
        (1.02, 0.004, "1", "1.0200 +- 0.0040"),
        (-412.3, 37.0, "N", "-412 +- 37 N"),
        (5.0, 0.0, "s", "5.000 +- 0.000 s"),
        (1.234e-9, 5.4e-11, "kg m2", "1.23e-09 +- 5.4e-11 kg m2"),
        (2.5e7, 3.1e4, "N", "2.5e+07 +- 3.1e+04 N"),
    ],
)
def test_two_digits_of_uncertainty(mean, sd, unit, text):
    assert rounded(number(mean, sd, unit)) == text


@pytest.mark.parametrize(
    ("odds", "words"),
    [
        ((0.6, 0.4), ["mass error on hand (60%)", "payload mass on hand (40%)"]),
        ((0.998, 0.002), ["mass error on hand"]),
        ((0.0, 0.0), []),
    ],
)
def test_a_candidate_without_rivals_has_no_probability_beside_them(odds, words):
    hand = {"kind": "body", "name": "hand"}
    named = zip(("mass_error", "payload_mass"), odds, strict=True)
    assert likeliest([Alternative(name=n, element=hand, probability=p) for n, p in named]) == words


def test_quantities_are_moments_of_their_draws():
    values = 3 + 0.5 * np.random.default_rng(0).standard_normal(4000)
    q = quantity(values, "m")
    assert q.mean == pytest.approx(values.mean()) and q.sd == pytest.approx(values.std()) and q.unit == "m"
    # Measured: 2.01 and 3.98; the truth is 3 -+ 0.98.
    np.testing.assert_allclose(q.interval, [2.02, 3.98], atol=0.06)


@pytest.mark.parametrize(("correlation", "sds"), [(0.0, 2.388), (1.0, 1.960)])
def test_intervals_of_a_vector_hold_all_components_at_once(correlation, sds):
    """Three independent normals lie within Phi^-1((1 + .95^(1/3)) / 2) sds; three that are one in those of one."""
    random = np.random.default_rng(0)
    own, common = random.standard_normal((40_000, 3)), random.standard_normal((40_000, 1))
    values = 1 + 0.5 * (np.sqrt(1 - correlation) * own + np.sqrt(correlation) * common)
    bounds = np.array(quantity(values, "m").interval)
    np.testing.assert_allclose(bounds, np.tile([1 - 0.5 * sds, 1 + 0.5 * sds], (3, 1)), atol=0.025)  # 0.019, 0.004


@pytest.mark.parametrize("count", [50, 200, 1000])
@pytest.mark.parametrize("distinct", [0.1, 1.0])
def test_few_draws_and_ties_lie_in_a_vector_s_intervals(count, distinct):
    random = np.random.default_rng(1)
    values = random.standard_normal((int(distinct * count), 3))[random.integers(0, int(distinct * count), count)]
    bounds = np.array(quantity(values, "m").interval)
    assert ((bounds[:, 0] <= values) & (values <= bounds[:, 1])).all(1).mean() >= 0.95


def test_draws_that_are_no_numbers_are_told_as_none():
    values = np.random.default_rng(2).standard_normal((100, 3))
    values[3, 1] = np.nan
    q = quantity(values, "m")
    assert q.mean[1] is None and q.interval[1] == (None, None) and None not in q.interval[0]
    one = quantity(values[:, :1], "m")
    np.testing.assert_allclose(one.interval[0], quantity(values[:, 0], "m").interval, atol=0.2)


def test_a_phase_has_no_seam():
    values = np.angle(np.exp(1j * (np.pi + 0.1 * np.random.default_rng(0).standard_normal(4000))))
    assert values.std() > 3  # on the circle they lie on both sides of the seam
    q = quantity(values, "rad", circular=True)
    assert abs(abs(q.mean) - np.pi) < 0.01 and q.sd == pytest.approx(0.1, rel=0.05)
    low, high = q.interval
    assert low < q.mean < high and high - low == pytest.approx(0.392, rel=0.06)


def on(name, hinge=True, kind="joint", element="wrist"):
    return PlacedEffect(CATALOGUE[name], Element(kind, element, hinge, unit="rad"), Typical())


def test_sentences():
    force = {"force": number(0.31, 0.012)}
    friction = statement(on("coulomb_friction"), force, ())
    assert friction == "Dry friction of 0.310 +- 0.012 N m on joint wrist is missing."
    drag = statement(on("quadratic_damping"), {"coefficient": number(0.2, 0.01)}, ("quadratic drag on body hand",))
    assert "(or equally quadratic drag on body hand)" in drag
    ripple = {"amplitude": number(0.2, 0.01), "cycles": number(6.0, 0.1, "1/rad"), "phase": number(1.0, 0.1, "rad")}
    text = statement(on("cogging_torque"), ripple, ())
    assert text == (
        "A torque ripple of amplitude 0.200 +- 0.010 N m, cycles 6.00 +- 0.10 1/rad, phase 1.00 +- 0.10 rad "
        "on joint wrist is missing."
    )
    late = statement(on("actuator_delay", kind="actuator", element="motor"), {"delay": number(0.02, 0.001, "s")}, ())
    assert late == "A delay of 0.0200 +- 0.0010 s on actuator motor was left out."


@pytest.mark.parametrize("name", [n for n, e in CATALOGUE.items() if e.listed and n != "numerical_integration"])
def test_every_effect_has_words_and_units(name):
    for hinge in (False, True):
        placed = on(name, hinge, CATALOGUE[name].kind)
        values = {p.name: number(1.0, 0.1, p.unit_on(placed.element)) for p in placed.effect.parameters}
        text = statement(placed, values, ())
        assert text.isascii() and text.endswith(".") and "_" not in text and "wrist" in text
        assert all(q.unit in text for q in values.values() if q.unit != "1")


def test_draws_have_the_covariance_of_the_fit(tmp_path):
    problem = spring_problem(tmp_path)
    stiff = place(problem, "cubic_stiffness", "slide", Typical(force=3, span=0.3))
    at = fit(problem.with_effects([stiff]))
    z = draws(at, 0.5, seed=4, num_draws=4000)
    sd = np.sqrt(np.diag(widened(at, 0.5)))
    # Sampling errors: 1.6 % of a sd, for the mean and (1.1 %) for the spread.
    np.testing.assert_allclose(z.mean(0), at.point.z, atol=0.06 * sd.max())
    np.testing.assert_allclose(np.cov(z.T) / np.outer(sd, sd), widened(at, 0.5) / np.outer(sd, sd), atol=0.08)
    np.testing.assert_array_equal(z, draws(at, 0.5, seed=4, num_draws=4000))
    assert (z != draws(at, 0.5, seed=5, num_draws=4000)).any()
    found = parameters(at, stiff, z)["stiffness"]
    scale = 0.3 * 3 / 0.3**3
    assert found.mean == pytest.approx(scale * z[:, 2].mean()) and found.unit == "N/m3"


def test_vectors_are_lists_with_a_name_for_each_unknown(tmp_path):
    problem = spring_problem(tmp_path)
    payload = place(problem, "payload_mass", "block")
    problem = problem.with_effects([payload])
    assert problem.names[2:] == tuple(f"payload_mass[block].{n}" for n in ("mass", "offset.x", "offset.y", "offset.z"))
    z = np.random.default_rng(0).standard_normal((50, problem.size))
    values, named = problem.effect_values(z)[0], problem.constrained(z)
    np.testing.assert_array_equal(values["offset"][:, 2], named["payload_mass[block].offset.z"])
    q = quantity(values["offset"], "m")
    assert isinstance(q.mean, tuple) and isinstance(q.interval, tuple) and len(q.mean) == len(q.interval) == 3
    low, high = q.interval[1]
    assert low < q.mean[1] < high
    text = statement(payload, {"offset": Quantity(mean=(1.0, 2, 3), sd=(0.1, 0.1, 0.1), interval=None, unit="m")}, ())
    assert text == "A payload of (1.00 +- 0.10, 2.00 +- 0.10, 3.00 +- 0.10) m on body block is missing."
