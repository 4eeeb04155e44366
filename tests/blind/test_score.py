"""Scoring: names, equivalents, verdicts, intervals."""

import io
import math
import subprocess

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from det2stoc_bayes.blind import demo
from det2stoc_bayes.blind.conceal import make_case
from det2stoc_bayes.blind.score import heldout_errors, improvement, score
from det2stoc_bayes.blind.statements import Group, groups, reliability
from det2stoc_bayes.blind.summary import cells, missed, pooled, row, summarize


def entry(name, kind, element, **parameters):
    return {"name": name, "element": {"kind": kind, "name": element}, "parameters": parameters}


def estimate(mean, low, high):
    return {"mean": mean, "sd": (high - low) / 3.92, "interval": [low, high], "unit": "1"}


ANSWER = {
    "verdict": "mismatch",
    "effects": [
        entry("quadratic_damping", "joint", "rail", coefficient=0.5)
        | {"accepted": [entry("quadratic_drag", "body", "carriage", coefficient=0.5)]}
    ],
    "psi": {"mass": 2.0, "stiffness": 60.0},
}
CONTROL = {"verdict": "no_mismatch", "effects": [], "psi": {}}
DRAG = entry("quadratic_drag", "body", "carriage", coefficient=estimate(0.51, 0.45, 0.57))


def claim(*effects, **more):
    return {"verdict": "mismatch", "effects": list(effects), **more}


def test_the_concealed_name_and_its_equivalents_are_right():
    after = {"mass": {"after": {"mean": 2.1, "sd": 0.1}}, "stiffness": {"after": {"mean": 50.0, "sd": 1.0}}}
    one = score(ANSWER, claim(DRAG, psi=after))
    assert one.verdict and one.named and one.placed and not one.false_claim
    told = one.effects[0].estimates
    assert told.covers and told.narrow
    assert told.error == pytest.approx(0.02) and told.width == pytest.approx(0.24)
    assert one.psi_inside == (True, False) and one.psi_narrow == (True, True)
    listed = entry("cubic_stiffness", "joint", "rail", stiffness=estimate(1, 0, 2)) | {"equivalent": [DRAG]}
    assert score(ANSWER, claim(listed)).named


def test_psi_under_an_equivalent_name_is_pooled_apart():
    after = {"mass": {"after": {"mean": 2.1, "sd": 0.1}}, "stiffness": {"after": {"mean": 50.0, "sd": 1.0}}}
    own = entry("quadratic_damping", "joint", "rail", coefficient=estimate(0.51, 0.45, 0.57))
    counts = {}
    for name, said in {"own": own, "alike": DRAG, "listed": own | {"name": "other", "equivalent": [own]}}.items():
        told = score(ANSWER, claim(said, psi=after))
        assert told.named and told.own == (name == "own")
        rows = [row(line("effect", ANSWER, claim(said | {"probability": 1.0}, psi=after)))]
        counts[name] = {c.name: c.count for c in pooled(rows)}
    assert counts["own"]["psi"] == 2 and counts["own"]["psi where an equivalent was said"] == 0
    assert counts["alike"] == counts["listed"]
    assert counts["alike"]["psi"] == 0 and counts["alike"]["psi where an equivalent was said"] == 2


def test_wrong_claims():
    wrong = score(ANSWER, claim(entry("coulomb_friction", "joint", "rail", force=estimate(1, 0, 2))))
    assert wrong.verdict and wrong.placed and not wrong.named and wrong.false_claim
    elsewhere = score(ANSWER, claim(entry("quadratic_damping", "joint", "elbow")))
    assert not elsewhere.placed and not elsewhere.named
    missed = score(ANSWER, {"verdict": "no_mismatch", "effects": []})
    assert not missed.verdict and not missed.named and not missed.false_claim
    unsure = score(ANSWER, {"verdict": "inconclusive", "effects": [], "candidates": [DRAG]})
    assert unsure.listed and not unsure.verdict and not unsure.false_claim
    both = score(ANSWER, claim(DRAG, entry("constant_force", "joint", "rail")))
    assert not both.named and both.listed


def test_controls():
    assert score(CONTROL, {"verdict": "no_mismatch", "effects": []}).named
    assert score(CONTROL, claim(DRAG)).false_claim


def test_phases_wrap_and_amplitudes_flip():
    truth = entry("cogging_torque", "joint", "x", amplitude=0.3, cycles=5.0, phase=3.0)
    given = entry(
        "cogging_torque",
        "joint",
        "x",
        amplitude=estimate(-0.3, -0.32, -0.28),
        cycles=estimate(5.0, 4.9, 5.1),
        phase=estimate(3.0 - math.pi - 2 * math.pi, 2.9 - 3 * math.pi, 3.1 - 3 * math.pi),
    )
    one = score({**ANSWER, "effects": [truth]}, claim(given))
    assert one.effects[0].estimates.covers and one.effects[0].estimates.error == pytest.approx(0.0)


