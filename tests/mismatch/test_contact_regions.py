"""Where a region of other friction ends, found by frictions that are the same everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, TRUTH, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact import regions
from det2stoc_bayes.mismatch.contact.fit import at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.places import elements_of
from det2stoc_bayes.mismatch.contact.polish import polished
from det2stoc_bayes.mismatch.contact.regions import bordered, likeliest_border
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator

SLIDING = [f"{c}/glide/{p}" for c, p in (("qpos", "x"), ("qpos", "y"), ("qvel", "vx"), ("qvel", "vy"))]
RATIO = 1.7


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    study = make_study(tmp_path_factory.mktemp("slides") / "study", XML.format(0.02), PSI, slides())
    problem = make_problem(Simulator(study, num_threads=1))
    return Followed(problem, 6.0).hearing(np.isin(problem.segments.columns, SLIDING))


@pytest.fixture(scope="module")
def pool(followed):
    return candidates(followed.problem, elements_of(fit_followed(followed)))


def named(pool, name):
    return next(c for c in pool if c.effect.name == name)


@pytest.fixture(scope="module")
def rough(followed, pool):
    """Recordings of a table that is rougher beyond a plane through the middle of where the puck was; its unknowns."""
    patch, problem = named(pool, "friction_patch"), followed.problem
    middle = np.mean(patch.typical.region, axis=0)
    values = {"ratio": RATIO, "point": middle, "normal": np.array([0.8, 0.6, 0.0])}
    friction = problem.simulator.parameters[0].prior.to_normal(TRUTH)
    z = np.concatenate([[float(friction)], patch.effect.to_normal(values, patch.typical)])
    made = followed.with_problem(problem.with_effects((patch,))).drawn(z, np.random.default_rng(3))
    made[:, 0] = problem.segments.values[:, 0]
    segments = replace(problem.segments, values=made)
    return Followed(problem.on(segments), followed.memory).hearing(followed.heard), values, z


def test_the_likeliest_border_is_the_true_one(rough, pool):
    recorded, values, z = rough
    border = likeliest_border(at(recorded, z[:1]), named(pool, "friction_patch"))
    assert border is not None and border.gain > 30  # measured: 51 nats more than by one friction everywhere
    assert border.normal @ values["normal"] > 0.95, border
    reach = np.ptp(np.array(named(pool, "friction_patch").typical.region) @ values["normal"])
    off = abs((border.point - values["point"]) @ values["normal"])
    assert off < 0.2 * reach, (border, reach)  # measured: 0.13, of four slides
    assert 0.6 * RATIO < border.ratio < 1.5 * RATIO


def test_a_border_that_lies_wrong_is_moved_to_where_it_tells_most(rough, pool, monkeypatch):
    """A fit whose border has no sample near it has no way to go by derivatives."""
    recorded, values, z = rough
    patch = named(pool, "friction_patch")
    hypothesis = recorded.with_problem(recorded.problem.with_effects((patch,)))
    wrong = values | {"normal": np.array([-0.6, 0.8, 0.0]), "ratio": 1.2}
    start = np.concatenate([z[:1], patch.effect.to_normal(wrong, patch.typical)])
    moved, best = bordered(at(hypothesis, start)), at(hypothesis, z)
    found = moved.problem.effect_values(moved.z[None])[-1]
    assert found["normal"][0] @ values["normal"] > 0.95, found
    assert abs(found["ratio"][0] / RATIO - 1) < 0.3, found
    assert moved.loss < best.loss + 60 < at(hypothesis, start).loss  # measured: 44; psi and ratio trade
    monkeypatch.setattr(regions, "_from_afar", lambda *_: pytest.fail("looked for everywhere"))
    again = bordered(moved, anew=False)  # as with a longer memory: once, about where it is
    assert again.loss <= moved.loss


def test_polishing_leads_psi_and_ratio_on_and_leaves_the_border(rough, pool):
    recorded, _, z = rough
    hypothesis = recorded.with_problem(recorded.problem.with_effects((named(pool, "friction_patch"),)))
    off = at(hypothesis, z + np.array([0.3, 0.3, *np.zeros(6)]))
    found = polished(off)
    assert found.loss < off.loss - 10 and (found.z[2:] == z[2:]).all()
    assert found.loss == at(hypothesis, found.z).loss


def on_ground(x, y=0.0):
    x = np.asarray(x, float)
    return np.column_stack([x, np.broadcast_to(y, x.shape), np.zeros(len(x))])


def told_by(rough):
    """-log likelihoods that friction of another ratio lessens by half a nat a sample where it is `rough`."""
    told = np.ones((len(regions.RATIOS), len(rough)))
    told[regions.RATIOS.index(1.45), rough] -= 0.5
    told[regions.RATIOS.index(1.45), ~rough] += 0.5
    return told


def test_a_border_parts_places_and_not_times():
    """Samples of one place are on one side, however they are ordered."""
    rough = np.arange(400) < 200
    assert regions._best_across(told_by(rough), on_ground(np.zeros(400)), 0.0, 1.0) is None
    x = np.where(np.arange(400) % 2, 0.0, 1.0)
    border = regions._best_across(told_by(x > 0.5), on_ground(x), 0.0, 1.0)
    assert border is not None and border.gain == pytest.approx(100.0) and border.point[0] == pytest.approx(0.5)


@pytest.mark.parametrize("end", [0.3, 0.7])
def test_of_two_frictions_about_psi_the_region_is_where_the_body_was_less(end):
    """Either side may have psi's own: a region and its complement tell the same, by another psi."""
    x = np.linspace(0, 1, 400)
    told = np.ones((len(regions.RATIOS), 400))
    told[regions.RATIOS.index(0.85), x < end] -= 0.5
    told[regions.RATIOS.index(1.2), x > end] -= 0.5
    border = regions._best_across(told, on_ground(x), 0.0, 1.0)
    assert border is not None and border.normal[0] == pytest.approx(1.0 if end > 0.5 else -1.0)
    assert border.ratio == pytest.approx(1.2 / 0.85 if end > 0.5 else 0.85 / 1.2)


def test_no_border_lies_along_the_way_of_a_body():
    x = np.linspace(0, 1, 400)
    assert regions._best_across(told_by(x > 0.5), on_ground(x), np.pi / 2, 1.0) is None
    border = regions._best_across(told_by(x > 0.5), on_ground(x), 0.0, 1.0)
    assert border is not None and abs(border.point[0] - 0.5) < 0.01 and border.normal[0] == pytest.approx(1.0)


def test_friction_that_is_another_everywhere_makes_no_border():
    x = np.linspace(0, 1, 400)
    border = regions._best_across(told_by(np.ones(400, bool)), on_ground(x), 0.0, 1.0)
    assert border is None or border.gain <= 1e-9


def test_what_has_no_region_stays_as_it_is(followed, pool):
    drag = named(pool, "linear_drag")
    bare = at(followed, np.zeros(followed.problem.size))
    assert likeliest_border(bare, drag) is None and bordered(bare) is bare
    more = at(followed.with_problem(followed.problem.with_effects((drag,))), np.zeros(followed.problem.size + 1))
    assert bordered(more) is more
