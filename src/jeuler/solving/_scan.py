"""``solve`` on a fixed grid of times: saving, checkpointing, compensated sums, and the Solution."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import Function, component
from jeuler._core.partition import arrays_only
from jeuler._jax import programs
from jeuler._jax.members import recomputed
from jeuler.solving._breaks import checked_breaks, split_at, told_apart
from jeuler.solving._reversible import check as check_reversible
from jeuler.solving._reversible import reversible
from jeuler.solving._tables import solution_table
from jeuler.solving.chunks import Progress, can_be_in_chunks, check_progress, run_in_chunks
from jeuler.solving.dataset import to_dataset
from jeuler.solving.grid import Checkpoint, Grid
from jeuler.solving.long_runs import check_resume, run_on_disk
from jeuler.solving.loop import Loop, in_one_scan, watched
from jeuler.steps.explicit import Step, VectorField, euler_step

PyTree = Any
INSTEAD = {
    "t1": "num_steps=round((t1 - t0) / dt), the end is at t0 + num_steps * dt",
    "steps": "num_steps=...",
    "n": "num_steps=...",
    "h": "dt=...",
    "method": "step=jeuler.rk4_step",
    "solver": "step=jeuler.rk4_step",
    "saveat": "save_every=...",
    "ts": "save_every=...",
    "callback": "save=lambda t, y: ... for what is kept, progress=lambda step, num_steps: ... for how far it is",
    "mass": "args=mass",
    "rng": "key=jax.random.key(0)",
    "seed": "key=jax.random.key(0)",
}


@component()
class Solution:
    """What a run gives back.

    Attributes:
      t: the saved times, shape (saved,), s; saved = num_steps // save_every + 1, the initial time first.
      y: the saved states, or what ``save`` made of them: a pytree with leading axis saved, the initial value first.
      first_nonfinite: int32 scalar: -1, or the 1-based number of the first step whose result is not finite.
        Under ``vmap`` one number a batch member.
      unresolved_contacts: int32 scalar, the impacts and overlaps that `Collisions` did not resolve; 0 without contact.
    Example:
      >>> import jeuler
      >>> run = jeuler.solve(lambda t, y, args: y * y, 1.0, dt=0.5, num_steps=20, save_every=10)
      >>> run.t.tolist(), run.y.tolist(), int(run.first_nonfinite)
      ([0.0, 5.0, 10.0], [1.0, inf, inf], 10)
    """

    t: Array
    y: PyTree
    first_nonfinite: Array
    unresolved_contacts: Array | int = 0

    def __getattr__(self, name: str) -> Any:
        own = ("t", "y", "first_nonfinite")
        state = self.__dict__.get("y")
        if name in ("position", "velocity", *getattr(state, "fields", tuple)()):
            raise AttributeError(f"a Solution has no {name!r} of its own; write solution.y.{name}, (saved, ...)")
        instead = {"times": "t", "time": "t", "ts": "t", "ys": "y", "states": "y", "state": "y", "success": own[2]}
        hint = f"; write solution.{instead[name]}" if name in instead else ""
        raise AttributeError(f"a Solution has {', '.join(own)}, got {name!r}{hint}")

    _repr_html_ = solution_table

    def to_xarray(self) -> Any:
        """The run as an ``xarray.Dataset``, with the times as its coordinate.

        Its variables are the fields of the state, with axes (time, particle, dim), or the arrays of another pytree by
        their paths, "y" for a single one. ``first_nonfinite`` and ``unresolved_contacts`` are attributes. Needs xarray:
        ``pip install jeuler[io]``.

        Returns: the dataset.
        Raises: ValueError, if the solution is a batch of runs.
        Example:
          >>> import jax.numpy as jnp, jeuler
          >>> state = jeuler.ParticleState(jnp.zeros((3, 2)), jnp.ones((3, 2)))
          >>> run = jeuler.simulate(jeuler.Scene(), state, dt=0.5, num_steps=2).to_xarray()
          >>> run.position.dims, run.position.sel(time=1.0, particle=0).values.tolist()
          (('time', 'particle', 'dim'), [1.0, 1.0])
        """
        return to_dataset(self)


@says_what_to_write(**INSTEAD)
def solve(
    f: VectorField,
    y0: PyTree,
    *,
    dt: Any,
    num_steps: int,
    t0: Any = 0.0,
    args: Any = None,
    step: Step = euler_step,
    save_every: int = 1,
    save: Callable[[Array, PyTree], PyTree] | None = None,
    checkpoint: Checkpoint = None,
    compensated: bool = False,
    breaks: Any = (),
    progress: Progress = None,
    resume: Any = None,
    checkpoint_every: int | None = None,
) -> Solution:
    """Advance y' = f(t, y, args) by num_steps steps of size dt, in one ``lax.scan``.

        t_n = t0 + n dt,   y_{n+1} = step(f, t_n, y_n, dt, args)

    The time comes from an integer step counter, never from an accumulated sum. Works under jit, vmap, grad, jacfwd,
    hessian and grad of grad as it is. Outside of these a long run is done in pieces of about 0.1 s, so that Ctrl-C
    stops it, with the same numbers to rounding.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``, of the structure, shapes and dtypes of y.
      y0: initial state, any pytree of floating or complex arrays. Differentiable.
      dt: step size, s; negative steps back in time. Differentiable.
      num_steps: number of steps, an integer >= 0.
      t0: initial time, s. Differentiable.
      args: passed to f; any pytree. Its arrays and floats are differentiable; other leaves, such as functions, strings
        and integers, stay as they are.
      step: the method: `euler_step`, `symplectic_euler_step`, `heun_step`, `rk4_step` or any such function.
      save_every: save each save_every-th step; must divide num_steps.
      save: ``save(t, y)`` makes what is kept of a saved state; None keeps y.
      checkpoint: reverse mode keeps every state (None), or only one in ``checkpoint`` steps and computes the others
        again (an integer), or one in sqrt(num_steps) ("sqrt"), so that its memory grows as sqrt(num_steps), or none
        but the saved ones ("reversible"): `symplectic_euler_step` with an acceleration that does not depend on the
        velocity is undone step by step, to the bit. For that, numbers are rounded to about four units in the last
        place of the largest, and a plain run before finds the largest; there is no forward mode, and a step that could
        not be undone (a damper) makes the gradient NaN.
      compensated: accumulate y by compensated (Kahan-Neumaier) sums: the roundoff of a long run stays near one unit
        in the last place instead of growing with the number of steps. Explicit steps only.
      breaks: times at which f may jump, (break,), s: the step that a break falls into ends there and goes on from it,
        and f is evaluated just before and just after. A jump at the last time must be named too, or the last step
        sees f after it. Differentiable, by each time that no other break has too: there the derivative is NaN.
      progress: True shows a bar with an estimate of the end; a function is called as ``progress(step, num_steps)``
        about ten times a second, and what it raises ends the run. Not under jit, vmap or grad, nor with "reversible".
      resume: path of a folder in which the run keeps its saved frames and its last state, and from which the same call
        goes on, after a kill or for more steps, with the numbers of a run in one go to the bit. The leaves of ``y`` are
        then read from disk where they are indexed or converted. It needs zarr, ``pip install 'jeuler[runs]'``.
      checkpoint_every: steps between two states on disk; None for one each 10 s.
    Returns: `Solution`, saved states with leading axis num_steps // save_every + 1, initial value first.
    Raises: ValueError, before tracing, naming the argument, what was expected and what came.
    Example:
      >>> import jeuler
      >>> solution = jeuler.solve(lambda x, y, args: x + y / 5, -3.0, dt=1.0, num_steps=5)
      >>> [round(float(y), 4) for y in solution.y]
      [-3.0, -3.6, -3.32, -1.984, 0.6192, 4.743]

    Source: E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 1993, sect. II.1; compensated
      sums: A. Neumaier, Rundungsfehleranalyse einiger Verfahren zur Summation endlicher Summen, 1974.
    """
    y0 = checks.state("y0", y0)
    check_progress(progress, checkpoint)
    check_resume(resume, checkpoint_every, checkpoint)
    many = can_be_in_chunks(checkpoint)
    grid = Grid.checked(dt, num_steps, t0, save_every, checkpoint, dtype=trees.time_dtype(y0), many=many)
    checks.field_form(f)
    checks.true_or_false("compensated", compensated)
    f, args = arrays_only(f, args)
    breaks = checked_breaks(breaks, grid.dt.dtype)
    if breaks.size and checkpoint == "reversible":
        raise ValueError('breaks must be () with checkpoint="reversible", got some; take checkpoint="sqrt"')
    inputs = Function(f), y0, args, grid, breaks, Function(step), Function(save)
    settings = checkpoint, compensated
    if checkpoint == "reversible":  # looks at values
        return _solve(*inputs, *settings)
    if resume is not None:
        return Solution(*run_on_disk(_loop, inputs, settings, grid, resume, checkpoint_every, progress))
    found = run_in_chunks(_loop, inputs, settings, grid, progress)
    return programs.call(_solve, inputs, settings) if found is None else Solution(*found)


def _solve(*given: Any) -> Solution:
    """`solve`, as it is compiled in one piece."""
    return Solution(*in_one_scan(_loop(*given)))


def _loop(
    field: Function,
    y0: PyTree,
    args: PyTree,
    grid: Grid,
    breaks: Array,
    stepper: Function,
    saver: Function,
    checkpoint: Any,
    compensated: bool,
) -> Loop:
    """The loop of `solve`."""
    f, step, save = field.function, stepper.function, saver.function
    check_step(step)
    check_save(save)
    checks.vector_field(f, grid.t0, y0, args)
    if checkpoint == "reversible":
        return reversible_loop(f, y0, args, grid, save, step, compensated)
    advance = advance_by(step, compensated=compensated)
    if breaks.size:
        advance = split_at(advance, told_apart(breaks, grid.t0, grid.clock(jnp.asarray(grid.num_steps))))

    def next_state(n, t, y_and_remainder):
        return advance(f, t, y_and_remainder, grid.dt, args)

    return Loop(next_state, (y0, no_remainder(y0, compensated)), grid, save)


def reversible_loop(
    f: VectorField,
    y0: PyTree,
    args: Any,
    grid: Grid,
    save: Callable[[Array, PyTree], PyTree] | None,
    step: Step,
    compensated: bool,
) -> Loop:
    """The loop of `solve` with ``checkpoint="reversible"``."""
    check_reversible(f, grid.t0, y0, args, step, compensated)
    y0, between_saves = reversible(f, y0, args, grid)

    def within(run, carry):
        n, first_nonfinite, (y, remainder) = carry
        first_nonfinite, y = between_saves(n, first_nonfinite, y)
        return n + grid.save_every, first_nonfinite, (y, remainder)

    return Loop(lambda n, t, state: state, (y0, None), grid, save, within=within)


def solve_to(
    f: VectorField,
    y0: PyTree,
    *,
    dt: Array,
    ends: Array,
    t0: Any,
    args: Any,
    step: Step,
    compensated: bool,
    breaks: Any,
) -> tuple[PyTree, Array]:
    """y0 and the states of `solve` after these numbers of steps, (end,) and rising, and its ``first_nonfinite``.

    dt and ends are inputs of the compiled program, so that one does for every number of steps. Not for reverse mode.
    """
    advance = advance_by(step, compensated=compensated)
    breaks = checked_breaks(breaks, dt.dtype)
    if breaks.size:
        advance = split_at(advance, breaks)
    t0 = jnp.asarray(t0, dt.dtype)
    one_step = watched(
        lambda n, t, state: advance(f, t, state, dt, args), lambda n: t0 + n.astype(dt.dtype) * dt, lambda y: y
    )

    def to_end(carry, end):
        carry = lax.while_loop(lambda carry: carry[0] < end, one_step, carry)
        return carry, carry[2][0]

    none = jnp.zeros((), ends.dtype)
    start = none, none - 1, (y0, no_remainder(y0, compensated))
    (_, first_nonfinite, _), states = lax.scan(to_end, start, ends)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), y0, states), first_nonfinite


def no_remainder(y: PyTree, compensated: bool) -> PyTree:
    """What rounding has cut off y at the start of a run: nothing."""
    return jax.tree.map(jnp.zeros_like, y) if compensated else None


def check_step(step: Any) -> None:
    """One ValueError if step is not a step, but a name or a factory of steps."""
    hint = "pass, say, jeuler.euler_step, or what jeuler.implicit_euler() makes"
    checks.refuse_class("step must be a function (f, t, y, dt, args) -> y", step)
    checks.function("step", step, "(f, t, y, dt, args) -> y", hint)


def check_save(save: Any) -> None:
    """One ValueError if save is neither None nor a function of time and state."""
    if save is not None:
        checks.function("save", save, "(t, y) -> what is kept", "write save=lambda t, y: y.position, say")


def advance_by(step: Any, *, compensated: bool) -> Callable[..., Any]:
    """The step on the pair (y, the remainder that rounding has cut off y so far; None in plain sums).

    Reverse mode keeps what an explicit step starts from and works the rest out again: that is less work than to store
    and load all that the step computes on its way. A step that solves equations keeps its solution.
    """
    check_step(step)
    if not compensated:

        def plain(f, t, y_and_remainder, dt, args):
            y, _ = y_and_remainder
            y_next = step(f, t, y, dt, args)
            checks.same_form("the step", y, y_next)
            return y_next, None

        forward_only = getattr(step, "in_loop", False)
        return recomputed(plain) if hasattr(step, "increment") and not forward_only else plain

    if not hasattr(step, "increment"):
        name = getattr(step, "__name__", repr(step))
        raise ValueError(
            f"compensated=True needs an explicit step that has an .increment, got {name}; "
            f"pass euler_step, symplectic_euler_step, heun_step or rk4_step, or compensated=False"
        )

    def two_sum(y, increment):
        total = y + increment
        rounded = total - y
        remainder = (y - (total - rounded)) + (increment - rounded)
        return total, lax.stop_gradient(remainder)  # exactly zero in real arithmetic, so is its derivative

    def compensating(f, t, y_and_remainder, dt, args):
        y, remainder = y_and_remainder
        increment = trees.add(step.increment(f, t, y, dt, args), remainder)
        pairs = jax.tree.map(two_sum, y, increment)
        return jax.tree.transpose(jax.tree.structure(y), jax.tree.structure((0, 0)), pairs)

    return recomputed(compensating)
