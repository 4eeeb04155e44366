"""The models of one seed of an experiment: baselines, the algorithm's iterations, and what lies beyond the source's."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from det2stoc_bayes.inference._amortized import Iteration, Options, Population, baseline, iterate, marginal
from det2stoc_bayes.inference._cvae import Schedule
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.models._runs import Runs
from det2stoc_bayes.reproduce.scores import rolled_out, rollout_scores, transition_scores
from det2stoc_bayes.reproduce.work import Settings, Work
from det2stoc_bayes.transitions import Transitions

MARGINAL = "det2stoc z integrated out"
VARIANTS = {
    "full covariances": Options(full=True),
    "2 more latents": Options(num_extra=2),
    "mixture of 3 as prior": Options(num_components=3),
}
ROTATIONS = "valid rotations"
WIDER = 2.0  # than believed, where episodes are read: what a narrow simulation excludes, no episode tells any more
VARIED_TURN = 2  # the third iteration, the source's last; variants are made of the first seed alone

Told = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Seed:
    """A seed's recordings, and the test set that all of its models are scored on."""

    work: Work
    number: int
    tested: Runs

    @cached_property
    def psi(self) -> Float[np.ndarray, "episodes psi"]:
        """That its recordings were made with."""
        return self.work.drawn(self.number)

    @cached_property
    def runs(self) -> Runs:
        """Its recordings; what is kept needs none of them."""
        return self.work.recorded(self.number)

    def models(self) -> dict[str, Told]:
        """All of them by name, each kept as soon as it is done."""
        found = self._baselines()
        found |= self._iterations()
        last = self.work.settings.num_iterations
        found[MARGINAL] = self.work.model(self.number, MARGINAL, lambda: self._marginal(_next(found, last), last))
        if self.number == 0 and self.work.settings.variants:
            found |= self._variants(found, min(VARIED_TURN, last - 1))
        return found

    def _baselines(self) -> dict[str, Told]:
        work, found = self.work, {}
        options = Options(baseline=Schedule(work.settings.baseline_steps, batch=256, learning_rate=2e-3))
        for episodes in work.settings.baselines:
            name = f"baseline {episodes * work.scene.num_steps}"

            def learn(episodes: int = episodes, name: str = name) -> Told:
                real = self.runs[:episodes].transitions
                made, history = baseline(
                    real, len(work.scene.names), work.key(name, self.number), options, work.progress
                )
                return self._scored(made, name, len(real)) | {"steps": history[-1][0]}

            found[name] = work.model(self.number, name, learn)
        return found

    def _iterations(self) -> dict[str, Told]:
        found: dict[str, Told] = {}
        for turn in range(self.work.settings.num_iterations):
            name = f"det2stoc {turn + 1}"

            def learn(turn: int = turn, name: str = name) -> Told:
                made = self._turned(_next(found, turn) if turn else None, turn)
                drawn = self.psi[: self.work.scene.real_episodes[turn]]
                about = {"drawn": {"mean": drawn.mean(0).tolist(), "sd": drawn.std(0, ddof=1).tolist()}}
                return self._scored(made.simulator, name, len(self._real(turn))) | told(made) | about

            found[name] = self.work.model(self.number, name, learn)
        return found

    def _turned(self, believed: Population | None, turn: int) -> Iteration:
        """One turn of the algorithm, from psi_0 where nothing is believed yet."""
        settings = self.work.settings
        options = Options.decoding(settings.decoder_steps if turn else settings.first_steps)
        if believed and settings.episode_steps:
            believed = replace(believed, scale=WIDER * believed.scale)
        episodes = Schedule(settings.episode_steps, batch=25, learning_rate=2e-3) if settings.episode_steps else None
        return self._iterate(believed, turn, replace(options, episodes=episodes))

    def _iterate(self, believed: Population | None, turn: int, options: Options, decoder: Any = None) -> Iteration:
        count = self.work.settings.num_simulated
        psi, simulated = self._simulated(believed, turn, count) if believed else first_simulations(self.work)
        believed = believed or Population.of(psi)
        each, key = np.repeat(psi, self.work.scene.num_steps, 0), self.work.key("iteration", self.number, turn)
        return iterate(self._real(turn), simulated, each, believed, key, options, self.work.progress, decoder)

    def _real(self, turn: int) -> Transitions:
        return self.work.real(self.number)[: self.work.scene.real_episodes[turn]].transitions

    def _simulated(
        self, believed: Population, turn: int, count: int
    ) -> tuple[Float[np.ndarray, "episodes psi"], Transitions]:
        """psi of a population, and episodes under them."""
        work = self.work
        random = work.random(2, self.number, turn)
        psi = work.scene.drawn(believed, random, count)
        return psi, work.simulate(psi, "simulating", 2, self.number, turn).transitions

    def _marginal(self, believed: Population, last: int) -> Told:
        settings = self.work.settings
        _, simulated = self._simulated(believed, last, settings.num_marginal or settings.num_simulated)
        options, key = Options.decoding(settings.decoder_steps), self.work.key(MARGINAL, self.number)
        made, _ = marginal(simulated, key, options, self.work.progress)
        return self._scored(made, MARGINAL, len(self._real(last - 1)))

    def _variants(self, models: dict[str, Told], turn: int) -> dict[str, Told]:
        """An iteration again: from the same recordings and simulations, and with its decoder where that serves."""
        found, name = {}, f"det2stoc {turn + 1}"
        believed = _next(models, turn) if turn else None

        def learn(kind: str) -> Told:
            plain = StochasticSimulator.load(self.work.saved(self.number, name))
            if kind == ROTATIONS:
                made = replace(plain, rotations=(self.work.scene.matrix,))
            else:
                schedule = Options.decoding(self.work.settings.decoder_steps).decoder
                options = replace(VARIANTS[kind], decoder=schedule)
                made = self._iterate(believed, turn, options, None if options.full else plain.decoder).simulator
            return self._scored(made, f"{name}, {kind}", len(self._real(turn))) | {"variant": True}

        for kind in (*VARIANTS, ROTATIONS):
            found[f"{name}, {kind}"] = self.work.model(self.number, f"{name}, {kind}", lambda kind=kind: learn(kind))
        return found

    def _scored(self, simulator: StochasticSimulator, name: str, real: int) -> Told:
        simulator.save(self.work.saved(self.number, name))
        work, draws = self.work, self.work.settings.num_draws
        test, blocks = self.tested.transitions, work.scene.blocks
        scores = transition_scores(simulator, test, draws, work.key("scores", self.number), blocks)
        rolled = rolled_out(simulator, work.scene, self.tested, draws, work.key("rollouts", self.number))
        metrics = scores | rollout_scores(rolled, self.tested.states)
        return {"real": real, "variant": False, "metrics": metrics}


