"""Concealed forces that are on no list: drawn only when asked for, right only with what they depend on."""

import mujoco
import numpy as np
import pytest

from det2stoc_bayes.blind.equivalents import entry
from det2stoc_bayes.blind.laws import LAWS, NAMES, UNLISTED, Effect
from det2stoc_bayes.blind.laws.unlisted import UNLISTED_LAWS
from det2stoc_bayes.blind.probe import draw_probe
from det2stoc_bayes.blind.score import score
from det2stoc_bayes.blind.sizing import combinations
from det2stoc_bayes.blind.systems import SYSTEMS


@pytest.fixture(scope="module")
def probe():
    rng, system = np.random.default_rng(3), SYSTEMS["slider"]
    return draw_probe(rng, system, system.draw_psi(rng), system.sampling[-1] * np.arange(30)).first()


def test_they_are_drawn_only_when_asked_for(probe):
    assert UNLISTED in NAMES and UNLISTED not in LAWS
    asked = {name for name, _ in combinations(probe, UNLISTED)}
    assert asked and asked <= set(UNLISTED_LAWS)
    assert not any(LAWS[name].variables for name, _ in combinations(probe))
    assert {name for name, _ in combinations(probe, "ledges")} == {"ledges"}


def test_each_depends_on_what_it_says(probe):
    """A change of any other variable leaves the force as it is."""
    joint = next(iter(probe.scene.joint))
    model, rng = probe.scene.model, np.random.default_rng(0)
    at = model.joint(joint)
    for name, law in UNLISTED_LAWS.items():
        if not law.fits(probe.scene, joint):
            continue
        push = law.push(model, joint, law.parameters(1.0, law.draw(rng, probe.scene, joint)))

        def force(q, v, t, u, push=push):
            data = mujoco.MjData(model)
            data.qpos[at.qposadr[0]], data.qvel[at.dofadr[0]], data.ctrl[:] = q, v, u
            push(data, float(t))
            return data.qfrc_applied[at.dofadr[0]]

        points = rng.uniform(0.05, 0.2, (20, 4))
        moved = {}
        for i, variable in enumerate(("position", "velocity", "time", "control")):
            step = 0.03 * np.eye(4)[i]
            moved[variable] = any(force(*p) != force(*(p + step)) for p in points)
        assert {v for v, on in moved.items() if on} == set(law.variables), name


def claim(*variables):
    found = {"name": UNLISTED, "element": {"kind": "joint", "name": "rail"}, "parameters": {"variables": variables}}
    return {"verdict": "mismatch", "effects": [found], "psi": {}}


def test_a_claim_must_name_the_variables():
    truth = entry(Effect("sticky_zone", "joint", "rail", {"strength": 1.0}))
    assert truth["name"] == UNLISTED and truth["law"] == "sticky_zone"
    answer = {"verdict": "mismatch", "effects": [truth], "psi": {}}
    assert score(answer, claim("velocity", "position")).named
    assert not score(answer, claim("position")).named
    assert score(answer, claim("position")).false_claim
