"""The two descents behind ``fit``: Levenberg-Marquardt, and any optax optimiser. Both keep the best point seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# a Jacobian larger than this is not formed: fits with more unknowns go through optax.lbfgs
JACOBIAN_BYTES = 2**30
JACOBIAN_COLUMNS_AT_ONCE = 16


@dataclasses.dataclass
class Progress:
    """What a fit has seen so far."""

    bar: Any
    best: Any
    best_loss: float
    history: list[float] = dataclasses.field(default_factory=list)
    nonfinite: int = 0

    def see(self, z: Any, loss: float) -> None:
        """One iteration's end: its point and its loss over all the data."""
        self.history.append(loss if np.isfinite(loss) else np.inf)
        self.offer(z, loss)
        self.bar.update()
        self.bar.set_postfix_str(f"loss {loss:.4g}, best {self.best_loss:.4g}", refresh=False)

    def offer(self, z: Any, loss: float) -> None:
        if np.isfinite(loss) and not loss >= self.best_loss:
            self.best, self.best_loss = z, loss


class LeastSquares:
    """A residual vector r(z), compiled once: its weighted mean square, gradient and Jacobian.

    loss(z) = sum_k w_k r_k(z)^2 / count,   w_k = 1 for what counts, 0 for what does not count yet
    """

    evaluate: Callable[..., Any]
    value_and_grad: Callable[..., Any]
    objective: Callable[..., Any]
    linearise: Callable[..., Any]

    def __init__(self, residual: Callable[[Array], Array], size: int) -> None:
        self.size = size
        self.evaluate = jax.jit(lambda z, w: self._losses(residual(z), w))
        self.value_and_grad = jax.jit(jax.value_and_grad(lambda z, w: self._losses(residual(z), w), has_aux=True))
        self.objective = lambda z, w: self._losses(residual(z), w)[0]

        def linearise(z: Array, w: Array) -> tuple[Array, Array, Array, Array]:
            def column(direction):
                return jax.jvp(residual, (z,), (direction,))

            directions = jnp.eye(len(z), dtype=z.dtype)
            values, columns = jax.lax.map(column, directions, batch_size=JACOBIAN_COLUMNS_AT_ONCE)
            r, jacobian = values[0], columns.T
            return r, jacobian, *self._normal_equations(r, jacobian, w)

        self.linearise = jax.jit(linearise)  # r, J, J^T J and J^T r of what counts

    def _losses(self, r: Array, w: Array) -> tuple[Array, Array]:
        """The mean square of what counts now, and of everything."""
        r = r / jnp.asarray(self.size, r.dtype) ** 0.5
        counted = jnp.sum(jnp.where(w > 0, r, 0) ** 2)
        return counted / jnp.maximum(jnp.mean(w), 1 / self.size), jnp.sum(r**2)

    def _normal_equations(self, r: Array, jacobian: Array, w: Array) -> tuple[Array, Array]:
        """J^T J and J^T r of the weighted loss."""
        used = (w > 0)[:, None]
        jacobian, r = jnp.where(used, jacobian, 0), jnp.where(w > 0, r, 0)
        count = jnp.maximum(jnp.sum(w), 1)
        return jacobian.T @ jacobian / count, jacobian.T @ r / count


