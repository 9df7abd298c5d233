"""What a fit found, and how it is put into words."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array

from jeuler._core.component import result
from jeuler.fitting._tables import fit_table, fit_text
from jeuler.fitting.beside import attached
from jeuler.fitting.errors import error_of
from jeuler.fitting.profiles import AGAIN, Profile

PyTree = Any
DENSITY = "log-density"  # under this name a `Density` is kept beside a result


@result
class Fit:
    """What a fit found.

    Attributes:
      params: the best parameters seen, of the structure of the start.
      loss: the mean square of the residual there, each as it counts: over sigma, times the root of its weight.
      history: the loss after each iteration, over all the data, (iteration,).
      stderr: standard error of each parameter, of the structure of params, for noise that is correlated as the
        residual is; inf where the data do not determine it. None for more than 3,000 unknowns, or where the Jacobian
        would not fit in half a gigabyte: `standard_error` gives those that you ask for.
      stderr_white: the same for independent noise: the smaller of the two on most recordings.
      covariance: of the parameters in the order of ``jax.flatten_util.ravel_pytree(params)``, (n, n), or None; within
        what the data determine, so that the error of a ratio or a sum is right even where its parts have none.
      residual: at the best parameters, weighted, of the structure that the residual function returns.
      converged: whether the minimum is nearer than ``tolerance`` standard errors, or than rounding.
      message: what happened, in one sentence.
      undetermined: names of the parameters that the data do not determine.
      blind: the combinations of them that do not change the residual, in words.
      at_bound: names of the parameters that ended on a bound.
      explained: share of the variance of the data that the fit explains, 1 at best; None where these are not known:
        `fit` sees them where data have the shapes of the residual, which is the model minus them.
      noise_ratio: residual over the noise of the data (from sigma, or seen in the data); None where it is not known.
      autocorrelation: of the residual from one sample to the next; near 0 where the model leaves nothing behind.
      nonfinite: how many trial points gave a value or gradient that was not finite and were stepped back from.
      starts: with several starts the parameters and the loss where each ended, ``{"params": ..., "loss": (start,)}``.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> x = jnp.linspace(0.0, 1.0, 11)
      >>> found = jeuler.fit(lambda p: p["slope"] * x - 3 * x, {"slope": 1.0, "unused": 5.0})
      >>> {name: round(float(value), 3) for name, value in found.params.items()}
      {'slope': 3.0, 'unused': 5.0}
      >>> found.converged, found.undetermined, float(found.stderr["unused"])
      (True, ('unused',), inf)
    """

    params: PyTree
    loss: Any
    history: Any
    stderr: PyTree
    covariance: Any
    converged: Any
    message: str
    undetermined: tuple[str, ...]
    nonfinite: Any
    stderr_white: PyTree = None
    residual: PyTree = None
    blind: tuple[str, ...] = ()
    at_bound: tuple[str, ...] = ()
    explained: Any = None
    noise_ratio: Any = None
    autocorrelation: Any = None
    starts: Any = None

    _repr_html_ = fit_table
    __repr__ = fit_text

    def profile(self, name: str, *, level: float = 0.95) -> Profile:
        """The profile-likelihood interval of one parameter: how far it can go when all others follow.

        (loss(p_k) - loss) / variance = z^2,   z = 1.96 for 95 %, times how much correlated residuals widen errors

        Args:
          name: of the parameter: "k", or "ks[3]" for one number of an array.
          level: probability of the interval.
        Returns: `Profile`, with ``.lower`` and ``.upper``; infinite, or the bound, where nothing stops it. Its
          ``.converged`` says whether each end was found.
        Raises: ValueError, if there is no such parameter, or the fit was copied, traced, interrupted or made by an
          optax optimiser.
        Example:
          >>> import jax.numpy as jnp, jeuler
          >>> x = jnp.linspace(0.0, 1.0, 11)
          >>> found = jeuler.fit(lambda p: p["a"] * x - 3 * x - 0.1 * jnp.sin(40 * x), {"a": 1.0})
          >>> interval = found.profile("a")
          >>> bool(interval.lower < found.params["a"] < interval.upper)
          True
        """
        from scipy.stats import norm

        if not 0 < level < 1:
            raise ValueError(f"level must lie between 0 and 1, got {level!r}")
        again = attached(self, AGAIN)
        if again is None:
            raise ValueError(
                "a profile needs the fit as `fit` or `fit_springs` gave it by Levenberg-Marquardt, uninterrupted; a "
                "copy, and what comes out of jit or vmap, has none; fit again"
            )
        return again.profile(name, float(norm.ppf((1 + level) / 2)))

    def log_density(self, params: PyTree) -> Array:
        """The logarithm of the density of parameters given the data and priors, up to a constant: for samplers.

            log p = -1/2 sum over k of rho(r_k(p) / sigma_k) + constant,   -inf outside the bounds

        It is made of JAX's operations, to be traced, differentiated and batched. Where no sigma was given, that of the
        residual of the best fit is taken. Noise counts as independent: for residuals that are correlated the density
        is too narrow, as `stderr_white` is against `stderr`.

        Args:
          params: of the structure of ``.params``.
        Returns: a number, ().
        Raises: ValueError, if params have another structure, or the fit was copied, traced, or made by an optax
          optimiser or for more than 500 unknowns.
        Example:
          >>> import jax, jax.numpy as jnp, jeuler
          >>> x = jnp.linspace(0.0, 1.0, 11)
          >>> found = jeuler.fit(lambda p: p["slope"] * x - 3 * x, {"slope": 1.0}, sigma=0.1)
          >>> density = found.log_density
          >>> round(float(density({"slope": 3.1}) - density({"slope": 3.0})), 3)  # -1/2 sum of x^2
          -1.925
        """
        density = attached(self, DENSITY)
        if density is None:
            raise ValueError(
                "log_density needs the fit as `fit` or `fit_springs` gave it by Levenberg-Marquardt, of at most 500 "
                "unknowns; a copy, and what comes out of jit or vmap, has none; fit again"
            )
        return density(params)

    def standard_error(self, of: str | Callable[[PyTree], Any]) -> float:
        """The standard error of one number: of a parameter, or of what is computed from several.

            sqrt(c^T C c),   c = d of / d params,   C the covariance

        Where a fit has so many unknowns that it has no covariance, one linear problem with the Jacobian is solved for
        it, by conjugate gradients; of the errors for correlated and for white noise it is then the larger.

        Args:
          of: the name of a parameter, "k" or "ks[3]", or a function of the params, differentiable, such as
            ``lambda p: p["ks"][0] / p["mass"]``.
        Returns: the error; inf where the data do not determine it.
        Raises: ValueError, if there is no such parameter, the function does not give one number, or the fit was
          copied or traced.
        Example:
          >>> import jax.numpy as jnp, jeuler
          >>> x = jnp.linspace(0.0, 1.0, 11)
          >>> line = lambda p: p["a"] + p["b"] * x - 3 * x - 0.1 * jnp.sin(40 * x)
          >>> found = jeuler.fit(line, {"a": 1.0, "b": 1.0})
          >>> middle = found.standard_error(lambda p: p["a"] + p["b"] / 2)
          >>> middle < found.standard_error("a") and found.standard_error("a") == float(found.stderr["a"])
          True
        """
        return error_of(self, of)

    @property
    def correlation(self) -> Any:
        """Correlation of the parameters' errors, (n, n), in the order of ``covariance``; NaN where one has no error."""
        if self.covariance is None:
            return None
        with np.errstate(all="ignore"):
            error = np.sqrt(np.diag(self.covariance))
            return np.asarray(self.covariance) / np.outer(error, error)


