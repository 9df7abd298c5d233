"""The step that `diagnose` looks at, part by part, is the step that `simulate` takes, whatever hooks a scene uses."""

import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import EFFECTS, FORCES

import jeuler
from jeuler.diagnosis.rerun import Rerun
from jeuler.particles.protocols import HOOKS

DRAG = jeuler.QuadraticDrag(50.0)  # 50 kg/m: limited at each step
TIME = {"dt": 0.1, "key": jax.random.key(3)}


class Buoyancy:
    """A force with every hook of forces but ``drag``."""

    reads = ("heat",)

    def __call__(self, t, position, velocity, mass, heat):
        return heat[:, None] * jnp.ones_like(position)

    def prepare(self, context):
        alive = context.alive
        return self if alive is None else lambda *a, heat: jnp.where(alive[:, None], self(*a, heat=heat), 0)

    def energy(self, t, position, mass):
        return jnp.zeros((), position.dtype)

    def check(self, particles, dim):
        assert dim == 2


class Shaken:
    """An effect with every hook of effects but ``max_births``: it leads particle 0, and shakes and heats the rest."""

    acts = "before motion"
    reads = ("heat",)
    writes: ClassVar[dict[str, tuple[int, ...]]] = {"shakes": ()}
    sets = ("size",)
    needs = ("key", "clock", "forward time")

    def __call__(self, t, dt, previous, state, key, *, clock=None):
        n, _ = clock
        kick = 0.1 * jax.random.normal(key, state.velocity.shape, state.velocity.dtype)
        return state.replace(
            velocity=state.velocity + kick,
            heat=state.heat + jnp.asarray(n, state.heat.dtype),
            shakes=state.shakes + 1,
            size=jnp.full_like(state.size, dt),
        )

    def prescribe(self, t, dtype):
        t = jnp.asarray(t, dtype)
        moves = (jnp.stack([jnp.sin(t), 0 * t]), jnp.stack([jnp.cos(t), 0 * t]), jnp.stack([-jnp.sin(t), 0 * t]))
        return jnp.array([0]), *(x[None] for x in moves)

    def check(self, particles, dim):
        assert dim == 2


def made(*names):
    return tuple(EFFECTS[name].make() for name in names)


FALL = (FORCES["gravity"](), jeuler.Springs([[0, 1]], 20.0, 0.1, 0.5), DRAG)
SCENES = {
    "led, born, bounced, capped": (FALL, made("prescribed_motion", "emitter", "lifetime", "collisions", "speed_limit")),
    "pairs": (FALL, made("colliding_pairs")),
    "sampled path, born, fading": (
        FALL,
        made("sampled_motion", "emitter", "lifetime", "color_over_life", "opacity_over_life"),
    ),
    "born on a disc, dying": (FALL, made("emitter_of_a_disc", "death", "death_outside", "death_on_contact")),
    "born on a ball and a line": (FALL, made("emitter_of_a_ball", "emitter_of_a_line", "lifetime", "heat_over_life")),
    "born on a surface": (FALL, made("emitter_of_a_surface", "lifetime", "size_over_life", "shape_over_life")),
    "hooks of one's own": ((*FALL, Buoyancy()), (Shaken(), *made("lifetime", "emitter"))),
}


def start(name, dtype):
    state = jeuler.ParticleState(
        jnp.array([[0.0, 2.0], [1.0, 2.2], [0.2, 3.0], [3.0, 1.0], [0.0, 0.0], [0.0, 0.0]], dtype),
        jnp.array([[0.0, 0.0], [1.0, -2.0], [0.0, 0.0], [-1.0, -1.0], [0.0, 0.0], [0.0, 0.0]], dtype),
        jnp.array([1.0, 2.0, 0.5, 1.0, 1.0, 1.0], dtype),
    )
    if "born" in name or "own" in name:
        state = state.replace(alive=jnp.array([True, True, True, True, False, False]))
    if "own" in name:
        state = state.replace(heat=jnp.ones(6, dtype), size=jnp.ones(6, dtype), shakes=jnp.zeros(6, dtype))
    return state


