"""The tables that the contract tests run through: one row a method, a force, an effect, a problem."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler._core.component import component


@dataclasses.dataclass(frozen=True)
class Method:
    step: Callable
    order: int
    needs_pair: bool = False  # y must be (position, velocity)


METHODS = {
    "euler": Method(jeuler.euler_step, 1),
    "symplectic_euler": Method(jeuler.symplectic_euler_step, 1, needs_pair=True),
    "heun": Method(jeuler.heun_step, 2),
    "rk4": Method(jeuler.rk4_step, 4),
}


def leapfrog_step(f, t, y, dt, args):
    """A step of one's own: velocity Verlet on y = (position, velocity)."""
    x, v = y
    half = v + dt / 2 * f(t, (x, v), args)[1]
    x = x + dt * half
    return x, half + dt / 2 * f(t + dt, (x, half), args)[1]


@dataclasses.dataclass(frozen=True)
class Problem:
    """y' = f(t, y, args) with an exact solution where there is one."""

    f: Callable
    y0: Any
    args: Any
    t1: float
    exact: Callable | None = None
    pair: bool = False


def oscillator(t, y, args):
    x, v = y
    ks, kd = args
    return v, -ks * x - kd * v


def oscillator_exact(t, args=(4.0, 0.4)):
    ks, kd = args
    decay, omega = kd / 2, np.sqrt(ks - kd**2 / 4)
    envelope = np.exp(-decay * t)
    x = envelope * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    v = -envelope * ks / omega * np.sin(omega * t)
    return x, v


def lotka_volterra(t, y, args):
    a, b = args
    return {"prey": a * y["prey"] - b * y["prey"] * y["fox"], "fox": b * y["prey"] * y["fox"] - y["fox"]}


def pendulum(t, y, args):
    angle, rate = y
    return rate, -args * jnp.sin(angle) + 0.1 * jnp.cos(3 * t)


PROBLEMS = {
    "source": Problem(lambda x, y, a: a * x + y / 5, -3.0, 1.0, 5.0, exact=lambda x: 22 * np.exp(x / 5) - 5 * x - 25),
    "decay": Problem(lambda t, y, k: -k * y, np.array([1.0, 2.0, -3.0]), 0.7, 2.0),
    "oscillator": Problem(oscillator, (1.0, 0.0), (4.0, 0.4), 3.0, exact=oscillator_exact, pair=True),
    "pendulum": Problem(pendulum, (np.array([0.5, 2.0]), np.zeros(2)), 9.81, 2.0, pair=True),
    "lotka_volterra": Problem(lotka_volterra, {"prey": 1.2, "fox": 0.8}, (1.5, 1.0), 2.0),
    "rotation": Problem(
        lambda t, y, w: 1j * w * y, np.array([1.0 + 0.0j]), 1.3, 2.0, exact=lambda t: np.exp([1.3j * t])
    ),
    "riccati": Problem(lambda t, y, a: a * (t - y**2), 0.5, 1.0, 2.0),
}

NET_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)]
NET_POSITION = np.array([[0.0, 0.0], [1.1, 0.1], [1.0, 0.9], [-0.1, 1.2]])
NET_VELOCITY = np.array([[0.0, 0.0], [0.4, -0.3], [0.2, 0.5], [-0.6, 0.1]])
NET_MASS = np.array([np.inf, 1.0, 2.0, 0.5])

STRAND = [[0, 1, 2, 3]]
STRAND_POSITION = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 0.8], [0.5, 0.3, 0.9], [0.9, 0.2, 0.7]])
STRAND_VELOCITY = np.array([[0.0, 0.0, 0.0], [0.4, -0.3, 0.2], [0.2, 0.5, -0.1], [-0.6, 0.1, 0.3]])
STRAND_REST = np.array([[[0.0, 0.0, 0.0], [0.3, 0.1, -0.2], [0.2, 0.4, -0.4], [0.5, 0.3, -0.8]]])
FLOOR = jeuler.Plane([0.0, 0.4], [0.1, 1.0])