def test_ratio_errors_are_relative_to_the_change():
    truth = entry("actuator_gain", "actuator", "m", ratio=0.9)
    given = entry("actuator_gain", "actuator", "m", ratio=estimate(0.91, 0.90, 0.92))
    told = score({**ANSWER, "effects": [truth]}, claim(given)).effects[0].estimates
    assert told.error == pytest.approx(0.1) and told.width == pytest.approx(0.2)


def test_integration_needs_no_exact_timestep_and_worlds_no_name():
    truth = entry("numerical_integration", "simulator", "option", timestep=0.005, integrator="RK4")
    given = entry("numerical_integration", "simulator", "opt", timestep=estimate(0.00125, 0.001, 0.002))
    one = score({**ANSWER, "effects": [truth]}, claim(given))
    assert one.named and one.effects[0].estimates.covers is None


def test_vectors_are_judged_where_the_study_sees_them():
    truth = entry("com_offset", "body", "rod", offset=[0.03, 0.9, 0.04]) | {"judged": {"offset": [0, 2]}}
    given = entry("com_offset", "body", "rod", offset={"mean": [0.03, 0.0, 0.05], "sd": [0.01] * 3, "interval": []})
    given["parameters"]["offset"]["interval"] = [[0.01, 0.05], [-0.1, 0.1], [0.03, 0.07]]
    told = score({**ANSWER, "effects": [truth]}, claim(given)).effects[0].estimates
    assert (
        told.covers and told.error == pytest.approx(0.2) and told.width == pytest.approx(math.hypot(0.04, 0.04) / 0.05)
    )
    assert told.narrow is False and told.inside == ()  # its intervals hold all three at once, of which two are judged
    given["parameters"]["offset"]["interval"][2] = [0.045, 0.055]
    assert score({**ANSWER, "effects": [truth]}, claim(given)).effects[0].estimates.covers is False


@pytest.mark.parametrize("seen", [True, False])
def test_a_vector_is_pooled_as_one(seen):
    truth = entry("gravity_error", "body", "rod", change=2.0, offset=[0.03, 0.04])
    low = 0.02 if seen else 0.05
    offset = {"mean": [0.03, 0.06], "sd": [0.01] * 2, "interval": [[0.01, 0.05], [low, 0.09]]}
    given = entry("gravity_error", "body", "rod", change=estimate(2.0, 1.9, 2.1), offset=offset)
    assert score({**ANSWER, "effects": [truth]}, claim(given)).effects[0].estimates.inside == (True, seen)


PUSH = entry("constant_force", "joint", "rail", force=2.0)
PUSHED = entry("constant_force", "joint", "rail", force=estimate(2.0, 1.9, 2.1))
TWO = {**ANSWER, "effects": [*ANSWER["effects"], PUSH]}


def test_pairs_need_both_and_nothing_else():
    both = score(TWO, claim(PUSHED, DRAG))
    assert both.named and not both.false_claim and [e.named for e in both.effects] == [True, True]
    assert [e.estimates.width for e in both.effects] == pytest.approx([0.24, 0.1])
    half = score(TWO, claim(PUSHED))
    assert not half.named and not half.false_claim and [e.named for e in half.effects] == [False, True]
    twice = score(TWO, claim(PUSHED, PUSHED))
    assert not twice.named and twice.false_claim
    more = score(TWO, claim(PUSHED, DRAG, entry("armature", "joint", "elbow")))
    assert not more.named and more.false_claim and all(e.named for e in more.effects)


def test_a_claim_that_fits_two_effects_is_given_to_the_one_that_needs_it():
    either = {**PUSH, "accepted": [ANSWER["effects"][0]]}
    two = {**ANSWER, "effects": [either, ANSWER["effects"][0] | {"accepted": []}]}
    same = entry("quadratic_damping", "joint", "rail", coefficient=estimate(0.5, 0.4, 0.6))
    assert score(two, claim(same, PUSHED)).named


def test_a_failed_diagnosis_is_neither_right_nor_a_claim():
    for answer in (ANSWER, CONTROL):
        one = score(answer, {"verdict": "failed (1)", "error": "what it said"})
        assert not one.named and not one.verdict and not one.false_claim and one.diagnosed == "failed (1)"


def line(kind, answer, diagnosis):
    return {"kind": kind, "answer": answer, "diagnosis": diagnosis, "seconds": 10.0, "peak_mb": 300.0}


