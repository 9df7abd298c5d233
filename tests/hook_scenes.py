"""Scenes that between them have every hook of a component and every effect of the library."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from cases import EFFECTS, FORCES, NET_EDGES, ONE_DIES, net_state

import jeuler
from jeuler._core.component import component
from jeuler.forces.drag import Resistance


@component()
class Ramp:
    """A force that must be prepared: it is another one before it is."""

    slope: Any = 2.0
    reads = ("heat",)
    prepared = False

    def prepare(self, context):
        assert context.particles == 4
        return ReadyRamp(jnp.asarray(self.slope, context.dtype))

    def __call__(self, t, position, velocity, mass, heat):
        raise AssertionError("prepare returns what is called")

    def energy(self, t, position, mass):
        return jnp.zeros(())

    def check(self, particles, dim):
        if dim != 2:
            raise ValueError("Ramp is for the plane")


@component()
class ReadyRamp:
    slope: Any

    def __call__(self, t, position, velocity, mass, heat):
        return self.slope * heat[:, None] * jnp.ones_like(position)


@component()
class AmongTheLiving:
    """A force that is prepared once more in each step, for those who live."""

    strength: Any = 3.0
    alive: Any = None

    def prepare(self, context):
        return dataclasses.replace(self, alive=context.alive)

    def __call__(self, t, position, velocity, mass):
        share = 1.0 if self.alive is None else jnp.where(self.alive, 1 / jnp.maximum(jnp.sum(self.alive), 1), 0)
        return self.strength * jnp.broadcast_to(share, mass.shape)[:, None].astype(position.dtype) * (1 - position)


class Absent:
    """A force, of an ordinary class, with nothing to do."""

    def prepare(self, context):
        return None

    def __call__(self, t, position, velocity, mass):
        raise AssertionError("prepare says that there is nothing to do")


@component(positive=("coefficient",))
class Honey:
    """A drag of one's own: called as a drag where it is limited, else as a force."""

    coefficient: Any

    def drag(self, t, position):
        return Resistance(linear=jnp.asarray(self.coefficient, position.dtype))

    def __call__(self, t, position, velocity, mass):
        return -self.coefficient * velocity


class Corner:
    """A sampler of an ordinary class."""

    numbers = 2

    def __call__(self, key, count):
        return self.at(jax.random.uniform(key, (2, count)))

    def at(self, u):
        return u.T**2


class Orbit:
    """Prescribes the motion of particle 3, by a class of one's own."""

    acts = "start and after motion"

    def prescribe(self, t, dtype):
        t = jnp.asarray(t, dtype)
        place = jnp.stack([jnp.cos(t), jnp.sin(t)])[None]
        speed = jnp.stack([-jnp.sin(t), jnp.cos(t)])[None]
        return jnp.array([3]), place, speed, -place

    def __call__(self, t, dt, previous, state, key):
        indices, place, speed, _ = self.prescribe(t, state.position.dtype)
        return state.replace(
            position=state.position.at[indices].set(place), velocity=state.velocity.at[indices].set(speed)
        )


class Counts:
    needs = ("key", "clock", "forward time")
    writes: ClassVar = {"heat": ()}

    def __call__(self, t, dt, previous, state, key, *, clock=None):
        n, _ = clock
        noise = jax.random.uniform(key, state.heat.shape, state.heat.dtype)
        return state.replace(heat=state.heat + noise + n.astype(state.heat.dtype))


class Lightens:
    """Moves what is not held, prescribed particles among that."""

    needs = ("prescribed pinned",)
    sets: ClassVar = {"lightness": ()}

    def __call__(self, t, dt, previous, state, key):
        free = jnp.isfinite(state.mass)
        shift = jnp.where(free[:, None], 0.01 * (state.position - previous.position), 0)
        lightness = jnp.where(free, 1.0, 0.0).astype(state.position.dtype)
        return state.replace(position=state.position + shift, lightness=lightness)


