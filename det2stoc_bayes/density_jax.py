"""A density as a jax function: callbacks into the C engine, or forward mode through MJX."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from det2stoc_bayes.density import Density
from det2stoc_bayes.likelihood import residuals
from det2stoc_bayes.robust_starts import left_over
from det2stoc_bayes.vector_density import AnyDensity

Terms = Callable[[Array], Array]  # z (size) -> log likelihood by recording (recordings)


@runtime_checkable
class HasGradient(Protocol):
    """Values and gradients for a batch."""

    def terms_and_grad(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points recordings"], Float[np.ndarray, "points size"]]:
        """log likelihood by recording, gradient of their sum."""
        ...


class Remembered:
    """Each point is simulated once: chains that wait for others, and the draws afterwards, cost nothing."""

    def __init__(self, source: HasGradient, density: AnyDensity):
        self._source, self._density = source, density
        self._seen: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def terms_and_grad(
        self, z: Float[np.ndarray, "points size"]
    ) -> tuple[Float[np.ndarray, "points recordings"], Float[np.ndarray, "points size"]]:
        """As the source's."""
        found = self._look_up(z, self._source.terms_and_grad)
        return np.stack([t for t, _ in found]), np.stack([g for _, g in found])

    def values(self, z: Float[np.ndarray, "points size"]) -> Float[np.ndarray, "points recordings"]:
        """log likelihood by recording; what was not seen is computed without gradients."""
        nothing = np.full(self._density.size, np.nan)
        found = self._look_up(z, lambda new: (self._density.log_likelihood_by_recording(new), [nothing] * len(new)))
        return np.stack([t for t, _ in found])

    def _look_up(self, z: np.ndarray, evaluate: Callable) -> list[tuple[np.ndarray, np.ndarray]]:
        z = np.ascontiguousarray(z, dtype=float)
        keys = [row.tobytes() for row in z]
        new = {key: i for i, key in enumerate(keys) if key not in self._seen}
        if new:
            self._seen.update(zip(new, zip(*evaluate(z[list(new.values())]), strict=True), strict=True))
        return [self._seen[key] for key in keys]


def jax_terms(density: AnyDensity, source: HasGradient | None = None) -> Terms:
    """log likelihood by recording of one z, for jax.

    Reverse mode returns the gradient of the sum: differentiate only functions of that sum.
    """
    jax.config.update("jax_enable_x64", True)
    if isinstance(density, Density) and density.problem.engine == "mjx":
        return _mjx_terms(density)
    return _callback_terms(source or density, len(density.problem.recordings))


def _callback_terms(source: HasGradient, num_recordings: int) -> Terms:
    def simulate(z):
        z = np.asarray(z)
        terms, gradients = source.terms_and_grad(z.reshape(-1, z.shape[-1]))
        return terms.reshape(*z.shape[:-1], num_recordings), gradients.reshape(z.shape)

    def forward(z):
        shapes = jax.ShapeDtypeStruct((num_recordings,), z.dtype), jax.ShapeDtypeStruct(z.shape, z.dtype)
        return jax.pure_callback(simulate, shapes, z, vmap_method="broadcast_all")

    terms = jax.custom_vjp(lambda z: forward(z)[0])
    terms.defvjp(forward, _backward)
    return terms


def _backward(gradient, cotangent):
    # The terms' cotangents are equal, since only their sum is differentiated.
    return (cotangent[0] * gradient,)


def _mjx_terms(density: Density) -> Terms:
    plain = mjx_terms(density)
    terms = jax.custom_vjp(plain)

    def forward(z):
        value, tangents = _value_and_jacobian(plain, z)
        return value, tangents.sum(0)

    terms.defvjp(forward, _backward)
    return terms


def _value_and_jacobian(function: Callable, z: Array) -> tuple[Array, Array]:
    def push(tangent):
        return jax.jvp(function, (z,), (tangent,))

    return jax.vmap(push, out_axes=(None, -1))(jnp.eye(z.shape[0], dtype=z.dtype))


def mjx_terms(density: Density) -> Terms:
    """log likelihood by recording in pure jax, for forward mode alone."""
    problem, latent = density.problem, density.latent
    engine: Any = problem.simulator.engine
    predict = engine.predict_fn(problem, density.start)
    observed, weight = jnp.asarray(problem.segments.values), jnp.asarray(problem.weight)
    rows, count = jnp.asarray(problem.segments.recording), len(problem.segments.recordings)
    normalizer, offset = jnp.asarray(density.normalizer), jnp.asarray(density.offset)[..., None]

    def left(error):
        if problem.measurement.degrees_of_freedom is None:
            return latent.project(latent.stack_whitened(error[..., None], offset, jnp), jnp)[..., 0]
        about = density.offset, density.sensitivity, latent.prior_sd, problem.measurement
        return left_over(error[..., None], *about, jnp)[..., 0]

    def terms(z):
        r = residuals(predict(z), observed, problem.quaternions, jnp)
        projected = left(r * weight)
        value = normalizer - 0.5 * density.temper * (projected**2).sum(1)
        value = jnp.where(jnp.isfinite(value), value, -jnp.inf)
        return jax.ops.segment_sum(value, rows, num_segments=count)

    return terms


def batched_value_and_grad(density: Density) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """log likelihood and gradient of several z by forward mode through MJX."""
    jax.config.update("jax_enable_x64", True)
    plain = mjx_terms(density)
    many = jax.jit(jax.vmap(lambda z: _value_and_jacobian(lambda a: plain(a).sum(), z)))

    def evaluate(z):
        value, gradient = many(jnp.asarray(z))
        count(density, len(z))
        return np.asarray(value), np.asarray(gradient)

    return evaluate


def count(density: Density, points: int) -> None:
    """Book gradients that jax took without the engine's knowing."""
    counter = density.problem.simulator.counter
    counter.gradients += points
    counter.simulations += points * density.problem.segments.count


def jax_log_prior(z: Array) -> Array:
    """log N(z; 0, I)."""
    return -0.5 * (z @ z + z.shape[0] * jnp.log(2 * jnp.pi))


def numpyro_model(density: Density, terms: Terms | None = None) -> Callable[[], None]:
    """`z`, every unknown by name, and the likelihood as a factor."""
    import numpyro
    import numpyro.distributions as dist

    terms = jax_terms(density) if terms is None else terms

    def model() -> None:
        z: Any = numpyro.sample("z", dist.Normal(0.0, 1.0).expand([density.size]).to_event(1))
        for name, value in density.problem.constrained(z, jnp).items():
            numpyro.deterministic(name, value)
        numpyro.factor("log_likelihood", terms(z).sum())

    return model
