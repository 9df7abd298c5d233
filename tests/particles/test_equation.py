"""`simulate` solves the equation of motion; where drag is limited, by the rule that the drags' docstrings say."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from cases import FORCES, IN_SPACE, force_state, leapfrog_step
from jax.test_util import check_grads

import jeuler
from jeuler.particles.equation import Equation
from jeuler.particles.protocols import Context

STEPS = {
    "euler": jeuler.euler_step,
    "symplectic_euler": jeuler.symplectic_euler_step,
    "heun": jeuler.heun_step,
    "rk4": jeuler.rk4_step,
    "one's own": leapfrog_step,
    "extrapolated": jeuler.extrapolated_euler(3),
    "implicit_euler": jeuler.implicit_euler(rtol=1e-13, atol=1e-15),
    "linearly_implicit_euler": jeuler.linearly_implicit_euler_step,
}
LIMITED = ("euler", "symplectic_euler")
UNLIMITED = [name for name in STEPS if name not in LIMITED]
IMPLICIT = ("implicit_euler", "linearly_implicit_euler")
EXPLICIT = [name for name in STEPS if name not in IMPLICIT]
FIRST_ORDER = (*LIMITED, *IMPLICIT)
TIME = {"dt": 0.01, "num_steps": 2}


def both_ways(forces, state, step, **time):
    scene = jeuler.Scene(forces)
    run = jeuler.simulate(scene, state, step=step, **time).y
    motion = state.position, jnp.where(jnp.isinf(state.mass)[:, None], 0, state.velocity)
    solution = jeuler.solve(scene.vector_field, motion, args=scene.attributes(state), step=step, **time)
    return (run.position, run.velocity), solution.y


def agree(found, expected, what="", dtype=jnp.float64, tolerance=1e-12):
    for a, b in zip(found, expected, strict=True):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=what)


def compiled(function, *arguments):
    """The function compiled without the optimisations that take most of the time: what it computes is looked at."""
    quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    return jax.jit(function).lower(*arguments).compile(compiler_options=quick)(*arguments)


@pytest.mark.parametrize("name", FORCES)
def test_every_force_alone(name):
    """Under a step that limits drag, and one that does not."""

    def runs(state):
        return {step: both_ways((FORCES[name](),), state, STEPS[step], **TIME) for step in ("euler", "rk4")}

    for step, run in compiled(runs, force_state(name)).items():
        agree(*run, step)


@pytest.mark.parametrize("name", FORCES)
def test_every_force_in_single_precision(name):
    run = both_ways((FORCES[name](),), force_state(name, jnp.float32), jeuler.symplectic_euler_step, **TIME)
    agree(*run, dtype=jnp.float32, tolerance=2e-6)


IN_PLANE = [name for name in FORCES if name not in IN_SPACE]


@functools.cache
def all_at_once(names):
    """Forces that stand in one scene, their particles, and the vector field of that scene as a program of its own."""
    forces, state = tuple(FORCES[name]() for name in names), force_state(names[0])
    return forces, state, jax.jit(jeuler.Scene(forces).vector_field)


def ran(forces, state, steps):
    """Positions and velocities at the steps' ends, a row for each step of a run, as `simulate` makes them."""

    def runs(state):
        found = {step: jeuler.simulate(jeuler.Scene(forces), state, step=STEPS[step], **TIME).y for step in steps}
        return {step: (y.position, y.velocity) for step, y in found.items()}

    return compiled(runs, state)


@pytest.mark.parametrize("names", [IN_PLANE, IN_SPACE], ids=["plane", "space"])
def test_every_force_under_every_explicit_step(names):
    """All in one scene, as each step compiles for a second or more: what one does to the others' arguments shows too.

    The run is followed by the steps' own functions, called one after the other on the vector field.
    """
    forces, state, field = all_at_once(tuple(names))
    for step, motion in ran(forces, state, EXPLICIT).items():
        y = state.position, jnp.where(jnp.isinf(state.mass)[:, None], 0, state.velocity)
        for k in range(TIME["num_steps"]):
            y = STEPS[step](field, k * TIME["dt"], y, TIME["dt"], state.mass)
            agree([part[k + 1] for part in motion], y, step)


