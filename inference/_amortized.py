"""The thesis' algorithm on transitions: simulate, learn the decoder, freeze it, learn the encoder, move psi's prior.

What is inferred is kept apart: q of one transition, the posterior of one episode, and the population that episodes'
psi come from. The pooled sd of q over all transitions, which the source reports, is none of these: it holds every
transition's own uncertainty as well.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from det2stoc_bayes.inference._cvae import (
    VALIDATION,
    Cvae,
    HybridELBO,
    Schedule,
    held_back,
    normal,
    optimize,
    standard_normal,
)
from det2stoc_bayes.inference._episode_encoder import episode_posteriors
from det2stoc_bayes.inference._episodes import Episodes, population_draws
from det2stoc_bayes.inference._latent import LatentMixture
from det2stoc_bayes.inference._networks import Decoder, Encoder, ExtendedDecoder
from det2stoc_bayes.inference._stochastic import StochasticSimulator
from det2stoc_bayes.transitions import Scaling, Transitions

Progress = Callable[[str, int, int], None]
History = Sequence[tuple[int, float, float]]
MOST_JUDGED = 20_000  # rows: a judgement on more costs more than it tells
NUM_DRAWS = 1000


@dataclass(frozen=True)
class Options:
    """Sizes and schedules. alpha: weight of the ELBO beside the expectation over the prior.

    full: Gaussians with all covariances. num_extra: latents beside psi's. num_components: of a learned mixture prior.
    """

    full: bool = False
    num_extra: int = 0
    num_components: int = 1
    alpha: float = 0.8
    dropout: float = 0.2
    width: int = 64
    few: tuple[int, int] = (3000, 32)  # fewer rows than this: a baseline of this width, the better one there
    decoder: Schedule = Schedule(num_steps=12_000, batch=1000, learning_rate=5e-3)
    encoder: Schedule = Schedule(num_steps=2_000, batch=256, learning_rate=1e-3)
    baseline: Schedule = Schedule(num_steps=8_000, batch=256, learning_rate=2e-3)
    episodes: Schedule | None = None  # of an encoder of whole episodes; None: their posteriors are the decoder's

    @classmethod
    def decoding(cls, num_steps: int) -> "Options":
        """The defaults with another number of steps for the decoder."""
        return cls(decoder=replace(cls.decoder, num_steps=num_steps))


@dataclass(frozen=True, eq=False)
class Population:
    """Normals that psi is drawn from, one a parameter."""

    loc: Float[np.ndarray, " psi"]
    scale: Float[np.ndarray, " psi"]

    @classmethod
    def of(cls, draws: Float[np.ndarray, "rows psi"]) -> "Population":
        """With the draws' means and sds."""
        return cls(draws.mean(0), draws.std(0))

    def standard(self, psi: Float[np.ndarray, "*rows psi"]) -> Float[np.ndarray, "*rows psi"]:
        """psi in the measure that the latent has."""
        return (psi - self.loc) / self.scale


@dataclass(frozen=True, eq=False)
class Iteration:
    """One turn of the algorithm, all of it in psi's own units."""

    cvae: Cvae[Decoder | ExtendedDecoder]
    simulator: StochasticSimulator
    pretrained: Decoder  # on simulations alone
    believed: Population  # that psi was simulated from
    simulated_range: Float[np.ndarray, "2 psi"]  # least and greatest psi that was simulated
    pooled_draws: Float[np.ndarray, "rows psi"]  # q's samples, one a transition
    episode_means: Float[np.ndarray, "episodes psi"]
    episode_covariances: Float[np.ndarray, "episodes psi psi"]
    mean_draws: Float[np.ndarray, "draws psi"]  # posterior of the population's mean
    sd_draws: Float[np.ndarray, "draws psi"]  # and of its sd
    divergences: Float[np.ndarray, " z"]  # KL(q || N(0, 1)) of each latent, mean over transitions [nat]
    history: Mapping[str, History]

    @property
    def pooled(self) -> Population:
        """Of q's samples over all transitions: the source's figure."""
        return Population.of(self.pooled_draws)

    @property
    def next_population(self) -> Population:
        """What an episode to come is expected to have: the population, and how unsure one is of it."""
        spread = np.sqrt((self.sd_draws**2).mean(0) + self.mean_draws.var(0))
        return Population(self.mean_draws.mean(0), spread)

    @property
    def outside(self) -> Float[np.ndarray, "draws psi"]:
        """1 where the population's mean lies beyond all psi that were simulated: the prior excluded the truth."""
        low, high = self.simulated_range
        return ((self.mean_draws < low) | (self.mean_draws > high)).astype(float)

    @property
    def alarm(self) -> float:
        """Probability that some psi's population mean does so."""
        return float(self.outside.max(1).mean())

    @property
    def predictive(self) -> StochasticSimulator:
        """The stochastic simulator with the population that was inferred as prior, not the one simulated from.

        Latents beside psi's stay standard normal.
        """
        now, then = self.next_population, self.believed
        further = self.simulator.decoder.latents - len(now.loc)
        loc = np.append(then.standard(now.loc), np.zeros(further))
        scale = np.append(now.scale / then.scale, np.ones(further))
        return replace(self.simulator, latent=LatentMixture.normal(loc, scale))


