"""The methods that advise_method compares, each as one program: of the number of steps, or of tolerances."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler._core.precision import double_precision
from jeuler.accuracy.method import has_diffrax, is_diffrax
from jeuler.accuracy.runs import by_diffrax
from jeuler.solving._adaptive import solve_adaptive
from jeuler.solving._scan import solve, solve_to
from jeuler.steps.explicit import (
    VectorField,
    euler_step,
    heun_step,
    rk4_step,
    symplectic_euler_step,
)
from jeuler.steps.extrapolated import extrapolated_euler
from jeuler.steps.implicit import implicit_euler_step, linearly_implicit_euler_step
from jeuler.steps.midpoint import implicit_midpoint_step

PyTree = Any
MOST_STEPS, MOST_IMPLICIT_STEPS = 65_536, 16_384  # of an adaptive run
LEAST_STEPS, WORK = 4096, 2**28  # of one of a large system: numbers advanced


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A method under its name.

    Attributes:
      name: in the table.
      step: a step or a diffrax solver; None for the default of `solve_adaptive`.
      adaptive: whether its steps are chosen by a tolerance.
      code: how the step is written.
    """

    name: str
    step: Any
    adaptive: bool
    code: str

    @property
    def order(self) -> int:
        if is_diffrax(self.step):
            return int(self.step.order(None) or 1)
        return int(getattr(self.step, "order", 1))

    @property
    def program_size(self) -> float:
        """About its compile time over that of an explicit adaptive run, if it solves equations; 0 if it does not."""
        if is_diffrax(self.step):
            import diffrax

            return 6.0 if isinstance(self.step, diffrax.AbstractImplicitSolver) else 0.0
        base = getattr(self.step, "base", self.step or euler_step)
        return 0.0 if hasattr(base, "increment") else 2.0


def default_candidates(f: VectorField, y0: PyTree, t0: float, args: PyTree) -> list[Candidate]:
    """All steps of the library and four solvers of diffrax, those first that are most likely to be fast."""
    found = [explicit_reference()]
    found += [Candidate("rk4_step", rk4_step, False, "jeuler.rk4_step")]
    found += [Candidate("heun_step", heun_step, False, "jeuler.heun_step")]
    if is_motion(f, y0, t0, args):
        name = "symplectic_euler_step"
        found += [Candidate(name, symplectic_euler_step, False, f"jeuler.{name}")]
    found += [Candidate("euler_step", euler_step, False, "jeuler.euler_step")]
    for order in (4, 8):
        name = f"extrapolated_euler({order})"
        found += [Candidate(name, extrapolated_euler(order), False, f"jeuler.{name}")]
    if has_diffrax():
        import diffrax

        for solver in (diffrax.Tsit5(), diffrax.Heun(), diffrax.Euler(), diffrax.Kvaerno5()):
            name = f"diffrax.{type(solver).__name__}"
            adaptive = isinstance(solver, diffrax.AbstractAdaptiveSolver)
            found += [Candidate(name, solver, adaptive, f"{name}()")]
    found.append(stiff_reference())
    for step in (linearly_implicit_euler_step, implicit_midpoint_step, implicit_euler_step):
        name = step.__name__
        found += [Candidate(name, step, False, f"jeuler.{name}")]
    return found


def given_candidates(methods: Mapping[str, Any]) -> list[Candidate]:
    """Methods of the user's own, a diffrax solver by its tolerance where it has an error estimate."""

    def adaptive(method: Any) -> bool:
        if not is_diffrax(method):
            return method is None
        import diffrax

        return isinstance(method, diffrax.AbstractAdaptiveSolver)

    return [
        Candidate(name, method, adaptive(method), f"methods[{name!r}]" if method else "")
        for name, method in methods.items()
    ]


def is_motion(f: VectorField, y0: PyTree, t0: float, args: PyTree) -> bool:
    """Whether y is a pair (position, velocity), the slope of position being the velocity: seen at two states.

    What does not move, as a pinned particle, may have a slope of 0 there.
    """
    parts, pair = trees.parts(y0)
    forms = [[leaf.shape for leaf in jax.tree.leaves(part)] for part in parts]
    if len(forms) != 2 or forms[0] != forms[1]:
        return False
    with double_precision():
        for factor in (0.9, 0.7):
            velocity = jax.tree.map(lambda leaf, factor=factor: factor * leaf + (1 - factor), parts[1])
            slope = pair.flatten_up_to(f(t0, pair.unflatten((parts[0], velocity)), args))[0]
            rows = zip(*(jax.tree.leaves(x) for x in (slope, velocity, parts[1])), strict=True)
            alike = [np.isclose(a, b, rtol=1e-5) | ((a == 0) & (at_start == 0)) for a, b, at_start in rows]
            if not all(np.all(each) for each in alike) or not any(np.any(leaf) for leaf in jax.tree.leaves(slope)):
                return False
    return True


