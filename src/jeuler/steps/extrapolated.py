"""Extrapolation of Euler steps to any order, with an estimate of the error."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler.steps.explicit import Step, VectorField, euler_step

PyTree = Any


@dataclasses.dataclass(frozen=True)
class ExtrapolatedStep:
    """A step of order k from k runs of a first-order step over the same dt; see `extrapolated_euler`.

    Attributes:
      order: order of the cumulative error, the number of rows.
      base: the first-order step that is extrapolated.
    """

    order: int
    base: Step

    @property
    def __name__(self) -> str:
        return f"extrapolated {getattr(self.base, '__name__', 'step')} of order {self.order}"

    @property
    def gap(self) -> float:
        """The longest part of a step between two looks at f, of `solve_adaptive`: the last substep of the last row."""
        return 1 / self.order

    @property
    def explicit(self) -> bool:
        return getattr(self.base, "explicit", False)

    def __call__(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
        return trees.add(y, self.increment(f, t, y, dt, args))

    def increment(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> PyTree:
        """y(t + dt) - y, what ``solve(compensated=True)`` adds."""
        return jax.tree.map(lambda row: aitken_neville(row)[0], self.rows(f, t, y, dt, args)[0])

    def start(self, f: VectorField, t: Any, y: PyTree, args: Any) -> None:
        """What the first step of `solve_adaptive` takes over: nothing."""

    def attempt(
        self, f: VectorField, t: Any, y: PyTree, taken_over: None, dt: Any, args: Any
    ) -> tuple[PyTree, PyTree, None]:
        """The increment with its estimated error, and what the next step takes over: nothing."""
        return *self.increment_with_error(f, t, y, dt, args), None

    def increment_with_error(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> tuple[PyTree, PyTree]:
        """The increment, and its estimated error: T_kk - T_{k,k-1}, or the `jump` of an explicit base if larger."""
        rows, chain = self.rows(f, t, y, dt, args)
        if self.order == 1:
            best = jax.tree.map(lambda row: row[0], rows)
            return best, jax.tree.map(jnp.zeros_like, best)
        pairs = jax.tree.map(aitken_neville, rows)
        best, before = jax.tree.transpose(jax.tree.structure(y), jax.tree.structure((0, 0)), pairs)
        error = trees.subtract(best, before)
        if not hasattr(self.base, "increment"):  # an implicit step sees f at its end
            return best, error
        jump = self.jump(f, t, y, dt, args, chain)
        return best, jax.tree.map(lambda a, b: jnp.where(jnp.abs(a) >= jnp.abs(b), a, b), error, jump)

    def jump(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any, chain: PyTree) -> PyTree:
        """The k-th difference of the substeps of row k, taken one substep beyond its end: what f does there.

        sum_i (-1)^(k - i) binomial(k, i) d_i,  d_i = increment of substep i = 0, ..., k:  O(dt^(k + 1)) where f is
        smooth, and dt / k times the jump where f jumps after the last substep began, which no row sees.
        chain: the increments of row k after 1, ..., k substeps, with leading axis substep.
        """
        k = self.order
        at = jax.tree.map(lambda a, c: a + c[-1], y, chain)
        beyond = self.base.increment(f, t + dt, at, dt / k, args)  # type: ignore[attr-defined]
        weights = [(-1.0) ** (k - i) * math.comb(k, i) for i in range(k + 1)]

        def difference(chain, beyond):
            steps = jnp.diff(chain, axis=0, prepend=jnp.zeros_like(chain[:1]))
            inner = jnp.tensordot(jnp.asarray(weights[:-1], trees.real_dtype(steps.dtype)), steps, axes=1)
            return inner + beyond

        return jax.tree.map(difference, chain, beyond)

    def rows(self, f: VectorField, t: Any, y: PyTree, dt: Any, args: Any) -> tuple[PyTree, PyTree]:
        """Increments over dt of the base step in 1, 2, ..., k substeps, with leading axis row; and row k on its way.

        One vmapped batch of lanes, k substeps deep. Row k has a lane to itself, rows j and k - j share one.
        """
        if hasattr(f, "within"):  # what acts through the step is the same in all rows
            f = f.within(t, y, dt, args)
        lanes = Lanes.of(self.order)
        increment = getattr(self.base, "increment", None) or self._difference

        def one_lane(done, fresh, start, length):
            done = jax.tree.map(lambda d: jnp.where(fresh, 0, d), done)
            at = trees.add(y, done)
            h = length * dt
            return trees.add(done, increment(f, t + start * dt, at, h, args))

        def substep(done, table):
            done = jax.vmap(one_lane)(done, *table)
            return done, done

        time = trees.time_dtype(y)
        tables = jnp.asarray(lanes.fresh), jnp.asarray(lanes.start, time), jnp.asarray(lanes.length, time)
        still = jax.tree.map(lambda leaf: jnp.zeros((lanes.fresh.shape[1], *leaf.shape), leaf.dtype), y)
        _, history = lax.scan(substep, still, tables)
        return jax.tree.map(lambda h: h[lanes.end, lanes.lane], history), jax.tree.map(lambda h: h[:, 0], history)

    def _difference(self, f, t, y, dt, args):
        return trees.subtract(self.base(f, t, y, dt, args), y)


@dataclasses.dataclass(frozen=True)
class Lanes:
    """Which row each lane works on at each of the k substeps: tables (substep, lane)."""

    fresh: np.ndarray  # a row begins here
    start: np.ndarray  # time of the substep, as a part of dt
    length: np.ndarray  # size of the substep, as a part of dt
    end: np.ndarray  # the substep at which row 1, ..., k is complete
    lane: np.ndarray  # and its lane

    @classmethod
    def of(cls, order: int) -> Lanes:
        lanes = [(order,)] + [(order - j, j) if j != order - j else (j,) for j in range(1, order // 2 + 1)]
        shape = order, len(lanes)
        fresh, start, length = np.zeros(shape, bool), np.zeros(shape), np.zeros(shape)
        end, place = np.zeros(order, int), np.zeros(order, int)
        for number, rows in enumerate(lanes):
            at = 0
            for row in rows:
                fresh[at, number] = True
                start[at : at + row, number] = np.arange(row) / row
                length[at : at + row, number] = 1 / row
                at += row
                end[row - 1], place[row - 1] = at - 1, number
        return cls(fresh, start, length, end, place)


def aitken_neville(rows: Array) -> tuple[Array, Array]:
    """T_kk and T_{k,k-1} from T_{j,1}, j = 1, ..., k, of a method whose error is a power series in h.

    T_{j,m+1} = T_{j,m} + (T_{j,m} - T_{j-1,m}) / (n_j / n_{j-m} - 1),  n_j = j
    """
    before = column = rows
    for m in range(1, len(rows)):
        before = column
        n = np.arange(m + 1, len(rows) + 1)
        weight = jnp.asarray((n - m) / m, trees.real_dtype(rows.dtype)).reshape(-1, *[1] * (rows.ndim - 1))
        column = column[1:] + weight * (column[1:] - column[:-1])
    return column[-1], before[-1]


@says_what_to_write()
def extrapolated_euler(order: int = 4, *, step: Step = euler_step) -> ExtrapolatedStep:
    """Make a step of any order by extrapolating an Euler step to dt = 0.

        T_{j,1}: j substeps of dt / j;   y = T_kk
        T_{j,m+1} = T_{j,m} + (T_{j,m} - T_{j-1,m}) / (j / (j - m) - 1)

    The k rows are one vmapped batch, k substeps deep, about k^2 / 2 evaluations of f in all. Of `euler_step` it is an
    explicit Runge-Kutta method of order k; of a linearly implicit Euler step it stays stable on stiff problems.

    Args:
      order: k, the number of rows and the order, 1 to 12.
      step: a step of order 1 without memory: `euler_step`, an implicit or linearly implicit Euler step.
    Returns: a step for `solve`, ``(f, t, y, dt, args) -> y``, also with compensated sums; its
      ``increment_with_error`` gives the error estimate T_kk - T_{k,k-1} as well, which `solve_adaptive` uses.
    Raises: ValueError if order is not an integer from 1 to 12, or step is known to be of another order than 1.
    Example:
      >>> import jeuler
      >>> step = jeuler.extrapolated_euler(6)
      >>> run = jeuler.solve(lambda t, y, args: y, 1.0, dt=0.25, num_steps=4, step=step)
      >>> abs(float(run.y[-1]) - 2.718281828) < 2e-6
      True

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. II.9; of the
      linearly implicit step: P. Deuflhard, Recent progress in extrapolation methods, SIAM Review 27, 1985.
    """
    order = checks.count("order", order, least=1)
    if order > 12:
        raise ValueError(
            f"order must be at most 12, got {order}; above, its weights amplify roundoff: take a smaller dt"
        )
    checks.function("step", step, "(f, t, y, dt, args) -> y", "pass, say, jeuler.euler_step")
    step_order = getattr(step, "order", 1)
    if step_order != 1:
        name = getattr(step, "__name__", repr(step))
        raise ValueError(f"step must be of order 1, such as euler_step, got {name} of order {step_order}")
    return ExtrapolatedStep(order, step)
