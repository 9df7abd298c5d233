"""The largest stable step size: the eigenvalues of what one step makes of the linearised equation."""

from __future__ import annotations

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import checks, trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import Function
from jeuler._core.describe import table
from jeuler._core.partition import arrays_only
from jeuler._core.precision import cast, double_precision
from jeuler._jax import programs
from jeuler.steps.amplification import SLOWEST, growth_at, growth_shows, scalar_limits, treats_all_alike
from jeuler.steps.explicit import Step, VectorField, euler_step
from jeuler.steps.reduced import SEGMENTS, Reduced, Runs, reduced_pair, reduced_whole, symmetric_weights
from jeuler.steps.step_map import GROWTH, StepMap, matrix_of_step

PyTree = Any

DENSE = 512  # numbers in the state up to which all eigenvalues of the Jacobian are computed
DENSE_MAP = 192  # and those of the step's own matrix, at every dt tried
NEUTRAL = 4.0  # |eigenvalue| below this times sqrt(eps) of the largest is a zero mode: so far a double zero splits
UNDAMPED = (
    1e-10  # |real part| below this part of the largest eigenvalue is zero up to roundoff, if its own is not known
)
WEAK = 1e-7  # a real part below this part of the largest eigenvalue is compared with its own roundoff
AT_ONCE = 1e-4  # dt |lambda|: growth that shows from there on shows at every dt
NEAR = 0.015  # a limit is confirmed by runs at dt so much below and above it
SECONDS = 4.0  # for the runs that check a large system


class StabilityLimit(float):
    """The largest stable dt, s, as a float that says how well it is known.

    Attributes:
      lower: dt known to be stable, s.
      upper: dt from which on growth shows, by 1e-12 a step or more, s; inf if none does.
      known: whether lower and upper are within 2 % of the limit; of 0.0, whether growth shows at once.
      reason: how it was found, what is not known about it, and where growth is too slow to show.
    Example:
      >>> import jeuler
      >>> limit = jeuler.stability_limit(lambda t, y, args: -4.0 * y, 0.0, 1.0)
      >>> round(limit, 6), limit.known, limit.reason
      (0.5, True, 'all eigenvalues')
    """

    lower: float
    upper: float
    known: bool
    reason: str

    def __new__(cls, value: float, lower: float, upper: float, known: bool, reason: str) -> StabilityLimit:
        limit = super().__new__(cls, value)
        limit.lower, limit.upper, limit.known, limit.reason = lower, upper, known, reason
        return limit

    def __getnewargs__(self) -> tuple[Any, ...]:
        return float(self), self.lower, self.upper, self.known, self.reason

    def _repr_html_(self) -> str:
        rows = [("dt, s", repr(float(self))), ("stable at, s", repr(self.lower)), ("unstable at, s", repr(self.upper))]
        return table("StabilityLimit", [*rows, ("known within 2 %", repr(self.known))], note=self.reason)