def num_models(settings: Settings) -> int:
    """Of all seeds together."""
    of_each = len(settings.baselines) + settings.num_iterations + 1
    return settings.num_seeds * of_each + settings.variants * (len(VARIANTS) + 1)


def _next(models: dict[str, Told], turn: int) -> Population:
    """What an iteration found, from which the next one simulates."""
    found = models[f"det2stoc {turn}"]["next"]
    return Population(np.array(found["loc"]), np.array(found["scale"]))


def told(found: Iteration) -> Told:
    """An iteration's posteriors as plain lists."""
    after = found.next_population
    return {
        "next": {"loc": after.loc.tolist(), "scale": after.scale.tolist()},
        "pooled": {"mean": found.pooled.loc.tolist(), "sd": found.pooled.scale.tolist()},
        "pooled_draws": found.pooled_draws.T.tolist(),
        "population": {
            "mean": found.mean_draws.mean(0).tolist(),
            "mean_sd": found.mean_draws.std(0).tolist(),
            "sd": found.sd_draws.mean(0).tolist(),
            "sd_sd": found.sd_draws.std(0).tolist(),
        },
        "episodes": found.episode_means.tolist(),
        "episode_sds": np.sqrt(np.einsum("eii->ei", found.episode_covariances)).tolist(),
        "divergences": found.divergences.tolist(),
    }


def first_simulations(work: Work) -> tuple[Float[np.ndarray, "episodes psi"], Transitions]:
    """psi_0 and its simulations, which all seeds have in common."""

    def made() -> dict[str, np.ndarray]:
        psi = work.scene.prior.draw(work.random(3), work.settings.num_first)
        runs = work.simulate(psi, "simulating psi_0", 3)
        return {"psi": psi, "states": runs.states, "actions": runs.actions}

    data = work.arrays(f"first_{work.settings.num_first}", made)
    return data["psi"], Transitions.of_episodes(data["states"], data["actions"])
