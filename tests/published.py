"""Published initial value problems: tests/data/ode_problems.json, which names the source of each."""

import json
import pathlib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

PROBLEMS = pathlib.Path(__file__).resolve().parent / "data" / "ode_problems.json"
NAMES = {name: getattr(jnp, name) for name in ("sin", "cos", "exp", "sqrt", "pi", "where", "floor", "sign")}
NAMES |= {"range": range, "sum": sum, "abs": abs}


class Published(NamedTuple):
    """y' = f(t, y, args) from y0 at t0, and the end value at t1 as it was published."""

    f: Any
    y0: Any
    t0: float
    t1: float
    reference: np.ndarray


def problems_in(path=PROBLEMS):
    """{name: `Published`} of a file."""
    with open(path) as file:
        return {problem["name"]: _published(problem) for problem in json.load(file)["problems"]}


def published(name):
    """The problem of this name."""
    return problems_in()[name]


def _published(problem):
    right_side = eval("lambda t, y: " + problem["rhs"], NAMES)

    def f(t, y, args):
        return jnp.stack([jnp.asarray(part, y.dtype) for part in right_side(t, y)])

    y0, reference = jnp.array(problem["y0"], float), np.array(problem["reference"])
    return Published(f, y0, problem["t0"], problem["t1"], reference)
