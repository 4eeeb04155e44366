"""Signatures, array shapes included, are checked in every test: the first calls of each function in it.

Checks of every call would take most of the tests' time. jaxtyping's import hook finds `checked` by name, from the
option --jaxtyping-packages in pyproject.toml, and decorates with what is put in place of its own decorator here.
"""

import functools
import inspect
from collections import Counter
from collections.abc import Callable
from types import CodeType
from typing import Any

import jaxtyping
import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

NUM_CALLS = 50  # of a function in a test
CALLS: Counter[CodeType] = Counter()  # cleared before each test
# Numpy's numbers are numbers, and an int is welcome where a float is asked for.
_WIDER = FrozenDict({int: int | np.integer, float: float | int | np.floating | np.integer})
_checked = beartype(conf=BeartypeConf(hint_overrides=_WIDER))
_every_call = jaxtyping.jaxtyped


def checked(thing: Any) -> Any:
    """The thing with its calls checked, but for a method that says `Self`, which beartype cannot read."""
    try:
        return _checked(thing)
    except BeartypeDecorHintPep673Exception:
        return thing


def _first_calls(*, typechecker: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """jaxtyping's decorator for a function's first calls; those of closures made anew count together."""

    def decorate(thing: Any) -> Any:
        if not inspect.isfunction(thing):
            return _every_call(thing, typechecker=typechecker)
        code = thing.__code__
        if CALLS[code] >= NUM_CALLS:
            return thing
        strict = _every_call(thing, typechecker=typechecker)

        @functools.wraps(thing)
        def called(*args: Any, **kwargs: Any) -> Any:
            CALLS[code] += 1
            return (strict if CALLS[code] <= NUM_CALLS else thing)(*args, **kwargs)

        return called

    return decorate


jaxtyping.jaxtyped = _first_calls
