"""Problems that advise_step is tried on beside the published ones: fields that switch or kink, nets of springs, orbits."""

import math

import jax.numpy as jnp
import numpy as np
from published import Published, published

import jeuler
from jeuler._core.precision import flat


def relaxed(y, times, rates, levels):
    """y after y' = rate (level - y) with a rate and level of their own between neighbouring times."""
    for length, rate, level in zip(np.diff(times), rates, levels, strict=True):
        y = level + (y - level) * math.exp(-rate * length)
    return y


def _driven(t, y, args):
    return jnp.where(jnp.floor(t) % 2 == 0, 55 - 1.5 * y, -0.5 * y)


def _relay(t, y, args):
    return jnp.where(jnp.floor(t / 0.7) % 2 == 0, 1.0, -1.0) - y


IRREGULAR = np.concatenate([[0.0], np.cumsum(0.2 + 0.1 * np.sin(1.7 * np.arange(57)))])  # 57 switch times


def _irregular(t, y, args):
    return jnp.where(jnp.sum(t >= IRREGULAR.astype(t.dtype)) % 2 == 1, 1.0, -1.0) - 0.3 * y


def _staircase(t, y, args):
    return jnp.floor(3 * t) / 3 - y / 2


def _kink(t, y, args):
    return jnp.abs(t - 1 / 3) - y


def _kinked_growth(t, y, args):
    return y * jnp.maximum(jnp.sin(t), 0.0)


def _jump_in_state(t, y, args):
    return jnp.where(y > 0.5, -1.0, -3.0 * y)


STIFFNESS, GRAVITY, HEIGHT = 400.0, 9.8, 0.5  # a unit mass above a floor that pushes like a spring


def _floor(t, y, args):
    return jnp.stack([y[1], STIFFNESS * jnp.maximum(-y[0], 0.0) - GRAVITY])


def on_the_floor(t):
    """Height and velocity: free fall, half a swing about the depth where the floor carries the weight, and up again."""
    omega, fall, speed = math.sqrt(STIFFNESS), math.sqrt(2 * HEIGHT / GRAVITY), math.sqrt(2 * GRAVITY * HEIGHT)
    touch = (math.pi + 2 * math.atan(GRAVITY / (omega * speed))) / omega
    t = math.fmod(t, 2 * fall + touch)
    if t < fall:
        return np.array([HEIGHT - GRAVITY * t * t / 2, -GRAVITY * t])
    if t < fall + touch:
        depth, phase = GRAVITY / STIFFNESS, omega * (t - fall)
        x = -depth + depth * math.cos(phase) - speed / omega * math.sin(phase)
        return np.array([x, -depth * omega * math.sin(phase) - speed * math.cos(phase)])
    t -= fall + touch
    return np.array([speed * t - GRAVITY * t * t / 2, speed - GRAVITY * t])


def _kink_exact(t):
    """y' = |t - a| - y from y(0) = 1: y = a + 1 - t + c exp(-t), then y = t - a - 1 + c exp(-t)."""
    a = 1 / 3
    middle = 1 + (1 - a - 1) * math.exp(-a)
    return t - a - 1 + (middle + 1) * math.exp(a - t)


SEVENS = np.append(0.7 * np.arange(15), 10.0)
THIRDS = np.append(np.arange(0, 15) / 3, 5.0)
FIELDS = {  # f, y0, t1, y(t1)
    "driven": (_driven, 110.0, 20.0, relaxed(110.0, np.arange(21.0), [1.5, 0.5] * 10, [55 / 1.5, 0.0] * 10)),
    "relay": (_relay, 3.0, 10.0, relaxed(3.0, SEVENS, [1.0] * 15, [1.0, -1.0] * 7 + [1.0])),
    "57 switches": (
        _irregular,
        2.0,
        float(IRREGULAR[-1]) + 0.1,
        relaxed(2.0, np.append(IRREGULAR, IRREGULAR[-1] + 0.1), [0.3] * 58, [1 / 0.3, -1 / 0.3] * 29),
    ),
    "staircase": (_staircase, 1.0, 5.0, relaxed(1.0, THIRDS, [0.5] * 15, 2 * np.arange(15) / 3)),
    "kink in time": (_kink, 1.0, 2.0, _kink_exact(2.0)),
    "kinked growth": (_kinked_growth, 1.0, 7.0, math.exp(2 + 1 - math.cos(7 - 2 * math.pi))),
    "jump in the state": (_jump_in_state, 2.0, 2.2, 0.5 * math.exp(-3 * 0.7)),
    "floor": (_floor, [HEIGHT, 0.0], 3.0, on_the_floor(3.0)),
}