BOULDER = jeuler.GridDistance(
    [-2.0, -2.0], 0.7, np.hypot(*np.meshgrid(0.7 * np.arange(7) - 2.3, 0.7 * np.arange(7) - 2.2, indexing="ij")) - 0.9
)  # about (0.3, 0.2)

NEAR = jeuler.Neighbours(cutoff=1.4, skin=0.2, capacity=3)


@component()
class AllPairs:
    """Forces of those that are near, on four particles of which all see all."""

    forces: tuple

    def __call__(self, t, position, velocity, mass):
        rows = jnp.asarray([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]], jnp.int32)
        return sum(force(t, position, velocity, mass, rows) for force in self.forces)


def of_those_near():
    fluid = jeuler.Fluid(NEAR, mass=0.5, density=0.3, stiffness=4.0, viscosity=0.2)
    return AllPairs((jeuler.SoftRepulsion(NEAR, 1.3, 20.0, 0.5), jeuler.Flocking(NEAR, 1.0, 2.0, 3.0), fluid))


FORCES = {
    "nearby": of_those_near,
    "triangle_contact": lambda: AllPairs((jeuler.TriangleContact(NEAR, [[1, 2, 3]], 0.6, ks=20.0, kd=0.5),)),
    "cubic_springs": lambda: jeuler.CubicSprings(NET_EDGES, np.linspace(20.0, 60.0, 5), 0.7, 0.9, cubic=30.0),
    "strings": lambda: jeuler.Strings(NET_EDGES, ks=30.0, kd=0.7, rest_length=np.linspace(0.9, 1.3, 5)),
    "torsion": lambda: jeuler.Torsion(STRAND, 0.4, 2.0),
    "gravity": lambda: jeuler.Gravity([0.3, -9.81]),
    "springs": lambda: jeuler.Springs(NET_EDGES, ks=np.linspace(20.0, 60.0, 5), kd=0.7, rest_length=0.9),
    "springs_in_a_box": lambda: jeuler.Springs(NET_EDGES, ks=30.0, kd=0.7, rest_length=0.5, box=[1.7, 1.5]),
    "springs_without_length": lambda: jeuler.Springs(NET_EDGES, ks=30.0, kd=np.linspace(0.1, 1.0, 5), rest_length=0.0),
    "no_springs": lambda: jeuler.Springs([], ks=30.0, kd=1.0, rest_length=1.0),
    "linear_drag": lambda: jeuler.LinearDrag(0.4),
    "quadratic_drag": lambda: jeuler.QuadraticDrag(0.3),
    "wind": lambda: jeuler.LinearDrag(0.4, air=jeuler.Wind([1.0, -0.5])),
    "gust": lambda: jeuler.QuadraticDrag(0.4, air=jeuler.Gust([3.0, 0.5], period=0.7)),
    "turbulence": lambda: jeuler.LinearDrag(0.4, air=jeuler.turbulence(dim=2, speed=1.0, size=0.8, time=0.5, modes=4)),
    "vortex": lambda: jeuler.LinearDrag(0.4, air=jeuler.Vortex([0.4, 0.3], circulation=3.0, core=0.2)),
    "dry_friction": lambda: jeuler.DryFriction(0.4, slow=0.2),
    "applied_force": lambda: jeuler.AppliedForce(
        jeuler.SampledPath([0.0, 0.5, 1.0], [[0.0, 1.0], [2.0, 0.5], [-1.0, 0.0]]), particles=[1, 3], gain=0.5
    ),
    "attractor": lambda: jeuler.PointAttractor([0.3, 2.0], 5.0, softening=0.1),
    "viscosity": lambda: jeuler.Viscosity(NET_EDGES, np.linspace(0.1, 0.5, 5)),
    "bending": lambda: jeuler.Bending([[0, 1, 2], [1, 2, 3]], [0.3, 0.5], 0.4),
    "shape_matching": lambda: jeuler.ShapeMatching(range(4), 1.2 * NET_POSITION[::-1], 5.0, damping=0.4),
    "penalty_contact": lambda: jeuler.PenaltyContact(BOULDER, ks=40.0, kd=0.2, radius=0.1),
    "strand_bending": lambda: jeuler.StrandBending(STRAND, STRAND_REST, 3.0, 0.5, 1.0),
    "strand_core": lambda: jeuler.StrandCore(STRAND, STRAND_REST, 3.0, 0.5, 1.0),
    "function": lambda: lambda t, position, velocity, mass: -0.1 * velocity + 0.2 * jnp.sin(t),
}
IN_SPACE = ("triangle_contact", "strand_bending", "strand_core", "torsion")
# action equals reaction; and those whose forces have no torque either
INTERNAL_FORCES = (
    "springs", "springs_in_a_box", "springs_without_length", "no_springs", "cubic_springs", "strings", "viscosity", "bending", "shape_matching", *IN_SPACE,
)  # fmt: skip
CENTRAL_FORCES = (
    "springs",
    "cubic_springs",
    "strings",
    "springs_without_length",
    "no_springs",
    "bending",
    "shape_matching",
)


