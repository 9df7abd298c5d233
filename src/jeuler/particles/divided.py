"""One scene over the devices of a mesh: each has a strip of the particles, and ghosts of those that act on them.

    device p:   own particles   ghosts from p - 1   ghosts from p + 1

Each device computes every spring, or other group, that holds one of its particles, so that positions and velocities
of ghosts are all that is sent, once in each evaluation of the forces, by ``lax.ppermute``. The rest is `simulate` as it
always is, of a scene that has the device's own particles.
"""

from __future__ import annotations

from typing import Any

import jax
from jax.sharding import Mesh

from jeuler._core import checks
from jeuler._core.component import result
from jeuler._core.in_time import at_time
from jeuler.contact.collisions import Collisions
from jeuler.graphs.partition import Partition, partition
from jeuler.particles.fields import name_of
from jeuler.particles.scene import Scene
from jeuler.particles.state import DEFAULTS, ParticleState
from jeuler.particles.strips import ALONE, COUNTED, ON_GROUPS, ON_PATHS, acts_alone, groups_of, numbers_of


@result
class Division:
    """How a scene is divided over devices, and what they send to each other.

    Attributes:
      devices: their number, one strip each.
      particles: of a strip; the last one is filled up with pinned ones.
      ghosts: the most particles of other strips that a strip has copies of.
      messages: from one device to another, in one evaluation of the forces.
      bytes_sent: by all devices together in one evaluation of the forces: position and velocity of each ghost. A step
        of Euler's method takes one evaluation, of Heun's two, of RK4 four.
    Example:
      >>> import jax, jax.numpy as jnp, jeuler
      >>> chain = jeuler.Springs([[n, n + 1] for n in range(99)], ks=10.0, kd=0.1, rest_length=0.1)
      >>> state = jeuler.ParticleState(jnp.arange(200.0).reshape(100, 2), jnp.zeros((100, 2)))
      >>> print(jeuler.divide(jeuler.Scene((chain,)), state, devices=4))
      4 devices of 25 particles and at most 2 ghosts, 6 messages of 96 bytes in all in each evaluation of the forces
    """

    devices: int
    particles: int
    ghosts: int
    messages: int
    bytes_sent: int

    def __str__(self) -> str:
        return (
            f"{self.devices} devices of {self.particles:,} particles and at most {self.ghosts:,} ghosts, "
            f"{self.messages} messages of {self.bytes_sent:,} bytes in all in each evaluation of the forces"
        )


def divide(scene: Scene, state: ParticleState, *, devices: int) -> Division:
    """How ``simulate(scene, state, mesh=mesh)`` divides a scene over so many devices.

    The particles are ordered by reverse Cuthill-McKee, or left as they are where that sends less, and cut into strips
    of equal length.

    Args:
      scene: forces on single particles (`Gravity`, drags, `PointAttractor`, `DryFriction`, `PenaltyContact`) and on
        groups of them (`Springs`, `CubicSprings`, `Strings`, `Bending`, `Torsion`, `Viscosity`); the effects
        `PrescribedMotion` and `Collisions` without pairs.
      state: the particles.
      devices: how many; a scene can be divided over more than there are here.
    Returns: `Division`; printed, it is one line.
    Raises: ValueError, naming the first force, effect or field that cannot be divided.
    Example:
      >>> import jax.numpy as jnp, jeuler
      >>> pair = jeuler.Springs([[0, 1]], ks=10.0, kd=0.1, rest_length=1.0)
      >>> state = jeuler.ParticleState(jnp.array([[0.0], [1.5]]), jnp.zeros((2, 1)))
      >>> jeuler.divide(jeuler.Scene((pair,)), state, devices=2).bytes_sent
      16

    Source: E. Cuthill, J. McKee, Reducing the bandwidth of sparse symmetric matrices, ACM National Conference, 1969.
    """
    devices = checks.count("devices", devices, least=1)
    check_divisible(scene, state)
    scene.check(state)
    parts = partition(groups_of(scene), len(state.position), devices)
    most = sum(rows.shape[1] for rows in parts.sends)
    each = 2 * state.position.shape[1] * state.position.dtype.itemsize
    messages = sum(devices - abs(h) for h in parts.hops)
    return Division(devices, parts.size, most, messages, each * parts.sent())


def check_divisible(scene: Scene, state: ParticleState) -> None:
    """One ValueError that names the first force, effect or field that cannot be divided."""
    for part in (*scene.forces, *scene.effects):
        if isinstance(part, Collisions) and part.pairs:
            raise ValueError(
                f"mesh must be None with Collisions of pairs, which may be on any two devices, got pairs="
                f"{checks.shown(part.pairs)}; what can be divided is Collisions of particles with colliders"
            )
        if not acts_alone(part) and type(part) not in ON_GROUPS:
            able = ", ".join(sorted(kind.__name__ for kind in (*ALONE, *ON_PATHS, *ON_GROUPS)))
            raise ValueError(
                f"mesh must be None with {name_of(part)}, which may act on any particles; what can be divided is {able}"
            )
        for name in numbers_of(part) if type(part) in ON_GROUPS else ():
            value = getattr(part, name)
            if callable(value) and checks.form_of(name, at_time, value, 0.0).shape != ():
                raise ValueError(
                    f"mesh must be None with {name_of(part)}.{name} that is a function of time with a number for each, "
                    f"got one; give one number for all, or numbers that stay"
                )
    for name in state.fields():
        if name not in ("position", "velocity", "mass", COUNTED, *DEFAULTS) or name == "alive":
            able = ", ".join(("position", "velocity", "mass", *sorted({*DEFAULTS} - {"alive"})))
            raise ValueError(f"mesh must be None with state.{name}; what can be divided is {able}")


def check_division(
    scene: Scene, state: ParticleState, mesh: Any, step: Any, checkpoint: Any, how: dict[str, Any]
) -> Partition:
    """The `Partition` of a run with these arguments of `simulate`; one ValueError if it cannot be divided."""
    if not isinstance(mesh, Mesh):
        hint = 'write mesh=jax.make_mesh((jax.device_count(),), ("device",))'
        raise ValueError(f"mesh must be a jax.sharding.Mesh, got {checks.shown(mesh)}; {hint}")
    for name, value in how.items():
        if name != "resume" and value is not None and value != ():
            raise ValueError(f"{name} must not be given with mesh, a run in one piece, got {checks.shown(value)}")
    if how["resume"] is not None and jax.process_count() > 1:
        raise ValueError("resume must not be given with mesh in several processes, none of which has the whole state")
    if checkpoint == "reversible":
        raise ValueError('checkpoint must not be "reversible" with mesh; take checkpoint="sqrt"')
    if not hasattr(step, "increment"):
        raise ValueError(
            f"step must be explicit with mesh, got {name_of(step)}, which may need all particles at once; "
            f"take euler_step, symplectic_euler_step, heun_step or rk4_step"
        )
    check_divisible(scene, state)
    return partition(groups_of(scene), len(state.position), mesh.size)