@pytest.mark.parametrize("names", [IN_PLANE, IN_SPACE], ids=["plane", "space"])
@pytest.mark.parametrize("step", IMPLICIT)
def test_every_force_under_every_implicit_step(names, step):
    """Each step of the run fulfils the equation that defines it: y' = y + h f(y'), or y' = y + h (f + J (y' - y))."""
    forces, state, field = all_at_once(tuple(names))
    motion, h = ran(forces, state, [step])[step], TIME["dt"]
    for k in range(TIME["num_steps"]):
        before, after = ([part[at] for part in motion] for at in (k, k + 1))
        t = (k + 1) * h
        if step == "implicit_euler":
            slope = field(t, tuple(after), state.mass)
        else:
            moved = tuple(b - a for a, b in zip(before, after, strict=True))
            at, along = jax.jvp(lambda y: field(t, y, state.mass), (tuple(before),), (moved,))  # noqa: B023
            slope = [a + b for a, b in zip(at, along, strict=True)]
        agree(after, [a + h * b for a, b in zip(before, slope, strict=True)], step)


# --- drag that would overshoot ---------------------------------------------------------------------------------------

WIND, OTHER_WIND = [3.0, -1.0], [-2.0, 0.5]
DRAGS = {
    "linear": lambda c: (jeuler.LinearDrag(c, air=WIND),),
    "two linear": lambda c: (jeuler.LinearDrag(c / 4), jeuler.LinearDrag(3 * c / 4, air=WIND)),
    "quadratic": lambda c: (jeuler.QuadraticDrag(c, air=WIND),),
    "quadratic at rest": lambda c: (jeuler.QuadraticDrag(c),),
    "both": lambda c: (jeuler.LinearDrag(c / 2, air=OTHER_WIND), jeuler.QuadraticDrag(c / 2, air=WIND)),
    "two quadratic": lambda c: (jeuler.QuadraticDrag(c / 3, air=WIND), jeuler.QuadraticDrag(c, air=OTHER_WIND)),
    "three": lambda c: (
        jeuler.QuadraticDrag(c / 3, air=WIND), jeuler.LinearDrag(c, air=WIND), jeuler.QuadraticDrag(c / 5)
    ),
}  # fmt: skip
MASS = np.array([1.0, 0.01, np.inf, 2.0])
VELOCITY = np.array([[0.0, 0.0], [50.0, 2.0], [3.0, -1.0], [-4.0, 7.0]])
PUSH = np.array([4.0, -9.81])


def falling(drags, dtype=jnp.float64):
    state = jeuler.ParticleState(jnp.zeros((4, 2), dtype), jnp.asarray(VELOCITY, dtype), jnp.asarray(MASS, dtype))
    return jeuler.Scene((jeuler.Gravity(PUSH), *drags)), state


def terms(drags):
    """(c, q, w) of each drag."""
    for drag in drags:
        c, linear = float(drag.coefficient), isinstance(drag, jeuler.LinearDrag)
        wind = np.asarray(drag.air[0].velocity) if drag.air else np.zeros(2)
        yield (c, 0.0, wind) if linear else (0.0, c, wind)


def drag_at(v, drags):
    return sum(-(c + q * np.linalg.norm(v - w)) * (v - w) for c, q, w in terms(drags))


def balance(mass, drags):
    """v*, where drag balances the weight: the minimum of a convex function, by SciPy."""
    slope = scipy.optimize.root(lambda v: drag_at(v, drags) + mass * PUSH, np.add(WIND, 1), tol=1e-13)
    assert np.abs(slope.fun).max() < 1e-9 * np.linalg.norm(mass * PUSH)
    return slope.x


def documented_step(v, mass, dt, drags):
    """v' = v + dt F / max(m, dt kappa), with kappa as `jeuler.forces.drag.stiffness` has it."""
    parts = list(terms(drags))
    c, q = sum(c for c, _, _ in parts), sum(q for _, q, _ in parts)
    w = sum(q * w for _, q, w in parts) / q if q else np.zeros(2)
    slope = sum(q * np.linalg.norm(v - w) for _, q, w in parts)
    spread = sum(q * np.linalg.norm(at - w) for _, q, at in parts)
    g = np.linalg.norm(drag_at(w, drags) + mass * PUSH)
    kappa = c / 2 + slope + 2 * spread + np.sqrt((c - 2 * spread) ** 2 + 4 * q * g) / 2
    return v + dt * (drag_at(v, drags) + mass * PUSH) / max(mass, dt * kappa)


