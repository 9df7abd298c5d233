"""Runs of a scene with their derivatives by forward mode, in one small program: what a fit of positions compiles.

A first fit takes as long as its programs take to compile, so there is one: the run and its derivatives in some
directions, kept where a recording asks for them. Its number of steps is a value, so that the same program also runs at
half the step. What needs no program, interpolation and weights, is NumPy's.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jeuler._core.interpolate import hermite
from jeuler._core.partition import is_array, partition
from jeuler._jax.haste import Haste, jit_in_haste
from jeuler._jax.moving import Moving
from jeuler.fitting.evaluate import Pair, by_blocks, directions_of
from jeuler.particles._simulate import begin
from jeuler.particles.state import split_state
from jeuler.steps.explicit import RK4, rk4_step

if TYPE_CHECKING:
    from jeuler.fitting.prediction import Prediction
    from jeuler.fitting.unknowns import Layout

ON_NODE = 1e-9  # of a step: a time nearer to its end than this is there
SMALL, MEDIUM = 100_000, 1_000_000  # numbers that all runs of a Jacobian pass through: less than the compiler takes


@dataclasses.dataclass(frozen=True)
class Nodes:
    """The ends of steps that the times of a recording lie at, or between.

    Attributes:
      rows: how many of them are kept at most.
      exact: whether each time is at the end of a step, so that velocities are not asked for.
    """

    rows: int
    exact: bool

    @classmethod
    def of(cls, data: dict[str, Any], num_steps: int) -> Nodes:
        interval, fraction = data["interval"], data["fraction"]
        exact = bool(np.all(np.minimum(fraction, 1 - fraction) <= ON_NODE))
        if exact:
            return cls(len(np.unique(interval + (fraction > 0.5))), True)
        return cls(min(2 * len(interval), 2 * num_steps + 1), False)

    def kept(self, data: dict[str, Any], num_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """For each of twice as many steps the row that keeps its end, and the rows of each time, (1 or 2, time)."""
        interval = data["interval"]
        ends = (interval + (data["fraction"] > 0.5))[None] if self.exact else np.stack([interval, interval + 1])
        nodes, rows = np.unique(ends, return_inverse=True)
        row = np.full(2 * num_steps + 1, self.rows, np.int32)  # the last row is for what is not asked for
        row[nodes] = np.arange(len(nodes))
        return row, rows.reshape(ends.shape)


@dataclasses.dataclass(frozen=True)
class Forward:
    """Positions of a recording and their derivatives. Hashable: its program is kept by it."""

    prediction: Prediction
    layout: Layout
    nodes: Nodes
    haste: Haste

    @classmethod
    def of(cls, prediction: Prediction, layout: Layout, data: dict[str, Any]) -> Forward:
        numbers = prediction.num_steps * data["state"].position.size * layout.size
        haste: Haste = "great" if numbers <= SMALL else "some" if numbers <= MEDIUM else "none"
        return cls(prediction, layout, Nodes.of(data, prediction.num_steps), haste)

    def residual_at(self, x: np.ndarray, data: dict[str, Any], parts: int = 1) -> Pair:
        """Prediction minus measurement, and a function that gives its Jacobian; ``parts`` steps for each step."""

        nodes = self.nodes.kept(data, self.prediction.num_steps)
        columns, observed = np.asarray(self.prediction.columns, int), data["observed"]

        def program(x, data, directions):
            kept, changes = self.run(x, data, directions, nodes, parts)
            seen = self.interpolated(kept, data, nodes, columns)
            seen_changes = self.interpolated(changes, data, nodes, columns)
            if not observed.all():
                seen_changes = np.where(observed, seen_changes, 0)
            return np.where(observed, seen - data["targets"], 0).ravel(), seen_changes.reshape(len(directions), -1)

        return by_blocks(program, x, data)

    def positions(self, x: np.ndarray, data: dict[str, Any]) -> np.ndarray:
        """Positions of all particles at the times, (time, particle, dim), m."""
        nodes = self.nodes.kept(data, self.prediction.num_steps)
        kept, _ = self.run(x, data, directions_of(0, len(x)), nodes, 1)
        return self.interpolated(kept, data, nodes, None).reshape(-1, *data["state"].position.shape)

    def run(
        self, x: np.ndarray, data: dict[str, Any], directions: np.ndarray, nodes: Any, parts: int
    ) -> tuple[Any, Any]:
        """The motion by component at the rows that are kept, and its changes in each direction."""
        arrays, rest = partition({name: data[name] for name in ("scene", "state", "dt", "t0", "key")}, is_array)
        row, _ = nodes
        return _compiled(self, rest)(x, arrays, row, np.int32(self.prediction.num_steps * parts), directions)

    def interpolated(self, kept: Any, data: dict[str, Any], nodes: Any, columns: np.ndarray | None) -> np.ndarray:
        """Positions at the times, (..., time, column), of these columns of position.ravel()."""
        _, rows = nodes

        def at(components: Any, which: int) -> np.ndarray:
            parts = [_chosen(np.asarray(x), rows[which], -2) for x in components]
            stacked = np.stack(parts, axis=-1)
            flat = stacked.reshape(*stacked.shape[:-2], -1)
            return flat if columns is None else _chosen(flat, columns, -1)

        if self.nodes.exact:
            return at(kept[0], 0)
        position, velocity = kept
        s = data["fraction"][:, None]
        ends: Any = (at(y, k) for y in (position, velocity) for k in (0, 1))
        return np.asarray(hermite(s, data["dt"], *ends))

    def traced(self, rest: Any, x: Any, arrays: Any, row: Any, steps: Any, directions: Any) -> tuple[Any, Any]:
        """What `run` compiles."""
        data = rest.join(arrays)
        prediction = self.prediction

        def begun(x):
            scene, state = prediction.places.put(data["scene"], data["state"], self.layout.params(x))
            return begin(
                scene,
                state,
                dt=data["dt"],
                num_steps=prediction.num_steps,
                t0=data["t0"],
                step=in_a_loop(prediction.step),
                key=data["key"],
            )

        if prediction.step is rk4_step and not data["scene"].effects and data["state"].alive is None:
            return _with_sensitivities(begun, x, directions, row, steps, self.nodes)

        def kept(x):
            advance, state = begun(x)
            return _kept(advance, split_state(state), row, steps, self.nodes)

        def column(direction):
            return jax.jvp(kept, (x,), (direction,))

        return jax.vmap(column, out_axes=(None, 0))(directions)


def _with_sensitivities(begun: Any, x: Any, directions: Any, row: Any, steps: Any, nodes: Nodes) -> tuple[Any, Any]:
    """The motion and its changes in each direction, as one run of a larger system:

        dy/dt = f(t, y, p),   dY/dt = f_y Y + f_p P

    A step of Runge and Kutta of it is the derivative of the step. The loops are then traced once, where a derivative
    of loops traces what they repeat six times.

    Source: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. I.14, II.6.
    """
    known: list[Any] = []

    def start(x):
        advance, state = begun(x)
        motion, _ = split_state(state)
        attributes = advance.scene.attributes(state)
        clock = advance.grid.clock(jnp.int32(0))
        field, parameters = jax.closure_convert(lambda t, y: advance.field(t, y, attributes), clock, motion)
        split = Moving.of(parameters)
        known.append((field, split, advance.grid))
        return motion, split.moving(parameters)

    (motion, p), changes = jax.vmap(lambda d: jax.jvp(start, (x,), (d,)), out_axes=(None, 0))(directions)
    field, split, grid = known[-1]

    def larger(t, both, args):
        y, changed = both

        def along(change):
            return jax.jvp(lambda y, p: field(t, y, *split.joined(p)), (y, p), change)

        return jax.vmap(along, out_axes=(None, 0))((changed, changes[1]))

    def one_step(n, carry):
        both, stores = carry
        both = RK4_IN_A_LOOP(larger, grid.clock(n), both, grid.dt, None)
        return both, written(stores, both, n + 1)

    def written(stores, both, n):
        asked = both if not nodes.exact else tuple(part[:1] for part in both)

        def put(store, value):
            value = value[..., None, :]
            return lax.dynamic_update_slice_in_dim(store, value, row[n], axis=store.ndim - 2)

        return jax.tree.map(put, stores, asked)

    asked = tuple(part[:1] if nodes.exact else part for part in (motion, changes[0]))
    stores = jax.tree.map(lambda a: jnp.zeros((*a.shape[:-1], nodes.rows + 1, a.shape[-1]), a.dtype), asked)
    both = motion, changes[0]
    _, stores = lax.fori_loop(jnp.int32(0), steps, one_step, (both, written(stores, both, 0)))
    return stores


def _kept(advance: Any, parts: Any, row: Any, steps: Any, nodes: Nodes) -> Any:
    """The motion at the ends of steps that are asked for: by component, (row, particle)."""

    def asked(parts: Any) -> Any:
        motion, _ = parts
        return motion[:1] if nodes.exact else motion

    def written(stores: Any, parts: Any, n: Any) -> Any:
        write = functools.partial(lax.dynamic_update_index_in_dim, index=row[n], axis=0)
        return jax.tree.map(write, stores, asked(parts))

    def one_step(n: Any, carry: Any) -> Any:
        parts, stores = carry
        parts, _ = advance(n, advance.grid.clock(n), (parts, None))
        return parts, written(stores, parts, n + 1)

    stores = jax.tree.map(lambda x: jnp.zeros((nodes.rows + 1, *x.shape), x.dtype), asked(parts))
    _, stores = lax.fori_loop(jnp.int32(0), steps, one_step, (parts, written(stores, parts, 0)))
    return stores


@functools.lru_cache(maxsize=32)
def _compiled(forward: Forward, rest: Any) -> Callable[..., Any]:
    return jit_in_haste(functools.partial(forward.traced, rest), forward.haste)


def _chosen(x: np.ndarray, index: np.ndarray, axis: int) -> np.ndarray:
    """x at these indices along the last axis or the one before; not copied where they follow one another."""
    first = int(index[0])
    if np.array_equal(index, np.arange(first, first + len(index))):
        here = slice(first, first + len(index))
        return x[..., here] if axis == -1 else x[..., here, :]
    return np.take(x, index, axis=axis)


class RungeKuttaInALoop:
    """The classical Runge-Kutta step with its four stages in a loop: a third of the program to compile.

    Each stage starts from the slope of the one before. Reverse mode keeps what each stage starts from and works its
    slope out again, which takes less time than to read what it would otherwise keep of each spring.
    """

    order: int = 4
    explicit: bool = True
    in_loop: bool = True

    def increment(self, f: Any, t: Any, y: Any, dt: Any, args: Any) -> Any:
        reach = jnp.asarray([0.0, *(row[-1] for row in RK4.matrix[1:])], dt.dtype) * dt
        share = jnp.asarray(RK4.weights, dt.dtype) * dt

        again = jax.checkpoint(f, prevent_cse=False)

        def stage(carry: Any, sizes: Any) -> Any:
            (slope, total), (reach, share) = carry, sizes
            slope = again(t + reach, jax.tree.map(lambda y, k: y + reach * k, y, slope), args)
            return (slope, jax.tree.map(lambda s, k: s + share * k, total, slope)), None

        nothing = jax.tree.map(jnp.zeros_like, y)
        return lax.scan(stage, (nothing, nothing), (reach, share))[0][1]

    def __call__(self, f: Any, t: Any, y: Any, dt: Any, args: Any) -> Any:
        return jax.tree.map(jnp.add, y, self.increment(f, t, y, dt, args))


RK4_IN_A_LOOP = RungeKuttaInALoop()


def in_a_loop(step: Any) -> Any:
    """The step, with its stages in a loop if there is such a form of it."""
    return RK4_IN_A_LOOP if step is rk4_step else step