def pretrain(
    simulated: Transitions,
    z: Float[np.ndarray, "rows z"],
    scaling: Scaling,
    key: PRNGKeyArray,
    options: Options,
    progress: Progress,
) -> tuple[Decoder, History]:
    """p(s' - s | s, a, z) by maximum likelihood on simulations, psi in the place of z."""
    x, y = scaling.standard(simulated)
    net, split, train = jax.random.split(key, 3)
    decoder = Decoder(x.shape[1], z.shape[1], y.shape[1], net, full=options.full, width=options.width)
    template = Cvae(Encoder(x.shape[1], y.shape[1], z.shape[1], net), decoder, standard_normal(z.shape[1]), False)
    params, history = optimize(
        HybridELBO(1.0), template.model, template.guide, *_split(split, simulated, x, y, z.astype(np.float32)), train,
        options.decoder, progress=lambda done, total: progress("training the decoder", done, total),
    )  # fmt: skip
    return template.with_params(params).decoder, history


def marginal(
    simulated: Transitions, key: PRNGKeyArray, options: Options, progress: Progress
) -> tuple[StochasticSimulator, History]:
    """p(s' - s | s, a) with psi integrated out: learned from simulations under the population, psi not shown.

    The state betrays psi, and what it betrays the network uses; a single z from the prior then costs nothing.
    """
    scaling = Scaling.of(simulated)
    decoder, history = pretrain(simulated, np.zeros((len(simulated), 0)), scaling, key, options, progress)
    return StochasticSimulator(decoder, scaling), history


def recognize(
    real: Transitions,
    decoder: Decoder,
    scaling: Scaling,
    key: PRNGKeyArray,
    options: Options,
    progress: Progress,
) -> tuple[Cvae[Decoder | ExtendedDecoder], History]:
    """q(z | s, a, s') on recordings under the frozen decoder, and what else is learned from recordings."""
    x, y = scaling.standard(real)
    net, split, train, apart, push = jax.random.split(key, 5)
    extended = ExtendedDecoder(decoder, options.num_extra, push) if options.num_extra else decoder
    size = extended.latents
    mixed = options.num_components > 1
    prior = LatentMixture.first(size, options.num_components, apart) if mixed else standard_normal(size)
    # The expectation over the prior would shrink a prior, or weights of further latents, that are learned with it.
    alpha = 1.0 if mixed or options.num_extra else options.alpha
    encoder = Encoder(x.shape[1], y.shape[1], size, net, drop=options.dropout, full=options.full)
    cvae = Cvae(encoder, extended, prior, options.num_extra == 0)
    params, history = optimize(
        HybridELBO(alpha), cvae.model, cvae.guide, *_split(split, real, x, y), train, options.encoder,
        progress=lambda done, total: progress("training the encoder", done, total),
    )  # fmt: skip
    return cvae.with_params(params), history


