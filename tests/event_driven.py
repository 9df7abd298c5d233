"""The exact motion of balls between planes, frictionless, under gravity: from event to event, by NumPy alone.

Between events each ball moves on a parabola, with the acceleration that the planes on which it rests leave it. Events
are the roots of gaps. Ends of bouncing (the accumulation of infinitely many) are taken where a ball leaves a plane by
less than SLOWEST.
"""

import dataclasses
import itertools

import numpy as np

SLOWEST = 1e-7  # m/s
EVENTS = 200


@dataclasses.dataclass
class Balls:
    """Balls (ball, dim) between half-spaces (plane, dim), in one gravity (dim,)."""

    position: np.ndarray
    velocity: np.ndarray
    mass: np.ndarray
    radius: np.ndarray
    points: np.ndarray
    normals: np.ndarray  # of length one, out of the solids
    gravity: np.ndarray
    restitution: float

    def __post_init__(self):
        self.resting = np.zeros((len(self.position), len(self.points)), bool)


class NotExact(Exception):
    """The scene has a motion that is not a sequence of parabolas: balls that lean on each other, a grazing contact."""


def exact(balls, duration):
    """Position, velocity at the end, and the list of events (kind, ball, other, speed of approach); raises NotExact."""
    now, events = dataclasses.replace(balls), []
    now.position, now.velocity = balls.position.copy(), balls.velocity.copy()
    time = 0.0
    while len(events) < EVENTS:
        ahead, contact = min(upcoming(now), key=lambda event: event[0], default=(np.inf, None))
        span = min(ahead, duration - time)
        a = accelerations(now)
        now.position = now.position + span * now.velocity + span**2 / 2 * a
        now.velocity = now.velocity + span * a
        time += span
        if ahead == np.inf or time >= duration:
            return now.position, now.velocity, events
        events.append((*contact, collide(now, *contact)))
    raise NotExact(f"{EVENTS} events")


def accelerations(now):
    """Gravity, projected for each ball on what the planes under it let it do: the nearest a with n.a >= 0."""
    result = np.repeat(now.gravity[None], len(now.position), axis=0)
    for b, resting in enumerate(now.resting):
        under = now.normals[resting]
        if len(under) and np.any(under @ now.gravity < 0):
            result[b] = nearest_in_cone(now.gravity, under)
    return result


def nearest_in_cone(g, normals):
    choices = []
    for size in range(1, len(normals) + 1):
        for some in itertools.combinations(normals, size):
            basis = np.linalg.qr(np.array(some).T)[0]
            a = g - basis @ (basis.T @ g)
            if np.all(normals @ a >= -1e-12):
                choices.append(a)
    return min([*choices, np.zeros_like(g)], key=lambda a: np.linalg.norm(a - g))


def upcoming(now):
    """All (time ahead, (kind, ball, other)) at which something comes together."""
    a = accelerations(now)
    for b, w in np.ndindex(now.resting.shape):
        if not now.resting[b, w]:
            normal = now.normals[w]
            gap = (now.position[b] - now.points[w]) @ normal - now.radius[b]
            for s in meetings([a[b] @ normal / 2, now.velocity[b] @ normal, gap]):
                yield s, ("plane", b, w)
    for i, j in itertools.combinations(range(len(now.position)), 2):
        d, v, g = (y[i] - y[j] for y in (now.position, now.velocity, a))
        reach = now.radius[i] + now.radius[j]
        if abs(d @ d - reach**2) < 1e-11 and abs(v @ d) < 1e-9 and (g @ d + v @ v) < -1e-9:
            raise NotExact("balls that lean on each other")
        square = [g @ g / 4, v @ g, v @ v + d @ g, 2 * (d @ v), d @ d - reach**2]
        for s in meetings(square):
            yield s, ("balls", i, j)


def meetings(polynomial):
    """Times from now on at which a gap comes down through 0; now, where it is 0 (or a rounding below) and falling."""
    *_, slope, gap = polynomial
    if gap <= 1e-13 and slope < -1e-12:
        return [0.0]
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.roots(polynomial) if np.any(polynomial) else np.array([])
    found = []
    for root in roots[np.abs(roots.imag) < 1e-7].real:
        for _ in range(3):  # Newton's method, for the digits that the companion matrix leaves
            steep = np.polyval(np.polyder(polynomial), root)
            root = root - np.polyval(polynomial, root) / steep if steep else root
        if root > 0 and np.polyval(np.polyder(polynomial), root) < -1e-10:
            found.append(root)
    return found


