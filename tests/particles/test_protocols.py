"""One page says what a component may do: thirteen hooks, and the code looks for no others."""

import pathlib
import re
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.particles import fields, protocols

SOURCE = pathlib.Path(jeuler.__file__).parent
OLDER = {"before_motion", "over_step", "random"}  # words of before that are still taken
FOR_MESSAGES = {"__name__", "shape", "normal"}  # looked at to say what came in place of a component


def test_thirteen_hooks_each_in_a_protocol():
    classes = [c for c in vars(protocols).values() if isinstance(c, type) and c.__name__.endswith("Hooks")]
    in_protocols = {name for c in classes for name in (*c.__annotations__, *vars(c)) if not name.startswith("_")}
    assert in_protocols == set(protocols.HOOKS)
    assert len(set(protocols.HOOKS)) == len(protocols.HOOKS) <= 13


def test_the_particles_look_for_no_other_hook():
    asked = r'(?:declared|hasattr|getattr)\((?:effect|force|part|other), "([a-z_]+)"'
    found = {name for path in (SOURCE / "particles").glob("*.py") for name in re.findall(asked, path.read_text())}
    assert {"acts", "reads"} <= found
    assert found - OLDER - FOR_MESSAGES <= set(protocols.HOOKS)


def test_every_built_in_need_is_one_that_the_page_names():
    page = re.sub(r"\s+", " ", (SOURCE / "particles" / "protocols.py").read_text())
    for name in jeuler.effects.__all__ + jeuler.contact.__all__:
        for need in getattr(getattr(jeuler, name), "needs", ()):
            assert need in get_args(fields.Need)
            assert f'"{need}"' in page


def test_an_effect_of_ones_own_gets_what_it_needs():
    seen = {}

    class Counts:
        needs = ("key", "clock")

        def __call__(self, t, dt, previous, state, key, *, clock=None):
            seen["clock"] = clock
            assert key is not None
            n, t0 = clock
            return state.replace(position=state.position.at[0, 0].set((t0 + n).astype(state.position.dtype)))

    scene = jeuler.Scene(effects=(Counts(),))
    state = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
    with pytest.raises(ValueError, match="needs a key"):
        jeuler.simulate(scene, state, dt=0.1, num_steps=3)
    run = jeuler.simulate(scene, state, dt=0.1, num_steps=3, t0=10.0, key=jax.random.key(0))
    assert run.y.position[1:, 0, 0].tolist() == [10.0, 11.0, 12.0]


@pytest.mark.parametrize("parts", [1, 3], ids=lambda parts: f"extrapolated from {parts}")
def test_an_effect_of_ones_own_in_the_solve(parts):
    """It pulls as gravity does, as much as it said at the start of the whole step."""
    told, told_acceleration = [], []

    class Pull:
        needs = ("the solve",)

        def __call__(self, t, dt, previous, state, key, *, acceleration=None):
            told_acceleration.append(acceleration is not None)
            return state

        def answer(self, t, dt, state, acceleration, stays):
            told.append(stays is not None)
            return lambda velocity: jnp.full_like(velocity, dt) * (-9.8 if stays is None else stays)

        def touching(self, t, dt, state, acceleration):
            return jnp.asarray(-9.8)

    base = jeuler.linearly_implicit_euler_step
    step = base if parts == 1 else jeuler.extrapolated_euler(parts, step=base)
    state = jeuler.ParticleState([[0.0, 1.0]], [[0.5, 0.0]])
    ran, expected = (
        jeuler.simulate(scene, state, dt=0.1, num_steps=5, step=step).y
        for scene in (jeuler.Scene(effects=(Pull(),)), jeuler.Scene((jeuler.Gravity([-9.8, -9.8]),)))
    )
    np.testing.assert_allclose(ran.position, expected.position, rtol=1e-12)
    np.testing.assert_allclose(ran.velocity, expected.velocity, rtol=1e-12)
    assert set(told) == {parts > 1}
    assert told_acceleration[-1]
