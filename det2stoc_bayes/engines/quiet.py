"""MuJoCo's process-wide settings while many simulations run: no warnings of those that diverge, no profiler."""

import ctypes
import threading
from contextlib import ContextDecorator
from functools import cache
from pathlib import Path
from typing import Any

import mujoco


class _ProcessWide(ContextDecorator):
    """A setting that is changed while any thread is inside, and put back when the last one leaves."""

    def __init__(self):
        self._lock, self._depth, self._before = threading.Lock(), 0, None

    def __enter__(self):
        with self._lock:
            if self._depth == 0:
                self._before = self._change()
            self._depth += 1

    def __exit__(self, *_):
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                self._put_back(self._before)

    def _change(self) -> Any:
        """Changes it, and says what it was."""
        raise NotImplementedError

    def _put_back(self, before: Any) -> None:
        raise NotImplementedError


class _Quiet(_ProcessWide):
    """Keeps MuJoCo's warnings of simulations that diverge off the console and out of its log file."""

    def _change(self) -> tuple[bool, bool]:
        config = mujoco.MjLogConfig.get()
        before = config.logto_console, config.logto_file
        self._put_back((False, False))
        return before

    def _put_back(self, before: tuple[bool, bool]) -> None:
        config = mujoco.MjLogConfig.get()
        config.logto_console, config.logto_file = before
        config.set()


class _Untimed(_ProcessWide):
    """Keeps MuJoCo from reading the clock for `MjData.timer`, in every thread of the process.

    It takes a fifth of a step with contacts, and half of one of a pendulum by RK4.
    """

    def _change(self) -> int | None:
        clock = _clock()
        before = None if clock is None else clock.value
        self._put_back(None)
        return before

    def _put_back(self, before: int | None) -> None:
        if (clock := _clock()) is not None:
            clock.value = before


QUIET, UNTIMED = _Quiet(), _Untimed()


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
