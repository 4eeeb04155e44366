"""The type checker of jaxtyping's import hook: signatures, array shapes included, are checked in every test.

The hook finds it by name, from the option --jaxtyping-packages in pyproject.toml.
"""

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is welcome where a float is asked for


def checked(thing):
    """The thing with its calls checked, but for a method that says `Self`, which beartype cannot read."""
    try:
        return _checked(thing)
    except BeartypeDecorHintPep673Exception:
        return thing