def test_summary_and_what_was_missed():
    drag, psi = DRAG | {"probability": 1.0}, {"mass": {"after": {"mean": 2.1, "sd": 0.1}}}
    said = [claim(drag, psi=psi), claim(drag), {"verdict": "no_mismatch"}]
    pairs = zip(("effect", "control", "control"), (ANSWER, CONTROL, CONTROL), said, strict=True)
    rows = [row(line(*one)) for one in pairs]
    told = summarize(rows)
    effect, control, whole = told.kinds
    assert (effect.right, effect.cover, effect.narrow, control.false_claims, whole.right) == (1, 1, 1, 1, 2)
    counts = {c.name: (c.inside, c.count) for c in told.coverage}
    assert counts["both"] == counts["psi where an equivalent was said"] == (1, 1)
    assert cells(effect)[:8] == ["1", "1", "1", "0", "1 of 1", "1 of 1", "2.0 %", "24.0 %"]
    assert cells(control)[:5] == ["2", "1", "1", "1", "0 of 0"]
    assert missed(rows) == ["control: nothing was said to be quadratic_drag @ carriage (false alarm)"]


def test_every_parameter_is_pooled_and_the_size_alone_decides():
    truth = entry("cogging_torque", "joint", "x", amplitude=0.3, cycles=5.0, phase=3.0)
    given = {"amplitude": estimate(0.31, 0.28, 0.34), "cycles": estimate(5.2, 5.1, 5.3)}
    given["phase"] = estimate(3.0 + 2 * math.pi, 2.9 + 2 * math.pi, 3.1 + 2 * math.pi)
    told = score({**ANSWER, "effects": [truth]}, claim(entry("cogging_torque", "joint", "x", **given)))
    assert told.effects[0].estimates.covers and told.effects[0].estimates.inside == (True, False, True)


def test_pooled_coverage_is_tested_exactly():
    psi = {f"p{i}": 0.0 for i in range(100)}
    for inside, p_value in ((95, 1.0), (85, stats.binomtest(85, 100, 0.95).pvalue)):
        after = {name: {"after": {"mean": 0.0 if i < inside else 3.0, "sd": 1.0}} for i, name in enumerate(psi)}
        told = pooled([row(line("control", {**CONTROL, "psi": psi}, {"verdict": "no_mismatch", "psi": after}))])
        assert [(c.inside, c.count) for c in told] == [(0, 0), (inside, 100), (inside, 100), (0, 0), (0, 0)]
        assert told[2].p_value == pytest.approx(p_value)


def test_improvement_is_a_share_of_what_the_true_law_gives():
    fit = {"rollout_rmse_before": {"a": 10.0, "b": 0.5}, "rollout_rmse_after": {"a": 2.0, "b": 0.5}}
    answer = {**ANSWER, "truth_rmse": {"a": 1.0, "b": 0.5}}
    before, after = math.sqrt(101 / 2), math.sqrt(5 / 2)
    assert heldout_errors(answer, fit) == pytest.approx((before, after))
    assert score(answer, claim(DRAG, fit=fit)).improvement == pytest.approx((before - after) / (before - 1))
    old = fit | {"rollout_rmse_noise": {"a": 1.0, "b": 0.5}}
    assert score(ANSWER, claim(DRAG, fit=old)).improvement == pytest.approx((before - after) / (before - 1))
    assert improvement(answer, fit | {"rollout_rmse_after": {"a": None, "b": 0.5}}) == 0.0
    assert improvement(answer, fit | {"rollout_rmse_before": {"a": 1.0, "b": 0.5}}) is None


def test_probabilities_are_of_what_excludes_one_another():
    other = {"name": "armature", "element": {"kind": "joint", "name": "rail"}, "probability": 0.1}
    right, wrong = DRAG | {"probability": 0.8, "alternatives": [other]}, PUSHED | {"probability": 0.9}
    assert groups(ANSWER, claim(right)) == [Group((0.8, 0.1), 0)]
    assert groups(TWO, claim(right, PUSHED | {"probability": 0.9})) == [Group((0.8, 0.1), 0), Group((0.9,), 0)]
    assert groups(ANSWER, claim(right, wrong)) == [Group((0.8, 0.1), 0), Group((0.9,), None)]
    # The alternative is right: the claim beside it that was paired with the other effect does not count for this one.
    assert groups(ANSWER, claim(wrong | {"alternatives": [DRAG | {"probability": 0.1}]})) == [Group((0.1, 0.9), 0)]
    none = {"name": "none", "element": None, "probability": 0.3}
    unsure = {"verdict": "inconclusive", "candidates": [DRAG | {"probability": 0.7}, none]}
    assert groups(ANSWER, unsure) == [Group((0.7, 0.3), 0)] and groups(CONTROL, unsure) == [Group((0.3, 0.7), 0)]
    assert groups(CONTROL, {"verdict": "no_mismatch"}) == []
    beside = claim(right) | {"candidates": [PUSHED | {"probability": 0.6}, DRAG | {"probability": 0.4}]}
    assert groups(TWO, beside) == [Group((0.8, 0.1), 0), Group((0.6, 0.4), 0)]


