"""Slips that people make: one line that names the argument, what was expected, what came and what to write."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler import (
    Bending,
    Choice,
    Collisions,
    Cone,
    Death,
    DeathOutside,
    Emitter,
    FromDisc,
    Gravity,
    Gust,
    LinearDrag,
    Normal,
    OverLife,
    ParticleState,
    Plane,
    PointAttractor,
    PrescribedMotion,
    Scene,
    ShapeMatching,
    Springs,
    Uniform,
    Viscosity,
    Vortex,
)

PAIR = ParticleState([[0.0, 0.0], [1.0, 0.0]], jnp.zeros((2, 2)), mass=[jnp.inf, 0.5])
NET = Scene((Springs([[0, 1]], 10.0, 0.1, 1.0), Gravity([0.0, -9.8])))
FLOOR = Plane([0.0, 0.0], [0.0, 1.0])


def simulate(scene=NET, state=PAIR, **changes):
    return jeuler.simulate(scene, state, **{"dt": 0.01, "num_steps": 2, **changes})


def decay(t, y, args):
    return -y


WRONG = {  # what a person wrote: a part of the one line that comes back
    "an index past int32": (lambda: Springs([[0, 2**32 + 1]], 1.0, 0.0, 1.0), r"edges\[0\] = \[0, 4294967297\]"),
    "indices with a fraction": (lambda: Springs([[0.5, 1.0]], 1.0, 0.0, 1.0), "edges must be integers .*got float"),
    "whole indices as floats": (lambda: Springs([[0.0, 1.0]], 1.0, 0.0, 1.0), r"np.asarray\(edges, dtype=int\)"),
    "traced edges": (
        lambda: jax.jit(lambda e: Springs(e, 1.0, 0.0, 1.0).ks)(jnp.array([[0, 1]])),
        "fixed while tracing, got traced ones",
    ),
    "edges turned round": (lambda: Springs(np.zeros((2, 5), int), 1.0, 0.0, 1.0), r"turn it round, edges.T"),
    "ragged edges": (lambda: Springs([[0, 1], [1]], 1.0, 0.0, 1.0), "rows differ in length"),
    "a particle twice in a triple": (lambda: Bending([[0, 0, 1]], 1.0), r"Bending.triples\[0\] = \[0, 0, 1\]"),
    "an edge to itself": (
        lambda: Springs([[1, 1]], 1.0, 0.0, 1.0),
        r"two different particles, got edges\[0\] = \[1, 1\]",
    ),
    "a particle moved twice": (
        lambda: simulate(Scene(effects=(PrescribedMotion([0, 0], lambda t: jnp.zeros((2, 2))),))),
        r"PrescribedMotion.particles must be different indices from 0 to 1, got \[0, 0\]",
    ),
    "a particle pushed twice": (
        lambda: jeuler.AppliedForce([1.0, 0.0], particles=[0, 0]),
        "AppliedForce.particles must be different particles, got 0 twice",
    ),
    "a particle twice in a body": (lambda: ShapeMatching([0, 0], np.eye(2), 1.0), "0 twice"),
    "an index with a fraction": (
        lambda: PrescribedMotion([0.7], lambda t: t),
        "PrescribedMotion.particles must be int",
    ),
    "one strand": (lambda: jeuler.strand_edges([0, 1, 2]), r"strand_edges\(\[strand\]\)"),
    "complex stiffness": (lambda: Springs([[0, 1]], 1j, 0.0, 1.0), "Springs.ks must be a number.*real"),
    "complex stiffnesses": (lambda: Springs([[0, 1]], np.array([1j]), 0.0, 1.0), "Springs.ks must be .*complex128"),
    "complex array": (lambda: Gravity(jnp.zeros(2, complex)), "Gravity.acceleration must be a number.*complex"),
    "a boolean stiffness": (lambda: Springs([[0, 1]], True, 0.0, 1.0), "Springs.ks .*got True"),
    "a stiffness that is not a number": (lambda: simulate(Scene((Springs([[0, 1]], np.nan, 0.0, 1.0),))), "got nan"),
    "endless stiffness": (
        lambda: simulate(Scene((Springs([[0, 1]], np.inf, 0.0, 1.0),))),
        "ks must be finite, got inf",
    ),
    "a normal that is not a number": (
        lambda: simulate(Scene(effects=(Collisions((Plane([0.0, 0.0], [np.nan, 1.0]),)),))),
        "normal must be .*got nan",
    ),
    "a drag that drives": (lambda: LinearDrag(-1.0), "LinearDrag.coefficient must not be negative, got -1 kg/s"),
    "a quadratic drag that drives": (lambda: jeuler.QuadraticDrag(-1.0), "must not be negative, got -1 kg/m"),
    "negative viscosity": (lambda: Viscosity([[0, 1]], -1.0), "Viscosity.coefficient must not be negative"),
    "negative spread": (lambda: Normal(0.0, -1.0), "Normal.deviation must not be negative"),
    "negative radius": (lambda: FromDisc([0.0, 0.0], -1.0), "FromDisc.radius must not be negative, got -1 m"),
    "negative angle": (lambda: Cone([0.0, 1.0], 1.0, -1.0), "Cone.angle must not be negative"),
    "a cone about nothing": (lambda: Cone([0.0, 0.0], 1.0, 0.1), "Cone.direction must point somewhere"),
    "bounds swapped": (lambda: Uniform(2.0, 1.0), "Uniform.low must not be above Uniform.high"),
    "corners swapped": (lambda: DeathOutside([1.0, 1.0], [-1.0, -1.0]), "swap the two"),
    "nothing to choose from": (lambda: Choice([]), "Choice.values must have shape"),
    "no period": (lambda: Gust([1.0, 0.0], 0.0), "Gust.period must be greater than 0 s, got 0"),
    "no core": (lambda: Vortex([0.0, 0.0], 1.0, 0.0), "Vortex.core must be greater than 0 m"),
    "no softening": (lambda: PointAttractor([0.0, 0.0], 1.0, 0.0), "softening must be greater than 0 m"),
    "a power in words": (
        lambda: PointAttractor([0.0, 0.0], 1.0, 0.1, power="2"),
        "power must be one finite real number",
    ),
    "air in words": (lambda: LinearDrag(1.0, air="wind"), "Wind.velocity must be .*got 'wind'"),
    "no waves": (lambda: jeuler.turbulence(dim=2, speed=1.0, size=1.0, modes=0), "modes must be at least 1"),
    "a negative life": (lambda: Emitter(1.0, [0.0], [0.0], lifetime=-1.0), "Emitter.lifetime must be greater than 0 s"),
    "a place in words": (lambda: Emitter(1.0, "here", [0.0]), "Emitter.position must be a sampler"),
    "bursts as a dict": (lambda: Emitter(1.0, [0.0], [0.0], bursts={0.5: 3}), r"bursts=\(\(0.5, 100\),\)"),
    "a condition in words": (lambda: Death("hot"), r"Death.condition must be a function \(t, state\)"),
    "a number for a condition": (
        lambda: simulate(Scene(effects=(Death(lambda t, state: state.position[:, 0]),))),
        "Death.condition must return a boolean a particle",
    ),
    "a field by number": (lambda: OverLife(3, [1.0, 0.0]), "OverLife.field must be the name of a field"),
    "a collider's class": (lambda: Collisions((Plane,)), r"got the class Plane; make one, Plane\(...\)"),
    "a field misspelt": (
        lambda: PAIR.replace(postion=jnp.zeros((2, 2))),
        r"no field 'postion'; did you mean position=",
    ),
    "a parameter misspelt": (lambda: Springs([[0, 1]], k=1.0, kd=0.0, rest_length=1.0), "did you mean ks="),
    "a parameter left out": (lambda: Springs([[0, 1]], 1.0), "Springs needs kd and rest_length"),
    "a field of the state in words": (lambda: ParticleState([[0.0]], [[0.0]], extra=[1]), "extra must be a dict"),
    "a dtype that is none": (lambda: jeuler.empty_pool(3, 2, dtype="nope"), "dtype must be a floating dtype"),
    "an end in place of a number of steps": (lambda: simulate(t1=1.0), r"write num_steps=round\(\(t1 - t0\) / dt\)"),
    "an end for solve": (lambda: jeuler.solve(decay, 1.0, t1=1.0), r"write num_steps=round\(\(t1 - t0\) / dt\)"),
    "dt by place in a scene": (
        lambda: jeuler.simulate(NET, PAIR, 0.1, 10),
        r"write simulate\(scene, state, dt=..., num_steps=...\)",
    ),
    "an end by place": (lambda: jeuler.solve_adaptive(decay, 1.0, 1.0), r"write solve_adaptive\(f, y0, t1=...\)"),
    "dt by place": (lambda: jeuler.solve(decay, 1.0, 0.1, 10), r"write solve\(f, y0, dt=..., num_steps=...\)"),
    "no dt": (lambda: jeuler.solve(decay, 1.0), r"solve needs dt and num_steps; write solve\(f, y0, dt=..., num"),
    "an argument misspelt": (lambda: jeuler.solve(decay, 1.0, dt=0.1, n_steps=1), "did you mean num_steps="),
    "a batch of keys": (lambda: simulate(key=jax.random.split(jax.random.key(0), 3)), "for a batch use jax.vmap"),
    "a word for a bool": (lambda: simulate(compensated="yes"), "compensated must be True or False, got 'yes'"),
    "what to save in words": (lambda: simulate(save="position"), r"save must be a function \(t, y\)"),
    "a save that forgets to return": (lambda: simulate(save=lambda t, s: None), "save must return arrays"),
    "one window": (lambda: simulate(windows=5), r"write windows=\(5,\)"),
    "swapped": (lambda: jeuler.simulate(PAIR, NET, dt=0.1, num_steps=1), "scene comes first"),
    "a scene for a field": (lambda: jeuler.solve(NET, 1.0, dt=0.1, num_steps=1), "pass scene.vector_field"),
    "a force of two arguments": (lambda: Scene((lambda t, p: p,)), "all four arguments are passed"),
    "an effect of one argument": (
        lambda: Scene(effects=(lambda s: s,)),
        r"an effect must be a function \(t, dt, previous, state, key\)",
    ),
    "a force that is a number a particle": (
        lambda: simulate(Scene((lambda t, p, v, m: p[:, 0],))),
        r"must return the force on each particle, \(particle, dim\) = \(2, 2\), got shape \(2,\)",
    ),
    "a force that forgets to return": (lambda: simulate(Scene((lambda t, p, v, m: None,))), "got None"),
    "a step that forgets to return": (lambda: simulate(step=lambda f, t, y, dt, args: None), "the step must return"),
    "a field that decides": (
        lambda: jeuler.solve(lambda t, y, a: y if y > 0 else -y, 1.0, dt=0.1, num_steps=1),
        "write jnp.where",
    ),
    "a field by NumPy": (
        lambda: jeuler.solve(lambda t, y, a: np.sin(y), 1.0, dt=0.1, num_steps=1),
        "write jnp in place",
    ),
    "a field as a list": (
        lambda: jeuler.solve(lambda t, y, a: [y[1], -y[0]], jnp.ones(2), dt=0.1, num_steps=1),
        "jnp.stack",
    ),
    "dt below float32": (
        lambda: jeuler.solve(decay, jnp.float32(1.0), dt=1e-60, num_steps=1),
        "dt must be from .* in float32",
    ),
    "dt above float32": (
        lambda: jeuler.solve(decay, jnp.float32(1.0), dt=1e60, num_steps=1),
        "dt must be from .* in float32",
    ),
    "a complex mass": (lambda: simulate(state=PAIR.replace(mass=jnp.ones(2, complex))), "mass must be real numbers"),
    "a mass that is no mass": (
        lambda: simulate(state=PAIR.replace(mass=jnp.ones(2, bool))),
        "mass must be real numbers",
    ),
    "no step to cap": (lambda: jeuler.cap_cotangent(None, 1.0), "step must be a function"),
    "a solver in words": (lambda: jeuler.implicit_euler(linear_solver="LU"), "lineax.LU()"),
    "an optimiser in words": (lambda: jeuler.fit(lambda p: p["a"], {"a": 1.0}, optimizer="adam"), "such as optax.adam"),
    "no residual": (lambda: jeuler.fit(None, {"a": 1.0}), "residual must be a function"),
    "a step longer than the recording": (
        lambda: jeuler.fit_springs(
            NET, PAIR, np.linspace(0.0, 1.0, 5), np.random.default_rng(0).random((5, 2, 2)), dt=2.0
        ),
        "dt must be at most the span of the times, 1 s from t0=0 s, got 2 s",
    ),
    "a column of wind": (
        lambda: simulate(Scene((LinearDrag(1.0, air=jeuler.Wind([[1.0], [0.0]])),))),
        r"Wind.velocity must have shape \(dim,\), got shape \(2, 1\)",
    ),
    "None for a number": (lambda: Cone([0.0, 1.0], 1.0, None), "Cone.angle must be a number"),
    "a pool of no mass": (lambda: jeuler.empty_pool(3, 2, mass=0.0), "state.mass must be greater than 0 kg"),
    "a callback": (lambda: simulate(callback=print), "progress=lambda step, num_steps: ... for how far it is"),
    "no path": (lambda: jeuler.read_trajectory(3), "a recording is a path, an open file"),
    "names as one string": (lambda: jeuler.uses(reads="temperature"), "uses.reads must be a tuple of names"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_slip_is_refused_in_one_line(name):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert type(caught.value) is ValueError
    assert "\n" not in str(caught.value)


def test_what_looks_odd_but_is_right_passes():
    simulate(Scene((Springs([], 1.0, 0.0, 1.0),)))
    simulate(Scene((Springs(np.zeros((0, 2)), 1.0, 0.0, 1.0),)))
    simulate(Scene((Springs(np.array([[0, 1], [0, 1]], np.uint64), 10, 0, 1),)))
    simulate(num_steps=np.int64(2), dt=np.float32(0.01))
    PAIR.replace(temperature=jnp.ones(2), team=jnp.ones(2)).replace(temperature=jnp.zeros(2))


def test_a_solution_says_where_the_positions_are():
    run = simulate()
    with pytest.raises(AttributeError, match=r"write solution.y.position"):
        run.position  # noqa: B018
    with pytest.raises(AttributeError, match=r"write solution.t"):
        run.times  # noqa: B018
    assert not hasattr(run, "__array__")


def test_a_clock_that_stands_still_is_announced():
    with pytest.warns(UserWarning, match="dt=0.001 s does not move the clock from t0=1e.06 s in float32"):
        jeuler.solve(decay, jnp.float32(1.0), dt=1e-3, num_steps=1, t0=1e6)


@pytest.mark.parametrize(
    "step",
    [
        jeuler.euler_step,
        jeuler.heun_step,
        jeuler.rk4_step,
        jeuler.extrapolated_euler(4),
        jeuler.implicit_euler_step,
        jeuler.linearly_implicit_euler_step,
        jeuler.implicit_midpoint_step,
    ],
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_backwards_in_time_eagerly_as_under_jit(step, dtype):
    """Back from y(1) = e: y(0) = 1 for y' = y, within the error of the step."""
    start = jnp.asarray(np.e, dtype)

    def back(dt):
        return jeuler.solve(lambda t, y, a: y, start, dt=dt, num_steps=1000, t0=1.0, step=step, save_every=1000)

    eager = back(-1e-3)
    np.testing.assert_allclose(eager.y[-1], 1.0, atol=1e-3)
    np.testing.assert_allclose(eager.t[-1], 0.0, atol=1e-6)
    np.testing.assert_allclose(jax.jit(back)(-1e-3).y, eager.y, rtol=1e-6)