@dataclasses.dataclass(frozen=True)
class Problem:
    """y' = f(t, y, args) from y0 at t0 to t1."""

    f: VectorField
    y0: PyTree
    t0: float
    t1: float
    args: PyTree
    breaks: tuple[float, ...]

    @property
    def inner_breaks(self) -> tuple[float, ...]:
        """The breaks between t0 and t1."""
        return tuple(t for t in self.breaks if self.t0 < t < self.t1)

    def without_values(self) -> Problem:
        """The equation alone, which is what a program is made of; it gets y0 and args when it runs."""
        return dataclasses.replace(self, y0=None, args=None)

    def max_steps(self, candidate: Candidate) -> int:
        """Most steps of an adaptive run."""
        size = sum(leaf.size for leaf in jax.tree.leaves(self.y0))
        most = MOST_IMPLICIT_STEPS if candidate.program_size else MOST_STEPS
        return min(most, max(LEAST_STEPS, WORK // max(1, size)))


def program(candidate: Candidate, problem: Problem) -> Any:
    """``(y0, args, t0, t1, setting) -> (y at t1, steps taken)``, NaN where it was lost or took too many steps.

    setting: the number of steps, or the pair (rtol, atol).
    """
    most, problem = problem.max_steps(candidate), problem.without_values()
    if candidate.adaptive:
        return _adaptive(candidate, problem, most)
    return _diffrax_fixed(candidate, problem) if is_diffrax(candidate.step) else _fixed(candidate, problem)


def _fixed(candidate: Candidate, problem: Problem) -> Any:
    def run(y0, args, t0, t1, num_steps):
        states, _ = solve_to(
            problem.f,
            y0,
            dt=(t1 - t0) / num_steps.astype(t0.dtype),
            ends=num_steps[None],
            t0=t0,
            args=args,
            step=candidate.step,
            compensated=False,
            breaks=problem.breaks,
        )
        return jax.tree.map(lambda leaf: leaf[-1], states), num_steps

    return run


def written_out(candidate: Candidate, problem: Problem, num_steps: int) -> Any:
    """``(y0, args, t0, t1) -> result`` by `solve` for one number of steps, with dt as a constant of the program.

    As a user writes it: XLA may compile that to a program of another speed.
    """
    problem = problem.without_values()

    def run(y0, args, t0, t1):
        found = solve(
            problem.f,
            y0,
            dt=(problem.t1 - problem.t0) / num_steps,
            num_steps=num_steps,
            t0=problem.t0,
            args=args,
            step=candidate.step,
            save_every=num_steps,
            breaks=problem.breaks,
        )
        return jax.tree.map(lambda leaf: leaf[-1], found.y), found.first_nonfinite

    return run


def _diffrax_fixed(candidate: Candidate, problem: Problem) -> Any:
    import diffrax

    def run(y0, args, t0, t1, num_steps):
        dt = (t1 - t0) / num_steps.astype(t0.dtype)
        equal = diffrax.ConstantStepSize()
        return _solved(candidate, problem, y0, args, t0, t1, dt, equal, None)

    return run


def _adaptive(candidate: Candidate, problem: Problem, most: int) -> Any:
    if is_diffrax(candidate.step):
        import diffrax

        def run(y0, args, t0, t1, tolerances):
            controller = diffrax.PIDController(rtol=tolerances[0], atol=tolerances[1])
            if problem.inner_breaks:
                jumps = jnp.asarray(problem.inner_breaks, t0.dtype)
                controller = diffrax.ClipStepSizeController(controller, jump_ts=jumps)
            return _solved(candidate, problem, y0, args, t0, t1, None, controller, most)

        return run

    def run_ours(y0, args, t0, t1, tolerances):
        rtol, atol = tolerances
        taken = solve_adaptive(
            problem.f,
            y0,
            t0=t0,
            t1=t1,
            args=args,
            step=candidate.step,
            rtol=rtol,
            atol=atol,
            max_steps=most,
            breaks=problem.breaks,
        )
        return jax.tree.map(lambda leaf: leaf[-1], taken.y), taken.num_steps + taken.num_rejected

    return run_ours


def _solved(candidate, problem, y0, args, t0, t1, dt0, controller, most):
    states, failed, num_steps = by_diffrax(problem.f, y0, args, candidate.step, t0, t1, dt0, controller, most)
    return jax.tree.map(lambda leaf: jnp.where(failed < 0, leaf[-1], jnp.nan), states), num_steps


def explicit_reference() -> Candidate:
    """`solve_adaptive` as it is, or where diffrax, which has the coefficients, is not installed, by extrapolation."""
    if has_diffrax():
        return Candidate("solve_adaptive", None, True, "")
    return Candidate("solve_adaptive", extrapolated_euler(6), True, "jeuler.extrapolated_euler(6)")


def stiff_reference() -> Candidate:
    """`solve_adaptive` by an extrapolated linearly implicit step, for stiff equations."""
    step, base = extrapolated_euler(6, step=linearly_implicit_euler_step), "jeuler.linearly_implicit_euler_step"
    return Candidate("solve_adaptive, linearly implicit", step, True, f"jeuler.extrapolated_euler(6, step={base})")
