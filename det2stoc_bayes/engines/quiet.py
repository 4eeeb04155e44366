"""MuJoCo's process-wide settings while many simulations run: no warnings of those that diverge, no profiler."""

import ctypes
import threading
from contextlib import ContextDecorator
from functools import cache
from pathlib import Path

import mujoco


class _Quiet(ContextDecorator):
    """Keeps MuJoCo's warnings of simulations that diverge off the console and out of its log file, and its clock still.

    Reading the clock for `MjData.timer` takes a fifth of a step with contacts, and half of one of a pendulum by RK4.
    """

    def __init__(self):
        self._lock, self._depth, self._before = threading.Lock(), 0, (True, True, None)

    def __enter__(self):
        with self._lock:
            if self._depth == 0:
                config, clock = mujoco.MjLogConfig.get(), _clock()
                self._before = config.logto_console, config.logto_file, clock and clock.value
                _log_to(False, False)
                if clock is not None:
                    clock.value = None
            self._depth += 1

    def __exit__(self, *_):
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                *log, read = self._before
                _log_to(*log)
                if (clock := _clock()) is not None:
                    clock.value = read


QUIET = _Quiet()


@cache
def _clock() -> ctypes.c_void_p | None:
    """MuJoCo's pointer to the function that tells the time (`mjcb_time`), which Python's binding cannot clear.

    None where the library is not beside the package.
    """
    folder = Path(mujoco.__file__).parent
    for library in (p for name in ("libmujoco.*", "mujoco.dll") for p in sorted(folder.glob(name))):
        try:
            return ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_time")
        except (OSError, ValueError):
            continue
    return None


def _log_to(console: bool, file: bool) -> None:
    config = mujoco.MjLogConfig.get()
    config.logto_console, config.logto_file = console, file
    config.set()
