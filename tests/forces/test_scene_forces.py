"""The forces of scenes, each against its formula, a conservation law, or finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jeuler import (
    Bending,
    Gravity,
    Gust,
    LinearDrag,
    ParticleState,
    PointAttractor,
    QuadraticDrag,
    SampledPath,
    Scene,
    ShapeMatching,
    Springs,
    StrandBending,
    StrandCore,
    Viscosity,
    Vortex,
    Wind,
    euler_step,
    rk4_step,
    simulate,
    strand_edges,
    turbulence,
)
from jeuler.forces.hair import share_of, smoothed, transported_frames
from jeuler.forces.soft_body import rotation_of
from jeuler.particles.equation import Equation
from jeuler.particles.protocols import Context

ONE = jnp.asarray(1.0)
_force = jax.jit(lambda force, p, v, mass: force(0.0, p, v, mass))


def at(force, p, v=None):
    """The force on unit masses at p, moving with v or at rest."""
    return _force(force, p, 0 * p if v is None else v, ONE)


@pytest.fixture
def cloud(random):
    return jnp.asarray(random.normal(size=(7, 3))), jnp.asarray(random.normal(size=(7, 3)))


def rotation(random, dim=3):
    q, _ = np.linalg.qr(random.normal(size=(dim, dim)))
    return jnp.asarray(q * np.sign(np.linalg.det(q)))


@pytest.mark.parametrize("dim", [2, 3])
def test_bending_is_minus_the_gradient_of_its_energy(dim, random):
    p = jnp.asarray(random.normal(size=(5, dim)))
    bend = Bending([[0, 1, 2], [1, 2, 3], [2, 3, 4]], 2.0, [0.0, 0.4, 1.0])
    expected = -jax.grad(lambda p: bend.energy(0.0, p, ONE))(p)
    assert np.allclose(at(bend, p), expected, atol=1e-12)


def test_bending_of_a_straight_rope_is_smooth_and_a_stiff_one_falls_back_to_straight():
    straight = jnp.stack([jnp.arange(3.0), jnp.zeros(3)], axis=1)
    bend = Bending([[0, 1, 2]], 3.0)
    slope = jax.jit(jax.jacfwd(lambda p: at(bend, p)))(straight)
    # E = k theta^2 / 2 with theta = y0 - 2 y1 + y2 for unit edges: the beam's second difference
    second = np.array([1.0, -2.0, 1.0])
    assert np.allclose(slope[:, 1, :, 1], -3.0 * np.outer(second, second), atol=1e-12)
    assert np.allclose(at(bend, straight), 0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_rotation_is_that_of_the_polar_decomposition_and_its_derivative_is_right(dim, random):
    a = jnp.asarray(random.normal(size=(dim, dim)))
    a = a * jnp.sign(jnp.linalg.det(a))
    expected, _ = scipy.linalg.polar(np.asarray(a))
    assert np.allclose(rotation_of(a), expected, atol=1e-12)
    da, step = jnp.asarray(random.normal(size=(dim, dim))), 1e-6
    for b in (a, jnp.eye(dim)):  # equal singular values too
        difference = (rotation_of(b + step * da) - rotation_of(b - step * da)) / (2 * step)
        assert np.allclose(jax.jvp(rotation_of, (b,), (da,))[1], difference, atol=1e-8)
    assert np.isclose(jnp.linalg.det(rotation_of(-jnp.eye(3))), 1), "an inverted body finds a rotation, no mirror"


def test_a_soft_body_does_not_resist_rigid_motion(random):
    rest = jnp.asarray(random.normal(size=(6, 3)))
    body = ShapeMatching(range(6), rest, 10.0, damping=3.0)
    turn = rotation(random)
    p = rest @ turn.T + 4.0
    spin = jnp.cross(jnp.array([0.3, -0.2, 0.9]), p - p.mean(axis=0)) + 1.0
    assert np.allclose(at(body, p, spin), 0, atol=1e-12)
    assert not np.allclose(at(body, 1.1 * p, spin), 0)


# --- air ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_turbulence_has_no_sources_and_its_speed(dim, random):
    field = turbulence(dim=dim, speed=2.0, size=0.7, time=3.0, modes=40, seed=4)
    points = jnp.asarray(random.uniform(-50, 50, size=(4000, dim)))
    w = field(1.3, points)
    assert np.isclose(jnp.sqrt(jnp.mean(jnp.sum(w**2, axis=1))), 2.0, rtol=0.05)
    slope = jax.vmap(jax.jacfwd(lambda p: field(1.3, p[None])[0]))(points[:5])
    assert np.allclose(jnp.trace(slope, axis1=1, axis2=2), 0, atol=1e-12)
    assert np.array_equal(turbulence(dim=dim, speed=2.0, size=0.7, time=3.0, modes=40, seed=4)(1.3, points), w)


def test_a_vortex_has_its_circulation_and_a_solid_core():
    vortex = Vortex([1.0, 0.0, 5.0], circulation=3.0, core=0.1, axis=[0.0, 0.0, 2.0])
    angle = jnp.linspace(0, 2 * jnp.pi, 100, endpoint=False)
    ring = jnp.stack([1 + 2 * jnp.cos(angle), 2 * jnp.sin(angle), 0 * angle], axis=1)
    tangent = jnp.stack([-jnp.sin(angle), jnp.cos(angle), 0 * angle], axis=1)
    around = jnp.sum(vortex(0.0, ring) * tangent, axis=1)
    assert np.isclose(around.mean() * 2 * jnp.pi * 2, 3.0)
    spin = jax.jacfwd(lambda p: vortex(0.0, p[None])[0])(jnp.array([1.0, 0.0, 0.0]))
    assert np.isclose(spin[1, 0], 3.0 / (2 * jnp.pi * 0.01)), "at the axis, half the vorticity"
    assert np.all(np.isfinite(jax.jit(jax.hessian(lambda p: vortex(0.0, p[None])[0, 1]))(jnp.array([1.0, 0.0, 0.0]))))


def test_wind_and_gust_and_attractor_follow_functions_of_time():
    p = jnp.zeros((1, 2))
    assert Wind(lambda t: jnp.array([t, 0.0]))(3.0, p).tolist() == [[3.0, 0.0]]
    gust = Gust([2.0, 0.0], 4.0)
    assert np.allclose([gust(t, p)[0, 0] for t in (0.0, 1.0, 2.0, 4.0)], [0.0, 1.0, 2.0, 0.0])
    path = SampledPath([0.0, 1.0], [[1.0, 0.0], [3.0, 0.0]])
    pull = PointAttractor(path, 1.0, softening=1e-9, power=0)
    assert np.allclose(pull(0.5, jnp.array([[9.0, 0.0]]), p, 2.0 * ONE), [[-2.0, 0.0]])
    push = PointAttractor([0.0, 0.0], lambda t: -4.0 * t, softening=1e-9)
    assert np.allclose(push(2.0, jnp.array([[2.0, 0.0]]), p, ONE), [[2.0, 0.0]])
    assert np.allclose(push(2.0, p, p, ONE), 0), "at the point itself"


DRAGS = {"linear": LinearDrag, "quadratic": QuadraticDrag}


@pytest.mark.parametrize("name", DRAGS)
@pytest.mark.parametrize("dt", [1e-3, 1.0, 1e3, 1e6])
def test_drag_never_overshoots_the_wind(name, dt):
    wind = jnp.array([3.0, -1.0])
    kind = DRAGS[name]
    state = ParticleState(
        jnp.zeros((3, 2)), jnp.array([[0.0, 0.0], [50.0, 2.0], [3.0, -1.0]]), mass=[1.0, 0.01, jnp.inf]
    )
    for forces in ((kind(2.0, air=wind),), (kind(2.0, air=wind), LinearDrag(7.0, air=wind))):
        v = simulate(Scene(forces), state, dt=dt, num_steps=20).y.velocity[:, :2]
        relative = v - wind
        along = jnp.sum(relative[1:] * relative[:-1], axis=-1)
        distance = jnp.linalg.norm(relative, axis=-1)
        assert np.all(along >= -1e-9), "it never passes the wind"
        assert np.all(np.diff(distance, axis=0) <= 1e-12)


@pytest.mark.parametrize("name", DRAGS)
def test_drag_where_the_step_is_short_is_the_plain_force_to_the_last_bit(name, cloud):
    p, v = cloud
    drag = DRAGS[name](0.3, air=(Wind([1.0, 0.0, 0.0]), turbulence(dim=3, speed=0.2, size=1.0, modes=4)))
    for mass in (ONE, jnp.full(len(p), 2.0)):
        motion = (p, v)
        free = Scene((drag,)).vector_field(0.3, motion, mass)[1]
        context = Context(len(p), p.dtype, jnp.asarray(0.01), euler_step)
        found = Equation.of((drag,), (), context).vector_field(0.3, motion, mass)[1]
        assert np.array_equal(found, free)


def test_drag_in_a_wind_agrees_with_the_exact_solutions():
    """Linear: w + (v - w) exp(-c t / m). Quadratic along the wind: u / (1 + c u t / m)."""
    state = ParticleState([[0.0, 0.0]], [[5.0, 0.0]], mass=2.0)

    def end(force):
        return float(simulate(Scene((force,)), state, dt=0.01, num_steps=100, step=rk4_step).y.velocity[-1, 0, 0])

    assert np.isclose(end(LinearDrag(1.5, air=[2.0, 0.0])), 2 + 3 * np.exp(-0.75), rtol=1e-10)
    assert np.isclose(end(QuadraticDrag(1.5, air=[2.0, 0.0])), 2 + 3 / (1 + 0.75 * 3), rtol=1e-9)


# --- hair --------------------------------------------------------------------------------------------------------


def helix(coils=3, nodes=30):
    s = np.linspace(0, 1, nodes)
    angle = 2 * np.pi * coils * s
    return jnp.asarray(np.stack([0.1 * np.cos(angle) - 0.1, 0.1 * np.sin(angle), -s], axis=1))[None]


def test_smoothing_is_the_recursion_of_the_paper(random):
    edges, share = jnp.asarray(random.normal(size=(2, 9, 3))), 0.3
    expected = np.empty(edges.shape)
    for i in range(9):
        last = expected[:, i - 1] if i >= 1 else edges[:, 0]
        before = expected[:, i - 2] if i >= 2 else edges[:, 0]
        expected[:, i] = 2 * (1 - share) * last - (1 - share) ** 2 * before + share**2 * edges[:, i]
    assert np.allclose(smoothed(edges, jnp.asarray(share)), expected, atol=1e-13)


def test_transported_frames_are_frames_along_the_curve(random):
    edges = jnp.asarray(random.normal(size=(2, 9, 3)))
    frames = jax.jit(transported_frames)(edges)
    assert np.allclose(jnp.einsum("seij,seik->sejk", frames, frames), np.eye(3), atol=1e-12)
    along = edges / jnp.linalg.norm(edges, axis=-1, keepdims=True)
    assert np.allclose(frames[..., 0], along, atol=1e-12)
    assert np.allclose(jnp.linalg.det(frames), 1)


def test_hair_at_rest_feels_nothing_however_it_is_turned(random):
    rest = helix()
    turned = rest[0] @ rotation(random).T + 1.0
    core = StrandCore([range(30)], rest, 3.0, 0.1, smoothing=0.5)
    bend = StrandBending([range(30)], rest, 3.0, 0.1, smoothing=0.5)
    assert np.allclose(at(core, turned), 0, atol=1e-12)
    about_z = jnp.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(at(bend, rest[0]), 0, atol=1e-12)
    assert np.isfinite(at(bend, rest[0] @ about_z.T)).all()


def test_core_springs_pull_a_drawn_out_curl_back():
    """The strand is drawn to 1.3 of its length without a longer edge: only the core notices."""
    rest = helix()
    wide = np.diff(np.asarray(rest[0]), axis=0)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    flat = wide * [0.3, 0.3, 1.0]
    drawn = jnp.asarray(
        np.concatenate([[[0.0, 0, 0]], np.cumsum(flat * length / np.linalg.norm(flat, axis=1, keepdims=True), axis=0)])
    )
    stretch = Springs(strand_edges([range(30)]), 100.0, 0.0, length[:, 0])
    core = StrandCore([range(30)], rest, 3.0, 0.0, smoothing=0.5)
    assert np.allclose(at(stretch, drawn), 0, atol=1e-9)
    pull = at(core, drawn)
    assert pull[-1, 2] > 0.05, "the tip goes up again"
    assert 0 < float(share_of(jnp.asarray(0.5), jnp.diff(rest, axis=1))) < 1


def test_bad_indices_and_shapes_get_one_clear_error():
    state = ParticleState(jnp.zeros((3, 2)), jnp.zeros((3, 2)))

    def run(force):
        simulate(Scene((force,)), state, dt=0.1, num_steps=1)

    for force, message in (
        (Bending([[0, 1, 9]], 1.0), "Bending.triples must be particle indices from 0 to 2"),
        (Viscosity([[0, 9]], 1.0), "edges must be indices below the number of particles, 3"),
        (ShapeMatching([0, 9], [[0.0, 0.0], [1.0, 0.0]], 1.0), "ShapeMatching.particles must be particle indices"),
        (ShapeMatching([0, 1], [[0.0] * 3] * 2, 1.0), r"rest_position must have shape \(2, 2\)"),
        (StrandCore([[0, 1, 2]], np.zeros((1, 3, 3)), 1.0, 0.0, 1.0), "StrandCore needs particles in space, dim 3"),
        (PointAttractor([0.0] * 3, 1.0, 1.0), r"PointAttractor.center must have shape \(2,\), got \(3,\)"),
        (LinearDrag([1.0, 2.0]), r"LinearDrag.coefficient must have shape \(\) or \(3,\)"),
        (LinearDrag(1.0, air=[1.0, 2.0, 3.0]), r"LinearDrag.air must give a velocity of shape \(3, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            run(force)
    with pytest.raises(ValueError, match="triples must be integers"):
        Bending([[0.0, 1.0, 2.0]], 1.0)
    with pytest.raises(ValueError, match="dim must be 2 or 3"):
        turbulence(dim=4, speed=1.0, size=1.0)


def test_gravity_and_drag_give_terminal_speed_under_any_dt():
    state = ParticleState([[0.0, 0.0]], [[0.0, 0.0]], mass=2.0)
    scene = Scene((Gravity([0.0, -9.81]), LinearDrag(4.0)))
    v = simulate(scene, state, dt=0.1, num_steps=200).y.velocity[-1, 0]
    assert np.allclose(v, [0.0, -9.81 * 2 / 4])
