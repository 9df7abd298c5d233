"""Peak memory of the gradient of a run against its number of steps, as the compiler plans it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from arguments import arguments
from works import DT, KS, cloth

import jeuler


def gradient_bytes(num_steps: int, checkpoint) -> int:
    """Temporary memory of the gradient of an undamped run, bytes."""
    work = cloth(64, num_steps)

    def loss(position, velocity, ks):
        scene = jeuler.Scene((jeuler.Springs(work.edges, ks, 0.0, work.rest_length),))
        state = jeuler.ParticleState(position, velocity)
        run = jeuler.simulate(
            scene, state, dt=DT, num_steps=num_steps, save_every=num_steps, checkpoint=checkpoint,
            step=jeuler.symplectic_euler_step,
        )  # fmt: skip
        return jnp.sum(run.y.position[-1] ** 2)

    args = work.position[0], work.velocity[0], KS
    compiled = jax.jit(jax.grad(loss, argnums=(0, 1, 2))).lower(*args).compile()
    return compiled.memory_analysis().temp_size_in_bytes


def table(steps: tuple[int, ...] = (64, 256, 1024, 4096)) -> str:
    lines = ["| gradient of cloth 64x64, temporary MB | " + " | ".join(f"{n} steps" for n in steps) + " |"]
    lines.append("|---|" + "--:|" * len(steps))
    for checkpoint in (None, 32, "sqrt", "reversible"):
        cells = [f"{gradient_bytes(n, checkpoint) / 1e6:.1f}" for n in steps]
        lines.append(f"| checkpoint={checkpoint!r} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    arguments(__doc__)
    print(table())