def iterate(
    real: Transitions,
    simulated: Transitions,
    psi: Float[np.ndarray, "rows psi"],
    believed: Population,
    key: PRNGKeyArray,
    options: Options = Options(),
    progress: Progress = lambda *_: None,
    decoder: Decoder | None = None,
    varies: Bool[np.ndarray, " psi"] | None = None,
) -> Iteration:
    """One turn of the algorithm; `psi` are those of the simulated rows, `decoder` one that learned from them before.

    `varies`: which psi differ between episodes (None: all of them); of the others the population's sd is 0.
    """
    keys = jax.random.split(key, 4)
    true, scaling, learned = believed.standard(psi), Scaling.of(simulated), ()
    if decoder is None:
        decoder, learned = pretrain(simulated, true, scaling, keys[0], options, progress)
    cvae, recognized = recognize(real, decoder, scaling, keys[1], options, progress)
    x, y = scaling.standard(real)
    q = normal(*jax.vmap(cvae.encoder)(jnp.asarray(x), jnp.asarray(y)))
    q_mean, q_variance = np.asarray(q.mean, float), np.asarray(q.variance, float)
    divergences = 0.5 * (q_variance + q_mean**2 - 1 - np.log(q_variance))
    loc, sd, own = believed.loc, believed.scale, slice(len(believed.loc))
    history = {"decoder": learned, "encoder": recognized}
    if options.episodes is None:
        means, covariances = Episodes.of(cvae, x, y, real.episode).posteriors()
        means, covariances = means[:, own], covariances[:, own, own]
    else:
        means, covariances, history["episodes"] = episode_posteriors(
            real, simulated, true, scaling, jax.random.fold_in(key, len(keys)), options.episodes,
            lambda done, total: progress("training the encoder of episodes", done, total),
        )  # fmt: skip
    centre, spread = population_draws(means, covariances, keys[3], NUM_DRAWS, varies)
    learned_prior = cvae.prior if isinstance(cvae.prior, LatentMixture) else None
    return Iteration(
        cvae,
        StochasticSimulator(cvae.decoder, scaling, latent=learned_prior),
        decoder,
        believed,
        np.stack([psi.min(0), psi.max(0)]),
        loc + sd * np.asarray(q.sample(keys[2]), float)[:, own],
        loc + sd * means,
        covariances * np.outer(sd, sd),
        loc + sd * centre,
        sd * spread,
        divergences.mean(0),
        history,
    )


def baseline(
    real: Transitions,
    num_latents: int,
    key: PRNGKeyArray,
    options: Options = Options(),
    progress: Progress = lambda *_: None,
) -> tuple[StochasticSimulator, History]:
    """A CVAE of the same networks that learns from recordings alone."""
    scaling = Scaling.of(real)
    x, y = scaling.standard(real)
    keys = jax.random.split(key, 4)
    width = options.few[1] if len(real) < options.few[0] else options.width
    shape: dict[str, Any] = {"full": options.full, "width": width}
    encoder = Encoder(x.shape[1], y.shape[1], num_latents, keys[0], drop=options.dropout, **shape)
    decoder = Decoder(x.shape[1], num_latents, y.shape[1], keys[1], **shape)
    cvae = Cvae(encoder, decoder, standard_normal(num_latents), False)
    params, history = optimize(
        HybridELBO(options.alpha), cvae.model, cvae.guide, *_split(keys[2], real, x, y), keys[3], options.baseline,
        progress=lambda done, total: progress("training the baseline", done, total),
    )  # fmt: skip
    return StochasticSimulator(cvae.with_params(params).decoder, scaling), history


def _split(key: PRNGKeyArray, data: Transitions, *arrays: np.ndarray) -> tuple[list[Any], list[Any]]:
    """Rows to learn from and rows to judge by, which are whole episodes: neighbours in time are alike.

    Of a single episode its end is held back.
    """
    episodes = np.unique(data.episode)
    held = np.isin(data.episode, episodes[held_back(key, len(episodes))[1]])
    if len(episodes) == 1:
        held = np.arange(len(data)) >= (1 - VALIDATION) * len(data)
    judged = np.flatnonzero(held)
    judged = judged[:: -(-len(judged) // MOST_JUDGED)]
    return [jnp.asarray(a[~held]) for a in arrays], [jnp.asarray(a[judged]) for a in arrays]
