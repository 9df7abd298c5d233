"""What went wrong in a run whose value or gradient is not finite. Its cost is paid only when it is called."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler._core import trees
from jeuler._core.arguments import says_what_to_write
from jeuler._core.component import result
from jeuler.diagnosis.rerun import GROWN, Rerun, coincident, compiled, largest, nonfinite_particles, springs_among
from jeuler.particles._simulate import check_kinds
from jeuler.particles.fields import declared, name_of
from jeuler.particles.scene import Scene
from jeuler.particles.state import ParticleState
from jeuler.steps.explicit import Step, euler_step


@result
class Diagnosis:
    """Where a run stopped being finite, and why.

    Attributes:
      finite: whether everything that was looked at is finite; the rest is then empty.
      quantity: "value" or "gradient".
      step: 1-based number of the step; 0 is the initial state; None where there is none.
      part: the force, effect, step, state field or parameter, such as "forces[1] Springs".
      particles: indices of the particles concerned.
      springs: indices of the springs concerned, where the part is a force of springs.
      cause: the likely cause, in words.
      remedy: what to do.
    Example:
      >>> import jeuler
      >>> found = jeuler.Diagnosis(False, step=3, part="forces[0] Springs", springs=(4,), cause="it blew up",
      ...     remedy="take a smaller dt")
      >>> found.finite, found.springs, print(jeuler.Diagnosis(finite=True))
      every value and gradient that was looked at is finite
      (False, (4,), None)
    """

    finite: bool
    quantity: str = "value"
    step: int | None = None
    part: str = ""
    particles: tuple[int, ...] = ()
    springs: tuple[int, ...] = ()
    cause: str = ""
    remedy: str = ""

    def _repr_html_(self) -> str:
        return f"<div><b>Diagnosis</b>: {html.escape(str(self))}</div>"

    def __str__(self) -> str:
        if self.finite:
            return "every value and gradient that was looked at is finite"
        where = "" if self.step is None else f" in step {self.step}"
        who = "".join(
            f", {name}{'s' * (len(some) > 1)} {', '.join(map(str, some[:5]))}{' ...' if len(some) > 5 else ''}"
            for name, some in (("particle", self.particles), ("spring", self.springs))
            if some
        )
        return f"the {self.quantity} stops being finite{where}, {self.part}{who}: {self.cause}; {self.remedy}"


@says_what_to_write()
def diagnose(
    scene: Scene,
    state: ParticleState,
    *,
    dt: float,
    num_steps: int,
    t0: float = 0.0,
    step: Step = euler_step,
    key: jax.Array | None = None,
    loss: Callable[[ParticleState], jax.Array] | None = None,
) -> Diagnosis:
    """Find where a run loses its finite values, or the gradient of a loss of its last state, and the likely cause.

    Takes the arguments of the run. It runs again up to the step that failed, then looks at each force and effect of
    that step by itself.

    Args:
      scene: forces and effects, as in `simulate`.
      state: initial state, as in `simulate`.
      dt: step size, s.
      num_steps: number of steps.
      t0: initial time, s.
      step: the method, as in `simulate`.
      key: the key of the run, as in `simulate`.
      loss: a scalar of the last state, ``loss(state) -> ()``; given, its gradient is followed back step by step.
    Returns: `Diagnosis`; print it.
    Raises: ValueError, as `simulate` does.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> scene = jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks=100.0, kd=1.0, rest_length=1.0),))
      >>> state = jeuler.ParticleState(jnp.array([[0.0], [1.1]]), jnp.zeros((2, 1)))
      >>> print(jeuler.diagnose(scene, state, dt=0.5, num_steps=1000))
      the value stops being finite in step ...: dt = 0.5 s is 50 times the stability limit 0.01 s of euler_step; ...
    """
    check_kinds(scene, state)
    for name, tree in (("state", state), ("scene", scene)):
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
            field = name + jax.tree_util.keystr(path)
            must_be_finite = field in ("state.position", "state.velocity")  # elsewhere inf may have a meaning
            found = before_the_run(field, leaf, ~np.isfinite(leaf) if must_be_finite else np.isnan(leaf))
            if found:
                return found
    run = Rerun.of(scene, state, num_steps, dt=dt, t0=t0, step=step, key=key)
    return (
        find_in_value(run, num_steps) or (find_in_gradient(run, num_steps, loss) if loss else None) or Diagnosis(True)
    )


def find_in_value(run: Rerun, num_steps: int) -> Diagnosis | None:
    """The first step whose result is not finite, and what in it, or None."""
    n = int(run.solution(num_steps).first_nonfinite)
    return None if n < 0 else inside_step(run, n)


def before_the_run(field: str, leaf: Any, bad: np.ndarray) -> Diagnosis | None:
    """A number of the state or the scene that no run can use."""
    if not bad.any():
        return None
    who = np.unique(np.argwhere(bad)[:, 0]).tolist() if field.startswith("state") and bad.ndim else ()
    cause = f"it is {np.asarray(leaf)[bad].ravel()[0]} before the first step"
    return Diagnosis(False, "value", 0, field, tuple(who), cause=cause, remedy="start from finite numbers")


def inside_step(run: Rerun, n: int) -> Diagnosis:
    """Which part of step n made the first number that is not finite, from the finite state before it."""
    start = before = run.before(n)
    for part, after in run.parts_of_step(n, start):
        if part == name_of(run.step):
            found = inside_motion(run, n, before)
            if found:
                return found
        bad = nonfinite_particles(after.alive, after.position, after.velocity)
        if bad:
            return explain(run, "value", n, part, bad, start)
        before = after
    return explain(run, "value", n, name_of(run.step), (), start)


def inside_motion(run: Rerun, n: int, before: ParticleState) -> Diagnosis | None:
    """Which force, or what else in the motion of step n, is not finite, from the state that it starts from."""
    t, alive = run.time(n), before.alive
    for effect, t_of_path in run.nonfinite_paths(n, before):
        cause = f"the motion that it prescribes is not finite at t = {t_of_path:.6g} s"
        return Diagnosis(False, "value", n, effect, cause=cause, remedy="look at what its path divides by and takes")
    for t_of_stage, stage in run.stages(n, before):
        for part, force in run.shares(t_of_stage, stage):
            bad = nonfinite_particles(alive, force)
            if bad:
                return explain_force(run, n, part, bad, stage)
    motion, attributes = (before.position, before.velocity), run.scene.attributes(before)
    bad = nonfinite_particles(alive, run.of_one.equation.vector_field(t, motion, attributes)[1])
    if bad and largest(before.position) < run.huge():
        light = np.broadcast_to(before.mass, len(before.position))[bad[0]]
        cause = f"force / mass overflows {before.position.dtype}: the mass is {light:.3g} kg"
        remedy = "raise the mass, or pin the particle with mass = inf, or use float64"
        return Diagnosis(False, "value", n, "acceleration", bad, cause=cause, remedy=remedy)
    if hasattr(run.step, "with_info"):
        equation, dt = run.of_one.equation, run.of_one.grid.dt
        after, info = run.step.with_info(equation.vector_field, t, motion, dt, attributes)
        bad = nonfinite_particles(alive, *after)
        if bad:
            cause = f"its equation was not solved in {int(info.iterations)} iterations"
            remedy = "take a smaller dt, or implicit_euler(max_steps=..., damped_steps=..., rtol=...)"
            return Diagnosis(False, "value", n, name_of(run.step), bad, cause=cause, remedy=remedy)
    return None


def explain_force(run: Rerun, n: int, part: str, bad: tuple[int, ...], at: ParticleState) -> Diagnosis:
    """Why a force is not finite: a number in it, a field that it reads, or what it makes of them."""
    k = index_of(part)
    force = run.scene.forces[k]
    for path, leaf in jax.tree_util.tree_leaves_with_path(force):
        found = before_the_run(f"scene.forces[{k}]{jax.tree_util.keystr(path)}", leaf, ~np.isfinite(leaf))
        if found:
            return found
    for field in declared(force, "reads"):
        value = np.asarray(getattr(at, field))
        if np.issubdtype(value.dtype, np.floating) and np.isnan(value).any():
            writers = [e for e in run.scene.effects if field in (*declared(e, "writes"), *declared(e, "sets"))]
            by = f", as {' or '.join(map(name_of, writers))} left it" if writers else ""
            cause, remedy = f"the field {field!r}, which it reads, is NaN{by}", f"look at what changes {field!r}"
            return Diagnosis(False, "value", n, part, bad, cause=cause, remedy=remedy)
    return explain(run, "value", n, part, bad, at, springs_among(force, at, bad))


def find_in_gradient(run: Rerun, num_steps: int, loss: Callable[..., Any]) -> Diagnosis | None:
    """Follow the cotangent of the loss back, step by step, to the first that is not finite."""
    states = run.solution(num_steps, save_every=1).y

    def after(scene, motion, n, before):
        before = dataclasses.replace(before, position=motion[0], velocity=motion[1])
        *_, (_, state) = run.with_scene(scene).parts_of_step(n, before)
        return state.position, state.velocity

    def pull_back(n, before, cotangent):
        motion = before.position, before.velocity
        _, pullback = jax.vjp(lambda scene, motion: after(scene, motion, n, before), run.scene, motion)
        return pullback(cotangent)

    last = jax.tree.map(lambda x: x[-1], states)
    motion = last.position, last.velocity
    cotangent = jax.grad(lambda m: loss(dataclasses.replace(last, position=m[0], velocity=m[1])))(motion)
    bad = nonfinite_particles(None, *cotangent)
    if bad:
        cause = "its derivative at the last state is not finite"
        remedy = "look at roots and norms of zero in the loss; write them with a double jnp.where"
        return Diagnosis(False, "gradient", num_steps, "loss", bad, cause=cause, remedy=remedy)
    program = compiled(pull_back)
    for n in range(num_steps, 0, -1):
        before = jax.tree.map(lambda x, n=n: x[n - 1], states)
        of_scene, pulled = program(jnp.int32(n), before, cotangent)
        bad = nonfinite_particles(None, *pulled)
        if bad or not bool(trees.all_finite(of_scene)):
            return gradient_in_step(run, n, before, cotangent, bad)
        cotangent = pulled
    return None


def gradient_in_step(run: Rerun, n: int, before: ParticleState, cotangent: Any, bad: tuple[int, ...]) -> Diagnosis:
    """Which part of step n made the cotangent not finite."""
    before = run.before_motion(n, before)
    t, motion = run.time(n), (before.position, before.velocity)

    def force(scene, x, v, k):
        moved = dataclasses.replace(before, position=x, velocity=v)
        return dict(run.with_scene(scene).shares(t, moved))[k]

    for part, _ in run.shares(t, before):
        k = index_of(part)
        value, pullback = jax.vjp(lambda scene, x, v, part=part: force(scene, x, v, part), run.scene, *motion)
        of_scene, *of_motion = pullback(jnp.ones_like(value))
        who = nonfinite_particles(before.alive, *of_motion)
        if who or not bool(trees.all_finite(of_scene.forces[k])):
            springs = springs_among(run.scene.forces[k], before, who)
            return explain(run, "gradient", n, part, who, before, springs)
    if largest(cotangent) > np.sqrt(run.huge()):
        limit = run.stability_limit(n)
        over = "" if not limit < run.dt else f"; dt is over the stability limit, {limit:.3g} s"
        cause = f"the cotangent grew to {largest(cotangent):.3g} on its way back{over}"
        remedy = "take a shorter horizon or a smaller dt, or cap_cotangent(step, max_norm)"
        return Diagnosis(False, "gradient", n, name_of(run.step), bad, cause=cause, remedy=remedy)
    parts = [f"effects[{k}] {name_of(effect)}" for k, effect in enumerate(run.scene.effects)]
    return explain(run, "gradient", n, " or ".join([name_of(run.step), *parts]), bad, before)


def index_of(part: str) -> int:
    """The index of a force in its scene, from a name such as "forces[1] Springs"."""
    return int(part[part.index("[") + 1 : part.index("]")])


def explain(
    run: Rerun,
    quantity: str,
    n: int,
    part: str,
    bad: tuple[int, ...],
    before: ParticleState,
    springs: tuple[int, ...] = (),
) -> Diagnosis:
    """Why a part gave what is not finite from finite numbers: the step size, their size, or itself."""
    reached, dtype = largest((before.position, before.velocity)), before.position.dtype
    grown = reached > GROWN * max(1.0, largest((run.state.position, run.state.velocity)))
    limit = run.stability_limit(n) if grown else np.inf
    if limit < run.dt:
        times = "dt" if limit == 0 else f"{run.dt / limit:.3g} times the stability limit {limit:.3g} s"
        cause = f"dt = {run.dt:.3g} s is {times} of {name_of(run.step)}"
        remedy = f"take dt < {limit:.3g} s, or implicit_euler_step"
        if limit == 0:
            cause = f"no dt is stable for {name_of(run.step)} here, the numbers grew to {reached:.3g}"
            remedy = "add damping, or take symplectic_euler_step"
    elif grown:
        cause = f"the numbers grew to {reached:.3g} and overflow {dtype}"
        remedy = "take smaller forces or steps" + (", or float64" if dtype == jnp.float32 else "")
    else:
        derivative = "derivative" if quantity == "gradient" else "value"
        pairs = coincident(before.position, bad)
        cause = f"its {derivative} is not finite at finite positions and velocities{pairs}"
        remedy = "look at what it divides by and takes roots of"
        if pairs:
            remedy = "move them apart, or write lengths with a double jnp.where, as Springs does"
    return Diagnosis(False, quantity, n, part, bad, springs, cause, remedy)
