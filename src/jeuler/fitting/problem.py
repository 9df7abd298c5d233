"""A residual as the search takes it: a function of a vector, with data and weights beside it."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jeuler._core import checks
from jeuler._core.partition import OfArrays, arrays_only
from jeuler._jax.fingerprint import fingerprint
from jeuler._jax.programs import is_transformed
from jeuler.fitting.evaluate import Evaluate, evaluations
from jeuler.fitting.least_squares import Task
from jeuler.fitting.options import Options
from jeuler.fitting.priors import Alike, Priors
from jeuler.fitting.unknowns import Layout, checked_bounds

PyTree = Any
JACOBIAN_BYTES = 2**30  # a Jacobian larger than this is not formed,
MOST_COLUMNS = 500  # nor one of more columns: a run of the model for each takes longer than conjugate gradients


@dataclasses.dataclass(frozen=True)
class FlatResidual:
    """``residual(params)``, or ``residual(params, data)``, from vector to vector. Equal ones share their programs."""

    residual: Callable[..., Any]
    layout: Layout
    with_data: bool
    priors: Priors | None = None

    def __call__(self, x: Array, data: Any) -> Array:
        params = self.layout.params(x)
        out = self.residual(params, data) if self.with_data else self.residual(params)
        leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(out)]
        leaves += [] if self.priors is None else [self.priors.rows(x)]
        return jnp.concatenate(leaves).astype(self.layout.dtype) if leaves else jnp.zeros(0, self.layout.dtype)


@functools.lru_cache(maxsize=32)
def kept_programs(residual: FlatResidual) -> Evaluate:
    """The compiled programs of a residual that takes its data as an argument: used again by the next fit."""
    function: Any = residual.residual
    function = function.function if isinstance(function, OfArrays) else function
    return evaluations(residual, compiled=True, haste=getattr(function, "haste", "none"))


def programs(residual: FlatResidual, data: Any) -> Evaluate:
    """The compiled programs of a residual. One that closes over its data may read others next time: nothing is kept.

    A residual that has its own way to run with derivatives, ``forward``, is run by that.
    """
    evaluate = kept_programs(residual) if residual.with_data else evaluations(residual, compiled=True)
    function: Any = residual.residual
    whole: Callable[..., Any] | None = None
    if isinstance(function, OfArrays):
        function, whole = function.function, function.rest.join
    if not hasattr(function, "forward"):
        return evaluate
    forward = function.forward(residual.layout, data if whole is None else whole(data))

    def at(x: np.ndarray, data: Any) -> Any:
        found = forward.residual_at(x, data if whole is None else whole(data))
        return found if residual.priors is None else residual.priors.after(found, x)

    return dataclasses.replace(evaluate, at=at)


def residual_form(residual: Callable[..., Any], params: PyTree, data: Any, with_data: bool) -> tuple[Any, bool]:
    """The form of what the residual returns, and whether it closes over something traced; or one ValueError."""
    checks.function(
        "residual",
        residual,
        "(params, data) -> residuals" if with_data else "(params) -> residuals",
        "with data=..., it is called as residual(params, data)",
    )
    layout = Layout.of(params)
    if hasattr(residual, "form") and not is_transformed():  # it says so itself, and nothing is traced
        return residual.form(data), False
    flat = jax.ShapeDtypeStruct((layout.size,), layout.dtype)
    if with_data:
        program, form = jax.make_jaxpr(lambda x, data: residual(layout.params(x), data), return_shape=True)(flat, data)
    else:
        program, form = jax.make_jaxpr(lambda x: residual(layout.params(x)), return_shape=True)(flat)
    leaves = jax.tree.leaves(form)
    for leaf in leaves:
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(f"residual must return real floating arrays, got {leaf.dtype}; convert what it returns")
    return form, any(map(checks.is_traced, program.consts))


def series_of(layout: Layout) -> tuple[tuple[int, int], ...]:
    """(times, channels) of each leaf of a residual: its first axis is time."""
    shapes = [shape for shape in layout.shapes if shape is not None]
    return tuple((shape[0], math.prod(shape[1:])) if shape else (1, 1) for shape in shapes)


def residual_weights(layout: Layout, sigma: PyTree, weights: PyTree) -> Any:
    """What each residual is multiplied with: 1 / sigma, or the root of its weight; 0 leaves it out."""
    if sigma is not None and weights is not None:
        raise ValueError("sigma and weights must not both be given: sigma is an error, weights are relative; pass one")
    if sigma is None and weights is None:
        return np.ones(layout.size, layout.dtype)
    name = "weights" if sigma is None else "sigma"
    values = layout.spread(name, weights if sigma is None else sigma, 1.0)
    if not checks.is_traced(values):
        wrong = np.isnan(values) | (values < 0 if sigma is None else values <= 0)
        if wrong.any():
            expected = "0 or more (0 leaves a residual out)" if sigma is None else "greater than 0 (inf leaves one out)"
            raise ValueError(f"{name} must be {expected}, got {values[wrong][0]:g}")
        if not (values > 0).any() or (sigma is not None and np.isinf(values).all()):
            raise ValueError(f"{name} must leave at least one residual in, got none")
    xp: Any = jnp if checks.is_traced(values) else np
    return xp.sqrt(values) if sigma is None else 1 / values


@dataclasses.dataclass(frozen=True)
class Problem:
    """A residual with its data, weights, bounds and start, checked.

    Attributes:
      windows: the same unknowns with parts of the data as rows, for minibatches; None: the data's own rows.
    """

    residual: FlatResidual
    form: Layout  # of what the residual returns
    data: Any
    x: Any
    lower: Any
    upper: Any
    weights: Any
    absolute: bool
    stages: tuple[Any, ...]
    closes_over_traced: bool = False
    windows: Problem | None = None

    @classmethod
    def of(
        cls,
        residual: Callable[..., Any],
        params: PyTree,
        *,
        data: PyTree = None,
        bounds: PyTree = None,
        positive: PyTree = False,
        sigma: PyTree = None,
        weights: PyTree = None,
        stages: Iterable[PyTree] = (),
        priors: Any = None,
        loss: str = "linear",
        alike: Alike | None = None,
    ) -> Problem:
        """From what the user passes, or one ValueError that says what is wrong with it."""
        layout = Layout.of(params)
        x = layout.vector(params)
        lower, upper = checked_bounds(layout, x, bounds, positive)
        with_data = data is not None
        if with_data:
            residual, data = arrays_only(residual, data)
        if not layout.size:
            raise ValueError(f"params must hold at least one floating number, got {checks.shown(params)}")
        shape, closes_over_traced = residual_form(residual, params, data, with_data)
        form = Layout.of(shape)
        if not form.size or not layout.size:
            raise ValueError(
                f"residual and params must not be empty, got {form.size} residuals and {layout.size} parameters"
            )
        weight = residual_weights(form, sigma, weights)
        masks = tuple(_stage(form, stage, weight) for stage in stages)
        known = Priors.of(layout, priors, sigma, loss, alike)
        flat = FlatResidual(residual, layout, with_data, known)
        if known is not None:
            form = Layout.of({"data": shape, "priors": jax.ShapeDtypeStruct((1, len(known.places)), layout.dtype)})
            weight, *rest = (_joined(values, 1 / np.asarray(known.sigmas)) for values in (weight, *masks))
            masks = tuple(rest)
        return cls(flat, form, data, x, lower, upper, weight, sigma is not None, masks, closes_over_traced)

    @property
    def layout(self) -> Layout:
        return self.residual.layout

    def of_data(self, residual: Any) -> PyTree:
        """A residual vector in the structure that the residual function returns, without the rows of priors."""
        parts = self.form.params(residual)
        return parts if self.residual.priors is None else parts["data"]

    @property
    def traced(self) -> bool:
        """Whether any part of it is being traced."""
        parts = (self.data, self.x, self.lower, self.upper, self.weights, self.stages)
        return self.closes_over_traced or any(map(checks.is_traced, jax.tree.leaves(parts)))

    @property
    def small(self) -> bool:
        """Whether its Jacobian is formed."""
        n = self.layout.size
        return self.form.size * n * 8 <= JACOBIAN_BYTES and n <= MOST_COLUMNS

    @property
    def precision(self) -> float:
        """The unit roundoff of the residual's arithmetic."""
        used = [d for d in (*self.form.dtypes, *self.layout.dtypes) if d is not None]
        return max(float(jnp.finfo(dtype).eps) for dtype in used)

    def task(self, tolerance: float) -> Task:
        """What the search is given, of NumPy in float64 unless something is traced."""
        if self.traced:
            dtype = self.layout.dtype
            own: list[Any] = [jnp.asarray(a, dtype) for a in (self.weights, self.weights, self.lower, self.upper)]
            rest: list[Any] = [jnp.asarray(a, dtype) for a in (1.0, tolerance, self.precision, 0.0)]
        else:
            own = [np.asarray(a, float) for a in (self.weights, self.weights, self.lower, self.upper)]
            rest = [np.asarray(a, float) for a in (1.0, tolerance, self.precision, 0.0)]
        return Task(self.data, *own, *rest)


