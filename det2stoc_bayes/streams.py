"""What the command line says and where: progress, warnings and errors on stderr, results on stdout, exit codes."""

import json
import logging
import signal
import sys
import warnings
from _thread import interrupt_main
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Timer, current_thread, main_thread
from typing import TYPE_CHECKING, Any

import typer

from det2stoc_bayes.errors import Det2StocError

if TYPE_CHECKING:
    # Dotted names, so that the checker of the tests can look them up.
    import rich.console

    import det2stoc_bayes.progress

PLAIN_WIDTH = 200  # columns of a table in a pipe or file


@contextmanager
def reporting(debug: bool) -> Iterator["det2stoc_bayes.progress.Stages"]:
    """Progress for the work inside; its warnings and errors as lines on stderr, its errors as exit codes."""
    from rich.console import Console

    from det2stoc_bayes.progress import Stages

    console = Console(stderr=True)
    interrupted = Event()
    logging.disable(logging.NOTSET if debug else logging.ERROR)  # what libraries log
    try:
        with _interrupting(interrupted), Stages(console, interrupted) as stages, _warnings_on(console):
            yield stages
    except (Exception, KeyboardInterrupt) as error:
        if interrupted.is_set() or isinstance(error, KeyboardInterrupt):
            raise _exit(console, "interrupted", 130) from error
        if isinstance(error, Det2StocError):
            raise _exit(console, f"error: {error}", 2) from error
        if debug:
            raise
        if isinstance(error, OSError) and error.filename is not None:
            raise _exit(console, f"error: {error.filename}: {error.strerror}", 2) from error
        if isinstance(error, MemoryError):
            raise _exit(console, f"error: not enough memory ({error}); allowed: fewer draws", 2) from error
        reason = " ".join(str(error).split())
        what = f"{type(error).__name__}: {reason}" if reason else type(error).__name__
        raise _exit(console, f"unforeseen error: {what} (--debug shows where)", 1) from error
    finally:
        logging.disable(logging.NOTSET)


@contextmanager
def _interrupting(interrupted: Event) -> Iterator[None]:
    """Remembers a Ctrl-C or a scheduler's SIGTERM: a library makes an error of its own of a KeyboardInterrupt.

    One raised where Python can only drop it (a finalizer, a callback of the garbage collector) is raised again.
    """
    over = Event()

    def note(*_: Any) -> None:
        interrupted.set()
        raise KeyboardInterrupt

    def again() -> None:
        if not over.is_set():
            _interrupt()

    def lost(dropped: Any) -> None:
        if isinstance(dropped.exc_value, KeyboardInterrupt):
            Timer(0.05, again).start()
        else:
            before_hook(dropped)

    if current_thread() is not main_thread():
        yield
        return
    before = {sent: signal.signal(sent, note) for sent in (signal.SIGINT, signal.SIGTERM)}
    before_hook, sys.unraisablehook = sys.unraisablehook, lost
    try:
        yield
    finally:
        over.set()
        for sent, handler in before.items():
            signal.signal(sent, handler)
        sys.unraisablehook = before_hook


def _interrupt() -> None:
    """A Ctrl-C for the main thread, which it wakes where the system can."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main_thread().ident or 0, signal.SIGINT)
    else:
        interrupt_main()


def _exit(console: "rich.console.Console", line: str, code: int) -> typer.Exit:
    console.print(line, style="red", markup=False, highlight=False, soft_wrap=True)
    return typer.Exit(code)


@contextmanager
def _warnings_on(console: "rich.console.Console") -> Iterator[None]:
    """What a study's reader warns of, each once; what libraries warn of is not the user's to mend."""
    from det2stoc_bayes.recording import StudyWarning

    seen = set()

    def told(message: Warning | str, *_: Any, **__: Any) -> None:
        if isinstance(message, StudyWarning) and str(message) not in seen:
            seen.add(str(message))
            line = f"warning: {message}"
            console.print(line, style="yellow", markup=False, highlight=False, soft_wrap=True)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", StudyWarning)
        warnings.showwarning = told
        yield


def show(result: "rich.console.RenderableType | dict[str, Any] | list[Any]", as_json: bool) -> None:
    """To stdout: JSON with null for what is not a number, or tables, in colour on a terminal alone."""
    try:
        _print(result, as_json)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        from rich.console import Console

        raise _exit(Console(stderr=True), f"error: stdout: {error.strerror}", 2) from error


def _print(result: "rich.console.RenderableType | dict[str, Any] | list[Any]", as_json: bool) -> None:
    if as_json:
        from det2stoc_bayes.mismatch.finding import plain

        print(json.dumps(plain(result), indent=2, ensure_ascii=False, allow_nan=False))
        return
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    console.print(result, soft_wrap=isinstance(result, str))


def show_report(result: "rich.console.RenderableType | dict[str, Any]", out: Path, as_json: bool) -> None:
    """The same, and where the report is."""
    show(result, as_json)
    if not as_json:
        show(f"Report: {out / 'report.html'}", as_json)
