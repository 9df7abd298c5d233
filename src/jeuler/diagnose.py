"""What went wrong in a run whose value or gradient is not finite. Its cost is paid only when it is called."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jeuler import _tree
from jeuler.declare import completed, declared
from jeuler.forces import Springs
from jeuler.methods import Step, euler_step
from jeuler.particles import ParticleState, Scene, simulate
from jeuler.solve import Solution
from jeuler.stability import stability_limit


@dataclasses.dataclass(frozen=True)
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

    def __str__(self) -> str:
        if self.finite:
            return "every value and gradient that was looked at is finite"
        where = "" if self.step is None else f" in step {self.step}"
        who = "".join(
            f", {name}{'s' * (len(some) > 1)} {', '.join(map(str, some[:5]))}{' ...' if len(some) > 5 else ''}"
            for name, some in (("particle", self.particles), ("spring", self.springs))
            if some
        )
        return f"the {self.quantity} is lost{where}, {self.part}{who}: {self.cause}; {self.remedy}"


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
      the value is lost in step ...: dt = 0.5 s is 50 times the stability limit 0.01 s of euler_step; ...

    Source: A. Witkin, D. Baraff, Physically Based Modeling, SIGGRAPH course notes, 1997, sect. 3.
    """
    state = completed(state, scene.forces, scene.effects)
    run = _Run(scene, state, float(dt), float(t0), step, key)
    return run.lost_value(num_steps) or (run.lost_gradient(num_steps, loss) if loss else None) or Diagnosis(True)


