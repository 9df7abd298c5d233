"""``fit``: any parameters, any residual."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from jeuler._core.arguments import says_what_to_write
from jeuler.fitting.engine import run
from jeuler.fitting.options import Options
from jeuler.fitting.problem import Problem
from jeuler.fitting.result import Fit

PyTree = Any


@says_what_to_write()
def fit(
    residual: Callable[..., PyTree],
    params: PyTree,
    *,
    data: PyTree = None,
    bounds: PyTree = None,
    positive: PyTree = False,
    sigma: PyTree = None,
    weights: PyTree = None,
    priors: dict[str, Any] | None = None,
    loss: str = "linear",
    loss_scale: float | None = None,
    starts: Any = None,
    scale: PyTree = None,
    optimizer: Any = None,
    minibatch: int | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    stages: Iterable[PyTree] = (),
    resume: Any = None,
    progress: bool | None = None,
) -> Fit:
    """Find the parameters that make a residual small.

        minimise  sum over k of rho(r_k(p) / sigma_k),   lower <= p <= upper,   rho(z) = z^2

    Levenberg-Marquardt steps, each parameter measured by its column of the Jacobian: the result does not depend on the
    units, nor on the size of the start. A trial point whose residual or Jacobian is not finite is stepped back from and
    counted. Under jit, vmap and grad the whole fit is part of the program: a thousand data sets are one ``jax.vmap``,
    and the derivative of the best parameters by the data is that of the optimum, by the implicit function theorem.

    Args:
      residual: ``residual(params)``, or with ``data`` ``residual(params, data)``: a pytree of floating arrays, model
        minus data in the unit of the data. The first axis of each array is taken as time.
      params: starting values, any pytree; its floating leaves are fitted, what is not a number (a network's activation
        function) stays as it is.
      data: any pytree of arrays; fits of one residual function with data of one shape share their compiled programs.
      bounds: a pair (lower, upper), each one value or a tree that params extends, or a dict ``{name: (lower, upper)}``
        of such pairs; None or inf leaves a side open. A start may be on a bound, and so may the result.
      positive: which parameters must not be negative: one bool, or a tree of bools that is a prefix of params.
      sigma: the known error of each residual, a number or a tree broadcast to its structure; the covariance is then
        not scaled by the residual. inf leaves a residual out.
      weights: relative weights instead, such as 1 / variance; the covariance is scaled by the residual.
      priors: ``{name: (mean, sigma)}``, what is known of parameters beforehand: each is one more row of the residual,
        (parameter - mean) / sigma. They need ``sigma`` of the data, and are part of the covariance.
      loss: "linear" for squares, or "soft_l1" or "huber", which bend for outliers.
      loss_scale: the size of a residual, over sigma if that is given, at which they bend; None takes 1.345 times sigma,
        or else 1.345 times what the median of the residuals says of it.
      starts: search from this many starts, those after the first drawn about it (positive parameters within a factor of
        ten, with a fixed seed), in one batched program; or from a tree of starts with a leading axis.
      scale: for ``optimizer``: what one unit of its steps is worth, one number or a tree that params extends.
      optimizer: None for Levenberg-Marquardt, or any optax optimiser, such as ``optax.adam(0.05)``.
      minibatch: for ``optimizer``: each of its steps looks at so many rows of the data, drawn anew in every pass over
        them: the first axis of all data, and of what the residual returns, counts samples, or windows of time that are
        run one by one. The history then has the loss over everything after each pass.
      max_iterations: the most iterations in each stage; with ``minibatch`` the most steps.
      tolerance: how near the minimum must be, in standard errors, by the linear model. For an optax optimiser the share
        by which the loss must decrease within 50 iterations.
      stages: weights of the residual (its structure; 0 leaves out) that are fitted one after the other before all of
        it is: a growing time horizon keeps an oscillation's fit out of wrong periods.
      resume: path of a file in which the search writes where it is, and from which it goes on if it is there. The file
        knows its fit by data, start, options, and by the code and the values of residual and optimizer: a fit of
        another residual or another learning rate is refused.
      progress: show a progress bar; None shows it on a terminal.
    Returns: `Fit`. After Ctrl-C the best so far.
    Raises: ValueError, if an argument does not fit the others, the residual is empty, or it is not finite at the start.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> t = jnp.linspace(0.0, 1.0, 20)
      >>> found = jeuler.fit(lambda p: p["a"] * jnp.exp(-p["k"] * t) - 3 * jnp.exp(-2 * t), {"a": 1.0, "k": 1.0})
      >>> round(float(found.params["a"]), 3), round(float(found.params["k"]), 3), found.converged
      (3.0, 2.0, True)

    Source: J. J. More, The Levenberg-Marquardt algorithm: implementation and theory, 1978; D. M. Bates, D. G. Watts,
      A relative offset orthogonality convergence criterion for nonlinear least squares, Technometrics 23, 1981.
    """
    options = Options(
        loss=loss,
        loss_scale=loss_scale,
        starts=starts,
        optimizer=optimizer,
        minibatch=minibatch,
        max_iterations=max_iterations,
        tolerance=tolerance,
        resume=resume,
        progress=progress,
    )
    problem = Problem.of(
        residual,
        params,
        data=data,
        bounds=bounds,
        positive=positive,
        sigma=sigma,
        weights=weights,
        stages=stages,
        priors=priors,
        loss=loss,
    )
    return run(problem, options, scale=scale).fit
