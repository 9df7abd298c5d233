"""The largest stable step size: the spectrum of the vector field, and what the step makes of it."""

from __future__ import annotations

import functools
import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jeuler._core import checks, trees
from jeuler._core.partition import arrays_only
from jeuler._core.precision import cast, double_precision
from jeuler.steps.amplification import pair_limits, scalar_limits, treats_all_alike
from jeuler.steps.explicit import Step, VectorField, euler_step

PyTree = Any

DENSE = 512  # numbers in the state up to which all eigenvalues are computed
NEUTRAL = 4.0  # |eigenvalue| below this times sqrt(eps) of the largest is a zero mode: so far a double zero splits
UNDAMPED = 1e-10  # |real part| below this part of the largest eigenvalue is zero up to roundoff
EXTREMES = 8  # eigenvalues asked for at each end of a large spectrum


def stability_limit(
    f: VectorField,
    t: Any,
    y: PyTree,
    args: Any = None,
    *,
    step: Step = euler_step,
    growing: Literal["unstable", "skip"] = "unstable",
) -> float:
    """The largest stable dt of a step at one state: what is perturbed there does not grow.

        |R(dt lambda)| <= 1 for every eigenvalue lambda of df/dy (t, y)

    R, the amplification of the step on y' = lambda y, is found by applying the step itself to that problem, so any step
    has a limit: explicit, implicit, or one of your own. A step on pairs (position, velocity) that treats the two
    differently, such as `symplectic_euler_step`, is applied to x'' = -k x - c x' instead, one (k, c) a mode.

    Explicit Euler: dt <= -2 Re(lambda) / |lambda|^2, so 2 z / omega for an oscillator of damping ratio z < 1, and 0
    without damping. `symplectic_euler_step` on an undamped oscillator: 2 / omega. Implicit Euler: no limit, inf.

    The limit belongs to the state: look at it where the system is stiffest. Eigenvalues that are 0 up to the roundoff
    of the data (a system that can drift) do not count. Up to 512 numbers in the state all eigenvalues are computed;
    above, Arnoldi iteration on Jacobian-vector products finds those of the largest modulus, real part and imaginary
    part, and the limit is that of these. Computed in float64 on the host, so it is not for use under jit.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``.
      t: time, s.
      y: state, any pytree of floating or complex arrays.
      args: passed to f.
      step: the method.
      growing: "unstable": where the equation itself grows (Re lambda > 0) no dt is stable, 0.0; "skip": the
        growth is the solution's own and only the other eigenvalues count.
    Returns: the limit, s, a float; 0.0 when no dt is stable, inf when every dt is.
    Raises: ValueError if y or t is traced, if f does not return the form of y, or if its Jacobian is not finite.
    Example:
      >>> import jeuler
      >>> oscillator = lambda t, y, ks: (y[1], -ks * y[0])
      >>> jeuler.stability_limit(oscillator, 0.0, (1.0, 0.0), 25.0)
      0.0
      >>> step = jeuler.symplectic_euler_step
      >>> round(jeuler.stability_limit(oscillator, 0.0, (1.0, 0.0), 25.0, step=step), 6)
      0.4
      >>> round(jeuler.stability_limit(lambda t, y, args: -50.0 * y, 0.0, 1.0), 6)
      0.04

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.2; W. E. Arnoldi,
      The principle of minimized iterations, Q. Appl. Math. 9, 1951.
    """
    if growing not in ("unstable", "skip"):
        raise ValueError(f'growing must be "unstable" or "skip", got {growing!r}')
    checks.untraced("stability_limit", t, y, args)
    checks.number("t", t)
    y = checks.state("y", y)
    f, args = arrays_only(f, args)
    checks.same_form("the vector field f", y, jax.eval_shape(f, t, y, args))
    with double_precision():
        linear = Linearisation(f, y, args)
        return linear.limits(t, linear.flat, step, growing=growing)[0]


