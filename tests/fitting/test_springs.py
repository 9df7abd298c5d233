"""fit_springs: twin experiments against diffrax's data, real data, every parameter, bad input."""

import diffrax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jeuler


def solve_tight(scene, position, velocity, mass, times):
    """The scene's motion by diffrax Tsit5 at 1e-10: data that the fit's own steps did not make."""
    return np.asarray(
        diffrax.diffeqsolve(
            diffrax.ODETerm(scene.vector_field),
            diffrax.Tsit5(),
            0.0,
            times[-1],
            1e-3,
            (jnp.asarray(position), jnp.asarray(velocity)),
            args=jnp.asarray(mass),
            saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
            stepsize_controller=diffrax.PIDController(rtol=1e-10, atol=1e-10),
            max_steps=100_000,
        ).ys[0]
    )


def net(side):
    """Structural and shear springs of a square net."""
    at = np.arange(side * side).reshape(side, side)
    pairs = [(at[:, :-1], at[:, 1:]), (at[:-1], at[1:]), (at[:-1, :-1], at[1:, 1:]), (at[:-1, 1:], at[1:, :-1])]
    return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def test_twin_net_recovers_every_spring(random):
    """4x4 particles, 42 springs, top corners pinned, thrown; from a start wrong by a factor of 3."""
    edges, side = net(4), 4
    position = np.stack(np.meshgrid(np.arange(side), -np.arange(side)), axis=-1).reshape(-1, 2).astype(float)
    mass = np.ones(side * side)
    mass[[0, side - 1]] = np.inf
    velocity = np.where(np.isinf(mass)[:, None], 0, random.normal(size=position.shape))
    ks, kd = 50 * 4 ** random.uniform(size=len(edges)), 0.5 * 4 ** random.uniform(size=len(edges))
    length = np.linalg.norm(position[edges[:, 0]] - position[edges[:, 1]], axis=1)

    def scene(ks, kd):
        return jeuler.Scene(forces=(jeuler.Gravity([0.0, -9.81]), jeuler.Springs(edges, ks, kd, length)))

    times = np.sort(random.uniform(0, 1.5, 50))
    targets = solve_tight(scene(ks, kd), position, velocity, mass, times)
    state = jeuler.ParticleState(position, velocity, mass)
    found = jeuler.fit_springs(scene(ks / 3, kd * 3), state, times, targets, dt=0.015)
    assert np.max(np.abs(found.ks / ks - 1)) < 0.01
    assert np.max(np.abs(found.kd / kd - 1)) < 0.03
    assert found.predicted.shape == targets.shape
    np.testing.assert_allclose(found.loss, np.mean((found.predicted - targets) ** 2), rtol=1e-6)


def test_spring_between_pinned_particles_stays_and_is_named():
    edges = [(0, 1), (0, 2), (1, 2)]
    position = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, -1.0]])
    mass, velocity = np.array([np.inf, np.inf, 1.0]), np.zeros((3, 2))

    def scene(ks):
        return jeuler.Scene(forces=(jeuler.Gravity([0.0, -9.81]), jeuler.Springs(edges, ks, 0.3, 0.9)))

    times = np.linspace(0.03, 2, 40)
    targets = solve_tight(scene([5.0, 20.0, 30.0]), position, velocity, mass, times)
    state = jeuler.ParticleState(position, velocity, mass)
    found = jeuler.fit_springs(scene([7.0, 25.0, 25.0]), state, times, targets, dt=0.02, parameters=("ks",))
    np.testing.assert_allclose(found.ks, [7.0, 20.0, 30.0], rtol=1e-4)
    assert found.undetermined == ("ks[0]",)
    assert np.isinf(found.stderr["ks"][0])
    assert "do not determine ks[0]" in found.message


# one mass on one damped spring, x = L + e^(-gt) (a cos wt + b sin wt): all that may be free, each found from the others
KS, KD, MASS, LENGTH, ANCHOR, X0, V0 = 9.0, 0.5, 1.2, 1.0, 0.4, 1.7, -0.3
TIMES = np.linspace(0.0, 4.0, 83)[1:]


def exact(times, kd=KD):
    decay = kd / MASS / 2
    omega = np.sqrt(KS / MASS - decay**2)
    a = X0 - ANCHOR - LENGTH
    return (
        ANCHOR
        + LENGTH
        + np.exp(-decay * times) * (a * np.cos(omega * times) + (V0 + decay * a) / omega * np.sin(omega * times))
    )


def single(ks=KS, kd=KD, length=LENGTH, anchor=ANCHOR, x0=X0, v0=V0, mass=MASS):
    scene = jeuler.Scene(forces=(jeuler.Springs([[0, 1]], ks, kd, length),))
    return scene, jeuler.ParticleState([[anchor], [x0]], [[0.0], [v0]], mass=[jnp.inf, mass])


