"""A likelihood that contact makes rough, without contact."""

from functools import cached_property
from types import SimpleNamespace

import numpy as np

from det2stoc_bayes.mismatch.contact.fit import at
from det2stoc_bayes.mismatch.contact.followed import Followed
from det2stoc_bayes.problem import Problem
from det2stoc_bayes.unknowns import Unknowns

TRUTH = np.array([0.4, -0.3])


class Asked(Problem):
    """What a fit asks of a problem, as its followed recordings tell it."""

    told: "Rough"
    simulator = SimpleNamespace(engine=None)
    effects, timestep = (), None

    def __init__(self, told):
        object.__setattr__(self, "told", told)

    size = property(lambda self: self.told.size)
    num_psi = property(lambda self: self.told.num_psi)
    floor = property(lambda self: self.told.floor)
    unknowns = property(lambda self: self.told.unknowns)

    def probes(self):
        return [np.array([k]) for k in range(self.size)]

    def nudge(self, z, which, size):
        return size


class Rough(Followed):
    """A linear model of 400 samples of noise 1; of a sixth a contact is made or broken within a fraction of a sd."""

    size, num_psi, floor, unknowns = 2, 2, np.full(2, -np.inf), Unknowns((), ())
    recording = cached_property(lambda _: np.zeros(40, int))
    volumes = cached_property(lambda _: np.zeros(40))
    shape = (40, 10, 1)
    rough: float
    seed: int
    columns: np.ndarray
    phase: np.ndarray
    values: np.ndarray

    def __init__(self, seed, rough):
        random = np.random.default_rng(seed)
        object.__setattr__(self, "problem", Asked(self))
        object.__setattr__(self, "rough", rough)
        object.__setattr__(self, "seed", seed)
        object.__setattr__(self, "columns", np.column_stack([np.ones(400), random.standard_normal(400)]))
        object.__setattr__(self, "phase", random.uniform(0, 2 * np.pi, 400))
        object.__setattr__(self, "values", self.columns @ TRUTH + random.standard_normal(400))

    def leads_as(self, other):
        return other is self

    def errors(self, z):
        foretold = z @ self.columns.T
        jump = self.rough * np.sign(np.sin(150 * foretold + self.phase)) * (np.arange(400) % 6 == 0)
        return (self.values - foretold - jump).reshape(len(z), 40, 10, 1)


class Fixed(Rough):
    """The same without an unknown."""

    size, num_psi, floor = 0, 0, np.zeros(0)

    def errors(self, z):
        return np.zeros((len(z), 40, 10, 1))


def smooth_top(seed):
    model = Rough(seed, 0.0)
    fit = at(model, TRUTH)
    for _ in range(5):
        fit = at(model, fit.z + np.linalg.solve(fit.gram, fit.slopes.sum(0) - fit.z))
    return fit
