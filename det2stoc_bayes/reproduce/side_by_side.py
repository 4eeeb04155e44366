"""What is independent of each other in an experiment, made by several processes at once."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from joblib import cpu_count

from det2stoc_bayes.executors import finished, workers
from det2stoc_bayes.reproduce.parts import Progress

MOST = 2  # processes where their number is not given: each takes gigabytes


def num_jobs(jobs: int) -> int:
    """So many processes; where it is 0 two, or one on a lone core or an accelerator, which processes cannot share."""
    return jobs or (min(cpu_count(), MOST) if jax.default_backend() == "cpu" else 1)


def side_by_side[T](
    make: Callable[[T], object], items: Sequence[T], jobs: int, parts: Path, total: int, progress: Progress
) -> None:
    """Make all items, of which `total` files come to a folder of parts. What one raises is raised, and others end."""

    def count() -> None:
        progress("making parts", len(list(parts.glob("*.json"))), total)

    with workers(jobs, progress=progress, most=len(items)) as executor:
        for _, result in finished(executor, make, items, count):
            result()


def silent(*_: Any) -> None:
    """Progress that nobody sees, which processes can be given."""
