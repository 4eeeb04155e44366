"""Threads that simulate at once find what one after the other finds, and end together."""

import threading
import time
from concurrent.futures import CancelledError

import numpy as np
import pytest
from conftest import make_study
from sliding import PSI, XML, slides

from det2stoc_bayes.mismatch.candidates import candidates
from det2stoc_bayes.mismatch.contact.fit import at, fit_followed
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.mismatch.contact.screen import screen
from det2stoc_bayes.mismatch.contact.side_by_side import side_by_side
from det2stoc_bayes.problem import make_problem
from det2stoc_bayes.simulator import Simulator


def with_threads(folder, threads):
    study = make_study(folder / f"with_{threads}", XML.format(0.02), PSI, slides())
    return make_problem(Simulator(study, num_threads=threads))


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return with_threads(tmp_path_factory.mktemp("two"), 2)


def test_fits_are_those_of_one_thread_and_stand_in_order(tmp_path):
    starts = [np.array([z]) for z in (-1.0, 0.0, 1.0)]
    found, counts = [], []
    for threads in (1, 3):
        problem = with_threads(tmp_path, threads)
        followed = Followed(problem).averaged(2)
        fits = side_by_side(problem, lambda z, f=followed: fit_followed(f, z, iterations=2), starts)
        found.append([(f.z[0], f.loss) for f in fits])
        counts.append(problem.simulator.counter.steps)
    assert found[0] == found[1] and counts[0] == counts[1]


def test_what_is_screened_does_not_depend_on_threads(tmp_path):
    out = []
    for threads in (1, 2):
        problem = with_threads(tmp_path, threads)
        pool = [c for c in candidates(problem) if c.effect.name in ("linear_drag", "gravity_tilt", "gravity_error")]
        told = []
        promises = screen(at(Followed(problem), np.zeros(1)), pool, told.append)
        out.append([(p.placed.label, p.gain) for p in promises])
        assert sum(told) == len(pool) == 3
    assert out[0] == out[1]


def test_threads_run_at_once_and_share_the_cores(problem):
    meet, engine = threading.Barrier(2, timeout=20), problem.simulator.engine
    users = side_by_side(problem, lambda _: (meet.wait(), engine.users)[1], [0, 1])
    assert users == [2, 2] and engine.users == 1


@pytest.mark.parametrize("first", [0, 1])
def test_where_one_fails_the_others_end_with_their_next_simulation(problem, first):
    followed, ends, begun = Followed(problem), [], threading.Event()

    def goes_on(_):
        try:
            begun.set()
            until = time.monotonic() + 30
            while time.monotonic() < until:
                followed.errors(np.zeros((1, 1)))
        except CancelledError:
            ends.append("cancelled")
            raise

    def fails(_):
        begun.wait(20)
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        side_by_side(problem, lambda make: make(0), [fails, goes_on] if first == 0 else [goes_on, fails])
    assert ends == ["cancelled"]
    assert np.isfinite(at(followed, np.zeros(1)).loss)  # and the engine goes on


def test_within_a_thread_nothing_is_shared_once_more(problem):
    inner = side_by_side(problem, lambda _: side_by_side(problem, lambda k: threading.get_ident(), [0, 1]), [0, 1])
    assert all(a == b for a, b in inner)
