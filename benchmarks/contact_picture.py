"""Draw docs/contact.png: where a ball gets to over a rough floor, and the gradient of that, against the exact ones.

python benchmarks/contact_picture.py
"""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
from arguments import arguments

import jeuler
from jeuler import Collisions, Plane

ROOT = pathlib.Path(__file__).resolve().parent.parent
G, RADIUS, RESTITUTION, FRICTION, DT, END = 9.8, 0.1, 0.8, 0.1, 0.01, 0.8


def ends(step):
    """The ball's place along the floor after 0.8 s, as a function of start height and speed."""
    floor = Plane([0.0, 0.0], [0.0, 1.0])
    contact = Collisions((floor,), radius=RADIUS, restitution=RESTITUTION, friction=FRICTION)
    scene = jeuler.Scene((jeuler.Gravity([0.0, -G]),), (contact,))

    def end(height, speed):
        state = jeuler.ParticleState(jnp.stack([0.0 * height, height])[None], jnp.stack([speed, 0.0 * speed])[None])
        run = jeuler.simulate(scene, state, dt=DT, num_steps=round(END / DT), save_every=round(END / DT), step=step)
        return run.y.position[-1, 0, 0]

    return end


def exact(height, speed, bounces=12):
    """The same by its flights: an impact takes friction (1 + restitution) v_n of the speed along."""
    impact = jnp.sqrt(2 * G * (height - RADIUS))
    flight, left, x = impact / G, END, 0.0
    for _ in range(bounces):
        x = x + speed * jnp.minimum(flight, left)
        left = jnp.maximum(left - flight, 0)
        speed = jnp.maximum(speed - FRICTION * (1 + RESTITUTION) * impact, 0)
        impact = RESTITUTION * impact
        flight = 2 * impact / G
    return x


def main():
    arguments(__doc__)
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    jax.config.update("jax_enable_x64", True)
    heights, speeds = np.linspace(0.3, 1.0, 141), np.linspace(0.1, 2.0, 141)
    over_height = (jnp.asarray(heights), jnp.full(len(heights), 0.7), 0, "start height, m")
    over_speed = (jnp.full(len(speeds), 0.6), jnp.asarray(speeds), 1, "start speed, m/s")
    figure, axes = plt.subplots(2, 2, figsize=(11, 6.4), layout="constrained", sharex="col")
    steps = {"symplectic Euler": jeuler.symplectic_euler_step, "RK4": jeuler.rk4_step}
    for column, (height, speed, which, label) in enumerate((over_height, over_speed)):
        along = np.asarray((height, speed)[which])
        truth = jax.jit(jax.vmap(jax.value_and_grad(exact, which)))(height, speed)
        for row in (0, 1):
            axes[row, column].plot(along, truth[row], lw=5, color="0.8", label="exact")
        for name, step in steps.items():
            found = jax.jit(jax.vmap(jax.value_and_grad(ends(step), which)))(height, speed)
            errors = [np.abs(np.asarray(f - t)) for f, t in zip(found, truth, strict=True)]
            print(
                f"{label}, {name}: error of the value, median {np.median(errors[0]):.2g}, most {errors[0].max():.2g} m;"
            )
            print(f"    of the gradient, median {np.median(errors[1]):.2g}, most {errors[1].max():.2g}")
            for row in (0, 1):
                axes[row, column].plot(along, found[row], "-" if name == "RK4" else "--", lw=1.3, label=name)
        axes[1, column].set_xlabel(label)
    axes[0, 0].set(ylabel="way along the floor in 0.8 s, m")
    axes[0, 0].set(title="Thrown along at 0.7 m/s, over start height")
    axes[0, 1].set(title="Thrown from 0.6 m, over start speed")
    axes[1, 0].set(ylabel="its derivative, m/m (left), s (right)")
    axes[0, 0].legend(frameon=False)
    for one in axes.ravel():
        one.spines[["top", "right"]].set_visible(False)
    figure.savefig(ROOT / "docs" / "contact.png", dpi=110)
    print("wrote docs/contact.png")


if __name__ == "__main__":
    main()