def collide(now, kind, b, other):
    """The impact of ball b on a plane or on another ball, after which it may rest on a plane; the speed of approach."""
    if kind == "plane":
        normal = now.normals[other]
        speed = now.velocity[b] @ normal
        away = -now.restitution * speed
        stays = away < SLOWEST and now.gravity @ normal < 0
        now.velocity[b] += ((0 if stays else away) - speed) * normal
        now.resting[b, other] = stays
        moved = [b]
    else:
        d = now.position[b] - now.position[other]
        normal = d / np.linalg.norm(d)
        speed = (now.velocity[b] - now.velocity[other]) @ normal
        impulse = -(1 + now.restitution) * speed / (1 / now.mass[b] + 1 / now.mass[other]) * normal
        now.velocity[b] += impulse / now.mass[b]
        now.velocity[other] -= impulse / now.mass[other]
        moved = [b, other]
    for k in moved:  # whoever is moved off its plane, or into it, rests no more
        for w in np.flatnonzero(now.resting[k]):
            if abs(now.velocity[k] @ now.normals[w]) > 1e-12:
                now.resting[k, w] = False
    return -speed


def shifted(balls, velocity):
    """The same with another velocity added to all."""
    return dataclasses.replace(balls, velocity=balls.velocity + velocity)


def padded(balls, *, count, planes):
    """All numbers of the scene as arrays, with pinned balls and planes far away up to these many."""
    more, free = count - len(balls.position), planes - len(balls.points)
    far = 50.0 + np.arange(more)[:, None] * np.ones(2)
    return (
        np.concatenate([balls.position, far]),
        np.concatenate([balls.velocity, 0 * far]),
        np.concatenate([balls.mass, np.full(more, np.inf)]),
        np.concatenate([balls.radius, np.full(more, 0.1)]),
        np.concatenate([balls.points, np.tile([0.0, -100.0], (free, 1))]),
        np.concatenate([balls.normals, np.tile([0.0, 1.0], (free, 1))]),
        balls.gravity,
        np.array(balls.restitution),
    )


def random_scenes(random, count, duration, dt, *, balls=5, planes=4):
    """Scenes of 1 to 5 balls and 0 to 4 planes in which something happens and that are not chaotic.

    They have an exact motion also with the velocities that first-order steps of dt or dt / 2 have in effect.
    """
    scenes = []
    while len(scenes) < count:
        how = {"balls": random.integers(1, balls + 1), "planes": random.integers(0, planes + 1)}
        scene = random_balls(random, **how, restitution=float(random.choice([1.0, 0.8, 0.5, 0.0])))
        try:
            here, _, events = exact(scene, duration)
            near, _, _ = exact(shifted(scene, 1e-7 * random.normal(size=scene.velocity.shape)), duration)
            for part in (-0.5, -0.25, 0.25, 0.5) if scene.gravity.any() else ():
                exact(shifted(scene, part * dt * scene.gravity), duration)
        except NotExact:
            continue
        if events and np.max(np.abs(near - here)) < 1e-5:
            scenes.append(scene)
    return scenes


def random_balls(random, *, balls, planes, restitution):
    """Balls of a room of some size, at random places, of equal or of random masses and radii, not in touch."""
    alike = random.random() < 0.5
    radius = np.full(balls, 0.1) if alike else random.uniform(0.04, 0.15, balls)
    mass = np.full(balls, 1.0) if alike else 10 ** random.uniform(-0.7, 0.7, balls)
    tilt = 0.0 if random.random() < 0.5 else random.uniform(-0.3, 0.3)  # of the whole room
    points = np.array([[0.0, 0.0], [0.0, 0.0], [1.2, 0.0], [0.0, 1.2]])[:planes]
    normals = np.array([[0.0, 1.0], [1.0, 0.0], [-1.0, 0.0], [0.0, -1.0]])[:planes]
    turn = np.array([[np.cos(tilt), -np.sin(tilt)], [np.sin(tilt), np.cos(tilt)]])
    position = np.empty((0, 2))
    while len(position) < balls:
        place, r = random.uniform(0.16, 1.04, 2), radius[len(position)]
        if all(np.linalg.norm(place - p) > r + s + 0.01 for p, s in zip(position, radius, strict=False)):
            position = np.vstack([position, place])
    velocity = random.uniform(-1.5, 1.5, (balls, 2))
    gravity = np.array([0.0, -9.8]) if random.random() < 0.7 else np.zeros(2)
    return Balls(position @ turn.T, velocity, mass, radius, points @ turn.T, normals @ turn.T, gravity, restitution)
