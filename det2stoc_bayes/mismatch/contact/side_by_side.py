"""What is independent of each other at once, by as many threads as there are cores, four at most.

Half of a diagnosis' time where bodies touch is MuJoCo's own steps, during which Python is free; threads of its own
would wait for each other at every step, of which a followed simulation takes few between samples.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from threading import Event

from det2stoc_bayes.engines.mujoco_c import HALT, MujocoC
from det2stoc_bayes.problem import Problem

MOST = 4  # at once: more of them wait for Python


def side_by_side[T, S](
    problem: Problem, make: Callable[[T], S], items: Sequence[T], told: Callable[[int], None] = lambda _: None
) -> list[S]:
    """What is made of each, in their order; `told` hears the number of each that is waited for.

    Where one fails or is interrupted the others end with their next simulation, and what it raised is raised.
    """
    engine, count = problem.simulator.engine, min(len(items), MOST)
    if not isinstance(engine, MujocoC) or engine.users > 1 or (count := min(count, engine.threads)) < 2:
        return [(told(k), make(item))[1] for k, item in enumerate(items)]
    halt, failures = Event(), list[BaseException]()

    def made(item: T) -> S:
        HALT.set(halt)
        try:
            return make(item)
        except BaseException as error:
            failures.append(error)
            halt.set()
            raise

    with engine.shared_by(count), ThreadPoolExecutor(count) as pool:
        try:
            futures = [pool.submit(copy_context().run, made, item) for item in items]
            return [(told(k), future.result())[1] for k, future in enumerate(futures)]
        except BaseException as error:
            halt.set()
            pool.shutdown(cancel_futures=True)
            if failures and isinstance(error, Exception):
                raise failures[0] from None
            raise