@says_what_to_write(dt="nothing: it finds dt")
def stability_limit(
    f: VectorField | Any,
    t: Any,
    y: PyTree = None,
    args: Any = None,
    *,
    step: Step = euler_step,
    growing: Literal["unstable", "skip"] = "unstable",
) -> StabilityLimit:
    """The largest stable dt of a step at one state: what is perturbed there does not grow.

        |mu| <= 1 for every eigenvalue mu of M(dt),   u -> M(dt) u one step on u' = J u,   J = df/dy (t, y)

    M is found by applying the step itself, so any step has a limit: explicit, implicit, or one of your own. Where a
    step commutes with linear changes of variables, as Runge-Kutta steps do, mu = R(dt lambda) for each eigenvalue
    lambda of J.

    Explicit Euler: dt <= -2 Re(lambda) / |lambda|^2, so 2 z / omega for an oscillator of damping ratio z < 1, and 0
    without damping. `symplectic_euler_step` on an undamped oscillator: 2 / omega. Implicit Euler: no limit, inf.

    The limit belongs to the state: look at it where the system is stiffest. Eigenvalues lambda that are 0 up to the
    roundoff of the data (a system that can drift) do not count, and a real part that is 0 up to the roundoff of its own
    eigenvalue is 0. Growth is told from roundoff by the step's increment, however slow: then `StabilityLimit.upper` is
    where it reaches 1e-12 a step, which runs can show.

    Up to 512 numbers in the state (192 for steps such as `symplectic_euler_step`) all eigenvalues are computed. Above,
    the step is applied in a Krylov space of J, and runs of the step in full size confirm that a perturbation decays
    1.5 % below the limit found and grows 1.5 % above it, or correct it by bisection. Where the limit is not known
    within 2 %, or growth above it does not show, `StabilityLimit.known` is False, ``reason`` says what is known, and a
    warning is given. Computed in float64 on the host, so it is not for use under jit.

    Args:
      f: vector field, ``f(t, y, args) -> dy/dt``; or a `Scene`, and then call ``stability_limit(scene, state)`` or
        ``stability_limit(scene, t, state)``: the limit of its forces, which effects do not enter.
      t: time, s.
      y: state, any pytree of floating or complex arrays.
      args: passed to f.
      step: the method.
      growing: "unstable": where the equation itself grows (Re lambda > 0) no dt is stable, 0.0; "skip": the
        growth is the solution's own and only the other eigenvalues count.
    Returns: the limit, s, a `StabilityLimit`, which is a float; 0.0 when no dt is stable, inf when every dt is.
    Raises: ValueError if y or t is traced, if f does not return the form of y, or if its Jacobian is not finite.
    Example:
      >>> import jeuler
      >>> oscillator = lambda t, y, ks: (y[1], -ks * y[0])
      >>> float(jeuler.stability_limit(oscillator, 0.0, (1.0, 0.0), 25.0))
      0.0
      >>> step = jeuler.symplectic_euler_step
      >>> round(jeuler.stability_limit(oscillator, 0.0, (1.0, 0.0), 25.0, step=step), 5)
      0.4
      >>> round(jeuler.stability_limit(lambda t, y, args: -50.0 * y, 0.0, 1.0), 6)
      0.04

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.2.
    """
    if growing not in ("unstable", "skip"):
        raise ValueError(f'growing must be "unstable" or "skip", got {growing!r}')
    scene: Any = f
    if hasattr(scene, "as_equation"):
        t, state = (0.0 if y is None else y, t) if hasattr(t, "position") else (t, y)
        y, args = scene.as_equation(state)
        f = scene.without_effects().vector_field
    elif y is None:
        raise ValueError("y must be the state at time t, got None; call stability_limit(f, t, y, args)")
    checks.untraced("stability_limit", t, y, args)
    checks.refuse_class("step must be a function (f, t, y, dt, args) -> y", step)
    checks.function("step", step, "(f, t, y, dt, args) -> y", "pass, say, jeuler.euler_step")
    checks.number("t", t)
    y = checks.state("y", y)
    checks.field_form(f)
    f, args = arrays_only(f, args)
    checks.vector_field(f, t, y, args)
    with double_precision():
        linear = Linearisation(f, y, args)
        limit = linear.limit(t, linear.flat, step, growing=growing)
    if not limit.known:
        warnings.warn(f"stability_limit: {limit.reason}", stacklevel=2)
    return limit