def test_a_run_that_ends_where_it_begins_stays_there():
    run = jeuler.solve_adaptive(decay, 2.0, t0=0.7, t1=0.7)
    assert run.finished
    np.testing.assert_array_equal(run.y, 2.0)
    np.testing.assert_allclose(run.t, 0.7)
    traced = jax.jit(lambda t1: jeuler.solve_adaptive(decay, 2.0, t0=0.7, t1=t1).y)
    np.testing.assert_array_equal(traced(0.7), 2.0)
    assert np.isnan(traced(0.6)[-1]), "backwards goes solve: refused where t1 is known, NaN where it is traced"
    assert jeuler.solve(decay, 2.0, t0=0.7, dt=0.1, num_steps=0).y.tolist() == [2.0]


@pytest.mark.parametrize(
    "effect", [Collisions((FLOOR,)), jeuler.Lifetime(1.0), jeuler.SpeedLimit(1.0), DeathOutside(-1.0, 1.0)]
)
def test_what_cannot_be_undone_refuses_to_run_backwards(effect):
    scene = Scene(effects=(effect,))
    with pytest.raises(ValueError, match=f"dt must be greater than 0 s with {type(effect).__name__}"):
        simulate(scene, dt=-0.01)
    traced = jax.jit(lambda dt: simulate(scene, dt=dt).t)
    assert np.isnan(traced(-0.01)).any(), "a traced dt < 0 cannot be refused: its times are NaN"
    assert np.isfinite(traced(0.01)).all()


@pytest.mark.parametrize(("step", "near"), [(jeuler.rk4_step, 1e-7), (jeuler.symplectic_euler_step, 0.05)])
def test_a_scene_runs_backwards_to_where_it_came_from(step, near):
    state = ParticleState([[0.0, 0.0], [1.2, 0.0]], jnp.zeros((2, 2)), mass=[jnp.inf, 0.5])
    there = simulate(NET, state, num_steps=100, step=step).y
    end = state.replace(position=there.position[-1], velocity=there.velocity[-1])
    back = simulate(NET, end, num_steps=100, dt=-0.01, t0=1.0, step=step).y
    np.testing.assert_allclose(back.position[-1], state.position, atol=near)
