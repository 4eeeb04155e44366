"""Progress of long work on stderr: bars with rate and time left on a terminal, one line a stage elsewhere."""

from threading import Event
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text


class Stages:
    """Takes `(stage, done, total)`, or `(done, total)` of one stage through `of`; a context manager."""

    def __init__(self, console: Console, interrupted: Event | None = None):
        """`interrupted`: once set, the next report raises KeyboardInterrupt; a library's callback may have lost it."""
        self._console, self._interrupted = console, interrupted
        self._seen: dict[str, TaskID] = {}
        self._bars = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn(), _Rate(), _Left(),
            console=console, disable=not console.is_terminal,
        )  # fmt: skip

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """`done` of `total` steps of a stage are over; the first call of a stage announces it."""
        if self._interrupted is not None and self._interrupted.is_set():
            raise KeyboardInterrupt
        if stage not in self._seen:
            self._seen[stage] = self._bars.add_task(stage, total=total)
            if not self._console.is_terminal:
                self._console.print(stage, highlight=False, markup=False, soft_wrap=True)
        self._bars.update(self._seen[stage], completed=done, total=total)

    def of(self, stage: str):
        """The same for work that knows one stage only: a function of `(done, total)`."""
        return lambda done, total: self(stage, done, total)


class _Rate(ProgressColumn):
    """Steps a second, or seconds a step where they are slow; nothing before there are two."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed or (task.total or 0) < 2:
            return Text("")
        rate = f"{speed:.3g}/s" if speed >= 1 else f"{1 / speed:.3g} s each"
        return Text(rate, style="progress.data.speed")


class _Left(ProgressColumn):
    """Time left while a stage runs, time taken when it is over."""

    def __init__(self):
        super().__init__()
        self._left, self._taken = TimeRemainingColumn(), TimeElapsedColumn()

    def render(self, task: Task) -> Text:
        if task.finished:
            return Text(str(self._taken.render(task)), style="progress.elapsed")
        return Text(f"{self._left.render(task)} left", style="progress.remaining")