def test_the_scenes_use_every_effect_and_every_hook_of_forces_and_effects():
    effects = [effect for _, many in SCENES.values() for effect in many]
    kinds = {type(effect).__name__ for effect in effects}
    assert {type(case.make()).__name__ for case in EFFECTS.values()} <= kinds
    parts = (*effects, *(force for forces, _ in SCENES.values() for force in forces))
    of_samplers_and_airs = {"numbers", "at"}
    assert {hook for hook in HOOKS if any(hasattr(part, hook) for part in parts)} | of_samplers_and_airs == set(HOOKS)


CONTACT = ("led, born, bounced, capped", "pairs")  # slow to compile: in one precision


@pytest.mark.parametrize(
    ("name", "dtype"),
    [(name, dtype) for name in SCENES for dtype in ("float64", "float32") if dtype == "float64" or name not in CONTACT],
)
def test_parts_of_each_step_end_in_the_next_state_of_the_run(name, dtype):
    """And the forces that are named add up to what moved the living, with the limit of drag in it."""
    forces, effects = SCENES[name]
    scene, state = jeuler.Scene(forces, effects), start(name, dtype)
    run = Rerun.of(scene, state, 6, **TIME)
    saved = jeuler.simulate(scene, state, num_steps=6, **TIME).y
    tolerance = 1e-12 if dtype == "float64" else 2e-5
    close = functools.partial(np.testing.assert_allclose, rtol=tolerance, atol=tolerance)

    @jax.jit
    def step(n, before):
        parts = list(run.parts_of_step(n, before))
        moved = [name for name, _ in parts].index("euler_step")
        ready = parts[moved - 1][1] if moved else before
        return parts[-1][1], parts[moved][1], ready, [force for _, force in run.shares(run.time(n), ready)]

    for n in range(1, 7):
        before, after = (jax.tree.map(lambda x, k=k: x[k], saved) for k in (n - 1, n))
        last, moved, ready, shares = step(n, before)
        for a, b in zip(jax.tree.leaves(last), jax.tree.leaves(after), strict=True):
            assert a.dtype == b.dtype
            close(a, b)
        assert_the_forces_moved_the_living(scene, ready, moved, shares, close)


def assert_the_forces_moved_the_living(scene, ready, moved, shares, close):
    """m dv/dt lies along the sum of the forces and is no longer: the limit of drag is a greater mass."""
    free = np.isfinite(np.broadcast_to(ready.mass, len(ready.position)))
    if ready.alive is not None:
        free = free & np.asarray(ready.alive)
    if any(hasattr(effect, "prescribe") for effect in scene.effects):
        free[0] = False
    mass = np.broadcast_to(ready.mass, len(free))[free, None]
    change = mass * np.asarray(moved.velocity - ready.velocity)[free] / TIME["dt"]
    total = np.asarray(sum(shares))[free]
    size = np.abs(np.stack([np.asarray(share)[free] for share in shares])).max() + 1
    slowed = np.sum(change * total, 1, keepdims=True) / np.maximum(np.sum(total**2, 1, keepdims=True), 1e-30)
    assert (slowed < 1 + 1e-4).all()
    assert (slowed > 0)[np.abs(total).max(1) > 1e-6 * size].all()
    close(change / size, slowed * total / size)


def test_not_jitted_the_parts_are_the_same():
    name = "hooks of one's own"
    forces, effects = SCENES[name]
    scene, state = jeuler.Scene(forces, effects), start(name, "float64")
    run = Rerun.of(scene, state, 1, **TIME)
    after = jax.tree.map(lambda x: x[-1], jeuler.simulate(scene, state, num_steps=1, **TIME).y)
    *_, (_, found) = run.parts_of_step(1, run.state)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
