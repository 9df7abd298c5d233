"""Draw docs/hard_cases.png: a stiff cloth at 200 times the explicit limit, and the gradient through a bounce.

python benchmarks/hard_cases.py
"""

import dataclasses
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from arguments import arguments

import jeuler
from jeuler import Collisions, PenaltyContact
from jeuler.contact.colliders import Plane
from jeuler.steps.implicit import implicit_euler_step, linearly_implicit_euler_step

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
from hard_scenes import cloth, cloth_scene  # noqa: E402

G, RADIUS, END = 9.81, 0.1, 0.6
FLOOR = Plane([0.0], [1.0])


def cloth_energies(n=16, num_steps=60):
    """Energy of the waving cloth against time, for each step function."""
    state, scene = cloth(n), cloth_scene(n, ks=2000.0, kd=0.01)

    def energy(t, state):
        return scene.energy(t, (state.position, state.velocity), state.mass)

    steps = {
        "explicit": jeuler.euler_step,
        "symplectic": jeuler.symplectic_euler_step,
        "implicit": implicit_euler_step,
        "linearly implicit": linearly_implicit_euler_step,
    }
    for name, step in steps.items():
        run = jeuler.simulate(scene, state, dt=1e-3, num_steps=num_steps, step=step, save=energy)
        print(f"cloth, {name}: energy {run.y[0]:.3g} -> {run.y[-1]:.3g} J, first_nonfinite {run.first_nonfinite}")
        yield name, np.asarray(run.t), np.asarray(run.y)


def mirror(t, dt, state, key):
    """What a bounce is without its time of impact: the velocity is mirrored at the end of the step."""
    under = (state.position < RADIUS) & (state.velocity < 0)
    return dataclasses.replace(state, velocity=jnp.where(under, -state.velocity, state.velocity))


def bounce_gradients(dt=1e-3):
    """d(height at 0.6 s)/d(height at 0) of an elastic ball, against the height at 0, for each kind of contact."""
    gravity, num_steps = jeuler.Gravity([-G]), round(END / dt)
    scenes = {
        "Collisions": jeuler.Scene((gravity,), (Collisions((FLOOR,), radius=RADIUS, restitution=1.0),)),
        "PenaltyContact, ks = 1e4": jeuler.Scene((gravity, PenaltyContact(FLOOR, ks=1e4, radius=RADIUS))),
        "velocity mirrored after the step": jeuler.Scene((gravity,), (mirror,)),
    }
    heights = jnp.linspace(0.3, 1.0, 141)

    def end(scene, height):
        state = jeuler.ParticleState(height[None, None], jnp.zeros((1, 1)))
        step = jeuler.symplectic_euler_step
        return jeuler.simulate(scene, state, dt=dt, num_steps=num_steps, step=step).y.position[-1, 0, 0]

    def exact(height):
        fall = jnp.sqrt(2 * (height - RADIUS) / G)
        left = END - fall
        return RADIUS + G * fall * left - G * left**2 / 2

    truth = np.asarray(jax.vmap(jax.grad(exact))(heights))
    yield "exact", np.asarray(heights), truth
    for name, scene in scenes.items():
        gradient = np.asarray(jax.jit(jax.vmap(jax.grad(lambda h, s=scene: end(s, h))))(heights))
        print(f"bounce, {name}: largest error of the gradient {np.max(np.abs(gradient - truth)):.3g}")
        yield name, np.asarray(heights), gradient


def main():
    arguments(__doc__)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    jax.config.update("jax_enable_x64", True)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for name, t, energy in cloth_energies():
        shown = np.isfinite(energy) & (np.abs(energy) < 10)
        last = len(shown) if shown.all() else int(np.argmin(shown))
        style = "--" if name == "linearly implicit" else "-"
        (line,) = left.plot(1e3 * t[:last], 1e3 * (energy[:last] - energy[0]), style, label=name)
        if last < len(t):
            left.plot(1e3 * t[last - 1], 1e3 * (energy[last - 1] - energy[0]), "x", color=line.get_color(), ms=9)
    left.set_yscale("symlog", linthresh=1)
    left.set(xlabel="time, ms", ylabel="energy gained, mJ", title="Cloth at dt = 200 x the explicit limit")
    left.legend(frameon=False)
    left.annotate("x: beyond 10 J", (0.98, 0.5), xycoords="axes fraction", ha="right")
    for name, heights, gradient in bounce_gradients():
        width, order = (5, 0) if name == "exact" else (1.4, 2)
        color = "0.8" if name == "exact" else None
        right.plot(heights, gradient, lw=width, color=color, label=name, zorder=order)
    right.set(xlabel="height at 0 s, m", ylabel="d height(0.6 s) / d height(0 s)", title="Gradient through a bounce")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    target = ROOT / "docs" / "hard_cases.png"
    target.parent.mkdir(exist_ok=True)
    figure.savefig(target, dpi=130)
    print(f"wrote {target.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
