"""The type checker of jaxtyping's import hook: signatures, array shapes included, are checked in every test.

The hook finds it by name, from the option --jaxtyping-packages in pyproject.toml.
"""

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

# Numpy's numbers are numbers, and an int is welcome where a float is asked for.
_WIDER = FrozenDict({int: int | np.integer, float: float | int | np.floating | np.integer})
_checked = beartype(conf=BeartypeConf(hint_overrides=_WIDER))


def checked(thing):
    """The thing with its calls checked, but for a method that says `Self`, which beartype cannot read."""
    try:
        return _checked(thing)
    except BeartypeDecorHintPep673Exception:
        return thing