def levenberg_marquardt(
    problem: LeastSquares,
    z: Any,
    weight: Array,
    progress: Progress,
    *,
    max_iterations: int,
    tolerance: float,
    longest_step: float = 1.0,
) -> tuple[Any, bool]:
    """Descend by damped Gauss-Newton steps (J^T J + damping I) s = -J^T r, the damping ruled by the gain ratio.

    The damping is one number for all unknowns, in the units of `Unknowns`: what the data do not determine stays at
    its start. No step is longer than ``longest_step`` in any unknown, a factor e for a logarithm.

    Returns the last accepted point, and whether it converged: the relative decrease fell below the tolerance.
    Source: K. Madsen, H. B. Nielsen, O. Tingleff, Methods for Non-Linear Least Squares Problems, 2004, sect. 3.2.
    """
    z = np.asarray(z)
    loss, total = (float(x) for x in problem.evaluate(z, weight))
    progress.offer(z, total)
    if not np.isfinite(loss):
        progress.nonfinite += 1
        return z, False
    matrix, gradient = _normal_equations(problem, z, weight)
    damping = 1e-3 * float(np.max(np.diag(matrix)))
    growth = 2.0
    for _ in range(max_iterations):
        if not (np.isfinite(matrix).all() and np.isfinite(gradient).all()):
            progress.nonfinite += 1
            return z, False
        if loss == 0.0 or not np.any(gradient):
            return z, True
        step = _damped_step(matrix, gradient, damping)
        length = float(np.max(np.abs(step)))
        if length > longest_step:
            step = step * (longest_step / length)
        trial = (z + step).astype(z.dtype)
        predicted = -float(step @ (2 * gradient + matrix @ step))
        trial_loss, trial_total = (float(x) for x in problem.evaluate(trial, weight))
        progress.nonfinite += not np.isfinite(trial_loss)
        if trial_loss < loss:
            gain = (loss - trial_loss) / max(predicted, 1e-300)
            damping, growth = damping * max(1 / 5, 1 - (2 * gain - 1) ** 3), 2.0
            converged = loss - trial_loss <= tolerance * loss and gain > 0.25
            z, loss = trial, trial_loss
            progress.see(z, trial_total)
            if converged:
                return z, True
            matrix, gradient = _normal_equations(problem, z, weight)
        else:
            damping, growth = damping * growth, growth * 2
            if predicted <= tolerance * loss or length <= 4 * float(np.finfo(z.dtype).eps):
                return z, True
    return z, False


def _normal_equations(problem: LeastSquares, z: np.ndarray, weight: Array) -> tuple[np.ndarray, np.ndarray]:
    """J^T J and J^T r in float64."""
    _, _, matrix, gradient = problem.linearise(z, weight)
    return np.asarray(matrix, float), np.asarray(gradient, float)


def _damped_step(matrix: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    """The solution of (J^T J + damping I) s = -J^T r, by the eigenvectors of the symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    values = np.maximum(values, 0) + max(damping, 1e-15 * values[-1])
    return -vectors @ ((vectors.T @ gradient) / values)


def descend(
    optimizer: Any,
    problem: LeastSquares,
    z: Any,
    weight: Array,
    progress: Progress,
    *,
    max_iterations: int,
    tolerance: float,
    patience: int = 50,
) -> tuple[Any, bool]:
    """Descend by an optax optimiser. A step into non-finite values goes back to the best point and halves what follows.

    Returns the last finite point, and whether it converged: no relative decrease above the tolerance in ``patience``
    iterations.
    """
    import optax

    optimizer = optax.with_extra_args_support(optimizer)

    @jax.jit
    def propose(z, state, value, grad, weight, damping):
        updates, state = optimizer.update(
            grad, state, z, value=value, grad=grad, value_fn=lambda z: problem.objective(z, weight)
        )
        return optax.apply_updates(z, jax.tree.map(lambda u: damping * u, updates)), state

    state, damping = optimizer.init(z), 1.0
    best, best_loss, since_best = z, np.inf, 0
    for _ in range(max_iterations):
        (loss, total), gradient = problem.value_and_grad(z, weight)
        if not (np.isfinite(loss) and np.isfinite(gradient).all()):
            progress.nonfinite += 1
            if not np.isfinite(best_loss):
                return z, False
            z, state, damping = best, optimizer.init(best), damping / 2
            continue
        progress.see(z, float(total))
        since_best = 0 if loss < (1 - tolerance) * best_loss else since_best + 1
        if loss < best_loss:
            best, best_loss = z, float(loss)
        if loss == 0.0 or since_best >= patience:
            return best, True
        z, state = propose(z, state, loss, gradient, weight, damping)
    progress.offer(z, float(problem.evaluate(z, weight)[1]))
    return best, False
