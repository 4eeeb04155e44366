"""What is to be recorded next, by what cannot be told apart."""

import pytest

from det2stoc_bayes.mismatch.contact.experiment import MOTIONS, OF_KIND, proposed
from det2stoc_bayes.mismatch.effects import CATALOGUE
from det2stoc_bayes.mismatch.finding import Alternative, Element


def candidate(name, kind="contact", element="floor/hull", probability=0.4):
    return Alternative(name=name, element=Element(kind=kind, name=element), probability=probability)


def test_every_effect_has_a_motion_and_no_other_effect_that_of_a_name():
    assert set(MOTIONS) <= set(CATALOGUE) and {e.kind for e in CATALOGUE.values()} <= set(OF_KIND)
    assert len(set(MOTIONS.values())) == len(MOTIONS)
    assert {e.name for e in CATALOGUE.values() if e.kind == "contact"} <= set(MOTIONS)


@pytest.mark.parametrize(
    ("first", "second"), [("friction_error", "restitution_error"), ("rolling_friction", "contact_stiffness")]
)
def test_two_effects_are_told_apart_by_their_motions(first, second):
    text = proposed([candidate(first), candidate(second), candidate("linear_drag", "body", "hull")])
    assert MOTIONS[first] in text and MOTIONS[second] in text and MOTIONS["linear_drag"] not in text
    assert text.index(MOTIONS[first]) < text.index(MOTIONS[second])


def test_one_effect_in_two_places_is_told_apart_by_what_takes_part():
    text = proposed([candidate("friction_error"), candidate("friction_error", element="ramp/hull")])
    assert "contact floor/hull takes part and contact ramp/hull does not" in text


def test_a_lone_candidate_is_asked_about_itself():
    assert proposed([candidate("hysteresis", "joint", "hinge")]) == (
        f"Record {OF_KIND['joint']}: hysteresis on joint hinge shows there, if it is that."
    )


def test_the_world_is_called_by_its_name_alone():
    text = proposed([candidate("base_vibration", "world", "world"), candidate("adhesion")])
    assert "base vibration on the world would show" in text and "world world" not in text