@dataclasses.dataclass(frozen=True)
class Effect:
    """An effect, the fields that it brings into the state, and what else its scene must have."""

    make: Callable
    fields: frozenset = frozenset()
    needs: tuple = ()


def effect(make, *fields, needs=()):
    return Effect(make, frozenset(fields), needs)


def path(t):
    return jnp.stack([0.3 * jnp.sin(2 * t), 0.1 * t])[None]


SAMPLES = np.array([[[0.0, 0.0]], [[0.1, 0.2]], [[0.3, 0.1]], [[0.2, 0.0]]])
POOL = ("alive", "births", "missed_births", "steps")
PLACE, SPEED = [0.5, 2.0], [0.1, 0.3]
LIFE = jeuler.Lifetime(0.5)
ONE_DIES = jeuler.Death(lambda t, state: (t > 0.07) & (jnp.arange(len(state.position)) == 1))
SOLIDS = (FLOOR, jeuler.Sphere([2.0, 2.0], 0.2), jeuler.Box([-2.0, 1.0], 0.3))

EFFECTS = {
    "prescribed_motion": effect(lambda: jeuler.PrescribedMotion([0], path)),
    "sampled_motion": effect(
        lambda: jeuler.PrescribedMotion([0], jeuler.SampledPath([0.0, 0.5, 1.0, 1.5], SAMPLES))
    ),
    "collisions": effect(lambda: jeuler.Collisions(SOLIDS, radius=0.05, restitution=0.5, friction=0.3), "unresolved_contacts"),
    "colliding_pairs": effect(lambda: jeuler.Collisions(pairs="near", radius=0.2, restitution=0.5), "unresolved_contacts"),
    "distance_links": effect(lambda: jeuler.DistanceLinks([(0, 1), (1, 2)], length=[1.0, 0.8]), "unresolved_links"),
    "breaking": effect(lambda: jeuler.Breaking(jeuler.BreakableSprings(NET_EDGES, 30.0, 0.7, 0.9), 0.4), "broken", "broken_springs"),
    "neighbours": effect(
        lambda: jeuler.Neighbours(1.0, 0.2, capacity=3),
        "neighbours", "neighbours_made_at", "has_neighbours", "missed_neighbours",
    ),
    "trail": effect(lambda: jeuler.Trail(3, every=2), "trail", "steps"),
    "sub_emitter": effect(
        lambda: jeuler.SubEmitter(1, SPEED, inherit=0.5, color=np.ones(3)), *POOL, "color", "generation", needs=(ONE_DIES,)
    ),
    "sub_emitter_on_contact": effect(
        lambda: jeuler.SubEmitter(1, SPEED, PLACE, contact=jeuler.Plane([0.0, 0.3], [0.0, 1.0])), *POOL, "generation"
    ),
    "speed_limit": effect(lambda: jeuler.SpeedLimit(0.5)),
    "emitter": effect(lambda: jeuler.Emitter(40.0, PLACE, SPEED, max_births=2), *POOL),
    "emitter_of_a_disc": effect(
        lambda: jeuler.Emitter(40.0, jeuler.FromDisc(PLACE, 0.1), jeuler.Cone([0.0, 1.0], 2.0, 0.2)), *POOL
    ),
    "emitter_of_a_ball": effect(
        lambda: jeuler.Emitter(40.0, jeuler.FromSphere(PLACE, 0.1), jeuler.Normal(SPEED, 0.1), color=np.ones(3)),
        *POOL, "color",
    ),
    "emitter_of_a_line": effect(
        lambda: jeuler.Emitter(
            40.0, jeuler.FromLine(PLACE, SPEED), jeuler.Uniform(SPEED, PLACE), size=jeuler.Choice([0.1, 0.2])
        ),
        *POOL, "size",
    ),
    "emitter_of_a_surface": effect(
        lambda: jeuler.Emitter(40.0, jeuler.FromSurface([PLACE, SPEED, [0.0, 0.0]], [[0, 1, 2]]), SPEED), *POOL
    ),
    "lifetime": effect(lambda: jeuler.Lifetime(0.5), "alive", "age"),
    "death": effect(lambda: jeuler.Death(lambda t, state: state.position[:, 0] > 5.0), "alive"),
    "death_outside": effect(lambda: jeuler.DeathOutside(-4.0, 4.0), "alive"),
    "death_on_contact": effect(lambda: jeuler.DeathOnContact(jeuler.Plane([0.0, -3.0], [0.0, 1.0])), "alive"),
    "color_over_life": effect(lambda: jeuler.OverLife("color", np.eye(3), duration=0.5), "color", needs=(LIFE,)),
    "opacity_over_life": effect(lambda: jeuler.OverLife("opacity", [1.0, 0.0], duration=0.5), "opacity", needs=(LIFE,)),
    "size_over_life": effect(lambda: jeuler.OverLife("size", [0.1, 0.2], duration=0.5), "size", needs=(LIFE,)),
    "shape_over_life": effect(lambda: jeuler.OverLife("shape", [0.0, 1.0], duration=0.5), "shape", needs=(LIFE,)),
    "heat_over_life": effect(lambda: jeuler.OverLife("heat", [1.0, 0.0], duration=0.5), "heat", needs=(LIFE,)),
}  # fmt: skip


def kinds_in(part):
    """The names of the public classes in a force or effect, at any depth."""
    ours = type(part).__module__.startswith(("jeuler", "cases"))
    children = part if isinstance(part, (tuple, list)) else vars(part).values() if ours else ()
    return {type(part).__name__}.intersection(jeuler.__all__).union(*map(kinds_in, children))


def force_state(name, dtype=jnp.float64):
    """The state on which a force is tried: four particles, in space for hair."""
    if name not in IN_SPACE:
        return net_state(dtype)
    mass = jnp.asarray([np.inf, 1.0, 2.0, 0.5], dtype)
    return jeuler.ParticleState(jnp.asarray(STRAND_POSITION, dtype), jnp.asarray(STRAND_VELOCITY, dtype), mass)


def net_state(dtype=jnp.float64):
    """Four particles, one of them pinned."""
    return jeuler.ParticleState(
        jnp.asarray(NET_POSITION, dtype), jnp.asarray(NET_VELOCITY, dtype), jnp.asarray(NET_MASS, dtype)
    )


def net_scene():
    """Gravity, springs and drag."""
    return jeuler.Scene(forces=(FORCES["gravity"](), FORCES["springs"](), FORCES["quadratic_drag"]()))
