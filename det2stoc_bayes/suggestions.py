"""How an error message names the alternatives to something that was not understood."""

from collections.abc import Iterable
from difflib import get_close_matches

from det2stoc_bayes.errors import listing


def choices(found: str, allowed: Iterable[str], limit: int = 12) -> str:
    """The nearest allowed name, if one is near, and what is allowed: `did you mean 'b'? allowed: a, b`."""
    names = list(allowed)
    near = get_close_matches(found, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return f"{hint}allowed: {listing(names, limit)}"
