"""Samplers: the distributions they say, in closed form, and gradients by reparameterisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jeuler import Choice, Cone, FromDisc, FromLine, FromSphere, FromSurface, Normal, Uniform
from jeuler.samplers.base import draw_named

KEY, COUNT = jax.random.key(3), 4000

# a number of each sample, and its cumulative distribution
SHAPES = {
    "uniform": (Uniform(2.0, 5.0), lambda x: (x - 2) / 3, scipy.stats.uniform.cdf),
    "normal": (Normal(1.0, 2.0), lambda x: (x - 1) / 2, scipy.stats.norm.cdf),
    "line": (FromLine([1.0, 0.0], [1.0, 4.0]), lambda x: x[:, 1] / 4, scipy.stats.uniform.cdf),
    "disc": (FromDisc([1.0, 1.0], 2.0), lambda x: np.sum((x - 1) ** 2, axis=1) / 4, scipy.stats.uniform.cdf),
    "disc in space": (
        FromDisc([0.0, 0.0, 1.0], 2.0, normal=[1.0, 1.0, 0.0]),
        lambda x: np.sum((x - [0, 0, 1]) ** 2, axis=1) / 4,
        scipy.stats.uniform.cdf,
    ),
    "ball": (FromSphere(jnp.zeros(3), 2.0), lambda x: np.linalg.norm(x, axis=1) ** 3 / 8, scipy.stats.uniform.cdf),
    # Archimedes: the height on a sphere is uniform
    "sphere": (FromSphere(jnp.zeros(3), 2.0, surface=True), lambda x: (x[:, 2] + 2) / 4, scipy.stats.uniform.cdf),
    "triangle": (  # the first coordinate of a uniform point of this triangle has the density 2 (1 - x)
        FromSurface([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 1, 2]]),
        lambda x: 1 - (1 - x[:, 0]) ** 2,
        scipy.stats.uniform.cdf,
    ),
    "cone": (  # the cap's height is uniform too
        Cone([0.0, 0.0, 2.0], speed=3.0, angle=0.8),
        lambda v: (v[:, 2] / 3 - np.cos(0.8)) / (1 - np.cos(0.8)),
        scipy.stats.uniform.cdf,
    ),
    "fan": (
        Cone([0.0, 1.0], speed=3.0, angle=0.8),
        lambda v: (np.arctan2(v[:, 0], v[:, 1]) + 0.8) / 1.6,
        scipy.stats.uniform.cdf,
    ),
    "all ways": (Cone([1.0, 0.0, 0.0], 1.0, jnp.pi), lambda v: (v[:, 1] + 1) / 2, scipy.stats.uniform.cdf),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_sampler_has_its_distribution(name):
    sampler, number, cdf = SHAPES[name]
    x = np.asarray(sampler(KEY, COUNT))
    assert len(x) == COUNT
    assert scipy.stats.kstest(number(x), cdf).pvalue > 0.01  # a fixed key: this cannot flicker


def test_a_disc_in_space_is_flat_and_lies_across_its_normal():
    x = FromDisc([0.0, 0.0, 1.0], 2.0, normal=[1.0, 1.0, 0.0])(KEY, 50)
    assert np.allclose((x - jnp.array([0.0, 0.0, 1.0])) @ jnp.array([1.0, 1.0, 0.0]), 0, atol=1e-12)


def test_a_surface_takes_its_triangles_by_area():
    vertices = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 3.0]]
    x = np.asarray(FromSurface(vertices, [[0, 1, 2], [0, 1, 3]])(KEY, COUNT))
    on_first = x[:, 2] < 1e-12
    assert scipy.stats.binomtest(int(on_first.sum()), COUNT, 0.25).pvalue > 0.01
    assert np.allclose(x[~on_first, 1], 0)
    with pytest.raises(ValueError, match="indices from 0 to 3, got from 0 to 4"):
        FromSurface(vertices, [[0, 1, 4]])


def test_a_choice_takes_each_row_as_often():
    x = np.asarray(Choice([1.0, 2.0, 4.0])(KEY, COUNT))
    assert scipy.stats.chisquare([np.sum(x == value) for value in (1.0, 2.0, 4.0)]).pvalue > 0.01


@pytest.mark.parametrize("name", ["uniform", "normal", "line", "disc in space", "ball", "triangle", "cone", "fan"])
def test_gradients_flow_to_every_parameter(name):
    sampler, _, _ = SHAPES[name]

    def loss(sampler):
        x = sampler(KEY, 20)
        return jnp.sum(jnp.sin(jnp.arange(x.size).reshape(x.shape) + x))

    gradient, step = jax.grad(loss)(sampler), 1e-6
    leaves, tree = jax.tree.flatten(sampler)
    for k, (leaf, slope) in enumerate(zip(leaves, jax.tree.leaves(gradient), strict=True)):
        along = jnp.cos(jnp.arange(leaf.size, dtype=float)).reshape(leaf.shape)

        def moved(h, k=k, leaf=leaf, along=along):
            return loss(jax.tree.unflatten(tree, [*leaves[:k], leaf + h * along, *leaves[k + 1 :]]))

        difference = (moved(step) - moved(-step)) / (2 * step)
        assert np.isclose(jnp.sum(slope * along), difference, rtol=1e-6, atol=1e-7)


def test_a_jet_without_spread_has_a_finite_gradient():
    gradient = jax.grad(lambda angle: jnp.sum(Cone([0.0, 0.0, 1.0], 1.0, angle)(KEY, 5)))(0.0)
    assert np.isfinite(gradient)


def test_samplers_drawn_together_have_nothing_in_common_and_do_not_change_each_other():
    def own(key, count):
        return jax.random.uniform(key, (count,))

    named = {"a": Uniform([0.0, 0.0], 1.0), "b": Uniform([0.0, 0.0], 1.0), "own": own, "same": 3.0}
    values = draw_named(named, KEY, 500, jnp.float64)
    assert np.all(values["same"] == 3.0)
    columns = np.column_stack([values["a"], values["b"], values["own"]])
    p_values = scipy.stats.spearmanr(columns).pvalue[np.triu_indices(5, 1)]
    assert p_values.min() > 0.01 / len(p_values)
    for name, alone in (("b", named["b"]), ("own", own)):
        assert np.array_equal(draw_named({name: alone}, KEY, 500, jnp.float64)[name], values[name])


def test_the_speed_of_a_cone_may_be_a_function_of_the_persons_own():
    jet = Cone([0.0, 3.0], lambda key, count: 2.0 + jax.random.uniform(key, (count,)), 0.5)
    v = draw_named({"velocity": jet}, KEY, COUNT, jnp.float64)["velocity"]
    speed, angle = np.linalg.norm(v, axis=1), np.arctan2(v[:, 0], v[:, 1])
    assert scipy.stats.kstest(speed - 2, scipy.stats.uniform.cdf).pvalue > 0.01
    assert scipy.stats.kstest(angle + 0.5, scipy.stats.uniform.cdf).pvalue > 0.01
    assert scipy.stats.spearmanr(speed, angle).pvalue > 0.01
