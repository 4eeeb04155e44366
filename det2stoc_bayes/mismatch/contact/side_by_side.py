"""What is independent of each other at once, by as many threads as there are cores.

Half of a diagnosis' time where bodies touch is MuJoCo's own steps, during which Python is free; threads of its own
would wait for each other at every step, of which a followed simulation takes few between samples.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context

from det2stoc_bayes.engines.mujoco_c import MujocoC
from det2stoc_bayes.problem import Problem

MOST = 4  # at once: more of them wait for Python


def side_by_side[T, S](
    problem: Problem, make: Callable[[T], S], items: Sequence[T], told: Callable[[int], None] = lambda _: None
) -> list[S]:
    """What is made of each, in their order; `told` hears the number of each that is waited for.

    Where one fails or is interrupted the others end with their next simulation.
    """
    engine = problem.simulator.engine
    count = min(len(items), MOST)
    if not isinstance(engine, MujocoC) or engine.users > 1 or min(engine.threads, count) < 2:
        return [(told(k), make(item))[1] for k, item in enumerate(items)]
    count = min(count, engine.threads)
    with ThreadPoolExecutor(count) as pool, engine.shared_by(count):
        futures = [pool.submit(copy_context().run, make, item) for item in items]
        try:
            return [(told(k), future.result())[1] for k, future in enumerate(futures)]
        except BaseException:
            engine.halt()
            pool.shutdown(cancel_futures=True)
            raise