@dataclasses.dataclass(frozen=True)
class Spectrum:
    """Eigenvalues of J, sorted: those that count, those that grow by nature, how many are neutral; and J itself."""

    scale: float
    counting: np.ndarray
    growing: np.ndarray
    neutral: int
    matrix: np.ndarray
    like: Any  # a state of the form on which the step works with this J

    errors: np.ndarray  # of the real parts of those that count

    @classmethod
    def of(cls, matrix: np.ndarray, like: Any, neutral: float, exact: bool = False) -> Spectrum:
        """exact: know weak damping from roundoff where that can be told."""
        rates = np.linalg.eigvals(matrix).astype(complex)
        scale = np.abs(rates).max(initial=0.0)
        errors = np.full(rates.shape, UNDAMPED * scale)
        if exact and np.any(np.abs(rates.real) <= WEAK * scale):
            rates, errors = eigenvalues(matrix)
            scale = np.abs(rates).max(initial=0.0)
        moving = np.abs(rates) > neutral * scale
        grows = moving & (rates.real > np.maximum(UNDAMPED * scale, errors))
        counts = moving & ~grows
        counting = rates[counts]
        counting = np.where(counting.real >= -errors[counts], 1j * counting.imag, counting)
        return cls(scale, counting, rates[grows], int(np.sum(~moving)), matrix, like, errors[counts])