class Warms:
    """Before the motion: forces see what it writes in the same step."""

    acts = "before motion"
    writes: ClassVar = {"heat": ()}

    def __call__(self, t, dt, previous, state, key):
        return state.replace(heat=0.5 * state.heat + jnp.asarray(t, state.heat.dtype))


@dataclasses.dataclass(frozen=True)
class HookScene:
    """A scene of hooks; ``linear`` is the sum of linear drag that is limited, kg/s."""

    forces: tuple
    effects: tuple = ()
    step: Any = jeuler.euler_step
    linear: float = 0.0
    pool: bool = False
    builtin: tuple[str, ...] = ()

    def scene(self):
        return jeuler.Scene(self.forces, (*self.effects, *(EFFECTS[name].make() for name in self.builtin)))

    def state(self, dtype):
        state = net_state(dtype)
        if not self.pool:
            return state
        alive = jnp.array([True, True, False, False])
        blank = jnp.where(alive[:, None], state.position, 0), jnp.where(alive[:, None], state.velocity, 0)
        return jeuler.ParticleState(*blank, jnp.where(alive, state.mass, 1), alive=alive)

    def components(self):
        """Forces, effects, samplers and colliders, as they were written."""
        parts = [getattr(part, "function", part) for part in (*self.scene().forces, *self.scene().effects)]
        inner = [x for part in parts for x in vars(part).values() if callable(x)]
        return [*parts, *(getattr(x, "function", x) for x in inner)]


GRAVITY, SPRINGS = FORCES["gravity"](), FORCES["springs"]()
WINDY = jeuler.LinearDrag(20.0, air=[1.0, -0.5])
OVER_LIFE = tuple(name for name in EFFECTS if name.endswith("_over_life"))
EMITTERS = tuple(name for name in EFFECTS if name.startswith("emitter"))
OFFSPRING = ("sub_emitter", "sub_emitter_on_contact", "trail")
DEATHS = ("lifetime", "death", "death_outside", "death_on_contact")

SCENES = {
    "drag that is limited": HookScene((GRAVITY, WINDY, Honey(15.0)), linear=35.0),
    "drag of a step that is not": HookScene(
        (GRAVITY, FORCES["quadratic_drag"](), Honey(0.3)), (Orbit(),), step=jeuler.rk4_step
    ),
    "prepared": HookScene((Ramp(), Absent(), AmongTheLiving()), (Counts(), Warms())),
    "prescribed": HookScene(
        (SPRINGS, GRAVITY, WINDY),
        (Orbit(), Lightens()),
        step=jeuler.symplectic_euler_step,
        linear=20.0,
        builtin=("prescribed_motion", "speed_limit"),
    ),
    "contact": HookScene((GRAVITY,), builtin=("sampled_motion", "collisions")),
    "pairs": HookScene((SPRINGS,), builtin=("colliding_pairs",)),
    "links": HookScene((SPRINGS, GRAVITY), builtin=("distance_links",)),
    "springs that break": HookScene(
        (jeuler.BreakableSprings(NET_EDGES, 30.0, 0.7, 0.9), GRAVITY), builtin=("breaking",)
    ),
    "those near": HookScene(
        (jeuler.SoftRepulsion(EFFECTS["neighbours"].make(), 0.9, 20.0, 0.5), GRAVITY), builtin=("neighbours",)
    ),
    "births": HookScene(
        (SPRINGS, AmongTheLiving(), WINDY),
        (jeuler.Emitter(10.0, Corner(), [0.1, 0.2], max_births=1), Counts()),
        linear=20.0,
        pool=True,
        builtin=EMITTERS[:1],
    ),
    "births of other kinds": HookScene((GRAVITY,), pool=True, builtin=EMITTERS[1:]),
    "offspring": HookScene((GRAVITY,), (ONE_DIES,), pool=True, builtin=OFFSPRING),
    "deaths": HookScene((FORCES["viscosity"](), GRAVITY), builtin=DEATHS, step=jeuler.linearly_implicit_euler_step),
    "appearance": HookScene((GRAVITY,), builtin=("lifetime", *OVER_LIFE)),
}
