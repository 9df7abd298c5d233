"""Wrong inputs that a person is likely to write, drawn with a fixed seed from a table of right calls.

Every argument of a right call has a kind; every kind has values that are wrong for it. Beside these, calls are made
wrong as a whole: a name misspelt or of another library, an argument left out, by place or twice. `tried` says what
came back.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import traceback
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jeuler
from jeuler.__main__ import main

SOURCE = str(Path(jeuler.__file__).parent)
KEY = jax.random.key(0)


class Thing:
    """What has nothing to do with any argument."""


# Values that are wrong for a kind of argument

NO_NUMBER = {
    "a unit": "0.5 m",
    "a number in quotes": "0.5",
    "None": None,
    "nan": np.nan,
    "complex": 1j,
    "a dict": {"value": 1.0},
    "an object": Thing(),
    "a function": lambda: 1.0,
    "a class": float,
    "a set": {1.0},
    "NaN in an array": np.array([np.nan]),
}
SCALAR = {k: v for k, v in NO_NUMBER.items() if k != "NaN in an array"} | {
    "a list": [0.5],
    "an array": np.array([0.5]),
    "a boolean": True,
    "infinite": np.inf,
}
COUNT = {
    "a float": 2.0,
    "a fraction": 2.5,
    "negative": -1,
    "in quotes": "3",
    "None": None,
    "a list": [3],
    "nan": np.nan,
    "a boolean": True,
    "complex": 3j,
}
ARRAY = {
    "ragged": [[0.0, 0.0], [1.0]],
    "strings": [["a", "b"], ["c", "d"]],
    "None": None,
    "complex": np.zeros((2, 2), complex),
    "a dict": {"x": 0.0},
    "a function": lambda t: t,
    "an object": Thing(),
    "a word": "here",
    "objects": np.array([[None, 1.0]], object),
    "dates": np.array([["2020-01-01"]], "datetime64[s]"),
    "too many axes": np.zeros((2, 2, 2, 2)),
}
INDICES = {
    "floats": [[0.0, 1.0]],
    "fractions": [[0.5, 1.0]],
    "past 2^32": [[0, 2**32 + 1]],
    "past 2^31": [[0, 2**31]],
    "negative": [[0, -1]],
    "out of range": [[0, 99]],
    "one twice": [[1, 1]],
    "ragged": [[0, 1], [1]],
    "strings": [["0", "1"]],
    "None": None,
    "a word": "0-1",
    "booleans": [[False, True]],
    "one axis": [0, 1],
    "three axes": [[[0, 1]]],
    "complex": [[0j, 1j]],
    "a set": {(0, 1)},
    "a dict": {0: 1},
    "nan": [[0, np.nan]],
}
FUNCTION = {
    "None": None,
    "a word": "f",
    "a number": 1.0,
    "no arguments": lambda: 0.0,
    "a class": Thing,
    "a list": [1.0],
    "an object": Thing(),
}
VECTOR = {
    "ragged": [[0.0], [1.0, 2.0]],
    "four numbers": [0.0, 1.0, 2.0, 3.0],
    "in space": [0.0, 1.0, 2.0],
    "strings": ["a", "b"],
    "a word": "down",
    "None": None,
    "nan": [np.nan, 1.0],
    "complex": [1j, 0.0],
    "a dict": {"x": 0.0, "y": 1.0},
    "an object": Thing(),
    "booleans": [True, False],
    "a column": [[0.0], [1.0]],
}
NEGATIVE = {"negative": -0.5}
ZERO = {"zero": 0.0}
PER_PARTICLE = {"one too many": [0.1, 0.2, 0.3], "a column": [[0.1], [0.2]], "ragged": [[0.1], [0.2, 0.3]]}
PARAMETER = {k: v for k, v in NO_NUMBER.items() if k not in ("a function",)} | {"infinite": np.inf, "a boolean": True}


def without(values, *names):
    return {k: v for k, v in values.items() if k not in names}


KINDS = {
    "word": {"misspelt": "linaer", "another": "adam", "a number": 3, "None": None, "a function": lambda r: r, "empty": "", "an object": Thing()},
    "list above 0": {"empty": [], "negative": [-0.1], "zero": [0.0], "nan": [np.nan], "strings": ["0.1"], "None": None, "a number": 0.1, "complex": [1j], "longer than the run": [9.0], "two axes": [[0.1, 0.2]], "infinite": [np.inf]},
    "steps": {"None": None, "empty": {}, "a name": "rk4", "numbers": {"Euler": 1.0}, "names": ["rk4"], "a factory": {"implicit": jeuler.implicit_euler}},
    "measured": {"negative": -1.0, "zero": 0.0, "nan": np.nan, "a word": "small", "complex": 1j, "one too many": np.ones(3), "an object": Thing()},
    "solver": {"a name": "LU", "a class": Thing, "a number": 1},
    "field names": {"one word": "heat", "numbers": (1,), "None": None, "a dict of numbers": {1: 2}, "a set of numbers": {3}},
    "windows": {"a word": "all", "a number": 1, "negative": (-1,), "decreasing": (2, 1), "floats": (1.5,), "None": None, "without a pool": (1,), "a dict": {1: 2}},
    "checkpoint": {"another word": "log", "zero": 0, "a float": 2.5, "a boolean": True, "a list": [2], "negative": -3},
    "breaks": {"a word": "soon", "nan": [np.nan], "two axes": [[0.1, 0.2]], "None": None, "a dict": {0.1: 1}, "complex": [1j], "booleans": [True], "strings": ["0.1"]},
    "progress": {"a word": "bar", "a number": 10, "of one argument": lambda n: n, "a class": Thing, "while tracing": True},
    "flags": {"integers": [1, 0], "floats": [1.0, 0.0], "a word": "yes", "too many": np.ones(3, bool), "a column": np.ones((2, 1), bool)},
    "ages": {"a word": "old", "strings": ["1", "2"], "too many": np.zeros(3), "a column": np.zeros((2, 1)), "integers": [1, 2], "complex": [1j, 2j], "a dict": {"a": 1}, "ragged": [[1.0], [1.0, 2.0]]},
    "any number": SCALAR,
    "positive": SCALAR | NEGATIVE | ZERO,
    "not negative": SCALAR | NEGATIVE,
    "step size": SCALAR | ZERO,
    "end": without(SCALAR, "a list", "an array") | NEGATIVE | {"decreasing": [2.0, 1.0], "two axes": [[1.0, 2.0]], "empty": []},
    "count": COUNT,
    "count from 1": COUNT | {"zero": 0},
    "points": ARRAY | {"one axis": [0.0, 1.0], "a number": 1.0, "integers": [[0, 0], [1, 0]]},
    "points of a shape": ARRAY | {"other points": np.zeros((5, 2)), "in space": np.zeros((2, 3)), "a number": 1.0},
    "edges": INDICES,
    "triples": without(INDICES, "one twice", "out of range") | {"pairs": [[0, 1]], "one twice": [[0, 1, 1]], "out of range": [[0, 1, 99]]},
    "bodies": without(INDICES, "one axis", "one twice", "out of range") | {"one twice": [0, 0], "out of range": [0, 99]},
    "bodies or None": without(INDICES, "one axis", "None", "one twice", "out of range") | {"one twice": [0, 0], "out of range": [0, 99]},
    "function": FUNCTION,
    "vector": VECTOR,
    "parameter": PARAMETER | PER_PARTICLE,
    "parameter from 0": PARAMETER | PER_PARTICLE | NEGATIVE,
    "parameter above 0": PARAMETER | PER_PARTICLE | NEGATIVE | ZERO,
    "mass": without(PARAMETER, "infinite") | PER_PARTICLE | NEGATIVE | ZERO,
    "switch": {"a word": "yes", "a number": 2.0, "an object": Thing(), "None": None},
    "key": {"a number": 0, "a word": "seed", "a float": 1.5, "a batch": jax.random.split(KEY, 3), "an object": Thing()},
    "step": FUNCTION | {"a name": "rk4", "its factory": jeuler.implicit_euler, "another function": lambda y: y},
    "save": without(FUNCTION, "None", "no arguments") | {"of the state alone": lambda state: state, "nothing back": lambda t, y: None},
    "times": {
        "ragged": [[0.0], [1.0, 2.0]], "decreasing": [2.0, 1.0, 0.0], "nan": [0.0, np.nan, 2.0], "None": None, "equal": [1.0, 1.0, 1.0],
        "strings": ["0 s", "1 s", "2 s"], "two axes": np.zeros((3, 1)), "a dict": {"t": 0.0}, "complex": [0j, 1j, 2j],
    },
    "name": {"a number": 3, "None": None, "a list": ["age"], "an object": Thing()},
    "parts": {"one alone": jeuler.Gravity([0.0, -9.8]), "its class": (jeuler.Gravity,), "None": None, "a None": (None,), "a word": "gravity", "words": ("gravity",), "numbers": (9.8,), "a dict": {"gravity": 9.8}},
    "scene": {"None": None, "a list": [jeuler.Gravity([0.0, -9.8])], "a force": jeuler.Gravity([0.0, -9.8]), "a word": "scene", "a class": jeuler.Scene},
    "state": {"None": None, "an array": np.zeros((2, 2)), "a dict": {"position": np.zeros((2, 2))}, "a tuple": (np.zeros((2, 2)), np.zeros((2, 2))), "a class": jeuler.ParticleState},
    "y": {"None": None, "a word": "y", "integers": 1, "a boolean": True, "objects": np.array([None, 1.0], object), "an object": Thing(), "empty": ()},
    "names": {"another": ("k",), "one word": "stiffness", "numbers": (1, 2), "None": None, "empty": ()},
    "path": {"a number": 3, "None": None, "missing": "no_such_file.csv", "a folder": "/", "an object": Thing(), "bytes": b"no_such_file.csv"},
}  # fmt: skip


# Right calls: a function, and its arguments with their kinds and values

PAIR = jeuler.ParticleState([[0.0, 0.0], [1.0, 0.0]], np.zeros((2, 2)), mass=[np.inf, 0.5])
SPACE = jeuler.ParticleState(np.eye(3), np.zeros((3, 3)))
NET = jeuler.Scene((jeuler.Springs([[0, 1]], 10.0, 0.1, 1.0), jeuler.Gravity([0.0, -9.8])))
FLOOR = jeuler.Plane([0.0, 0.0], [0.0, 1.0])
TIMES = np.linspace(0.0, 1.0, 5)
SWING = np.stack([np.zeros((5, 2)), np.stack([1 + 0.1 * np.cos(4 * TIMES), 0 * TIMES], 1)], 1)


def decay(t, y, args):
    return -y


def run(scene, state=PAIR):
    """A run of the scene as far as it is traced: all that can be refused has been."""
    return jax.eval_shape(lambda: jeuler.simulate(scene, state, dt=0.01, num_steps=2, key=KEY).t)


def force(part):
    return run(jeuler.Scene((part,)))


def effect(part):
    return run(jeuler.Scene((), (part,)))


def air(part):
    return force(jeuler.LinearDrag(1.0, air=part))


def collider(part):
    return effect(jeuler.Collisions((part,)))


def born(sampler):
    return run(jeuler.Scene((), (jeuler.Emitter(1.0, [0.0, 0.0], sampler),)), jeuler.empty_pool(3, 2))


def solved(**how):
    return jax.eval_shape(lambda: jeuler.solve(**how).t)


def simulated(**how):
    return jax.eval_shape(lambda: jeuler.simulate(**how).t)


def made(cls, use):
    """A component, made and put to use."""
    return lambda *args, **how: use(cls(*args, **how))


RIGHT = {
    "work_precision": (jeuler.work_precision, {"f": ("function", decay), "y0": ("y", 1.0), "t1": ("positive", 1.0), "dts": ("list above 0", [0.5]), "steps": ("steps", {"Euler": jeuler.euler_step}), "t0": ("any number", 0.0), "repeats": ("count from 1", 1), "points": ("count from 1", 4), "timeout": ("positive", 1.0)}),
    "advise_method": (jeuler.advise_method, {"f": ("function", decay), "y0": ("y", 1.0), "t1": ("positive", 1.0), "error": ("positive", 0.1), "t0": ("any number", 0.0), "patience": ("positive", 1.0)}),
    "fit in detail": (jeuler.fit, {"residual": ("function", lambda p: p["a"] - jnp.ones(2)), "params": ("y", {"a": 1.0}), "loss": ("word", "linear"), "loss_scale": ("positive", 1.0), "tolerance": ("positive", 0.1), "max_iterations": ("count from 1", 1), "sigma": ("measured", 1.0)}),
    "fit_springs in detail": (jeuler.fit_springs, {"scene": ("scene", NET), "state": ("state", PAIR), "times": ("times", TIMES), "positions": ("points of a shape", SWING), "dt": ("positive", 0.05), "loss": ("word", "linear"), "start": ("word", "given"), "tolerance": ("positive", 0.1), "num_steps": ("count from 1", 20), "max_iterations": ("count from 1", 1), "grow": ("switch", False), "step_bias": ("switch", False)}),
    "linearly_implicit_euler": (jeuler.linearly_implicit_euler, {"linear_solver": ("solver", None)}),
    "strand_edges": (jeuler.strand_edges, {"strands": ("edges", [[0, 1, 2]])}),
    "StrandBending": (made(jeuler.StrandBending, lambda b: run(jeuler.Scene((b,)), SPACE)), {"strands": ("triples", [[0, 1, 2]]), "rest_position": ("points of a shape", np.eye(3)[None]), "stiffness": ("not negative", 1.0), "damping": ("not negative", 0.0), "smoothing": ("positive", 0.1)}),
    "FromSurface": (made(jeuler.FromSurface, lambda s: run(jeuler.Scene((), (jeuler.Emitter(1.0, s, [0.0, 0.0, 0.0]),)), jeuler.empty_pool(3, 3))), {"vertices": ("points", np.eye(3)), "faces": ("triples", [[0, 1, 2]])}),
    "uses": (jeuler.uses, {"reads": ("field names", ("heat",)), "writes": ("field names", ("heat",)), "sets": ("field names", ("heat",)), "before_motion": ("switch", False)}),
    "windows and breaks": (simulated, {"scene": ("scene", NET), "state": ("state", PAIR), "dt": ("step size", 0.01), "num_steps": ("count", 4), "windows": ("windows", ()), "checkpoint": ("checkpoint", None)}),
    "breaks": (solved, {"f": ("function", decay), "y0": ("y", 1.0), "dt": ("step size", 0.01), "num_steps": ("count", 4), "breaks": ("breaks", ()), "checkpoint": ("checkpoint", None), "progress": ("progress", None)}),
    "a field of a state": (lambda **how: run(NET, PAIR.replace(**how)), {"position": ("points", PAIR.position), "mass": ("mass", 1.0), "alive": ("flags", np.ones(2, bool)), "age": ("ages", np.zeros(2)), "lifetime": ("ages", np.ones(2)), "opacity": ("ages", np.ones(2))}),
    "simulate": (simulated, {"scene": ("scene", NET), "state": ("state", PAIR), "dt": ("step size", 0.01), "num_steps": ("count", 4),
                             "t0": ("any number", 0.0), "step": ("step", jeuler.rk4_step), "save_every": ("count from 1", 2), "save": ("save", None),
                             "key": ("key", None), "compensated": ("switch", False)}),
    "solve": (solved, {"f": ("function", decay), "y0": ("y", 1.0), "dt": ("step size", 0.01), "num_steps": ("count", 4), "t0": ("any number", 0.0),
                       "step": ("step", jeuler.rk4_step), "save_every": ("count from 1", 2), "save": ("save", None), "compensated": ("switch", False)}),
    "solve_adaptive": (jeuler.solve_adaptive, {"f": ("function", decay), "y0": ("y", 1.0), "t1": ("end", 1.0), "t0": ("any number", 0.0), "rtol": ("not negative", 1e-3),
                                               "atol": ("not negative", 1e-3), "max_steps": ("count from 1", 64)}),
    "diagnose": (jeuler.diagnose, {"scene": ("scene", NET), "state": ("state", PAIR), "dt": ("step size", 0.01), "num_steps": ("count", 1), "t0": ("any number", 0.0)}),
    "stability_limit": (jeuler.stability_limit, {"f": ("function", decay), "t": ("any number", 0.0), "y": ("y", 1.0), "step": ("step", jeuler.euler_step)}),
    "advise_step": (jeuler.advise_step, {"f": ("function", decay), "y0": ("y", 1.0), "t1": ("positive", 1.0), "error": ("positive", 0.1), "t0": ("any number", 0.0), "step": ("step", jeuler.euler_step), "patience": ("positive", 60.0)}),
    "fit": (jeuler.fit, {"residual": ("function", lambda p: p["a"] - 2.0), "params": ("y", {"a": 1.0}), "max_iterations": ("count from 1", 2)}),
    "fit_springs": (jeuler.fit_springs, {"scene": ("scene", NET), "state": ("state", PAIR), "times": ("times", TIMES), "positions": ("points of a shape", SWING),
                                         "dt": ("positive", 0.05), "parameters": ("names", ("ks",)), "t0": ("any number", 0.0)}),
    "identifiability": (jeuler.identifiability, {"scene": ("scene", NET), "state": ("state", PAIR), "times": ("times", TIMES), "parameters": ("names", ("ks",)), "dt": ("positive", 0.05)}),
    "read_trajectory": (jeuler.read_trajectory, {"path": ("path", "x.csv"), "skip": ("count", 0), "si": ("switch", False)}),
    "implicit_euler": (jeuler.implicit_euler, {"rtol": ("not negative", 1e-3), "max_steps": ("count from 1", 5)}),
    "extrapolated_euler": (jeuler.extrapolated_euler, {"order": ("count from 1", 2)}),
    "cap_cotangent": (jeuler.cap_cotangent, {"step": ("step", jeuler.euler_step), "max_norm": ("positive", 1.0)}),
    "Scene": (made(jeuler.Scene, run), {"forces": ("parts", ()), "effects": ("parts", ())}),
    "ParticleState": (made(jeuler.ParticleState, lambda s: run(NET, s)), {"position": ("points", PAIR.position), "velocity": ("points of a shape", PAIR.velocity), "mass": ("mass", 1.0)}),
    "empty_pool": (jeuler.empty_pool, {"capacity": ("count from 1", 4), "dim": ("count from 1", 2), "mass": ("mass", 1.0)}),
    "Springs": (made(jeuler.Springs, force), {"edges": ("edges", [[0, 1]]), "ks": ("parameter", 10.0), "kd": ("parameter", 0.1), "rest_length": ("parameter from 0", 1.0)}),
    "Gravity": (made(jeuler.Gravity, force), {"acceleration": ("vector", [0.0, -9.8])}),
    "LinearDrag": (made(jeuler.LinearDrag, force), {"coefficient": ("parameter from 0", 0.1)}),
    "QuadraticDrag": (made(jeuler.QuadraticDrag, force), {"coefficient": ("parameter from 0", 0.1)}),
    "Viscosity": (made(jeuler.Viscosity, force), {"edges": ("edges", [[0, 1]]), "coefficient": ("parameter from 0", 0.1)}),
    "Bending": (made(jeuler.Bending, lambda b: run(jeuler.Scene((b,)), SPACE)), {"triples": ("triples", [[0, 1, 2]]), "stiffness": ("parameter from 0", 1.0)}),
    "PointAttractor": (made(jeuler.PointAttractor, force), {"center": ("vector", [0.0, 0.0]), "strength": ("any number", 1.0), "softening": ("positive", 0.1)}),
    "DryFriction": (made(jeuler.DryFriction, force), {"coefficient": ("parameter from 0", 0.1), "slow": ("positive", 0.1)}),
    "AppliedForce": (made(jeuler.AppliedForce, force), {"force": ("vector", [1.0, 0.0]), "particles": ("bodies or None", [0]), "gain": ("any number", 1.0)}),
    "ShapeMatching": (made(jeuler.ShapeMatching, force), {"particles": ("bodies", [0, 1]), "rest_position": ("points of a shape", [[0.0, 0.0], [1.0, 0.0]]), "stiffness": ("not negative", 1.0), "damping": ("not negative", 0.0)}),
    "PenaltyContact": (made(jeuler.PenaltyContact, force), {"collider": ("function", FLOOR), "ks": ("parameter from 0", 1.0), "kd": ("parameter from 0", 0.0)}),
    "Wind": (made(jeuler.Wind, air), {"velocity": ("vector", [1.0, 0.0])}),
    "Gust": (made(jeuler.Gust, air), {"velocity": ("vector", [1.0, 0.0]), "period": ("positive", 1.0)}),
    "Vortex": (made(jeuler.Vortex, air), {"center": ("vector", [0.0, 0.0]), "circulation": ("any number", 1.0), "core": ("positive", 0.1)}),
    "turbulence": (made(jeuler.turbulence, air), {"dim": ("count from 1", 2), "speed": ("not negative", 1.0), "size": ("positive", 1.0), "modes": ("count from 1", 2)}),
    "Plane": (made(jeuler.Plane, collider), {"point": ("vector", [0.0, 0.0]), "normal": ("vector", [0.0, 1.0])}),
    "Sphere": (made(jeuler.Sphere, collider), {"center": ("vector", [0.0, 0.0]), "radius": ("not negative", 1.0), "inside": ("switch", False)}),
    "Box": (made(jeuler.Box, collider), {"center": ("vector", [0.0, 0.0]), "half_size": ("vector", [1.0, 1.0])}),
    "Collisions": (made(jeuler.Collisions, effect), {"colliders": ("parts", (FLOOR,)), "radius": ("parameter from 0", 0.1), "restitution": ("not negative", 0.5), "friction": ("not negative", 0.1), "max_bounces": ("count from 1", 8)}),
    "Emitter": (made(jeuler.Emitter, lambda e: run(jeuler.Scene((), (e,)), jeuler.empty_pool(3, 2))), {"rate": ("not negative", 1.0), "position": ("vector", [0.0, 0.0]), "velocity": ("vector", [0.0, 0.0]), "max_births": ("count from 1", 2)}),
    "SubEmitter": (made(jeuler.SubEmitter, lambda e: run(jeuler.Scene((), (jeuler.Lifetime(1.0), e)), jeuler.empty_pool(3, 2))), {"births": ("count from 1", 2), "velocity": ("vector", [0.0, 0.0]), "position": ("vector", [0.0, 0.0]), "generations": ("count from 1", 1), "max_births": ("count from 1", 2)}),
    "SubEmitter on contact": (made(lambda **of: jeuler.SubEmitter(1, [0.0, 0.0], **of), lambda e: run(jeuler.Scene((), (e,)), jeuler.empty_pool(3, 2))), {"contact": ("function", FLOOR), "margin": ("any number", 0.0), "slowest": ("not negative", 0.1), "inherit": ("any number", 0.5)}),
    "Trail": (made(jeuler.Trail, effect), {"points": ("count from 1", 3), "every": ("count from 1", 2)}),
    "Lifetime": (made(jeuler.Lifetime, effect), {"duration": ("positive", 1.0)}),
    "Lifetime in frames": (made(jeuler.Lifetime, effect), {"frames": ("count from 1", 3)}),
    "Death": (made(jeuler.Death, effect), {"condition": ("function", lambda t, state: state.position[:, 0] > 2)}),
    "DeathOutside": (made(jeuler.DeathOutside, effect), {"low": ("vector", [-9.0, -9.0]), "high": ("vector", [9.0, 9.0])}),
    "DeathOnContact": (made(jeuler.DeathOnContact, effect), {"collider": ("function", FLOOR), "margin": ("any number", 0.0)}),
    "SpeedLimit": (made(jeuler.SpeedLimit, effect), {"limit": ("not negative", 1.0)}),
    "OverLife": (made(jeuler.OverLife, lambda o: effect_with_age(o)), {"field": ("name", "opacity"), "values": ("parameter", [1.0, 0.0]), "duration": ("positive", 1.0)}),
    "PrescribedMotion": (made(jeuler.PrescribedMotion, effect), {"particles": ("bodies", [0]), "path": ("function", lambda t: jnp.zeros((1, 2)))}),
    "SampledPath": (made(jeuler.SampledPath, lambda p: effect(jeuler.PrescribedMotion([0], p))), {"times": ("times", [0.0, 1.0, 2.0]), "positions": ("points of a shape", np.zeros((3, 1, 2)))}),
    "Uniform": (made(jeuler.Uniform, born), {"low": ("vector", [0.0, 0.0]), "high": ("vector", [1.0, 1.0])}),
    "Normal": (made(jeuler.Normal, born), {"mean": ("vector", [0.0, 0.0]), "deviation": ("not negative", 1.0)}),
    "Cone": (made(jeuler.Cone, born), {"direction": ("vector", [0.0, 1.0]), "speed": ("not negative", 1.0), "angle": ("not negative", 0.1)}),
    "FromDisc": (made(jeuler.FromDisc, born), {"center": ("vector", [0.0, 0.0]), "radius": ("not negative", 1.0)}),
    "FromSphere": (made(jeuler.FromSphere, born), {"center": ("vector", [0.0, 0.0]), "radius": ("not negative", 1.0)}),
    "FromLine": (made(jeuler.FromLine, born), {"start": ("vector", [0.0, 0.0]), "end": ("vector", [1.0, 0.0])}),
}  # fmt: skip
ELSEWHERE = {  # arguments as other libraries call them
    "simulate": ("t1", "steps", "method", "solver", "n_steps", "callback", "seed"),
    "solve": ("t1", "h", "method", "saveat", "t_span", "n", "rng"),
    "solve_adaptive": ("dt", "num_steps", "tol", "method", "t_eval"),
    "Springs": ("k", "stiffness", "damping", "length", "l0", "rest"),
    "Gravity": ("g", "gravity"),
    "ParticleState": ("pos", "x", "v", "vel", "masses"),
    "fit": ("x0", "method", "tol", "maxiter"),
    "fit_springs": ("t", "x", "data", "method", "params"),
}


def effect_with_age(part):
    return run(jeuler.Scene((), (jeuler.Lifetime(1.0), part)))


def expected_none(name, argument, label):
    """Whether this value is right after all: an argument that may be left out may be None, and the like."""
    optional = {
        ("simulate", "save"), ("simulate", "key"), ("solve", "save"), ("implicit_euler", "rtol"), ("Emitter", "max_births"), ("Collisions", "max_bounces"),
        ("Lifetime", "duration"), ("Lifetime in frames", "frames"), ("OverLife", "duration"), ("identifiability", "dt"), ("stability_limit", "y"), ("fit_springs in detail", "num_steps"), ("fit in detail", "loss_scale"),
    }  # fmt: skip
    fine = {
        ("Scene", "forces", "a dict"), ("Sphere", "inside", "a number"), ("PointAttractor", "strength", "an array"),
        ("PenaltyContact", "collider", "no arguments"),  ("SpeedLimit", "limit", "infinite"), ("OverLife", "values", "one too many"),
        ("Normal", "deviation", "a list"), ("strand_edges", "strands", "out of range"), ("strand_edges", "strands", "one twice"), ("FromSurface", "faces", "one twice"),  ("Normal", "deviation", "an array"),
    }  # fmt: skip
    return (label == "None" and (name, argument) in optional) or (name, argument, label) in fine


def wrong_values():
    for name, (function, arguments) in RIGHT.items():
        for argument, (kind, _) in arguments.items():
            for label, value in KINDS[kind].items():
                if not expected_none(name, argument, label):
                    how = {key: right for key, (_, right) in arguments.items()} | {argument: value}
                    yield f"{name}: {argument} is {label}", lambda f=function, how=how: f(**how)


def wrong_calls(rng):
    for name, (function, arguments) in RIGHT.items():
        how = {key: right for key, (_, right) in arguments.items()}
        for key in how:
            for slip, other in misspelt(key, rng).items():
                changed = {other if k == key else k: v for k, v in how.items()}
                if len(changed) == len(how) and other not in how:
                    yield f"{name}: {key} {slip}, {other}", lambda f=function, changed=changed: f(**changed)
        for key in ELSEWHERE.get(name, ()):
            yield f"{name}: takes no {key}", lambda f=function, how=how, key=key: f(**how, **{key: 1.0})
    first = {"f": decay, "y0": 1.0, "dt": 0.1, "num_steps": 2}
    for key in first:
        rest = {k: v for k, v in first.items() if k != key}
        yield f"solve: without {key}", lambda rest=rest: jeuler.solve(**rest)
    yield "solve: dt by place", lambda: jeuler.solve(decay, 1.0, 0.1, 2)
    yield "solve: y0 twice", lambda: jeuler.solve(decay, 1.0, y0=1.0, dt=0.1, num_steps=2)
    yield "solve: f and y0 swapped", lambda: jeuler.solve(1.0, decay, dt=0.1, num_steps=2)
    yield "simulate: swapped", lambda: jeuler.simulate(PAIR, NET, dt=0.1, num_steps=1)
    yield "simulate: dt by place", lambda: jeuler.simulate(NET, PAIR, 0.1, 2)
    yield "fit_springs: swapped", lambda: jeuler.fit_springs(NET, PAIR, SWING, TIMES, dt=0.1)
    yield "fit_springs: dt above the span", lambda: jeuler.fit_springs(NET, PAIR, TIMES, SWING, dt=2.0)
    yield "advise_step: t1 before t0", lambda: jeuler.advise_step(decay, 1.0, t1=1.0, t0=2.0, error=0.1)
    yield (
        "simulate: steps that do not divide",
        lambda: simulated(scene=NET, state=PAIR, dt=0.1, num_steps=5, save_every=2),
    )
    yield "Uniform: swapped", lambda: jeuler.Uniform(2.0, 1.0)
    yield "DeathOutside: swapped", lambda: jeuler.DeathOutside([1.0, 1.0], [-1.0, -1.0])


def misspelt(word, rng):
    """A letter left out, twice, or two swapped."""
    if len(word) < 3:
        return {"in capitals": word.upper()} if word != word.upper() else {}
    k = rng.randrange(1, len(word) - 1)
    return {
        "without a letter": word[:k] + word[k + 1 :],
        "with a letter twice": word[:k] + word[k] + word[k:],
        "with two letters swapped": word[: k - 1] + word[k] + word[k - 1] + word[k + 1 :],
    }


def calls(count, seed=20240229):
    """So many wrong calls, by name: two in three a wrong value, the others wrong as a call."""
    rng = random.Random(seed)
    values, whole = list(wrong_values()), [c for c in wrong_calls(rng) if c is not None]
    few = min(len(whole), count // 3)
    return dict(rng.sample(values, count - few) + rng.sample(whole, few))


def tried(call):
    """What came of a wrong call: "told", or "warned", "raw: ..." or "silent: ..."."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            got = call()
        except Exception as error:  # whatever it is, it is sorted here
            return verdict(error)
    own = [w for w in caught if issubclass(w.category, UserWarning) and "jax" not in str(w.message).lower()]
    return "warned" if own else f"silent: {type(got).__name__}"


