"""How many cores there are to work on."""

import os


def usable_cores() -> int:
    """Cores that this process may run on: in a container, or under `taskset`, fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # where processes are not tied to cores
