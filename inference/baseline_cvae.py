"""A CVAE that learns from the recordings alone: it predicts transitions, and knows nothing of psi."""

import jax

from det2stoc_bayes.errors import MethodNotApplicable
from det2stoc_bayes.inference._amortized import Options, baseline
from det2stoc_bayes.inference._cvae import Schedule
from det2stoc_bayes.inference._predictive import heldout_transitions, kept, predictions
from det2stoc_bayes.inference._sampling import as_key, of_study, seed_of
from det2stoc_bayes.posterior import DataTree, Progress, build_predictive, measured, with_groups
from det2stoc_bayes.study_transitions import StudyTransitions
from det2stoc_bayes.vector_density import Inferred


def fit(
    problem: Inferred,
    key: int | jax.Array,
    *,
    num_samples: int = 1000,
    num_steps: int = 8_000,
    progress: Progress = lambda *_: None,
) -> DataTree:
    """Log densities of held-out transitions; `num_samples` latents weigh each, `num_steps` steps train the networks."""
    key = as_key(key)
    problem = of_study(problem, "baseline_cvae", "has no held-out recordings to predict")
    if not problem.simulator.study.holdout:
        raise MethodNotApplicable("baseline_cvae predicts held-out recordings; allowed: a study with holdout")
    with measured(problem) as cost:
        transitions = StudyTransitions.of(problem)
        real, heldout = transitions.recorded(), heldout_transitions(transitions)
        learn, judge = jax.random.split(key)
        options = Options(baseline=Schedule(num_steps, batch=256, learning_rate=2e-3))
        num_latents = max(len(problem.simulator.parameters), 1)
        simulator, _ = baseline(real, num_latents, learn, options, lambda _, done, total: progress(done, total))
        tree = build_predictive(
            problem,
            predictions(simulator, transitions, heldout, judge, num_samples),
            method="baseline_cvae",
            options={"num_samples": num_samples, "num_steps": num_steps},
            seed=seed_of(key),
            cost=cost,
        )
    return with_groups(tree, simulator=kept(simulator, transitions))
