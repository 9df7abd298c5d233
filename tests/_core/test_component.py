"""Components say which of their fields are parameters."""

import dataclasses

import cases
import jax.numpy as jnp
import pytest

import jeuler
from jeuler._core.component import component, parameters_of


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        (cases.FORCES["springs"](), {"ks": True, "kd": True, "rest_length": True}),
        (cases.FORCES["gravity"](), {"acceleration": False}),
        (jeuler.LinearDrag(0.4, air=[1.0, 0.0]), {"coefficient": True}),
        (jeuler.QuadraticDrag(0.4), {"coefficient": True}),
        (cases.FORCES["attractor"](), {"center": False, "strength": False, "softening": True}),
        (
            jeuler.PointAttractor(lambda t: jnp.array([t, t]), 1.0, softening=0.1),
            {"strength": False, "softening": True},
        ),
        (cases.FORCES["bending"](), {"stiffness": True, "rest_angle": False}),
        (cases.FORCES["shape_matching"](), {"rest_position": False, "stiffness": True, "damping": True}),
        (cases.FORCES["penalty_contact"](), {"ks": True, "kd": True, "radius": True}),
        (jeuler.Collisions((cases.FLOOR,)), {"radius": True, "restitution": True, "friction": True}),
        (lambda t, position, velocity, mass: position, {}),
    ],
)
def test_parameters_are_the_fields_that_hold_numbers_and_are_not_static(part, expected):
    assert parameters_of(part) == expected


@pytest.mark.parametrize("name", cases.FORCES)
def test_every_parameter_of_every_force_can_be_replaced_by_numbers(name):
    part = jeuler.Scene((cases.FORCES[name](),)).forces[0]
    for field in parameters_of(part):
        doubled = dataclasses.replace(part, **{field: 2 * getattr(part, field)})
        assert jnp.array_equal(getattr(doubled, field), 2 * getattr(part, field))


def test_a_component_may_name_its_parameters():
    @component(static=("power",), parameters=("strength",), positive=("strength",))
    class Pull:
        strength: float
        scale: float = 1.0
        power: float = 2.0

    assert parameters_of(Pull(3.0)) == {"strength": True}


def test_a_dataclass_of_ones_own_has_its_floating_fields():
    @dataclasses.dataclass(frozen=True)
    class Pull:
        strength: float
        name: str = "pull"
        count: int = 3

    assert parameters_of(Pull(3.0)) == {"strength": False}