_STATIC = ("message", "undetermined", "blind", "at_bound")


def as_pytree(cls: type, static: tuple[str, ...] = _STATIC) -> None:
    """Let a class of results come out of jit and vmap: arrays are its children, words are part of its structure."""
    names = [field.name for field in dataclasses.fields(cls)]
    jax.tree_util.register_dataclass(
        cls, data_fields=[name for name in names if name not in static], meta_fields=list(static)
    )


as_pytree(Fit)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What is known about a fit before it is put into words."""

    ending: str
    nonfinite: int
    blind: tuple[str, ...]
    at_bound: tuple[str, ...]
    unresolved: tuple[str, ...]
    explained: float | None
    noise_ratio: float | None
    autocorrelation: float | None
    correlated: bool
    sigma_given: bool
    more: tuple[str, ...] = ()

    def message(self) -> str:
        """One sentence: how it ended, and what must be known before the fit is used."""
        parts = [self.ending]
        if self.nonfinite:
            parts.append(f"stepped back from {self.nonfinite} points that were not finite")
        if self.blind:
            parts.append(f"the data do not determine {_some(self.blind, 6)}; hold some of it, or record what shows it")
        if self.at_bound:
            parts.append(f"{_some(self.at_bound, 4)} ended on a bound")
        if self.unresolved:
            parts.append(f"not told apart from 0: {_some(self.unresolved, 4)}")
        return "; ".join([*parts, *self._quality(), *self.more])

    def _quality(self) -> list[str]:
        parts = []
        ratio, explained, rho = self.noise_ratio, self.explained, self.autocorrelation
        poor = self.correlated and rho is not None and rho > 0.3
        if explained is not None and explained < 0.9 and (poor or (ratio is not None and ratio > 1.5)):
            parts.append(
                f"it explains only {max(explained, 0):.0%} of the variance of the data: a wrong minimum or a wrong "
                f"model; start elsewhere, fit the first part of the time first, try starts=64, or change the model"
            )
        elif ratio is not None and ratio > 1.5:
            noise = "sigma" if self.sigma_given else "the noise in the data"
            parts.append(
                f"the residual is {ratio:.2g} times {noise}: a wrong minimum, or the model lacks something; "
                f"the errors do not cover that"
            )
        if ratio is not None and self.sigma_given and ratio < 0.5:
            parts.append(f"the residual is only {ratio:.2g} times sigma: sigma is too large, or there are too few data")
        if poor:
            parts.append(
                f"the residual is correlated, {rho:.2f} from one sample to the next: the errors are widened for it"
            )
        return parts


def _some(names: tuple[str, ...], most: int) -> str:
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