def marks(problem: Problem, options: Options, task: Task) -> tuple[Any, ...]:
    """By what a file knows that it is of this fit: arrays and what prints itself."""
    windows = () if problem.windows is None else problem.windows.data
    how = (options.loss, options.loss_scale, options.starts, options.minibatch, options.max_iterations)
    functions = fingerprint((problem.residual, options.optimizer))
    return task, problem.stages, np.asarray(problem.x), repr(problem.layout.shapes), how, windows, functions


def variance_of_noise(problem: Problem, task: Task, state: Any) -> float:
    """That of a weighted residual: 1 where sigma is given, or what the best fit leaves over, per degree of freedom."""
    if problem.absolute:
        return 1.0
    unknowns = int(np.sum(np.asarray(problem.lower < problem.upper)))
    freedom = max(int(np.sum(np.asarray(task.all_weights) > 0)) - unknowns, 1)
    return max(float(np.sum(np.asarray(state.residual) ** 2)) / freedom, 1e-300)


def _joined(a: Any, b: Any) -> Any:
    return (jnp if checks.is_traced(a) else np).concatenate([a, b])


def _stage(form: Layout, stage: PyTree, weight: Any) -> Any:
    values = form.spread("each of stages", stage, 1.0) if isinstance(stage, (dict, list, tuple)) else stage
    if np.size(values) != form.size:
        raise ValueError(f"each of stages must have one weight a residual, {form.size}, got {np.size(values)}")
    traced = any(map(checks.is_traced, (values, weight)))
    if not traced and not np.all(np.asarray(values) >= 0):
        raise ValueError("each of stages must be weights of 0 or more (0 leaves a residual out), got one that is not")
    xp: Any = jnp if traced else np
    return weight * xp.sqrt(xp.ravel(xp.asarray(values)))
