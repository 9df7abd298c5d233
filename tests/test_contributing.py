"""The templates of CONTRIBUTING.md run, in one scene."""

import pathlib
import re
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import jeuler
from jeuler._core import checks, trees
from jeuler._core.vectors import length
from jeuler.contact.colliders import _Shape
from jeuler.particles import ParticleState
from jeuler.steps.explicit import PyTree, VectorField, explicit

PAGE = pathlib.Path(__file__).resolve().parent.parent / "CONTRIBUTING.md"
KNOWN = {
    "Any": Any, "Array": Array, "ClassVar": ClassVar, "ParticleState": ParticleState, "PyTree": PyTree,
    "VectorField": VectorField, "_Shape": _Shape, "checks": checks, "explicit": explicit, "jax": jax, "jnp": jnp,
    "length": length, "trees": trees,
}  # fmt: skip


@pytest.fixture(scope="module")
def made():
    """What the templates define. The one of imports stands behind the first that needs them, so it runs before."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    names = {"__name__": __name__, **KNOWN}
    for block in sorted(blocks, key=lambda block: not block.startswith("from jeuler")):
        exec("from __future__ import annotations\n" + block, names)
    return names


def test_the_force_is_its_equation_and_refuses_what_it_says(made):
    pull = made["Pull"](lambda t: jnp.array([t, 0.0]), strength=2.0)
    np.testing.assert_allclose(pull(3.0, jnp.ones((1, 2)), jnp.zeros((1, 2)), jnp.ones(1)), [[4.0, -2.0]])
    damped = made["Pull"](lambda t: jnp.array([3 * t, 0.0]), strength=0.0, damping=2.0)
    np.testing.assert_allclose(damped(1, jnp.ones((1, 2)), jnp.ones((1, 2)), jnp.ones(1)), [[4.0, -2.0]])
    with pytest.raises(ValueError, match=r"Pull\.strength must not be negative"):
        made["Pull"]([0.0, 0.0], strength=-2.0)
    with pytest.raises(ValueError, match=r"Pull\.strength must be one number, got shape \(2,\)"):
        jeuler.simulate(
            jeuler.Scene((made["Pull"]([0.0, 0.0], [1.0, 2.0]),)),
            jeuler.ParticleState(*jnp.zeros((2, 1, 2))), dt=0.1, num_steps=1,
        )  # fmt: skip
    with pytest.raises(ValueError, match=r"Pull\.center must have shape \(2,\)"):
        jeuler.simulate(
            jeuler.Scene((made["Pull"]([0.0], 1.0),)), jeuler.ParticleState(*jnp.zeros((2, 1, 2))), dt=0.1, num_steps=1
        )


def test_force_effect_collider_and_step_run_together(made):
    """From rest at distance 1: x = cos t until the cylinder of radius 0.6 around the same center."""
    state = jeuler.ParticleState(jnp.array([[1.0, 0.0, 0.0]]), jnp.zeros((1, 3)))
    solid = jeuler.Collisions((made["Cylinder"]([0.0, 0.0, 0.0], 0.6),))
    scene = jeuler.Scene((made["Pull"]([0.0, 0.0, 0.0], 1.0),), (made["Blink"](3.0), solid))
    run = jeuler.simulate(scene, state, dt=0.01, num_steps=200, step=made["midpoint_step"])
    np.testing.assert_allclose(run.y.position[:90, 0, 0], np.cos(run.t[:90]), atol=1e-4)
    np.testing.assert_allclose(run.y.position[-1, 0, 0], 0.6, atol=1e-6)
    np.testing.assert_allclose(run.y.opacity[1:, 0], np.abs(np.sin(3 * run.t[1:])), atol=1e-9)


def test_the_step_is_of_its_order(made):
    errors = [
        abs(
            float(jeuler.solve(lambda t, y, a: -y, 1.0, dt=1 / n, num_steps=n, step=made["midpoint_step"]).y[-1])
            - np.exp(-1)
        )
        for n in (64, 128)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)
