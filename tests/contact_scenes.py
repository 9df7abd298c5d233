"""Scenes of contact in round numbers: grids, touching starts, contacts at step ends, stacks, rows, corners, slopes.

Each shape of scene is one program for all its values, its steps included; what is checked of each value is here too.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler import Box, Collisions, Plane, Sphere

RADIUS, NUM_STEPS = 0.1, 24
STEPS = {
    "euler": jeuler.euler_step,
    "symplectic": jeuler.symplectic_euler_step,
    "Heun": jeuler.heun_step,
    "RK4": jeuler.rk4_step,
    "extrapolated": jeuler.extrapolated_euler(3),
    "midpoint": jeuler.implicit_midpoint_step,
    "implicit": jeuler.implicit_euler_step,
    "linearly implicit": jeuler.linearly_implicit_euler_step,
    "extrapolated, linearly implicit": jeuler.extrapolated_euler(3, step=jeuler.linearly_implicit_euler_step),
}
APART, TOGETHER = tuple(STEPS)[:6], tuple(STEPS)[6:]  # those that solve with contact have it in their program
FIRST_ORDER = ("euler", "symplectic", "implicit", "linearly implicit")
SPEEDS = (-1.0, -0.5, 0.0, 0.0, 0.5, 1.0)
# Compiled in half the time, by an option that versions which are not known might not have; and where few values are run:
QUICK = {"xla_cpu_use_fusion_emitters": False} if jax.__version__.startswith("0.10.") else {}
UNOPTIMISED = QUICK | {"xla_backend_optimization_level": 0}
SHAPES = {  # balls, whether they collide, what else is there, kinds of scene
    "two balls, floor": (2, False, "plane", ("grid", "floor", "slope")),
    "two balls, floor and wall": (2, True, "planes", ("grid", "floor", "row", "stack", "corner", "slope")),
    "three balls, box and sphere": (3, True, "box and sphere", ("grid", "floor", "row", "stack")),
    "three balls": (3, True, "", ("grid", "row")),
    "five balls, floor and wall": (5, True, "planes", ("grid", "floor", "row", "stack", "corner", "slope")),
}
CHANGES = {np.dtype(np.float64): (1e-6, 2e-7), np.dtype(np.float32): (4e-3, 1e-3)}
ALIKE = {np.dtype(np.float64): 1e-4, np.dtype(np.float32): 4e-2}


def colliders(kind, normals):
    """Solids whose surfaces meet at the origin: planes with these normals, or a box and a sphere."""
    if kind == "box and sphere":
        return Box([0.0, -0.5], 0.5), Sphere([1.0, 0.0], 0.3)
    origin = jnp.zeros(2, normals.dtype)
    return tuple(Plane(origin, normal) for normal in normals[: {"": 0, "plane": 1, "planes": 2}[kind]])


def scene_of(shape, numbers):
    _, collide, kind, _ = SHAPES[shape]
    pairs = [(i, j) for i in range(len(numbers["position"])) for j in range(i)] if collide else ()
    what = {"radius": RADIUS, "restitution": numbers["restitution"], "friction": numbers["friction"]}
    contact = Collisions(colliders(kind, numbers["normals"]), pairs, **what)
    return jeuler.Scene((jeuler.Gravity(numbers["gravity"]),), (contact,))


def run(shape, numbers, step):
    """A weighted sum of the last positions; and the whole run."""
    state = jeuler.ParticleState(numbers["position"], numbers["velocity"], numbers["mass"])
    solution = jeuler.simulate(scene_of(shape, numbers), state, dt=numbers["dt"], num_steps=NUM_STEPS, step=step)
    weights = np.random.default_rng(1).normal(size=state.position.shape).astype(state.position.dtype)
    return jnp.sum(weights * solution.y.position[-1]), solution


@functools.cache
def programs(shape, steps, few=False):
    """Of a batch of scenes and the number of one of these steps: the sums; (sums, runs, gradients by reverse mode);
    and the derivatives along ``direction`` by forward mode."""

    def summed(motion, numbers, method):
        def step(f, t, y, dt, args):
            return jax.lax.switch(method, [lambda y, s=s: STEPS[s](f, t, y, dt, args) for s in steps], y)

        step.solves_contact = not set(steps) <= set(APART)
        total, solution = run(shape, numbers | motion, step)
        y = solution.y
        return total, (y.position, y.velocity, solution.unresolved_contacts, solution.first_nonfinite)

    def value(numbers, method):
        return summed({}, numbers, method)[0]

    def reverse(numbers, method):
        motion = {name: numbers[name] for name in ("position", "velocity")}
        (total, runs), gradient = jax.value_and_grad(summed, has_aux=True)(motion, numbers, method)
        return total, runs, jnp.stack([gradient["position"], gradient["velocity"]])

    def forward(numbers, method):
        motion = {name: numbers[name] for name in ("position", "velocity")}
        direction = {"position": numbers["direction"][0], "velocity": numbers["direction"][1]}
        return jax.jvp(lambda motion: summed(motion, numbers, method)[0], (motion,), (direction,))[1]

    options = UNOPTIMISED if few else QUICK
    how = ((value, QUICK), (reverse, options), (forward, options))
    return [jax.jit(jax.vmap(f, (0, None)), compiler_options=options) for f, options in how]


def draw(random, shape, grid=RADIUS, speeds=SPEEDS):
    """The numbers of one scene without overlaps."""
    count, _, _, kinds = SHAPES[shape]
    while True:
        numbers = drawn(random, count, random.choice(kinds), grid, speeds)
        if not overlaps(shape, numbers):
            return numbers


def drawn(random, count, kind, grid, speeds):
    dt = random.choice([0.01, 1 / 60, 0.02, 1 / 30])
    up = np.array(random.choice([(0.0, 1.0), (-0.6, 0.8), (-0.5, np.sqrt(0.75))]) if kind == "slope" else (0.0, 1.0))
    wall = np.array(random.choice([(1.0, 0.0), (0.6, 0.8)]) if kind == "corner" else (1.0, 0.0))
    along = np.array([up[1], -up[0]])
    if kind == "grid":
        wide, high = (max(3, round(size / grid)) for size in (0.9, 0.7))
        position = grid * np.stack([random.integers(1, wide, count), random.integers(1, high, count)], axis=1)
    elif kind == "stack":
        position = RADIUS * np.stack([np.full(count, random.integers(1, 4)), 1 + 2 * np.arange(count)], axis=1)
    else:  # in a row on the floor, or on the slope; apart by multiples of what a speed of 1 goes in a step, or touching
        gaps = random.choice([0.0, 0.0, 1.0, 2.0, 3.0, 5.0], count) * random.choice([dt, grid])
        height = 3 if kind == "row" else 1
        way = RADIUS * (1 + 2 * np.arange(count)) + np.cumsum(gaps) + random.choice([0.0, grid, 0.25])
        position = way[:, None] * along + height * RADIUS * up
        if kind == "corner":
            position[0] = corner(wall)
    velocity = random.choice(speeds, (count, 2)) if random.random() < 0.6 else np.zeros((count, 2))
    if kind != "grid" and random.random() < 0.7:  # along what they are on
        velocity = random.choice(speeds, (count, 1)) * along
    return {
        "position": position,
        "velocity": velocity,
        "mass": np.ones(count) if random.random() < 0.6 else random.choice([0.5, 1.0, 2.0], count),
        "normals": np.stack([up, wall]),
        "gravity": random.choice([0.0, -9.8, -9.8, -10.0]) * np.array([0.0, 1.0]),
        "restitution": np.array(random.choice([0.0, 0.5, 1.0])),
        "friction": np.array(random.choice([0.0, 0.3])),
        "dt": np.array(dt),
    }


def corner(wall):
    """Where a ball touches the floor and a wall through the origin."""
    return np.linalg.solve(np.stack([[0.0, 1.0], wall]), [RADIUS, RADIUS])


def overlaps(shape, numbers):
    count, collide, kind, _ = SHAPES[shape]
    x = numbers["position"]
    solids = colliders(kind, numbers["normals"])
    gaps = [float(solid(0.0, p)) - RADIUS for solid in solids for p in x]
    if collide:
        gaps += [np.linalg.norm(x[i] - x[j]) - 2 * RADIUS for i in range(count) for j in range(i)]
    return any(gap < -1e-9 for gap in gaps)


def batch(scenes, dtype):
    return {name: np.stack([s[name] for s in scenes]).astype(dtype) for name in scenes[0]}


def differences(program, numbers, method, at_once=None):
    """Four one-sided differences of the sum for each position and velocity: (4, scene, 2, ball, dim), in the float type."""
    motion = np.stack([numbers["position"], numbers["velocity"]], axis=1)
    size, parameters, dtype = len(motion), int(np.prod(motion.shape[1:])), motion.dtype
    changes = np.array([sign * h for h in CHANGES[dtype] for sign in (1, -1)], dtype)
    moved = motion.reshape(size, 1, 1, -1) + changes[:, None, None] * np.eye(parameters, dtype=dtype)
    moved = np.concatenate([motion.reshape(size, 1, -1), moved.reshape(size, -1, parameters)], axis=1)
    actual = moved[:, 1:].reshape(size, 4, parameters, parameters) - motion.reshape(size, 1, 1, -1)
    actual = np.diagonal(actual, axis1=2, axis2=3)  # what was added, after rounding
    points = moved.shape[1]
    of_all = {name: np.repeat(x, points, axis=0) for name, x in numbers.items()}
    shape = (size * points, *motion.shape[2:])
    flat = moved.reshape(size * points, 2, -1)
    of_all |= {"position": flat[:, 0].reshape(shape), "velocity": flat[:, 1].reshape(shape)}
    values = in_chunks(program, of_all, method, at_once).reshape(size, points)
    slopes = (values[:, 1:] - values[:, :1]).reshape(size, 4, parameters) / actual
    return np.moveaxis(slopes, 1, 0).reshape(4, *motion.shape)


def in_chunks(program, numbers, method, at_once):
    """The program on parts of a batch, all of one size, so that it is compiled once."""
    total = len(numbers["dt"])
    at_once = at_once or total
    parts = []
    for begin in range(0, total, at_once):
        index = np.minimum(np.arange(begin, begin + at_once), total - 1)
        part = jax.tree.map(np.asarray, program({name: x[index] for name, x in numbers.items()}, method))
        parts.append(part)
    return jax.tree.map(lambda *x: np.concatenate(x)[:total], *parts)


def agree(slopes):
    """Where four one-sided differences agree among themselves, (scene, 2, ball, dim)."""
    return np.ptp(slopes, axis=0) < ALIKE[slopes.dtype] * (1 + np.max(np.abs(slopes), axis=0))


def wrong_gradients(gradient, slopes):
    """Where four one-sided differences agree among themselves, and the gradient not with them: (scene, 2, ball, dim)."""
    size = 1 + np.max(np.abs(slopes), axis=0)
    return agree(slopes) & ~(np.abs(gradient - np.mean(slopes, axis=0)) < 2 * ALIKE[slopes.dtype] * size)


def disagree(gradient, numbers, forward):
    """Where the derivative along ``direction`` is another by reverse than by forward mode, (scene,)."""
    parts = (gradient * numbers["direction"]).reshape(len(gradient), -1)
    size = 1 + np.sum(np.abs(parts), axis=1)
    return ~(np.abs(np.sum(parts, axis=1) - forward) < ALIKE[gradient.dtype] * size)


def rise_of_energy(numbers, position, velocity, step):
    """The most that the energy of each scene rises over any that it had before; and what the step's order allows, J.

    First-order steps follow a parabola with a velocity that is off by dt g / 2; a landing is cut short by less than dt g.
    """
    mass, gravity, dt = numbers["mass"], numbers["gravity"], numbers["dt"][:, None]
    speed = np.linalg.norm(velocity, axis=-1)
    height = -np.einsum("snbd,sd->snb", position, gravity)
    energy = np.sum(mass[:, None] * (speed**2 / 2 + height), axis=-1)
    rise = np.max(energy - np.minimum.accumulate(energy, axis=1), axis=1)
    g = np.linalg.norm(gravity, axis=1, keepdims=True)
    total, most = np.sum(mass, axis=1, keepdims=True), np.max(speed, axis=(1, 2))[:, None]
    allowed = total * ((g * dt) ** 2 + (g * dt * most if step in FIRST_ORDER else 0))
    return rise, allowed[:, 0] + 64 * np.finfo(position.dtype).eps * np.max(np.abs(energy), axis=1)