def more_problems():
    """The Oregonator (Mazzia and Magherini), an orbit of eccentricity 0.9 (DETEST D5), van der Pol's with mu = 1000."""

    def oregonator(t, y, args):
        a = 77.27 * (y[1] + y[0] * (1 - 8.375e-6 * y[0] - y[1]))
        return jnp.stack([a, (y[2] - (1 + y[0]) * y[1]) / 77.27, 0.161 * (y[0] - y[2])])

    def van_der_pol(t, y, args):
        return jnp.stack([y[1], 1000 * (1 - y[0] ** 2) * y[1] - y[0]])

    end = np.array([1.000814870318523, 1228.178521549917, 132.0554942846706])
    orbit = published("DETEST_nonstiff_D4").f
    return {
        "OREGO": Published(oregonator, jnp.array([1.0, 2.0, 3.0]), 0.0, 360.0, end),
        "DETEST_nonstiff_D5": Published(orbit, jnp.asarray(kepler(0.9, 0.0)), 0.0, 20.0, kepler(0.9, 20.0)),
        "VDPOL_mu1000": Published(
            van_der_pol, jnp.array([2.0, 0.0]), 0.0, 2000.0, np.array([1.706167732170469, -8.928097010248125e-4])
        ),
    }


def kepler(eccentricity, t):
    """Position and velocity on an orbit of semi-axis 1 about a unit mass, at its nearest at t = 0."""
    angle = t
    for _ in range(200):
        angle -= (angle - eccentricity * math.sin(angle) - t) / (1 - eccentricity * math.cos(angle))
    distance, minor = 1 - eccentricity * math.cos(angle), math.sqrt(1 - eccentricity**2)
    place = math.cos(angle) - eccentricity, minor * math.sin(angle)
    return np.array([*place, -math.sin(angle) / distance, minor * math.cos(angle) / distance])


def spring_scenes():
    """Ten (name, (f, y0, t1, args, y(t1))): chains and nets of springs that swing, stretch and are stirred."""
    for number in range(10):
        random = np.random.default_rng(number)
        side, dim = 2 + number % 3, 2 + number % 2
        index = np.arange(side * side).reshape(side, side)
        pairs = [(index[:-1], index[1:]), (index[:, :-1], index[:, 1:]), (index[:-1, :-1], index[1:, 1:])]
        edges = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])
        place = np.zeros((side * side, dim))
        place[:, 0], place[:, 1] = np.divmod(np.arange(side * side), side)
        rest = np.linalg.norm(place[edges[:, 0]] - place[edges[:, 1]], axis=1) * (1 - 0.05 * random.random())
        mass = random.uniform(0.5, 2.0, side * side)
        mass[0] = np.inf
        springs = jeuler.Springs(edges, ks=random.uniform(20, 200), kd=0.3 * (number % 4), rest_length=rest)
        scene = jeuler.Scene((springs, jeuler.Gravity(np.eye(dim)[1] * -9.8)))
        stirred = place + 0.05 * random.standard_normal(place.shape)
        state = jeuler.ParticleState(jnp.asarray(stirred), jnp.zeros_like(stirred), mass=jnp.asarray(mass))
        y0, args = scene.as_equation(state)
        end = jeuler.solve_adaptive(scene.vector_field, y0, t1=1.0, args=args, rtol=1e-11, atol=1e-12, max_steps=65_536)
        yield f"net {number}", (scene.vector_field, y0, 1.0, args, flat([leaf[-1] for leaf in end.y]))
