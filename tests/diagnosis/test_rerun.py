"""The step that `diagnose` looks at, part by part, is the step that `simulate` takes."""

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler.diagnosis.rerun import Rerun


def test_parts_of_each_step_end_in_the_next_state_of_the_run():
    """Births, deaths, appearance, prescribed motion, contact, springs of the living and a drag that is limited."""
    hand = jeuler.PrescribedMotion([0], lambda t: jnp.stack([jnp.sin(t), 0.0 * t])[None])
    jet = jeuler.Emitter(20.0, [0.0, 1.0], [1.0, 0.0], max_births=2)
    fade = jeuler.OverLife("opacity", [1.0, 0.0], duration=1.0)
    floor = jeuler.Collisions((jeuler.Plane([0.0, -1.0], [0.0, 1.0]),), restitution=0.5)
    forces = (jeuler.Gravity([0.0, -9.81]), jeuler.Springs([[0, 1]], 20.0, 0.1, 0.5), jeuler.QuadraticDrag(50.0))
    scene = jeuler.Scene(forces, (hand, jet, jeuler.Lifetime(0.4), fade, floor, jeuler.SpeedLimit(3.0)))
    alive = jnp.array([True, True, False, False])
    state = jeuler.ParticleState(jnp.eye(4, 2), jnp.ones((4, 2)), alive=alive)
    arguments = {"dt": 0.1, "key": jax.random.key(3)}
    run = Rerun.of(scene, state, 6, **arguments)
    saved = jeuler.simulate(scene, state, num_steps=6, **arguments).y
    parts = jax.jit(lambda n, before: dict(run.parts_of_step(n, before)))
    for n in range(1, 7):
        before, after = (jax.tree.map(lambda x, k=k: x[k], saved) for k in (n - 1, n))
        found = parts(n, before)["dead slots"]
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(after), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
