"""The checks of signatures that all tests run under."""

import numpy as np
import pytest
import shapes_plugin
from jaxtyping import TypeCheckError

from det2stoc_bayes.engines.rotations import rotated


def turn(length=3):
    return rotated(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(length))


def test_a_wrong_shape_is_an_error_in_the_first_calls():
    with pytest.raises(TypeCheckError, match="vector"):
        turn(4)
    for _ in range(shapes_plugin.NUM_CALLS):
        turn()
    with pytest.raises(ValueError, match="broadcast"):  # numpy's own
        turn(4)


def test_every_test_begins_anew():
    with pytest.raises(TypeCheckError):
        turn(4)