@dataclasses.dataclass(frozen=True)
class _Run:
    scene: Scene
    state: ParticleState
    dt: float
    t0: float
    step: Step
    key: jax.Array | None

    def solution(self, num_steps: int, save_every: int | None = None) -> Solution:
        return simulate(
            self.scene,
            self.state,
            dt=self.dt,
            num_steps=num_steps,
            t0=self.t0,
            step=self.step,
            key=self.key,
            save_every=save_every or max(num_steps, 1),
        )

    def parts_of_step(self, scene: Scene, n: Any, before: ParticleState) -> Iterator[tuple[str, ParticleState]]:
        """The state after the step function and after each effect of step n, with the name of what was applied."""
        dtype = before.position.dtype
        dt, t = jnp.asarray(self.dt, dtype), jnp.asarray(self.t0 + (n - 1) * self.dt, dtype)

        def effects(now: Any, before: ParticleState, state: ParticleState, early: bool) -> Iterator:
            for k, effect in enumerate(scene.effects):
                if declared(effect, "before_motion", False) == early:
                    own_key = None if self.key is None else jax.random.fold_in(jax.random.fold_in(self.key, n - 1), k)
                    if hasattr(effect, "over_step"):
                        state = effect.over_step(now, dt, before, state, own_key)
                    else:
                        state = effect(now, dt, state, own_key)
                    yield f"effects[{k}] {_name(effect)}", state

        for part, state in effects(t, before, before, early=True):
            yield part, state
            before = state
        motion = before.position, before.velocity
        x, v = self.step(scene.vector_field, t, motion, dt, scene.attributes(before))
        moved = _tree.replace(before, position=x, velocity=v)
        yield _name(self.step), moved
        yield from effects(t + dt, before, moved, early=False)

    def lost_value(self, num_steps: int) -> Diagnosis | None:
        for name, tree in (("state", self.state), ("scene", self.scene)):
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
                field = name + jax.tree_util.keystr(path)
                may_be_inf = field in ("state.mass", "state.lifetime")
                bad = np.isnan(leaf) if may_be_inf else ~np.isfinite(leaf)
                if bad.any():
                    who = np.unique(np.argwhere(bad)[:, 0]).tolist() if name == "state" and bad.ndim else ()
                    cause = f"it is {np.asarray(leaf)[bad].ravel()[0]} before the first step"
                    return Diagnosis(
                        False, "value", 0, field, tuple(who), cause=cause, remedy="start from finite numbers"
                    )
        lost = int(self.solution(num_steps).first_nonfinite)
        return None if lost < 0 else self.inside_step(lost)

    def inside_step(self, n: int) -> Diagnosis:
        """Which part of step n made the first number that is not finite, from the finite state before it."""
        before = jax.tree.map(lambda x: x[-1], self.solution(n - 1).y)
        t = self.t0 + (n - 1) * self.dt
        x, v, mass = before.position, before.velocity, before.mass
        for k, force in enumerate(self.scene.forces):
            own = {name: getattr(before, name) for name in declared(force, "reads")}
            bad = _particles(force(t, x, v, mass, **own))
            if bad:
                part = f"forces[{k}] {_name(force)}"
                return self.explain("value", n, part, bad, before, _springs(force, before, bad))
        attributes = self.scene.attributes(before)
        bad = _particles(self.scene.vector_field(t, (x, v), attributes)[1])
        if bad and float(jnp.max(jnp.abs(x))) < self.huge():
            light = np.broadcast_to(mass, len(x))[bad[0]]
            return Diagnosis(
                False,
                "value",
                n,
                "acceleration",
                bad,
                cause=f"force / mass overflows {x.dtype}: the mass is {light:.3g} kg",
                remedy="raise the mass, or pin the particle with mass = inf, or use float64",
            )
        for part, after in self.parts_of_step(self.scene, n, before):
            bad = _particles(after.position, after.velocity)
            if bad and part == _name(self.step) and hasattr(self.step, "with_info"):
                dt = jnp.asarray(self.dt, x.dtype)
                _, info = self.step.with_info(self.scene.vector_field, t, (x, v), dt, attributes)
                return Diagnosis(
                    False,
                    "value",
                    n,
                    part,
                    bad,
                    cause=f"Newton's method did not converge in {int(info.iterations)} iterations",
                    remedy="take a smaller dt, or implicit_euler(max_steps=..., rtol=...)",
                )
            if bad:
                return self.explain("value", n, part, bad, before)
        return self.explain("value", n, _name(self.step), (), before)

    def lost_gradient(self, num_steps: int, loss: Callable) -> Diagnosis | None:
        """Follow the cotangent of the loss back, step by step, to the first that is not finite."""
        states = self.solution(num_steps, save_every=1).y

        def after(scene, motion, n, before):
            before = dataclasses.replace(before, position=motion[0], velocity=motion[1])
            *_, (_, state) = self.parts_of_step(scene, n, before)
            return state.position, state.velocity

        @jax.jit
        def pull_back(n, before, cotangent):
            motion = before.position, before.velocity
            _, pullback = jax.vjp(lambda scene, motion: after(scene, motion, n, before), self.scene, motion)
            return pullback(cotangent)

        last = jax.tree.map(lambda x: x[-1], states)
        motion = last.position, last.velocity
        cotangent = jax.grad(lambda m: loss(dataclasses.replace(last, position=m[0], velocity=m[1])))(motion)
        bad = _particles(*cotangent)
        if bad:
            cause = "its derivative at the last state is not finite"
            remedy = "look at roots and norms of zero in the loss; write them with a double jnp.where"
            return Diagnosis(False, "gradient", num_steps, "loss", bad, cause=cause, remedy=remedy)
        for n in range(num_steps, 0, -1):
            before = jax.tree.map(lambda x, n=n: x[n - 1], states)
            of_scene, pulled = pull_back(n, before, cotangent)
            bad = _particles(*pulled)
            if bad or not bool(_tree.all_finite(of_scene)):
                return self.lost_in_step(n, before, cotangent, bad)
            cotangent = pulled
        return None

    def lost_in_step(self, n: int, before: ParticleState, cotangent: Any, bad: tuple[int, ...]) -> Diagnosis:
        """Which part of step n made the cotangent not finite."""
        t = self.t0 + (n - 1) * self.dt
        x, v, mass = before.position, before.velocity, before.mass
        for k, force in enumerate(self.scene.forces):
            own = {name: getattr(before, name) for name in declared(force, "reads")}
            value, pullback = jax.vjp(lambda force, x, v, own=own: force(t, x, v, mass, **own), force, x, v)
            of_force, *of_motion = pullback(jnp.ones_like(value))
            who = _particles(*of_motion)
            if who or not bool(_tree.all_finite(of_force)):
                part, springs = f"forces[{k}] {_name(force)}", _springs(force, before, who)
                return self.explain("gradient", n, part, who, before, springs)
        if float(_largest(cotangent)) > np.sqrt(self.huge()):
            limit = self.limit()
            over = "" if not limit < self.dt else f"; dt is over the stability limit, {limit:.3g} s"
            return Diagnosis(
                False,
                "gradient",
                n,
                _name(self.step),
                bad,
                cause=f"the cotangent grew to {float(_largest(cotangent)):.3g} on its way back{over}",
                remedy="take a shorter horizon or a smaller dt, or cap_cotangent(step, max_norm)",
            )
        parts = [f"effects[{k}] {_name(effect)}" for k, effect in enumerate(self.scene.effects)]
        return self.explain("gradient", n, " or ".join([_name(self.step), *parts]), bad, before)

    def explain(
        self, quantity: str, n: int, part: str, bad: tuple[int, ...], before: ParticleState, springs: Any = ()
    ) -> Diagnosis:
        """Why a part gave what is not finite from finite numbers: the step size, their size, or itself."""
        reached, dtype = _largest((before.position, before.velocity)), before.position.dtype
        grown = reached > 1e3 * max(1.0, _largest((self.state.position, self.state.velocity)))
        limit = self.limit() if grown else np.inf
        if limit < self.dt:
            times = "dt" if limit == 0 else f"{self.dt / limit:.3g} times the stability limit {limit:.3g} s"
            cause = f"dt = {self.dt:.3g} s is {times} of {_name(self.step)}"
            remedy = f"take dt < {limit:.3g} s, or implicit_euler_step"
            if limit == 0:
                cause = f"no dt is stable for {_name(self.step)} here, the numbers grew to {reached:.3g}"
                remedy = "add damping, or take symplectic_euler_step"
        elif grown:
            cause = f"the numbers grew to {reached:.3g} and overflow {dtype}"
            remedy = "take smaller forces or steps" + (", or float64" if dtype == jnp.float32 else "")
        else:
            derivative = "derivative" if quantity == "gradient" else "value"
            pairs = _coincident(before.position, bad)
            cause = f"its {derivative} is not finite at finite positions and velocities{pairs}"
            remedy = "look at what it divides by and takes roots of"
            if pairs:
                remedy = "move them apart, or write lengths with a double jnp.where, as Springs does"
        return Diagnosis(False, quantity, n, part, bad, springs, cause, remedy)

    def limit(self) -> float:
        """The stability limit at the initial state; inf where it cannot be found."""
        motion = self.state.position, self.state.velocity
        try:
            attributes = self.scene.attributes(self.state)
            return stability_limit(self.scene.vector_field, self.t0, motion, attributes, step=self.step)
        except ValueError:
            return np.inf

    def huge(self) -> float:
        return float(jnp.finfo(self.state.position.dtype).max) ** 0.75