def observed(times=TIMES, kd=KD):
    targets = np.full((len(times), 2, 1), np.nan)
    targets[:, 1, 0] = exact(times, kd)
    return targets


@pytest.mark.parametrize(
    ("free", "start"),
    [
        (("ks", "kd"), {"ks": 3.0, "kd": 1.5}),
        (("ks", "kd", "rest_length"), {"ks": 7.0, "kd": 0.8, "length": 1.2}),
        (("kd", "mass"), {"kd": 0.2, "mass": 2.0}),
        (("ks", "velocity", "position"), {"ks": 12.0, "v0": 0.0, "x0": 1.4}),
        (("ks", "kd", "anchors"), {"ks": 11.0, "anchor": 0.1}),
    ],
)
def test_every_parameter_may_be_free(free, start):
    scene, state = single(**start)
    found = jeuler.fit_springs(scene, state, TIMES, observed(), dt=0.02, parameters=free)
    truth = {
        "ks": KS, "kd": KD, "rest_length": LENGTH, "mass": MASS, "velocity": V0, "position": X0, "anchors": ANCHOR,
    }  # fmt: skip
    for name in free:
        np.testing.assert_allclose(np.ravel(found.params[name]), truth[name], rtol=1e-4)
    np.testing.assert_allclose(found.predicted[:, 1, 0], exact(TIMES), atol=1e-5)
    assert found.state.mass[0] == np.inf


def test_times_off_the_grid_and_missing_cells(random):
    times = np.sort(random.uniform(0, 4, 50))
    targets = observed(times)
    targets[::3] = np.nan
    scene, state = single(ks=20.0, kd=0.2)
    found = jeuler.fit_springs(scene, state, times, targets, dt=0.05)
    np.testing.assert_allclose((found.ks, found.kd), (KS, KD), rtol=1e-4)


def test_each_observation_has_its_own_sigma_or_weight(random):
    """An outlier of 10 m that is NaN, of sigma inf or of weight 0; elsewhere sigma is absolute and weights relative."""
    noise = np.where(np.arange(len(TIMES)) % 2, 1e-3, 5e-3)
    y = observed()
    y[:, 1, 0] += noise * random.normal(size=len(TIMES))
    scene, state = single(ks=7.0)
    spoilt, sigma = y.copy(), np.broadcast_to(noise[:, None, None], y.shape).copy()
    y[9], spoilt[9, 1], sigma[9] = np.nan, 10.0, np.inf
    found = [
        jeuler.fit_springs(scene, state, TIMES, positions, dt=0.02, **options)
        for positions, options in (
            (y, {"sigma": noise[:, None, None]}),
            (spoilt, {"sigma": sigma}),
            (spoilt, {"weights": 4e-6 / sigma**2}),
        )
    ]
    for name, truth in (("ks", KS), ("kd", KD)):
        by_sigma, by_inf, by_weight = (each.params[name] for each in found)
        np.testing.assert_allclose([by_inf, by_weight], by_sigma, rtol=1e-6)
        assert abs(by_sigma - truth) < 4 * found[0].stderr_white[name]
        scaled = found[0].stderr_white[name] * found[0].noise_ratio
        np.testing.assert_allclose(found[2].stderr_white[name], scaled, rtol=1e-4)
    equal = jeuler.fit_springs(scene, state, TIMES, y, dt=0.02)
    assert equal.stderr_white["ks"] > 1.5 * found[2].stderr_white["ks"]


def test_gradient_descent_by_optax():
    scene, state = single(ks=6.0, kd=0.8)
    adam = {"optimizer": optax.adam(0.05), "max_iterations": 300}
    found = jeuler.fit_springs(scene, state, TIMES, observed(), dt=0.04, start="given", **adam)
    np.testing.assert_allclose((found.ks, found.kd), (KS, KD), rtol=1e-2)
    assert found.history[-1] < 1e-4 * found.history[0]


def test_growing_horizon_finds_the_period_that_the_whole_record_hides():
    """Nine periods, hardly damped: gradient descent in ks over all of it at once settles in a wrong valley."""
    times = np.linspace(0, 20, 150)[1:]
    scene, state = single(ks=25.0, kd=0.02)
    run = {"dt": 0.08, "parameters": ("ks",), "start": "given"}
    descent = {"optimizer": optax.adam(0.05), "max_iterations": 150, "grow": False}
    at_once = jeuler.fit_springs(scene, state, times, observed(times, 0.02), **run, **descent)
    grown = jeuler.fit_springs(scene, state, times, observed(times, 0.02), **run)
    assert abs(float(at_once.ks) / KS - 1) > 0.3
    np.testing.assert_allclose(grown.ks, KS, rtol=1e-3)