def same_terms(drags, v, mass, dt):
    """A drag alone, as its own docstring says it: what is above must come to this."""
    (c, q, w), *others = terms(drags)
    assert not others
    if c:
        return v + dt * (drag_at(v, drags) + mass * PUSH) / max(mass, c * dt)
    balanced = np.linalg.norm(balance(mass, drags) - w)
    return v + dt * (drag_at(v, drags) + mass * PUSH) / max(mass, q * (np.linalg.norm(v - w) + balanced) * dt)


@pytest.mark.parametrize("name", DRAGS)
@pytest.mark.parametrize("step", LIMITED)
def test_the_limit_is_the_documented_one_and_keeps_the_side_of_the_balance(name, step):
    for c, dt in ((1e-3, 1e-2), (0.5, 0.1), (50.0, 0.1), (3.0, 1e3), (2.0, 1e6)):
        drags = DRAGS[name](c)
        scene, state = falling(drags)
        v = np.asarray(jeuler.simulate(scene, state, dt=dt, num_steps=3, step=STEPS[step]).y.velocity)
        for k in (0, 1, 3):
            target = balance(MASS[k], drags)
            for before, after in zip(v[:-1, k], v[1:, k], strict=True):
                expected = documented_step(before, MASS[k], dt, drags)
                size = np.abs(before).max() + np.abs(target).max()
                np.testing.assert_allclose(after, expected, rtol=1e-12, atol=1e-12 * size)
                if len(drags) == 1:
                    alone = same_terms(drags, before, MASS[k], dt)
                    np.testing.assert_allclose(after, alone, rtol=1e-9, atol=1e-9 * size)
                assert (after - target) @ (before - target) >= -1e-9 * size**2, "it does not go past the balance"
                assert np.linalg.norm(after - target) <= np.linalg.norm(before - target) + 1e-9 * size
        np.testing.assert_array_equal(v[:, 2], 0, err_msg="a pinned particle")


@pytest.mark.parametrize("name", DRAGS)
@pytest.mark.parametrize("step", LIMITED)
def test_a_balance_is_an_equilibrium_of_the_limited_step(name, step):
    drags = DRAGS[name](50.0)
    scene, state = falling(drags)
    v = np.stack([balance(mass, drags) if np.isfinite(mass) else [0, 0] for mass in MASS])
    end = jeuler.simulate(scene, state.replace(velocity=jnp.asarray(v)), dt=1.0, num_steps=4, step=STEPS[step]).y
    np.testing.assert_allclose(end.velocity, np.broadcast_to(v, (5, 4, 2)), rtol=1e-10, atol=1e-10)


TERMINAL = {"linear": jeuler.LinearDrag, "quadratic": jeuler.QuadraticDrag}


def terminal_speeds(kind, coefficients, step, air):
    """Falling from rest for a long time, for each coefficient at once; dt = 0.1 s, 1 kg."""

    def end(c):
        scene = jeuler.Scene((jeuler.Gravity([-9.81]), kind(c, air=air)))
        state = jeuler.ParticleState(jnp.zeros((1, 1)), jnp.zeros((1, 1)))
        run = jeuler.simulate(scene, state, dt=0.1, num_steps=2000, save_every=2000, step=step)
        return run.y.velocity[-1, 0, 0]

    return jax.jit(jax.vmap(end))(coefficients)


@pytest.mark.parametrize("name", TERMINAL)
@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("wind", [None, [2.0]])
def test_terminal_speed(name, step, wind):
    """c dt / m from 0.01 to 100 (for quadratic drag, of 2 c |u*|), for steps of higher order as far as they are stable.

    Theirs is the plain force, and `first_nonfinite` or the speed itself shows that dt is too long for it.
    """
    rate = np.geomspace(0.01, 100, 13)
    if step not in FIRST_ORDER:
        rate = rate[rate < 1.9]
    c = rate / 0.1 if name == "linear" else (rate / 0.1 / 2) ** 2 / 9.81
    expected = -9.81 / c if name == "linear" else -np.sqrt(9.81 / c)
    found = terminal_speeds(TERMINAL[name], jnp.asarray(c), STEPS[step], wind)
    np.testing.assert_allclose(found - (wind[0] if wind else 0), expected, rtol=1e-6)


