"""What is told of a fit, whether bodies touch or not."""

from typing import Protocol, runtime_checkable

from det2stoc_bayes.problem import Problem


@runtime_checkable
class AnyFit(Protocol):
    """A fit of any kind."""

    @property
    def problem(self) -> Problem:
        """The hypothesis."""
        ...

    @property
    def noise_inflation(self) -> float:
        """Variance of what it leaves over the noise's, outliers told apart."""
        ...
