"""``fit``: any parameters, any residual."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from jeuler._core import checks
from jeuler._core.component import result
from jeuler.fitting._tables import fit_table
from jeuler.fitting.minimise import JACOBIAN_BYTES, LeastSquares, Progress, descend, levenberg_marquardt
from jeuler.fitting.uncertainty import covariance
from jeuler.fitting.unknowns import Unknowns

PyTree = Any


@result
class Fit:
    """What a fit found.

    Attributes:
      params: the best parameters seen, of the structure of the start.
      loss: the mean square of the residual there.
      history: the loss after each iteration, over all the data, (iteration,).
      stderr: standard error of each parameter, of the structure of params; inf where the data do not determine it.
        None where the Jacobian would not fit in a gigabyte.
      covariance: of the parameters in the order of ``jax.flatten_util.ravel_pytree(params)``, (n, n), or None.
      converged: whether the last iterations changed the loss by less than the tolerance.
      message: what happened, in one sentence.
      undetermined: names of the parameters that the data say nothing about; they stayed at their start.
      nonfinite: how many trial points gave a value or gradient that was not finite and were stepped back from.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> x = jnp.linspace(0.0, 1.0, 11)
      >>> found = jeuler.fit(lambda p: p["slope"] * x - 3 * x, {"slope": 1.0, "unused": 5.0})
      >>> {name: round(float(value), 3) for name, value in found.params.items()}
      {'slope': 3.0, 'unused': 5.0}
      >>> found.converged, found.undetermined, float(found.stderr["unused"])
      (True, ("['unused']",), inf)
    """

    params: PyTree
    loss: float
    history: np.ndarray
    stderr: PyTree
    covariance: np.ndarray | None
    converged: bool
    message: str
    undetermined: tuple[str, ...]
    nonfinite: int

    _repr_html_ = fit_table


def fit(
    residual: Callable[[PyTree], PyTree],
    params: PyTree,
    *,
    positive: PyTree = False,
    scale: PyTree = None,
    optimizer: Any = None,
    max_iterations: int = 200,
    tolerance: float = 1e-6,
    stages: Iterable[PyTree] = (),
    progress: bool | None = None,
) -> Fit:
    """Find the parameters that make a residual small, by gradient.

        minimise  loss(p) = mean over k of r_k(p)^2

    Positive parameters are fitted as logarithms, so no step can make them negative. The best parameters seen are
    returned, not the last. A trial point whose residual or gradient is not finite is stepped back from and counted.

    Args:
      residual: ``residual(params)``, a pytree of floating arrays, model minus data in the unit of the data.
      params: starting values, any pytree. Its floating arrays are fitted; functions, strings and integers in it, as
        in a neural network, stay.
      positive: which parameters must stay positive: one bool, or a tree of bools that is a prefix of params.
      scale: a sensible step of each parameter that is not positive, one number or a prefix tree; None takes its size.
      optimizer: None for Levenberg-Marquardt (``optax.lbfgs()`` where its Jacobian would not fit in a gigabyte), or
        any optax optimiser, such as ``optax.adam(0.05)``.
      max_iterations: the most iterations in each stage.
      tolerance: stop when the loss decreases by less than this share.
      stages: weights of the residual (its structure; 1 counts, 0 does not) that are fitted one after the other before
        all of it is: a growing time horizon keeps an oscillation's fit out of wrong periods.
      progress: show a progress bar; None shows it on a terminal.
    Returns: `Fit`.
    Raises: ValueError, if params are not floating, a positive one does not start above 0, the residual is empty, or
      it is not finite at the start.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> t = jnp.linspace(0.0, 1.0, 20)
      >>> found = jeuler.fit(lambda p: p["a"] * jnp.exp(-p["k"] * t) - 3 * jnp.exp(-2 * t), {"a": 1.0, "k": 1.0})
      >>> round(float(found.params["a"]), 3), round(float(found.params["k"]), 3), found.converged
      (3.0, 2.0, True)

    Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems, 2004.
    """
    max_iterations = checks.count("max_iterations", max_iterations, least=1)
    checks.positive("tolerance", tolerance)
    unknowns = Unknowns.of(params, positive, scale)

    def flat_residual(z: Array) -> Array:
        return ravel_pytree(residual(unknowns.params(z)))[0].astype(z.dtype)

    form = jax.eval_shape(flat_residual, unknowns.start)
    m, n = form.size, len(unknowns.start)
    if not m or not n:
        raise ValueError(f"residual and params must not be empty, got {m} residuals and {n} parameters")
    problem = LeastSquares(flat_residual, m)
    fits_in_memory = m * n * form.dtype.itemsize <= JACOBIAN_BYTES
    if optimizer is None and not fits_in_memory:
        import optax

        optimizer = optax.lbfgs()

    everything = jnp.ones(m, form.dtype)
    weights = [jnp.asarray(ravel_pytree(w)[0], form.dtype) for w in stages]
    for weight in weights:
        if weight.shape != (m,):
            raise ValueError(f"each of stages must have one weight a residual, {m}, got {weight.size}")
    z, converged = unknowns.start, False
    with _bar(progress, max_iterations * (len(weights) + 1)) as bar:
        seen = Progress(bar, z, np.inf)
        for stage, weight in enumerate([*weights, everything]):
            last = stage == len(weights)
            if last and not np.isfinite(problem.evaluate(z, weight)[0]) and np.isfinite(seen.best_loss):
                z = seen.best
            descent = levenberg_marquardt if optimizer is None else functools.partial(descend, optimizer)
            z, converged = descent(
                problem,
                z,
                weight,
                seen,
                max_iterations=max_iterations if last or optimizer is not None else min(max_iterations, 10),
                tolerance=tolerance if last else 1e-3,
            )
    if not np.isfinite(seen.best_loss):
        raise ValueError(
            "the residual is not finite at the start of the fit, nor at any point that was tried; "
            "start closer, or use a smaller dt or a stabler step"
        )
    return _report(unknowns, problem, everything, seen, converged, fits_in_memory)


@contextlib.contextmanager
def _bar(progress: bool | None, total: int):
    from tqdm import tqdm

    with tqdm(total=total, desc="fit", disable=None if progress is None else not progress, leave=False) as bar:
        yield bar


def _report(
    unknowns: Unknowns,
    problem: LeastSquares,
    everything: Array,
    seen: Progress,
    converged: bool,
    fits_in_memory: bool,
) -> Fit:
    z = seen.best
    stderr = matrix = None
    undetermined: tuple[str, ...] = ()
    if fits_in_memory:
        r, jacobian = (np.asarray(x) for x in problem.linearise(z, everything)[:2])
        if np.isfinite(jacobian).all():
            variances, silent = covariance(jacobian, r)
            slope = unknowns.slope(z)
            with np.errstate(invalid="ignore"):
                matrix = np.where(variances == 0, 0, variances * np.outer(slope, slope))
            stderr = unknowns.unravel(jnp.asarray(np.sqrt(np.diag(matrix)), z.dtype))
            undetermined = tuple(name for name, out in zip(unknowns.names, silent, strict=True) if out)
    parts = ["converged" if converged else "stopped before it converged: allow more iterations or start closer"]
    if seen.nonfinite:
        parts.append(f"stepped back from {seen.nonfinite} points that were not finite")
    if unknowns.kept:
        parts.append(f"{', '.join(unknowns.kept)} kept as given, an integer; write a float to fit it")
    if undetermined:
        shown = ", ".join(undetermined[:6]) + (", ..." if len(undetermined) > 6 else "")
        parts.append(f"the data do not determine {shown}")
    return Fit(
        params=unknowns.params(z),
        loss=seen.best_loss,
        history=np.asarray(seen.history),
        stderr=stderr,
        covariance=matrix,
        converged=converged,
        message="; ".join(parts),
        undetermined=undetermined,
        nonfinite=seen.nonfinite,
    )