def _name(part: Any) -> str:
    part = getattr(part, "function", part)
    return getattr(part, "__name__", type(part).__name__)


def _particles(*arrays: jax.Array) -> tuple[int, ...]:
    """The particles with a number that is not finite, in arrays (particle, dim)."""
    bad = np.any([~np.isfinite(np.asarray(x)).all(axis=-1) for x in arrays], axis=0)
    return tuple(np.flatnonzero(bad).tolist())


def _springs(force: Any, state: ParticleState, bad: tuple[int, ...]) -> tuple[int, ...]:
    """The springs between two particles whose force is not finite; the longest first."""
    if not isinstance(force, Springs):
        return ()
    edges, x = np.asarray(force.edges), np.asarray(state.position, np.float64)
    touched = np.flatnonzero(np.isin(edges, bad).all(axis=1))
    with np.errstate(over="ignore"):
        length = np.linalg.norm(x[edges[touched, 0]] - x[edges[touched, 1]], axis=-1)
    return tuple(touched[np.argsort(-length, kind="stable")].tolist())


def _coincident(position: jax.Array, among: tuple[int, ...]) -> str:
    """Words for the first two of these particles that are at one place."""
    x = np.asarray(position)
    for a in among:
        same = [b for b in range(len(x)) if b != a and (x[b] == x[a]).all()]
        if same:
            return f", where particles {min(a, same[0])} and {max(a, same[0])} coincide"
    return ""


def _largest(y: Any) -> float:
    with np.errstate(over="ignore"):
        return float(max(np.max(np.abs(np.asarray(leaf, np.float64)), initial=0) for leaf in jax.tree.leaves(y)))