class Linearisation:
    """The linear field J u around states of one form: as products, as a matrix where it is small, by its modes."""

    def __init__(self, f: VectorField, y: PyTree, args: PyTree) -> None:
        self.neutral = NEUTRAL * float(np.sqrt(np.finfo(trees.time_dtype(y)).eps))  # the data's own roundoff
        y, args = cast(y, np.float64), cast(args, np.float64)
        self.complex = any(map(jnp.iscomplexobj, jax.tree.leaves(y)))
        self.flat, self.unflatten = trees.real_vector(y)

        def real_field(t, flat):
            slope = f(t, self.unflatten(flat), args)
            return trees.real_vector(trees.in_dtypes_of(y, slope))[0]

        def product(t, flat, u):
            return jax.jvp(lambda flat: real_field(t, flat), (flat,), (u,))[1]

        self.product = jax.jit(product)
        self.products = jax.jit(jax.vmap(product, in_axes=(None, None, 1), out_axes=1))

    def limits(
        self, t: Any, flat: Any, step: Step, *, growing: str = "skip", interval: float = math.inf
    ) -> tuple[float, float]:
        """The largest stable dt at a state, and the largest at which no stable mode grows e-fold within an interval."""
        rates, modes, matrix = self.eigen(t, flat)
        scale = np.abs(rates).max(initial=0.0)
        moving = np.abs(rates) > self.neutral * scale
        grows = moving & (rates.real > UNDAMPED * scale)
        if growing == "unstable" and grows.any():
            return 0.0, 0.0
        counts = moving & ~grows
        if not counts.any():
            return math.inf, math.inf
        # always as many, so that one program serves all states
        chosen = np.resize(np.flatnonzero(counts), rates.size)
        rates, modes = rates[chosen], modes[:, chosen]
        rates = np.where(np.abs(rates.real) <= UNDAMPED * scale, 1j * rates.imag, rates)
        alike = treats_all_alike(step)  # type: ignore[arg-type]
        if alike:
            limits = functools.partial(scalar_limits, step, rates)
        else:
            limits = functools.partial(pair_limits, step, *self.modal(t, flat, rates, modes))
        limit = float(np.min(limits()))
        bound = limit if math.isinf(interval) else max(limit, float(np.min(limits(interval=interval))))
        return (limit if alike or matrix is None else self.refined(step, matrix, limit)), bound

    def eigen(self, t: Any, flat: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Eigenvalues, all or the extreme ones, their eigenvectors as columns, and the matrix if it is small."""
        n = self.flat.size
        matrix = np.asarray(self.products(t, flat, jnp.eye(n))) if n <= DENSE else None
        if not np.all(np.isfinite(self.product(t, flat, jnp.ones(n)) if matrix is None else matrix)):
            raise ValueError(
                "the Jacobian of f at (t, y) must be finite, got inf or NaN in it; give a state at which f is smooth"
            )
        if matrix is not None:
            rates, modes = np.linalg.eig(matrix)
            return rates.astype(complex), modes.astype(complex), matrix
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

        operator = LinearOperator(
            (n, n), matvec=lambda u: np.asarray(self.product(t, flat, jnp.asarray(u).ravel())), dtype=float
        )
        start = np.random.default_rng(0).standard_normal(n)
        found = []
        for which in ("LM", "LR", "LI"):
            try:
                found.append(eigs(operator, k=EXTREMES, which=which, v0=start, tol=1e-6, maxiter=20 * EXTREMES))
            except ArpackNoConvergence as partial:
                found.append((partial.eigenvalues, partial.eigenvectors))
        return np.concatenate([r for r, _ in found]), np.concatenate([v for _, v in found], axis=1), None

    def modal(self, t: Any, flat: Any, rates: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stiffness k and damping c of each mode of a second-order system, from its shape.

        lambda^2 x = A x + lambda B x  =>  k = -x* A x / x* x,  c = -x* B x / x* x
        """
        half = self.flat.size // 2
        shape = modes[half:]
        still = np.zeros_like(shape)

        def quotient(direction):
            real, imaginary = (self.products(t, flat, jnp.asarray(part)) for part in (direction.real, direction.imag))
            image = np.asarray(real)[half:] + 1j * np.asarray(imaginary)[half:]
            return (-np.sum(shape.conj() * image, axis=0) / np.sum(np.abs(shape) ** 2, axis=0)).real

        stiffness = quotient(np.concatenate([shape, still]))
        damping = quotient(np.concatenate([still, shape]))
        return stiffness, np.where(rates.real == 0, 0.0, damping)

    def refined(self, step: Step, matrix: np.ndarray, limit: float) -> float:
        """The limit by bisection on the spectral radius of the whole step, where the system is small enough.

        Exact also where damping couples the modes, which the modal limit is not.
        """
        if not 0 < limit < math.inf or self.flat.size > DENSE // 4 or self.complex:
            return limit

        def linear(t, y, matrix):
            return self.unflatten(matrix @ ravel_pytree(y)[0])

        @jax.jit
        def image(dt):
            columns = jax.vmap(lambda u: ravel_pytree(step(linear, 0.0, self.unflatten(u), dt, matrix))[0])
            return columns(jnp.eye(len(matrix))).T

        def stable(dt):
            return np.abs(np.linalg.eigvals(np.asarray(image(dt)))).max() <= 1 + 1e-6

        low, high = limit / 4, limit * 2
        if not stable(low) or stable(high):
            return limit
        for _ in range(24):
            middle = (low + high) / 2
            low, high = (middle, high) if stable(middle) else (low, middle)
        return low
