"""Silence for simulations that are expected to diverge now and then."""

import threading
from contextlib import ContextDecorator

import mujoco


class _Quiet(ContextDecorator):
    """Keeps MuJoCo's warnings of simulations that diverge off the console and out of its log file."""

    def __init__(self):
        self._lock, self._depth, self._before = threading.Lock(), 0, (True, True)

    def __enter__(self):
        with self._lock:
            if self._depth == 0:
                config = mujoco.MjLogConfig.get()
                self._before = config.logto_console, config.logto_file
                _log_to(False, False)
            self._depth += 1

    def __exit__(self, *_):
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                _log_to(*self._before)


QUIET = _Quiet()


def _log_to(console: bool, file: bool) -> None:
    config = mujoco.MjLogConfig.get()
    config.logto_console, config.logto_file = console, file
    config.set()
