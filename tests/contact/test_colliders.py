"""Signed distances against plain geometry, and their gradients of length one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jeuler.contact.colliders import Box, Plane, Sphere, normal_and_speed

SHAPES = {
    "plane": (Plane([1.0, 0.0], [3.0, 4.0]), lambda p: ((p[0] - 1) * 3 + p[1] * 4) / 5),
    "sphere": (Sphere([1.0, -1.0], 0.5), lambda p: np.hypot(p[0] - 1, p[1] + 1) - 0.5),
    "shell": (Sphere([1.0, -1.0], 3.0, inside=True), lambda p: 3 - np.hypot(p[0] - 1, p[1] + 1)),
    "box": (
        Box([0.5, 0.0], [1.0, 0.25]),
        lambda p: (
            np.hypot(max(abs(p[0] - 0.5) - 1, 0), max(abs(p[1]) - 0.25, 0))
            or max(abs(p[0] - 0.5) - 1, abs(p[1]) - 0.25)
        ),
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_distance_and_normal(name, random):
    shape, expected = SHAPES[name]
    points = random.uniform(-2, 2, (200, 2))
    distance = jax.vmap(shape, (None, 0))(0.0, jnp.asarray(points))
    np.testing.assert_allclose(distance, [expected(p) for p in points], atol=1e-14)
    normals, speed = jax.vmap(normal_and_speed, (None, None, 0))(shape, 0.0, jnp.asarray(points))
    slope = jax.vmap(jax.grad(shape, argnums=1), (None, 0))(0.0, jnp.asarray(points))
    np.testing.assert_allclose(normals, slope, atol=1e-12)
    np.testing.assert_array_equal(speed, 0)


def test_normal_on_the_face_of_a_box_is_the_face_normal():
    normal, _ = normal_and_speed(Box([0.0, 0.0], 1.0), 0.0, jnp.array([1.0, 0.3]))
    np.testing.assert_array_equal(normal, [1, 0])


def test_center_of_a_sphere_is_finite():
    normal, _ = normal_and_speed(Sphere([0.0, 0.0], 1.0), 0.0, jnp.zeros(2))
    assert jnp.isfinite(normal).all()


def test_moving_sphere():
    moving = Sphere(lambda t: jnp.stack([2 * t, 0 * t]), 1.0)
    normal, speed = normal_and_speed(moving, 0.5, jnp.array([5.0, 0.0]))
    np.testing.assert_allclose(normal, [1, 0])
    np.testing.assert_allclose(speed, -2)  # it comes nearer by 2 m/s


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (Sphere([0.0, 0.0], -1.0), "Sphere.radius must be at least 0 m, got -1"),
        (Box([0.0, 0.0], [1.0, -2.0]), "Box.half_size must be at least 0 m"),
        (Plane([0.0, 0.0], [0.0, 0.0]), "Plane.normal must point somewhere"),
    ],
)
def test_impossible_shape_is_refused(shape, message):
    with pytest.raises(ValueError, match=message):
        shape.check(2)


def test_words_for_numbers_are_refused_by_name():
    with pytest.raises(ValueError, match="Sphere.radius must be a number, .* got 'large'"):
        Sphere([0.0, 0.0], "large")
