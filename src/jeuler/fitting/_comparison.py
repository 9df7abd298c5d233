"""``compare_fits``: which of two models a record speaks for, and how clearly."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jeuler._core import checks
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.fitting.beside import attached
from jeuler.fitting.density import Density
from jeuler.fitting.problem import series_of
from jeuler.fitting.result import DENSITY, Fit

VERDICTS = ((10.0, "very strongly"), (6.0, "strongly"), (2.0, "somewhat"))  # Kass and Raftery, 1995, sect. 3.2
SAME = 1e-9  # relative: data as two fits of one record see them


@result
class Comparison:
    """What `compare_fits` found.

    Attributes:
      better: "first", "second", or "neither" where the record does not tell them apart.
      difference: of the Bayesian information criteria, first minus second: above 0 the second is better, by odds of
        about exp(difference / 2); beyond 2, 6 and 10 somewhat, strongly and very strongly.
      residuals: root mean square of both residuals, each as it counts.
      unknowns: how many parameters each has.
      independent: how many independent values the record is worth, for residuals as correlated as those of the better.
      message: all of that in one sentence.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> one, two = (jeuler.fit(lambda p, k=k: p["a"] * jnp.arange(9.0) ** k - 3.0, {"a": 1.0}) for k in (0, 1))
      >>> jeuler.compare_fits(one, two).better
      'first'
    """

    _: dataclasses.KW_ONLY
    better: str
    difference: float
    residuals: tuple[float, float]
    unknowns: tuple[int, int]
    independent: float
    message: str


@says_what_to_write()
def compare_fits(first: Fit, second: Fit) -> Comparison:
    """Compare two models that were fitted to the same record, such as linear and quadratic drag.

        difference = BIC_1 - BIC_2,   BIC = (n - k_max) log(sum of squares) + k log(n)

    with k parameters, and where sigma was given BIC = sum of squares + k log(n). n counts independent values: residuals
    that are correlated in time, as those of a model that lacks something, say less than their number. So a long record
    with a pattern in both residuals does not make a small difference certain.

    Args:
      first, second: fits of the same data with the same weights and loss, each as `fit` or `fit_springs` gave it.
    Returns: `Comparison`, with a number and a verdict.
    Raises: ValueError, if they are not of the same data, weights and loss, or one was copied, traced or made by an
      optax optimiser.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> x = jnp.linspace(0.0, 1.0, 50)
      >>> data = 1 - x + 0.3 * x**2 + 0.01 * jnp.cos(97 * jnp.arange(50.0) ** 2)
      >>> line = jeuler.fit(lambda p: p["a"] + p["b"] * x - data, {"a": 0.0, "b": 0.0})
      >>> bent = jeuler.fit(lambda p: p["a"] + p["b"] * x + p["c"] * x**2 - data, {"a": 0.0, "b": 0.0, "c": 0.0})
      >>> found = jeuler.compare_fits(line, bent)
      >>> found.better, found.difference > 10
      ('second', True)

    Source: G. Schwarz, Estimating the dimension of a model, 1978; R. E. Kass, A. E. Raftery, Bayes factors, 1995; C. J.
      Geyer, Practical Markov chain Monte Carlo, 1992, sect. 3.3 (the sum of autocorrelations).
    """
    problems = [_density_of(name, fit) for name, fit in (("first", first), ("second", second))]
    _refuse_different(*problems)
    absolute = problems[0].problem.absolute
    totals, sizes = [], []
    for fit, density in zip((first, second), problems, strict=True):
        residual = _flat(fit.residual)
        totals.append(max(float(np.sum(residual**2)), 1e-300))
        sizes.append(density.problem.layout.size)
    count = int(np.sum(_data_weights(problems[0]) > 0))
    best = int(totals[1] < totals[0])
    independent = count / _correlation_time((first, second)[best], problems[best])
    freedom = max(independent - max(sizes), 0.0)  # a fit takes its unknowns' share out of the residual
    score = [t * independent / count if absolute else freedom * np.log(t / count) for t in totals]
    bic = [s + k * np.log(max(independent, 2.0)) for s, k in zip(score, sizes, strict=True)]
    difference = float(bic[0] - bic[1])
    clear = next((word for least, word in VERDICTS if abs(difference) > least), None)
    better = "neither" if clear is None else "second" if difference > 0 else "first"
    rms = tuple(float(np.sqrt(t / count)) for t in totals)
    worth = f"{independent:.0f} independent values of {count}"
    verdict = (
        f"the record does not tell the two models apart (difference {difference:.2g}, {worth})"
        if clear is None
        else f"the record speaks {clear} for the {better} model (difference {abs(difference):.3g}, {worth})"
    )
    message = f"{verdict}; residuals {rms[0]:.3g} and {rms[1]:.3g}, {sizes[0]} and {sizes[1]} parameters"
    if not (first.converged and second.converged):
        message += "; not both fits have converged, so neither the number nor the verdict is to be trusted"
    return Comparison(
        better=better,
        difference=difference,
        residuals=(rms[0], rms[1]),
        unknowns=(sizes[0], sizes[1]),
        independent=float(independent),
        message=message,
    )


def _density_of(name: str, fit: Any) -> Density:
    checks.kind(name, fit, Fit)
    density: Density | None = attached(fit, DENSITY)
    if density is None:
        raise ValueError(
            f"{name} must be a fit as `fit` or `fit_springs` gave it by Levenberg-Marquardt, of at most 500 unknowns; "
            f"a copy, and what comes out of jit or vmap, does not do; fit again"
        )
    return density


def _refuse_different(first: Density, second: Density) -> None:
    """Both must be fits of the same values, each with the same weight."""
    a, b = (_data_weights(density) for density in (first, second))
    alike = a.shape == b.shape and np.allclose(a, b, rtol=SAME, atol=0)
    if not alike or first.problem.absolute != second.problem.absolute:
        raise ValueError("first and second must be fits of the same data with the same weights, got different ones")
    if first.loss != second.loss:
        raise ValueError(f"first and second must have one loss, got {first.loss!r} and {second.loss!r}")
    seen, again = _targets(first), _targets(second)
    if seen is not None and again is not None and not np.allclose(seen, again, rtol=SAME, atol=0):
        raise ValueError("first and second must be fits of the same data, got different measured values")


def _targets(density: Density) -> np.ndarray | None:
    """The measured values, where the data are of the form of the residual or of a recording; None of others."""
    data, priors = density.problem.data, density.problem.residual.priors
    shapes = [shape for shape in density.problem.form.shapes if shape is not None]
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(data)]
    if [leaf.shape for leaf in leaves] == (shapes if priors is None else shapes[:-1]):
        return np.concatenate([leaf.ravel() for leaf in leaves])
    groups = data if isinstance(data, (list, tuple)) else [data]
    if not all(isinstance(each, dict) and "targets" in each for each in groups):
        return None
    return np.concatenate([np.ravel(np.asarray(each["targets"], float)) for each in groups])


def _data_weights(density: Density) -> np.ndarray:
    """The weights of the data, without those of priors."""
    weights, priors = np.asarray(density.problem.weights, float), density.problem.residual.priors
    return weights if priors is None else weights[: len(weights) - len(priors.places)]


def _flat(residual: Any) -> np.ndarray:
    leaves = jax.tree.leaves(residual)
    return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in leaves])


def _correlation_time(fit: Fit, density: Density) -> float:
    """1 + 2 sum of the autocorrelations of a residual, until neighbouring pairs of them no longer add up above 0."""
    kept, flat = _data_weights(density) > 0, _flat(fit.residual)
    products = np.zeros(0)
    first = 0
    for times, channels in series_of(density.problem.form):
        size = times * channels
        if first + size > len(flat):  # the rows of priors
            break
        part = np.where(kept[first : first + size], flat[first : first + size], 0).reshape(times, channels)
        lags = np.fft.irfft(np.abs(np.fft.rfft(part, 2 * times, axis=0)) ** 2, axis=0)[:times].sum(axis=1)
        longer, shorter = (lags, products) if len(lags) > len(products) else (products, lags)
        products = longer + np.pad(shorter, (0, len(longer) - len(shorter)))
        first += size
    if len(products) < 4 or products[0] <= 0:
        return 1.0
    rho = products / products[0]
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = int(np.argmax(pairs <= 0)) if (pairs <= 0).any() else len(pairs)
    return float(max(2 * pairs[:stop].sum() - 1, 1.0))
