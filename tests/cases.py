"""The tables that the contract tests run through: one row a method, a force, an effect, a problem."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import jeuler


@dataclasses.dataclass(frozen=True)
class Method:
    step: Callable
    order: int
    needs_pair: bool = False  # y must be (position, velocity)


METHODS = {
    "euler": Method(jeuler.euler_step, 1),
    "symplectic_euler": Method(jeuler.symplectic_euler_step, 1, needs_pair=True),
    "heun": Method(jeuler.heun_step, 2),
    "rk4": Method(jeuler.rk4_step, 4),
}


@dataclasses.dataclass(frozen=True)
class Problem:
    """y' = f(t, y, args) with an exact solution where there is one."""

    f: Callable
    y0: Any
    args: Any
    t1: float
    exact: Callable | None = None
    pair: bool = False


def oscillator(t, y, args):
    x, v = y
    ks, kd = args
    return v, -ks * x - kd * v


def oscillator_exact(t, args=(4.0, 0.4)):
    ks, kd = args
    decay, omega = kd / 2, np.sqrt(ks - kd**2 / 4)
    envelope = np.exp(-decay * t)
    x = envelope * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    v = -envelope * ks / omega * np.sin(omega * t)
    return x, v


def lotka_volterra(t, y, args):
    a, b = args
    return {"prey": a * y["prey"] - b * y["prey"] * y["fox"], "fox": b * y["prey"] * y["fox"] - y["fox"]}


def pendulum(t, y, args):
    angle, rate = y
    return rate, -args * jnp.sin(angle) + 0.1 * jnp.cos(3 * t)


PROBLEMS = {
    "source": Problem(
        lambda x, y, a: a * x + y / 5, -3.0, 1.0, 5.0, exact=lambda x: 22 * np.exp(x / 5) - 5 * x - 25
    ),
    "decay": Problem(lambda t, y, k: -k * y, np.array([1.0, 2.0, -3.0]), 0.7, 2.0),
    "oscillator": Problem(oscillator, (1.0, 0.0), (4.0, 0.4), 3.0, exact=oscillator_exact, pair=True),
    "pendulum": Problem(pendulum, (np.array([0.5, 2.0]), np.zeros(2)), 9.81, 2.0, pair=True),
    "lotka_volterra": Problem(lotka_volterra, {"prey": 1.2, "fox": 0.8}, (1.5, 1.0), 2.0),
    "rotation": Problem(
        lambda t, y, w: 1j * w * y, np.array([1.0 + 0.0j]), 1.3, 2.0, exact=lambda t: np.exp([1.3j * t])
    ),
    "riccati": Problem(lambda t, y, a: a * (t - y**2), 0.5, 1.0, 2.0),
}

NET_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)]
NET_POSITION = np.array([[0.0, 0.0], [1.1, 0.1], [1.0, 0.9], [-0.1, 1.2]])
NET_VELOCITY = np.array([[0.0, 0.0], [0.4, -0.3], [0.2, 0.5], [-0.6, 0.1]])
NET_MASS = np.array([np.inf, 1.0, 2.0, 0.5])

FORCES = {
    "gravity": lambda: jeuler.Gravity([0.3, -9.81]),
    "springs": lambda: jeuler.Springs(NET_EDGES, ks=np.linspace(20.0, 60.0, 5), kd=0.7, rest_length=0.9),
    "springs_without_length": lambda: jeuler.Springs(NET_EDGES, ks=30.0, kd=np.linspace(0.1, 1.0, 5), rest_length=0.0),
    "no_springs": lambda: jeuler.Springs([], ks=30.0, kd=1.0, rest_length=1.0),
    "quadratic_drag": lambda: jeuler.QuadraticDrag(0.3),
    "function": lambda: lambda t, position, velocity, mass: -0.1 * velocity + 0.2 * jnp.sin(t),
}
INTERNAL_FORCES = ("springs", "springs_without_length", "no_springs")  # action equals reaction

EFFECTS = {
    "prescribed_motion": lambda: jeuler.PrescribedMotion([0], lambda t: jnp.stack([0.3 * jnp.sin(2 * t), 0.1 * t])[None]),
    "sampled_motion": lambda: jeuler.PrescribedMotion(
        [0], jeuler.SampledPath([0.0, 0.5, 1.0, 1.5], np.array([[[0.0, 0.0]], [[0.1, 0.2]], [[0.3, 0.1]], [[0.2, 0.0]]]))
    ),
}


def net_state(dtype=jnp.float64):
    """Four particles, one of them pinned."""
    return jeuler.ParticleState(
        jnp.asarray(NET_POSITION, dtype), jnp.asarray(NET_VELOCITY, dtype), jnp.asarray(NET_MASS, dtype)
    )


def net_scene():
    """Gravity, springs and drag."""
    return jeuler.Scene(forces=(FORCES["gravity"](), FORCES["springs"](), FORCES["quadratic_drag"]()))
