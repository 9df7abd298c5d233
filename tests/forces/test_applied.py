"""Forces given in time, dry friction, and paths through samples of a band-limited signal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler


def test_a_force_in_time_acts_on_its_particles_alone():
    at_rest = jnp.zeros((3, 2))
    one = jeuler.AppliedForce(lambda t: jnp.stack([t, -t]), particles=[2, 0], gain=2.0)
    np.testing.assert_array_equal(one(1.5, at_rest, at_rest, jnp.ones(3)), [[3.0, -3.0], [0.0, 0.0], [3.0, -3.0]])
    each = jeuler.AppliedForce([[1.0, 0.0], [0.0, 1.0]], particles=[2, 0])
    np.testing.assert_array_equal(each(0.0, at_rest, at_rest, jnp.ones(3)), [[0.0, 1.0], [0.0, 0.0], [1.0, 0.0]])
    everywhere = jeuler.AppliedForce([1.0, 2.0])
    np.testing.assert_array_equal(everywhere(0.0, at_rest, at_rest, jnp.ones(3)), [[1.0, 2.0]] * 3)


def test_dry_friction_stops_a_sliding_block_after_its_distance():
    """v^2 = 2 a s, a = c / m = 4: from 2 m/s it comes to rest after 0.5 m and 0.5 s, and stays."""
    block = jeuler.ParticleState([[0.0, 0.0]], [[1.2, 1.6]], mass=0.1)
    run = jeuler.simulate(
        jeuler.Scene((jeuler.DryFriction(0.4, slow=0.005),)), block, dt=1e-3, num_steps=750, save_every=250
    )
    way = np.linalg.norm(np.asarray(run.y.position)[:, 0], axis=1)
    np.testing.assert_allclose(way, [0.0, 0.375, 0.5, 0.5], atol=2e-3)
    still = jax.jacfwd(lambda v: jeuler.DryFriction(0.4, 0.2)(0.0, v, v, jnp.ones(1)))(jnp.zeros((1, 2)))
    np.testing.assert_allclose(still[0, :, 0], 0 * np.eye(2))  # the direction of no motion is none


@pytest.mark.parametrize("samples", [2.5, 4.0, 40.0])
def test_between_samples_of_a_band_limited_signal_is_the_signal(samples):
    """A sine of so many samples a period, 16 samples from the ends on; a cubic through four is off by a tenth."""
    times = 3.0 + 0.1 * np.arange(101)
    rate = 2 * np.pi / (0.1 * samples)
    path = jeuler.SampledPath.band_limited(times, np.sin(rate * times))
    between = np.linspace(times[17], times[-18], 501)
    worst = np.abs(jax.vmap(path)(between) - np.sin(rate * between)).max()
    assert worst < 2e-3
    np.testing.assert_array_equal(path.positions[::8], np.sin(rate * times))


def test_band_limited_paths_need_even_times():
    with pytest.raises(ValueError, match="needs evenly spaced times, got one 0.02"):
        jeuler.SampledPath.band_limited([0.0, 0.1, 0.22, 0.3], np.zeros(4))
    two = jeuler.SampledPath.band_limited([0.0, 1.0], np.array([[0.0], [2.0]]))
    assert float(two(0.25)[0]) == pytest.approx(0.5, rel=1e-3)