def test_a_start_that_blows_up_is_backed_off_from():
    """At ks = 4e5 rk4 overflows within the record at this dt; the first stages see only what is finite."""
    scene, state = single(ks=KS * 4)
    run = {"dt": 0.2, "step": jeuler.euler_step, "num_steps": 40, "start": "given"}
    found = jeuler.fit_springs(scene, state, TIMES, observed(), **run)
    assert np.isfinite(found.loss)
    assert np.isfinite(found.ks)
    assert np.isfinite(found.predicted).all()
    stiff, state = single(ks=1e9)
    with pytest.raises(ValueError, match="not finite at the start.*smaller dt"):
        jeuler.fit_springs(stiff, state, TIMES, observed(), dt=0.2, start="given")
    found = jeuler.fit_springs(stiff, state, TIMES, observed(), dt=0.02)
    np.testing.assert_allclose(found.ks, KS, rtol=1e-4)


@pytest.mark.parametrize(
    ("drag", "frequency", "tolerance", "rms"), [(False, 22.9, 0.3, 2.1e-3), (True, 22.6, 0.2, 1.3e-3)]
)
def test_sphere_in_water(sphere_in_water, drag, frequency, tolerance, rms):
    times, columns = jeuler.read_trajectory(sphere_in_water)
    keep = times >= 0.75
    times, x = times[keep], columns["x_m"][keep]
    assert len(times) == 723
    targets = np.stack([np.full_like(x, np.nan), x], axis=1)[:, :, None]
    forces = (jeuler.Springs([[0, 1]], 15.0, 0.2, 0.0), *((jeuler.QuadraticDrag(1.0),) if drag else ()))
    state = jeuler.ParticleState([[x.mean()], [x[0]]], [[0.0], [0.0]], mass=[jnp.inf, 1.0])
    free = ("ks", "kd", "anchors", "position", "velocity", *(("coefficient",) if drag else ()))
    found = jeuler.fit_springs(
        jeuler.Scene(forces=forces), state, times, targets, dt=0.02, t0=times[0], parameters=free
    )
    assert abs(float(found.ks) - frequency) <= tolerance
    assert np.sqrt(found.loss) <= rms


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"times": TIMES[::-1]}, "times must not decrease"),
        ({"times": TIMES - 1}, r"begins at t0 = 0.0 s, got -0.9"),
        ({"num_steps": 10}, "times must lie in the simulated span.*num_steps=200 reaches it"),
        ({"times": TIMES[:5]}, r"positions must have shape \(time, particle, dim\) = \(5, 2, 1\), got \(82, 2, 1\)"),
        ({"times": np.full_like(TIMES, np.nan)}, "times must be finite, got nan"),
        ({"times": TIMES[:, None]}, r"times must have shape \(time,\)"),
        ({"positions": np.full((82, 2, 1), np.nan)}, "at least one finite value"),
        ({"positions": np.full((82, 2, 1), np.inf)}, "positions must be finite, or NaN"),
        ({"dt": 0.0}, "dt must be greater than 0"),
        ({"parameters": "ks"}, "parameters must be a tuple of names"),
        ({"parameters": ("stiffness",)}, "parameters must be among .*'kd', 'ks'.* got 'stiffness'"),
        ({"parameters": ()}, "parameters must be a tuple of names"),
    ],
)
def test_bad_input(change, message):
    scene, state = single()
    arguments = {"times": TIMES, "positions": observed(), "dt": 0.02, **change}
    with pytest.raises(ValueError, match=message):
        jeuler.fit_springs(scene, state, **arguments)


@pytest.mark.parametrize(
    ("start", "values"),
    [
        ("data", {"kd": 0.0}),
        ("data", {"ks": 0.0}),
        ("data", {"ks": 0.0, "kd": 0.0}),
        ("data", {"ks": 900.0}),
        ("given", {"kd": 0.0}),
        ("given", {"kd": 1e-6}),
        ("given", {"ks": 0.0, "kd": 1e-9}),
    ],
)
def test_zero_and_far_starts_are_legal(start, values):
    scene, state = single(**values)
    found = jeuler.fit_springs(scene, state, TIMES, observed(), dt=0.02, start=start)
    np.testing.assert_allclose((found.ks, found.kd), (KS, KD), rtol=1e-4)
    assert found.converged


def test_names_that_need_a_particle():
    scene, state = single()
    free = jeuler.ParticleState(state.position, state.velocity, 1.0)
    with pytest.raises(ValueError, match=r"'anchors', but the state has no pinned"):
        jeuler.fit_springs(scene, free, TIMES, observed(), dt=0.02, parameters=("anchors",))