def found_as_stated(random, count):
    """Findings of two explanations each, as often right as they say."""
    for p in random.uniform(0.4, 1.0, count).tolist():
        stated = (p, 0.6 * (1 - p))
        true = random.choice(3, p=[*stated, 1 - sum(stated)])
        yield Group(stated, None if true == 2 else int(true))


def test_probabilities_that_hold_what_they_say_have_even_p_values():
    random = np.random.default_rng(1)
    told = [reliability(list(found_as_stated(random, 60))) for _ in range(30)]
    assert stats.kstest([r.p_value for r in told if r], "uniform").pvalue > 0.01
    scores = [r.log_score - r.expected for r in told if r]
    assert abs(np.mean(scores)) < 4 * np.std(scores) / np.sqrt(30)
    assert all(r.num_statements == 120 and sum(b.count for b in r.bins) == 120 for r in told if r)


def test_probabilities_that_are_too_bold_or_too_timid_are_rejected():
    found = list(found_as_stated(np.random.default_rng(2), 300))
    bold = reliability([Group((min(1.0, 0.3 + g.stated[0]),), g.true if g.true == 0 else None) for g in found])
    timid = reliability([Group((0.5,), g.true if g.true == 0 else None) for g in found])
    assert bold is not None and bold.p_value < 0.001 and math.isfinite(bold.log_score)
    assert timid is not None and timid.p_value < 0.001
    assert reliability([]) is None


def test_demo_reports_a_failed_diagnosis(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        demo, "make_case", lambda seed, **_: make_case(seed, control=True, num_recordings=1, num_samples=40)
    )
    monkeypatch.setattr(demo.subprocess, "run", lambda command, check: subprocess.CompletedProcess(command, 3))
    assert demo.main(["--seed", "9", "--out", str(tmp_path)]) == 3
    shown = capsys.readouterr().out
    assert "ended with code 3" in shown and "Seed 9, pendulum" in shown and "a minute or two" in shown
    monkeypatch.setattr(demo.subprocess, "run", lambda command, check: subprocess.CompletedProcess(command, -15))
    assert demo.main(["--seed", "9", "--out", str(tmp_path)]) == 143
    assert "was ended by signal 15" in capsys.readouterr().out
    assert (tmp_path / "demo-9" / "study" / "study.toml").is_file()


def test_demo_shows_four_digits_of_vectors_too(capsys):
    case = make_case(3, control=True, num_recordings=1, num_samples=40)
    given = {"name": "rotating_frame", "element": {"kind": "world", "name": "world"}}
    given |= {"parameters": {"rate": {"mean": [-0.98268470, 0.5], "interval": [[-1.0, -0.9], [0.4, 0.6]]}}}
    demo.reveal(case, {"verdict": "mismatch", "effects": [given]}, Console(width=120))
    assert "[-0.9827, 0.5]" in capsys.readouterr().out


def test_demo_says_what_cannot_be_concealed(tmp_path, monkeypatch, capsys):
    def impossible(seed, **_):
        raise ValueError("psi cannot absorb it")

    monkeypatch.setattr(demo, "make_case", impossible)
    assert demo.main(["--seed", "9", "--out", str(tmp_path)]) == 2
    assert "error: psi cannot absorb it" in capsys.readouterr().out


def test_demo_reveals_both_sides():
    case = make_case(4, system="pendulum", effect="constant_force", num_recordings=1, num_samples=60)
    truth = case.answer["effects"][0]
    given = entry("constant_force", "joint", "pivot", force=estimate(truth["parameters"]["force"], -9.0, 9.0))
    given |= {"equivalent": [entry("actuator_bias", "actuator", "drive")]}
    console = Console(record=True, width=120, file=io.StringIO())
    demo.reveal(case, claim(given, summary="A torque was left out."), console)
    shown = console.export_text()
    assert "constant_force" in shown and "[-9, 9]" in shown and "Right." in shown
    assert shown.count("or equally") == 1 and "actuator_bias actuator drive" in shown
    assert "they are others" not in shown


def test_demo_says_whose_psi_are_shown_where_an_equivalent_is_named():
    """Beside a gravity that is tilted a pendulum weighs more than beside a sensor that is off."""
    case = make_case(4, system="pendulum", effect="constant_force", num_recordings=1, num_samples=60)
    given = entry("actuator_bias", "actuator", "drive", bias=estimate(0.1, 0.0, 0.2))
    console = Console(record=True, width=120, file=io.StringIO())
    demo.reveal(case, claim(given), console)
    assert "beside the concealed one they are others" in console.export_text()


def test_a_named_value_is_shown_as_it_is():
    assert demo._estimate("RK4") == "RK4"
