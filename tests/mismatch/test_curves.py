"""Words for known curves, and how a force on no list is written down."""

import numpy as np
import pytest
from catalogue import VALUES
from simulated import here, spring_problem

from det2stoc_bayes.mismatch.curves import energy, symmetry
from det2stoc_bayes.mismatch.effects import PlacedEffect, Typical
from det2stoc_bayes.mismatch.effects.unlisted import OverPosition, OverPositionAndVelocity
from det2stoc_bayes.mismatch.statements import parameters, statement

X = np.linspace(-1.0, 1.4, 49)
Q, V = np.linspace(-1, 1, 24), np.linspace(-2, 2, 8)


@pytest.mark.parametrize(
    ("curve", "word", "middle"),
    [(np.sin(2 * (X - 0.2)), "odd", 0.2), (np.exp(-(((X - 0.3) / 0.2) ** 2)), "even", 0.3)],
)
def test_symmetry_about_a_middle(curve, word, middle):
    found, _, where = symmetry(("position",), [X], curve).split()
    assert found == word and float(where) == pytest.approx(middle, abs=0.02)  # places are 0.024 apart
    assert symmetry(("position",), [X], np.exp(2 * X)) == "none"


def test_symmetry_of_a_speed_is_about_rest():
    assert symmetry(("velocity",), [X], -np.tanh(3 * X)) == "odd about 0"
    assert symmetry(("velocity",), [X], -np.tanh(3 * (X - 0.2))) == "none"
    surface = np.outer(np.exp(-(Q**2)), -V).ravel()
    assert symmetry(("position", "velocity"), [Q, V], surface) == "odd about 0"
    assert symmetry(("time",), [X], np.sin(X)) == "none"


@pytest.mark.parametrize(
    ("variables", "knots", "curve", "word"),
    [
        (("position",), [X], np.sin(X), "conserves"),
        (("velocity",), [X], -np.tanh(3 * X), "dissipates"),
        (("velocity",), [X], X**3, "supplies"),
        (("velocity",), [X], X**3 - 0.5 * X, "exchanges"),
        (("time",), [X], np.sin(X), "exchanges"),
        (("position", "velocity"), [Q, V], (3 * Q[:, None] - np.exp(-(Q**2))[:, None] * V).ravel(), "dissipates"),
        (("position", "velocity"), [Q, V], (Q[:, None] * V).ravel(), "exchanges"),
    ],
)
def test_energy(variables, knots, curve, word):
    assert energy(variables, knots, curve) == word


@pytest.mark.parametrize("form", [OverPosition, OverPositionAndVelocity])
def test_what_is_written_down(tmp_path, form):
    problem = spring_problem(tmp_path)
    (joint,) = problem.simulator.elements("joint", problem.segments.columns)
    placed = PlacedEffect(form(), joint, Typical(force=3.0))
    problem = problem.with_effects([placed])
    at = here(problem)
    z = np.random.default_rng(0).standard_normal((50, problem.size))
    found = parameters(at, placed, z)
    assert found["variables"] == form.variables and found["columns"][0] == "qpos/slide"
    assert len(found["curve"].x) == len(VALUES[form.__name__]["curve"])
    np.testing.assert_allclose(found["curve"].y, problem.effect_values(z)[0]["curve"].mean(0))
    assert found["curve"].unit == "N"
    text = statement(placed, found, ())
    assert (
        text.isascii() and text.endswith(".") and "_" not in text and "joint slide" in text and "its position" in text
    )
    assert len(problem.names) == problem.size == len(problem.constrained(z))