@pytest.mark.parametrize("step", LIMITED)
@pytest.mark.parametrize(
    ("one", "many"),
    [
        (lambda: (jeuler.LinearDrag(50.0),), lambda: (jeuler.LinearDrag(20.0), jeuler.LinearDrag(30.0))),
        (lambda: (jeuler.LinearDrag(50.0),), lambda: (jeuler.LinearDrag(50.0), jeuler.LinearDrag(1e-14))),
        (
            lambda: (jeuler.QuadraticDrag(50.0, air=WIND),),
            lambda: tuple(jeuler.QuadraticDrag(c, air=WIND) for c in (10.0, 15.0, 25.0)),
        ),
        (lambda: (jeuler.QuadraticDrag(50.0),), lambda: (jeuler.QuadraticDrag(50.0), jeuler.QuadraticDrag(1e-14))),
        (lambda: (jeuler.QuadraticDrag(50.0),), lambda: (jeuler.QuadraticDrag(50.0), jeuler.LinearDrag(1e-14))),
        (lambda: (jeuler.QuadraticDrag(50.0),), lambda: (jeuler.QuadraticDrag(50.0), jeuler.QuadraticDrag(0.0, WIND))),
    ],
)
def test_how_many_drags_share_the_work_makes_no_difference(step, one, many):
    runs = []
    for drags in (one(), many()):
        scene, state = falling(drags)
        runs.append(jeuler.simulate(scene, state, dt=0.1, num_steps=20, step=STEPS[step]).y)
    np.testing.assert_allclose(runs[0].velocity, runs[1].velocity, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(runs[0].position, runs[1].position, rtol=1e-9, atol=1e-9)


def test_the_order_of_forces_makes_no_difference():
    drags = DRAGS["three"](50.0)
    runs = []
    for forces in ((jeuler.Gravity(PUSH), *drags), (*drags[::-1], jeuler.Gravity(PUSH))):
        runs.append(jeuler.simulate(jeuler.Scene(forces), falling(drags)[1], dt=0.1, num_steps=9).y.velocity)
    np.testing.assert_allclose(*runs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("step", UNLIMITED)
def test_other_steps_see_the_plain_drag_at_any_step_size(step):
    """All drags in one program."""

    def runs(state):
        scenes = {name: falling(DRAGS[name](20.0))[0] for name in DRAGS}
        return {name: both_ways(scenes[name].forces, state, STEPS[step], dt=0.1, num_steps=1) for name in DRAGS}

    for name, run in compiled(runs, falling(())[1]).items():
        agree(*run, name, tolerance=1e-10)


def test_a_step_of_ones_own_gets_the_limit_if_it_says_what_it_is():
    def mine(f, t, y, dt, args):
        slope = f(t, y, args)
        return y[0] + dt * slope[0], y[1] + dt * slope[1]

    scene, state = falling(DRAGS["quadratic"](50.0))
    plain = jeuler.simulate(scene, state, dt=0.1, num_steps=5, step=mine).y.velocity
    mine.explicit, mine.order = True, 1
    limited = jeuler.simulate(scene, state, dt=0.1, num_steps=5, step=mine).y.velocity
    assert np.abs(plain[-1, 0]).max() > 1e3
    np.testing.assert_allclose(limited, jeuler.simulate(scene, state, dt=0.1, num_steps=5).y.velocity, rtol=1e-12)


@pytest.mark.parametrize("name", DRAGS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_where_the_limit_does_not_bind_the_run_is_the_plain_one_to_the_last_bit(name, dtype):
    """One step by hand, operation by operation: no compiler regroups anything."""
    scene, state = falling(DRAGS[name](1e-3), dtype)
    context = Context(4, dtype, jnp.asarray(1e-3, dtype), jeuler.euler_step)
    motion = state.position, state.velocity
    limited = Equation.of(scene.forces, (), context).vector_field(0.0, motion, state.mass)
    for a, b in zip(limited, scene.vector_field(0.0, motion, state.mass), strict=True):
        assert a.dtype == dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("drags", [(), (jeuler.LinearDrag(0.1),)])
@pytest.mark.parametrize("step", [jeuler.euler_step, jeuler.symplectic_euler_step, jeuler.rk4_step, None])
def test_a_force_is_told_whether_drags_are_limited(drags, step):
    told = []

    class Asks:
        def prepare(self, context):
            told.append(context.limits_drag)
            return lambda t, position, velocity, mass: -position

        def __call__(self, t, position, velocity, mass):
            return -position

    context = Context(4, jnp.float64, None if step is None else jnp.asarray(0.1), step)
    Equation.of((Asks(), *drags), (), context)
    assert told == [bool(drags) and step in (jeuler.euler_step, jeuler.symplectic_euler_step)]


@pytest.mark.parametrize("name", DRAGS)
@pytest.mark.parametrize("c", [1e-3, 50.0])
def test_gradients_through_the_limit(name, c):
    def loss(c, push):
        scene, state = falling(DRAGS[name](c))
        scene = jeuler.Scene((jeuler.Gravity(push), *scene.forces[1:]))
        return jnp.sum(jeuler.simulate(scene, state, dt=0.1, num_steps=3, save_every=3).y.velocity[-1] ** 2)

    both = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    _, (by_c, by_push) = both(c, PUSH)
    h = 1e-6
    difference = (both(c * (1 + h), PUSH)[0] - both(c * (1 - h), PUSH)[0]) / (2 * h * c)
    np.testing.assert_allclose(by_c, difference, rtol=1e-5, atol=1e-7)
    for k in range(2):
        step = h * np.eye(2)[k]
        difference = (both(c, PUSH + step)[0] - both(c, PUSH - step)[0]) / (2 * h)
        np.testing.assert_allclose(by_push[k], difference, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("kind", TERMINAL.values())
def test_no_other_force_no_wind_and_rest_have_finite_gradients(kind):
    def loss(c, v):
        state = jeuler.ParticleState(jnp.zeros((2, 2)), v)
        return jnp.sum(jeuler.simulate(jeuler.Scene((kind(c),)), state, dt=1.0, num_steps=3).y.velocity[-1])

    for v in (jnp.zeros((2, 2)), jnp.array([[0.0, 0.0], [3.0, 0.0]])):
        for slope in jax.grad(loss, argnums=(0, 1))(5.0, v):
            assert np.isfinite(slope).all()


def test_springs_beside_a_limited_drag_come_to_their_rest():
    """An overdamped chain in a wind hangs as the balance of springs, weight and drag says, at any dt c / m."""
    edges, state = [(0, 1), (1, 2)], jeuler.ParticleState([[0.0], [1.0], [2.0]], jnp.zeros((3, 1)), [np.inf, 1.0, 1.0])
    for drags in ((jeuler.LinearDrag(200.0, air=[0.5]),), (jeuler.QuadraticDrag(200.0, air=[0.5]),)):
        scene = jeuler.Scene((jeuler.Springs(edges, 100.0, 0.1, 1.0), *drags))
        end = jeuler.simulate(scene, state, dt=0.05, num_steps=4000, save_every=4000).y
        push = 200 * 0.5 if isinstance(drags[0], jeuler.LinearDrag) else 200 * 0.25
        np.testing.assert_allclose(end.position[-1, :, 0], [0, 1 + 2 * push / 100, 2 + 3 * push / 100], rtol=1e-6)
        np.testing.assert_allclose(end.velocity[-1], 0, atol=1e-6)


def test_a_light_particle_in_single_precision_gets_to_the_speed_of_the_air():
    """c / m = 5e37 1/s: the force over the mass would overflow."""
    state = jeuler.ParticleState(jnp.zeros((1, 2), "float32"), jnp.full((1, 2), 50.0, "float32"), jnp.float32(2e-38))
    for kind in TERMINAL.values():
        end = jeuler.simulate(jeuler.Scene((kind(1.0, air=WIND),)), state, dt=0.1, num_steps=30).y
        np.testing.assert_allclose(end.velocity[-1, 0], WIND, rtol=1e-6)


@pytest.mark.parametrize("name", ["quadratic", "three"])
def test_derivatives_through_the_limit_are_those_of_the_step(name):
    """By differences, forward and reverse, of all that a limited step reads; for some particles the limit binds."""
    _, state = falling(DRAGS[name](1.0))

    def end(coefficient, velocity, mass, push, dt):
        scene = jeuler.Scene((jeuler.Gravity(push), *DRAGS[name](coefficient)))
        start = state.replace(velocity=velocity, mass=mass)
        return jeuler.simulate(scene, start, dt=dt, num_steps=2, step=jeuler.symplectic_euler_step).y.velocity[-1]

    velocity = jnp.asarray(VELOCITY) + 0.1
    arguments = jnp.float64(0.7), velocity, jnp.asarray([30.0, 0.01, 9.0, 2.0]), jnp.asarray(PUSH), jnp.float64(0.4)
    check_grads(jax.jit(end), arguments, order=1, modes=("fwd", "rev"), atol=1e-7, rtol=1e-7, eps=1e-6)
