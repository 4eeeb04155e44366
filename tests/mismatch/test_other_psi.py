"""psi that hang on which of several equivalent effects it is."""

import numpy as np

from det2stoc_bayes.mismatch.finding import Effect, Element, Equivalent, Moments, PsiChange
from det2stoc_bayes.mismatch.other_psi import other_psi, others_beyond, over_equivalents

NAMED = {"mass": Moments(mean=2.0, sd=0.1), "stiffness": Moments(mean=60.0, sd=1.0)}


def effect(*psi):
    rail = Element(kind="joint", name="rail")
    others = [Equivalent(name=f"effect_{i}", element=rail, parameters={}, psi=p) for i, p in enumerate(psi)]
    return Effect.model_validate(
        {"name": "sensor_scale", "element": rail, "law": "", "statement": "", "probability": 1.0, "explains": 0.9}
        | {"recordings": "all", "parameters": {}, "equivalent": others, "alternatives": []}
    )


def test_psi_that_differ_beyond_their_sds_are_told():
    given = {"mass": Moments(mean=2.25, sd=0.1), "stiffness": Moments(mean=63.0, sd=1.0)}
    assert others_beyond(given, NAMED) == {"stiffness": given["stiffness"]}  # 1.8 and 2.1 sds of the difference
    assert others_beyond(NAMED, NAMED) == {}


def test_the_sentence_names_the_effect_and_what_it_means():
    assert other_psi(effect()) == other_psi(effect({}, {})) == ""
    assert other_psi(effect({}, NAMED)) == "psi hangs on which it is: effect 1 on rail means mass 2, stiffness 60."
    assert other_psi(effect(*[NAMED] * 5)).endswith("; 2 more mean others.")


def test_an_interval_holds_what_every_equivalent_says():
    change = {n: PsiChange(before=m, after=m, prior_conflict=0.5) for n, m in NAMED.items()}
    other = {"mass": Moments(mean=3.0, sd=0.2)}
    told = over_equivalents(change, [effect({}, other)], dict.fromkeys(NAMED, (1.9, np.inf)))
    low, high = told["mass"].over_equivalents
    assert (round(low, 6), round(high, 6)) == (1.9, 3.0 + 1.96 * 0.2)  # no less than the prior allows
    assert told["stiffness"] == change["stiffness"]
    assert over_equivalents(change, [], {}) == change
