"""One object of every public class, and steps of every factory: what the tests of copies and of reprs go over."""

import functools
import pathlib
import tempfile

import cases
import jax.numpy as jnp
import numpy as np

import jeuler
import jeuler.plotting
import jeuler.scenes


def hanging():
    """A particle that hangs on a spring: scene and state."""
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=25.0, kd=0.2, rest_length=1.0), jeuler.Gravity([0.0, -9.8])))
    return scene, jeuler.ParticleState([[0.0, 0.0], [0.0, -1.2]], jnp.zeros((2, 2)), mass=[jnp.inf, 1.0])


def solution():
    scene, state = hanging()
    return jeuler.simulate(scene, state, dt=0.01, num_steps=6, save_every=2)


def spring_fit():
    scene, state = hanging()
    times = np.linspace(0.0, 0.3, 7)
    positions = jeuler.simulate(scene, state, dt=0.05, num_steps=6).y.position
    options = {"dt": 0.05, "parameters": ("ks",), "max_iterations": 2, "grow": False}
    return jeuler.fit_springs(scene, state, times, positions, **options)


def found_springs():
    times = np.linspace(0.0, 6.0, 121)
    swing = 0.5 + 0.1 * np.cos(4.0 * times)  # two masses of 1 kg, ks = 8 N/m, rest length 1 m
    return jeuler.find_springs(times, np.stack([-swing, swing], axis=1)[:, :, None], mass=1.0, refine=False)


def shooting_fit():
    times = np.linspace(0.0, 10.0, 51)
    values = np.exp(-0.5 * times)[:, None]
    return jeuler.multiple_shooting(shrinking, jnp.asarray(2.0), times, values, dt=0.1, segments=2)


def shrinking(t, y, rate):
    return -rate * y


def trajectory():
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "swing.csv"
        path.write_text("t,x,y\n0.0,1.0,2.0\n0.1,1.1,\n")
        return jeuler.read_trajectory(path)


def decay(t, y, args):
    return -y


def line(p):
    return p["slope"] * jnp.linspace(0.0, 1.0, 5) - 3.0


def to_the_right(t, state):
    return state.position[:, 0] > 5.0


def drift(t, position, velocity, mass):
    return -0.1 * velocity


EFFECTS = {name: row.make for name, row in cases.EFFECTS.items() if name != "death"}
FORCES = {name: make for name, make in cases.FORCES.items() if name != "function"}
RESULTS = {
    "ParticleState": lambda: hanging()[1].replace(temperature=jnp.array([1.0, 2.0])),
    "Scene": lambda: jeuler.Scene((hanging()[0].forces[0], drift), (jeuler.SpeedLimit(3.0),)),
    "BreakableSprings": lambda: jeuler.BreakableSprings([[0, 1]], ks=10.0, kd=0.1, rest_length=1.0),
    "Death": lambda: jeuler.Death(to_the_right),
    "Solution": solution,
    "Ensemble": lambda: jeuler.ensemble(jnp.sin, jnp.ones(2)),
    "Moments": lambda: jeuler.Moments(),
    "MeshBody": lambda: jeuler.rope([0.0, 0.0], [1.0, 0.0], 3, density=1.0, ks=2.0, bending=0.1),
    "GridDistance": lambda: jeuler.GridDistance([0.0], 1.0, [1.0, -1.0, 1.0]),
    "Division": lambda: jeuler.divide(jeuler.Scene((hanging()[0].forces[0],)), hanging()[1], devices=1),
    "Quantiles": lambda: jeuler.Quantiles((0.5,), bounds=(0.0, 1.0)),
    "AdaptiveSolution": lambda: jeuler.solve_adaptive(decay, 1.0, t1=1.0, rtol=1e-3, max_steps=16),
    "Fit": lambda: jeuler.fit(line, {"slope": 1.0, "unused": 2.0}, max_iterations=3),
    "SpringFit": spring_fit,
    "FoundSprings": found_springs,
    "ShootingFit": shooting_fit,
    "Identifiability": lambda: jeuler.identifiability(*hanging(), np.linspace(0.0, 0.3, 7), ("ks",), dt=0.05),
    "Method": lambda: jeuler.Method(jeuler.rk4_step, dts=(0.1, 0.2), options={"breaks": (0.5,)}),
    "WorkPrecision": lambda: jeuler.work_precision(
        decay, 1.0, t1=1.0, dts=[0.5, 0.25], steps={"Euler": jeuler.euler_step}, reference=np.exp, repeats=1
    ),
    "Compensated": lambda: jeuler.Compensated(jeuler.euler_step),
    "StabilityLimit": lambda: jeuler.stability_limit(lambda t, y, args: -4.0 * y, 0.0, 1.0),
    "StepAdvice": lambda: jeuler.StepAdvice(0.01, 100, 1e-3, 2.0, 1e-7, True, "accuracy sets dt"),
    "MethodAdvice": lambda: jeuler.advise_method(decay, 1.0, t1=1.0, error=0.1, methods={"Euler": jeuler.euler_step}),
    "RankedMethod": lambda: RESULTS["MethodAdvice"]().best,
    "Diagnosis": lambda: jeuler.Diagnosis(False, step=3, part="forces[0] Springs", springs=(4,), cause="it blew up"),
    "Comparison": lambda: jeuler.compare_fits(*[RESULTS["Fit"]()] * 2),
    "Recording": lambda: jeuler.Recording(np.linspace(0.0, 1.0, 3), np.zeros((3, 1, 2)), sigma=0.01),
    "Trajectory": trajectory,
    "Setup": jeuler.scenes.fountain,
    "Camera": lambda: jeuler.plotting.Camera(width=3.0),
    "Look": jeuler.plotting.Look,
    "Hair": lambda: jeuler.plotting.Hair.grown([[0, 1]], np.arange(6.0).reshape(1, 2, 3), strands=3, spread=0.1),
    "Film": lambda: jeuler.plotting.animate(solution(), hanging()[0]),
}
STEPS = {
    "euler_step": lambda: jeuler.euler_step,
    "symplectic_euler_step": lambda: jeuler.symplectic_euler_step,
    "heun_step": lambda: jeuler.heun_step,
    "rk4_step": lambda: jeuler.rk4_step,
    "implicit_euler_step": lambda: jeuler.implicit_euler_step,
    "implicit_midpoint_step": lambda: jeuler.implicit_midpoint_step,
    "linearly_implicit_euler_step": lambda: jeuler.linearly_implicit_euler_step,
    "implicit_euler": lambda: jeuler.implicit_euler(max_steps=7),
    "linearly_implicit_euler": lambda: jeuler.linearly_implicit_euler(),
    "extrapolated_euler": lambda: jeuler.extrapolated_euler(3),
    "extrapolated_implicit": lambda: jeuler.extrapolated_euler(3, step=jeuler.linearly_implicit_euler_step),
    "cap_cotangent": lambda: jeuler.cap_cotangent(jeuler.symplectic_euler_step, 2.0),
}
OBJECTS = {name: functools.cache(make) for name, make in {**FORCES, **EFFECTS, **RESULTS, **STEPS}.items()}