def verdict(error):
    """Told is one line of the library's own, in an error that a person may catch as a wrong value or a missing file."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    last, missing = frame.filename, isinstance(error, OSError)
    own = missing or (last.startswith(SOURCE) and frame.line.lstrip().startswith("raise "))
    one_line = "\n" not in str(error).split("\n--------------------\n")[0]
    if own and one_line and isinstance(error, (ValueError, OSError)):
        return "told"
    return f"raw: {type(error).__name__}: {' '.join(str(error).split())[:160]} ({Path(last).name})"


# The command line

WORDS = ("abc", "", "nan", "inf", "1e400", "0.5 kg", "None", "1;2", "٣٤x", "--", "1..2", "{}")
OPTIONS = {
    "--mass": (*WORDS, "0", "-1", "1,2,3", "1,,2", "1e-300"),
    "--dt": (*WORDS, "0", "-0.1", "1000", "1e-300", "0,01,2"),
    "--edges": ("1-2", "foo", "0-anchor", "1-1", "1-anchor,1-anchor", "1-anchor,", "1", "anchor", "1-", "-1-2", "1.5-anchor", "1–anchor–2", ""),
    "--start": ("ks=0", "k=3", "ks=nan", "ks", "ks=1,ks=2", "ks=-1", "=3", "ks=abc", "ks=3;kd=1", ""),
    "--columns": ("y", "t", "", "x,x", "x,y", "X ,", "1"),
    "--dim": ("0", "-1", "4", "2", "a", "1.5", ""),
    "--time": ("x", "seconds", ""),
    "--run": ("0", "7", "x", "-1", "1.5", ""),
    "--unit": ("x", "x=parsec", "y=mm", "x=mm,x=m", "=mm", "x=", "t=m", "x=s", ""),
    "--skip": ("-1", "1000", "a", "1.5", ""),
    "--from": ("100", "nan", "abc", "", "5.99"),
    "--to": ("-1", "nan", "abc", "", "0.01"),
    "--friction": ("slick", "viscous+slick", "", "dry+dry", "viscous,dry", "0.3"),
    "--observe": ("colour", "", "Position ", "speed"),
    "--drag": ("linear", "", "0.1"),
    "--plot": ("pic", "a.exe", "nodir/a.png", "", "folder", "x.txt"),
    "--json": ("nodir/a.json", "", "folder"),
    "--report": ("nodir/a.html", "", "folder"),
    "--max-iterations": ("0", "-1", "a", "1.5", "", "nan"),
    "--input": ("force", "x", ""),
}  # fmt: skip
NAMES = ("--mas", "--edge", "--colums", "--masss", "-m", "--step", "--output", "--ks", "--tmie", "--help-me")


def write_files(folder):
    """The recordings that the wrong commands are about; returns the wrong ones by name."""
    t = np.linspace(0, 6, 61)
    x = 0.02 + 0.1 * np.exp(-0.3 * t) * np.cos(4 * t)
    lines = [f"{a:.6f},{b:.6f}" for a, b in zip(t, x, strict=True)]
    text = "t,x\n" + "\n".join(lines) + "\n"
    (folder / "good.csv").write_text(text)
    (folder / "folder").mkdir()
    wrong = {
        "empty.csv": "", "header.csv": "t,x\n", "three.csv": "\n".join(["t,x", *lines[:3]]), "words.csv": "t,x\n" + "a,b\n" * 20,
        "still.csv": "t,x\n" + "".join(f"{a},0.3\n" for a in t), "back.csv": "\n".join(["t,x", *lines[::-1]]), "infinite.csv": text.replace(lines[4].split(",")[1], "inf"),
        "same_time.csv": "t,x\n" + "".join(f"0,{b}\n" for b in x), "nan.csv": "t,x\n" + "".join(f"{a},nan\n" for a in t), "one_column.csv": "x\n" + "".join(f"{b}\n" for b in x),
        "page.csv": "<html><body>Not found</body></html>", "binary.csv": "\0\1\2\3" * 400,
    }  # fmt: skip
    for name, content in wrong.items():
        (folder / name).write_text(content)
    return [*wrong, "missing.csv", "folder"]


def commands(count, folder, seed=20240229):
    """So many wrong command lines, each by its text."""
    rng = random.Random(seed)
    lines = [["fit", name] for name in write_files(folder)] + [
        ["look", name] for name in ("missing.csv", "empty.csv", "folder", "words.csv")
    ]
    lines += [["fit", "good.csv", f"{option}={value}"] for option, values in OPTIONS.items() for value in values]
    lines += [["fit", "good.csv", name, "1"] for name in NAMES]
    lines += [["fit", "good.csv", option] for option in OPTIONS]  # without its value
    lines += [
        ["fit", "good.csv", f"{option}={values[0]}", f"{option}={values[1]}"] for option, values in OPTIONS.items()
    ]
    lines += [["fit", "good.csv", "good.csv"], ["fits", "good.csv"], ["good.csv"], [], ["look"], ["fit", "good.csv", "--plot", "good.csv"], ["fit", "good.csv", "--json", "good.csv"], ["fit", "good.csv", "--report", "good.csv"], ["fit", "good.csv", "--report", "-", "--json", "-"]]  # fmt: skip
    lines += [["fit", "good.csv", "--mass", "0.5", "--mass", "0.7"], ["fit", "good.csv", "--dt=0.01", "--dt=0.02"]]
    return {" ".join(map(repr, line)): line for line in rng.sample(lines, min(count, len(lines)))}


def commanded(line, folder):
    """What came of a wrong command in this folder: "told" is one line and exit code 2."""
    out, err = io.StringIO(), io.StringIO()
    before = os.getcwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(line)
    except SystemExit as end:
        code = end.code
    except Exception as error:  # whatever it is, it is sorted here
        return f"raw: {type(error).__name__}: {str(error)[:160]}"
    finally:
        os.chdir(before)
    said = err.getvalue().strip()
    if code == 0:
        return f"silent: {' '.join(out.getvalue().split())[:160]}"
    return "told" if code == 2 and said.count("\n") == 0 and said else f"raw: exit {code}, {said[:200]!r}"
