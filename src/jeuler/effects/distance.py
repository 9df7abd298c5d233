"""Rigid links: distances that stay as they are, by a projection at the end of each step."""

from __future__ import annotations

import functools
from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array, lax

from jeuler._core import checks
from jeuler._core.annotations import Parameter, ParticleIndices
from jeuler._core.calls import previous_is_optional
from jeuler._core.component import component, store_as_float
from jeuler._core.components import per_particle
from jeuler._core.limits import check_limits
from jeuler._jax.root import root
from jeuler.graphs.topology import Topology
from jeuler.particles.state import FieldForm
from jeuler.steps._newton import linear_solver_for, newton_then_damped, solve_linear


@component(static=("edges",), positive=("length",))
class DistanceLinks:
    """Links of fixed length between pairs of particles: the rod of a pendulum, an inextensible rope or net.

        x = x* + W G(x_n)^T z  with |x_i - x_j| = L,   v = v* + (x - x*) / dt,   then (v_i - v_j).(x_i - x_j) = 0

    x* and v* are where the step would have gone, G(x_n) the directions of the links before it, W the inverse masses
    (0 of pinned and prescribed particles): SHAKE for the positions, RATTLE for the velocities. Derivatives are those of
    the exact projection, by the implicit function theorem. Of the first order with `symplectic_euler_step`, of the
    second with `rk4_step`. Distances are right at the start of the run too, or the first step makes them so at once.

    A projection that does not converge, as of links that contradict each other, is counted in
    ``state.unresolved_links``, once a step. Links may say the same, as those of a braced square in the plane do.

    Args:
      edges: the two particles of each link, integers (link, 2). Static.
      length: L, () or (link,), m, > 0. Differentiable.
    Returns: called as an effect ``(t, dt, previous, state, key)``, the state with its links at their lengths.
      List it after `PrescribedMotion` and before `Collisions`.
    Raises: ValueError, if edges is not an integer (link, 2) array; in `simulate`, if an index is out of range, or a
      length has another shape or is not above 0.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> rod = jeuler.DistanceLinks([[0, 1]], length=1.0)
      >>> scene = jeuler.Scene((jeuler.Gravity([0.0, -9.81]),), (rod,))
      >>> bob = jeuler.ParticleState([[0.0, 0.0], [1.0, 0.0]], jnp.zeros((2, 2)), mass=[jnp.inf, 1.0])
      >>> run = jeuler.simulate(scene, bob, dt=0.01, num_steps=50, step=jeuler.symplectic_euler_step)
      >>> bool(jnp.allclose(jnp.linalg.norm(run.y.position[:, 1], axis=1), 1.0)), run.y.unresolved_links[-1].item()
      (True, 0)

    Source: J.-P. Ryckaert, G. Ciccotti, H. J. C. Berendsen, J. Comput. Phys. 23, 1977; H. C. Andersen, J. Comput. Phys.
      52, 1983.
    """

    edges: ParticleIndices
    length: Parameter

    needs: ClassVar[tuple[str, ...]] = ("prescribed pinned",)
    limits: ClassVar[dict[str, Any]] = {"length": ("> 0", "m")}
    writes: ClassVar[dict[str, Any]] = {"unresolved_links": FieldForm((), 0, whole=True)}

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", Topology(self.edges))
        store_as_float(self, "length")

    @previous_is_optional
    def __call__(self, t: Any, dt: Any, previous: Any, state: Any, key: Any) -> Any:
        if not len(self.edges):
            return state
        x, dtype = state.position, state.position.dtype
        mobility, here = self._mobility(state)
        length = jnp.broadcast_to(self.length.astype(dtype), here.shape)
        before = self.edges.difference(x if previous is None else previous.position)
        # of the two ends together: z is the share of its length by which a link is pulled in
        share = jnp.where(here, 1 / jnp.where(here, self._ends(mobility), 1), 0)

        def moved(z):
            return x + mobility * self.edges.accumulate((share * z)[:, None] * before, len(x))

        def error(z):
            d = self.edges.difference(moved(z))
            return jnp.where(here, (jnp.sum(d * d, axis=1) / length**2 - 1) / 2, z)

        z = self._solved(error, x)
        resolved = jnp.max(jnp.abs(lax.stop_gradient(error(z)))) <= (1e-10 if dtype == jnp.float64 else 1e-5)
        position = moved(z)
        velocity = state.velocity + (position - x) / dt
        d = self.edges.difference(position)
        velocity = velocity - mobility * self._along(velocity, d, mobility, share, here)
        lost = jnp.where(resolved, 0, 1).astype(jnp.int32)
        return state.replace(position=position, velocity=velocity, unresolved_links=state.unresolved_links + lost)

    def _mobility(self, state: Any) -> tuple[Array, Array]:
        """1 / m of each particle, (particle, 1), and which links can hold anything, (link,)."""
        mass = jnp.broadcast_to(jnp.asarray(state.mass, state.position.dtype), state.position.shape[:1])
        mobility = per_particle(1 / mass)
        here = self._ends(mobility) > 0
        if state.alive is not None:
            here = here & jnp.all(state.alive[self.edges[:]], axis=1)
        return mobility, here

    def _ends(self, mobility: Array) -> Array:
        """1 / m_i + 1 / m_j, (link,)."""
        return mobility[self.edges[:, 0], 0] + mobility[self.edges[:, 1], 0]

    def _solved(self, error: Any, x: Array) -> Array:
        """z with error(z) + bias z = 0: of links that say the same, each takes its part."""
        tolerance, bias = accuracy_of(x)
        guess = jnp.zeros(len(self.edges), x.dtype)
        linear = linear_solver_for(guess, rtol=1e-6, atol=1e-2)
        solve = newton_then_damped(rtol=1e-6, max_steps=20, damped_steps=0, linear_solver=linear)

        def scaled(z):  # in units of the tolerance
            return error(z * tolerance) / tolerance + bias * z

        return root(scaled, guess, solve, functools.partial(solve_linear, solver=None))[0] * tolerance

    def _along(self, velocity: Array, d: Array, mobility: Array, share: Array, here: Array) -> Array:
        """What takes the links' rates of change out of the velocities, (particle, dim), before the mobility."""
        square = jnp.sum(d * d, axis=1)

        def rate(velocity):
            return jnp.sum(self.edges.difference(velocity) * d, axis=1) / jnp.where(here, square, 1)

        def pull(z):
            return self.edges.accumulate((share * z)[:, None] * d, len(velocity))

        def matvec(z):
            return jnp.where(here, rate(mobility * pull(z)), z) + accuracy_of(velocity)[1] * z

        return pull(solve_linear(matvec, jnp.where(here, rate(velocity), 0), solver=None))

    def check(self, particles: int, dim: int) -> None:
        self.edges.check(particles)
        checks.shape("DistanceLinks.length", self.length.shape, (), (len(self.edges),), meaning="one a link")
        check_limits(self)


def accuracy_of(x: Array) -> tuple[float, float]:
    """Strain that counts as none, and a bias of the equations that is below it for the small corrections of a step."""
    return (1e-13, 1e-10) if x.dtype == jnp.float64 else (1e-6, 1e-5)