def eigenvalues(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues, and what roundoff makes of each: eps |A| over the cosine of its left and right vectors.

    Source: G. H. Golub, C. F. Van Loan, Matrix Computations, 1996, sect. 7.2.2.
    """
    import scipy.linalg

    balanced, _ = scipy.linalg.matrix_balance(matrix, permute=False)
    rates, left, right = scipy.linalg.eig(balanced, left=True)
    cosine = np.abs(np.sum(left.conj() * right, axis=0))
    with np.errstate(divide="ignore"):
        return rates, 8 * np.finfo(float).eps * np.linalg.norm(balanced) / cosine


def flat_field(f: VectorField, y: PyTree, args: PyTree, t: Any, flat: Any) -> Any:
    """f on the numbers of a state of the form of y."""
    slope = f(t, trees.real_vector(y)[1](flat), args)
    return trees.real_vector(trees.in_dtypes_of(y, slope))[0]


def _product(field: Function, y: PyTree, args: PyTree, t: Any, flat: Any, u: Any) -> Any:
    return jax.jvp(functools.partial(flat_field, field.function, y, args, t), (flat,), (u,))[1]


def _matrix(field: Function, y: PyTree, args: PyTree, t: Any, flat: Any) -> Any:
    product = functools.partial(_product, field, y, args, t, flat)
    return jax.vmap(product, in_axes=1, out_axes=1)(jnp.eye(flat.size))


class Linearisation:
    """The linear field J u around states of one form: as products, as a matrix where it is small, or a part of it."""

    neutral: float
    y: PyTree
    args: PyTree
    flat: Any
    unflatten: Callable[[Any], PyTree]

    def __init__(self, f: VectorField, y: PyTree, args: PyTree) -> None:
        self.f = f
        self.neutral = NEUTRAL * float(np.sqrt(np.finfo(trees.time_dtype(y)).eps))  # the data's own roundoff
        self.y, self.args = cast(y, np.float64), cast(args, np.float64)
        self.flat, self.unflatten = trees.real_vector(self.y)
        self.last: tuple[Any, Any] = None, None

    def field(self, t: Any, flat: Any) -> Any:
        """f on the numbers of the state."""
        return flat_field(self.f, self.y, self.args, t, flat)

    def product(self, t: Any, flat: Any, u: Any) -> np.ndarray:
        """J u."""
        inputs = Function(self.f), self.y, self.args, jnp.asarray(t, jnp.float64), flat, jnp.asarray(u)
        return np.asarray(programs.call(_product, inputs))

    def matrix(self, t: Any, flat: Any) -> np.ndarray:
        """J, of the state asked for last without work."""
        key = float(t), np.asarray(flat).tobytes()
        if self.last[0] != key:
            inputs = Function(self.f), self.y, self.args, jnp.asarray(t, jnp.float64), flat
            self.last = key, np.asarray(programs.call(_matrix, inputs))
        return self.last[1]

    def limits(self, t: Any, flat: Any, step: Step, *, interval: float) -> tuple[float, float]:
        """The largest stable dt at a state, and the largest at which no stable mode grows e-fold within an interval.

        What grows by nature does not count. Of large systems without a check by runs.
        """
        spectrum = self.spectrum(t, flat, step)[0]
        limit = self.limit_of(spectrum, step, "skip")
        return limit, max(limit, self.limit_of(spectrum, step, "skip", interval))

    def limit(self, t: Any, flat: Any, step: Step, *, growing: str) -> StabilityLimit:
        """The largest stable dt at a state, for large systems checked by runs."""
        spectrum, small = self.spectrum(t, flat, step, exact=True)
        limit = self.limit_of(spectrum, step, growing)
        if small is None:
            return self.of_all(spectrum, step, limit, growing)
        return self.checked(t, flat, step, spectrum, small, limit, growing)

    def of_all(self, spectrum: Spectrum, step: Step, limit: float, growing: str) -> StabilityLimit:
        """The limit that all eigenvalues say, and how well."""
        if growing == "unstable" and spectrum.growing.size:
            rate = spectrum.growing.real.max()
            return StabilityLimit(0.0, 0.0, 0.0, True, f"the equation itself grows, by exp({rate:.3g} t)")
        if not treats_all_alike(step):
            reason = f"all eigenvalues of the step's matrix, growth below {GROWTH:g} a step taken for roundoff"
            return StabilityLimit(limit, limit, limit, True, reason)
        below = f"below dt={{:.3g}} it is less than {SLOWEST:g} a step"
        if limit == 0.0:
            shows = growth_shows(step, spectrum.counting)
            reason = f"no dt is stable: what swings undamped, up to roundoff, grows at every dt; {below.format(shows)}"
            return StabilityLimit(0.0, 0.0, shows, bool(shows * spectrum.scale < AT_ONCE), reason)
        rates, errors = spectrum.counting, spectrum.errors
        sure = dataclasses.replace(spectrum, counting=np.minimum(rates.real + errors, 0) + 1j * rates.imag)
        perhaps = dataclasses.replace(spectrum, counting=rates.real - errors + 1j * rates.imag)
        low, high = limit, limit
        if np.any(errors > 1e-3 * np.abs(rates.real)):
            low, high = (self.limit_of(part, step, growing) for part in (sure, perhaps))
            low, high = min(low, limit), max(high, limit)
        too_slow = math.isfinite(high) and growth_at(step, rates, 1.02 * high) < SLOWEST
        shows = growth_shows(step, rates) if too_slow else high
        if high > low * (1 + 2.5 * NEAR):
            reason = (
                f"not known within 2 %: dt={low:.3g} to {high:.3g}, as damping that is {errors.max():.1e} 1/s or less "
                f"cannot be told from roundoff"
            )
            return StabilityLimit(limit, low, shows, False, reason)
        if too_slow:
            reason = f"all eigenvalues; growth above it is too slow to show in runs: {below.format(shows)}"
            return StabilityLimit(limit, low, shows, False, reason)
        return StabilityLimit(limit, low, high, True, "all eigenvalues")

    def spectrum(self, t: Any, flat: Any, step: Step, exact: bool = False) -> tuple[Spectrum, Reduced | None]:
        n = self.flat.size
        small = n <= (DENSE if treats_all_alike(step) else DENSE_MAP)
        if not np.all(np.isfinite(self.matrix(t, flat) if small else self.product(t, flat, jnp.ones(n)))):
            raise ValueError(
                "the Jacobian of f at (t, y) must be finite, got inf or NaN in it; give a state at which f is smooth"
            )
        if small:
            return Spectrum.of(self.matrix(t, flat), self.y, self.neutral, exact), None
        product = functools.partial(self.product, t, flat)
        if self.halves():
            masses = getattr(self.args, "mass", self.args)  # of a scene
            masses = masses if isinstance(masses, jax.Array) else None
            small = reduced_pair(product, n, symmetric_weights(product, n, masses))
        elif treats_all_alike(step):
            small = reduced_whole(product, n)
        else:
            raise ValueError(
                f"y must be a pair (position, velocity) for the stability limit of this step with more than "
                f"{DENSE_MAP} numbers in the state, got {jax.tree.structure(self.y)}; write the system as a pair"
            )
        return Spectrum.of(small.matrix, small.like, self.neutral), small

    def halves(self) -> bool:
        """Whether the state is a pair of two parts of one form."""
        parts, _ = trees.parts(self.y)
        forms = [[leaf.shape for leaf in jax.tree.leaves(part)] for part in parts]
        return len(forms) == 2 and forms[0] == forms[1] and all(map(np.isrealobj, jax.tree.leaves(self.y)))

    def limit_of(self, spectrum: Spectrum, step: Step, growing: str, interval: float = math.inf) -> float:
        if growing == "unstable" and spectrum.growing.size:
            return 0.0
        if not spectrum.counting.size:
            return math.inf
        if treats_all_alike(step):
            return float(np.min(scalar_limits(step, spectrum.counting, interval)))
        return self.step_map(spectrum, step).limit(interval)

    def step_map(self, spectrum: Spectrum, step: Step) -> StepMap:
        image = matrix_of_step(step, spectrum.like)
        return StepMap(lambda dt: image(spectrum.matrix, dt), spectrum.scale, spectrum.neutral, spectrum.growing)

    def checked(
        self, t: Any, flat: Any, step: Step, spectrum: Spectrum, small: Reduced, limit: float, growing: str
    ) -> StabilityLimit:
        """The limit found in a small space, confirmed or corrected by runs in full size."""
        runs = Runs(self.field, step, self.y, SECONDS)
        noise = np.random.default_rng(2).standard_normal(flat.size)
        image = self.step_map(spectrum, step).image

        def grows(dt: float) -> bool:
            factors, modes = np.linalg.eig(image(dt))
            fastest = small.lift(modes[:, np.abs(factors).argmax()].real)
            return runs.grows(t, flat, fastest / np.linalg.norm(fastest) + noise / np.linalg.norm(noise), dt)

        if growing == "skip" and spectrum.growing.size:
            reason = "growth of the equation itself hides that of the step in runs, so the limit is that of a part of J"
            return StabilityLimit(limit, 0.0, math.inf, False, reason)
        if math.isinf(limit):
            if treats_all_alike(step):
                return StabilityLimit(limit, limit, limit, True, "no eigenvalue in a part of J limits dt")
            limit = 1e3 / spectrum.scale
        if limit == 0.0:
            tried = 0.3 / spectrum.scale
            if grows(tried):
                return StabilityLimit(0.0, 0.0, tried, True, "growth at every dt in a part of J, confirmed by runs")
            limit = self.limit_of(spectrum, step, "skip") or tried
        return self.bisected(grows, runs, limit, spectrum.scale)

    def bisected(self, grows: Callable[[float], bool], runs: Runs, guess: float, scale: float) -> StabilityLimit:
        """The limit near a guess, between a dt at which runs decay and one at which they grow."""
        low, high = 0.0, math.inf
        dt, part = guess * (1 - NEAR), 1 + 2 * NEAR
        while not runs.late and high > (low or 1e-9 * guess) * (1 + 2.5 * NEAR):
            if grows(dt):
                high = dt
                dt = math.sqrt(low * high) if low else dt / part
            else:
                low = dt
                dt = dt * part if math.isinf(high) else math.sqrt(low * high)
            if not low or math.isinf(high):
                part = min(part**2, 4.0)
            if not 1e-8 < dt * scale < 1e4:
                break
        between = f"runs of {SEGMENTS * runs.length:,} steps decay at dt={low:.4g} and grow at dt={high:.4g}"
        if low and high <= low * (1 + 2.5 * NEAR) and guess > low / (1 + NEAR):
            limit = guess if guess < high else math.sqrt(low * high)
            return StabilityLimit(limit, low, high, True, between)
        if low:
            reason = (
                f"not known within 2 %: {between}; the value is what a part of the eigenvalues and the runs allow, "
                f"and slower growth than runs of that length show is not excluded"
            )
            return StabilityLimit(min(low, guess), min(low, guess), high, False, reason)
        return StabilityLimit(0.0, 0.0, high, False, f"no stable dt was found: {between}")
