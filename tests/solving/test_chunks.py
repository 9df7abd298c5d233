"""Long runs in pieces: the numbers of one piece to rounding, Ctrl-C heard within a second, and progress told."""

import os
import pathlib
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jeuler
from jeuler.solving import chunks

pytestmark = pytest.mark.optimised  # it is about rounding

KEY = jax.random.key(3)
PAIR = jeuler.ParticleState([[0.0, 0.0], [1.2, 0.0]], np.zeros((2, 2)), mass=[np.inf, 0.5])
SPRING = jeuler.Springs([[0, 1]], ks=100.0, kd=0.1, rest_length=1.0)
JET = jeuler.Emitter(60.0, [0.0, 0.0], jeuler.Normal(0.0, jnp.ones(2)), max_births=2, bursts=((0.5, 3),))
POOL = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (JET, jeuler.Lifetime(0.4)))


def turning(t, y, args):
    return y[1], -y[0] * jnp.cos(t)


def end_in_nan(t, y, args):
    return jnp.where(t > 0.777, jnp.nan, -y)


def oscillator(**how):
    return jeuler.solve(turning, (1.0, 0.0), dt=0.01, num_steps=600, **how)


RUNS = {
    "every step": lambda **how: oscillator(step=jeuler.symplectic_euler_step, **how),
    "one in ten": lambda **how: oscillator(step=jeuler.rk4_step, save_every=10, **how),
    "the last alone": lambda **how: oscillator(save_every=600, compensated=True, **how),
    "checkpoints": lambda **how: oscillator(save_every=20, checkpoint="sqrt", **how),
    "breaks": lambda **how: oscillator(save_every=200, breaks=[1.0, 2.345], **how),
    "what is kept": lambda **how: oscillator(save_every=6, save=lambda t, y: (t > 1, y[0]), **how),
    "not finite": lambda **how: jeuler.solve(end_in_nan, 1.0, dt=0.01, num_steps=100, save_every=50, **how),
    "no step": lambda **how: jeuler.solve(end_in_nan, 1.0, dt=0.01, num_steps=0, **how),
    "implicit": lambda **how: jeuler.solve(
        lambda t, y, args: -10 * y, 1.0, dt=0.01, num_steps=60, save_every=3, step=jeuler.implicit_euler_step, **how
    ),
    "springs": lambda **how: jeuler.simulate(jeuler.Scene((SPRING,)), PAIR, dt=0.01, num_steps=60, **how),
    "births": lambda **how: jeuler.simulate(
        POOL, jeuler.empty_pool(64, 2), dt=0.01, num_steps=120, save_every=4, key=KEY, windows=(32,), **how
    ),
}


def assert_same_to_rounding(got, expected, steps=600):
    """Times and what is counted are the same; a number is off by at most a unit in the last place for each step.

    The loops of a run in pieces and of one in one piece are two programs. Where a processor multiplies and adds at
    once, XLA rounds their products differently.
    """
    for a, b in zip(*map(jax.tree.leaves, (got, expected)), strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        if jnp.issubdtype(a.dtype, jnp.inexact):
            largest = float(np.max(np.abs(b), initial=1.0, where=np.isfinite(b)))
            np.testing.assert_allclose(a, b, rtol=0, atol=steps * largest * np.finfo(a.dtype).eps)
        else:
            np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(got.t, expected.t)


@pytest.mark.parametrize("name", RUNS)
def test_a_run_in_pieces_is_the_same_to_rounding(name, monkeypatch):
    told = []
    monkeypatch.setattr(chunks, "FIRST", 32 * 7)  # pieces of seven steps at first, which divide nothing
    got = RUNS[name](progress=lambda step, of: told.append((step, of)))
    assert_same_to_rounding(got, RUNS[name]())
    steps = [step for step, _ in told]
    assert steps == sorted(set(steps))
    assert told[-1] == (told[-1][1],) * 2
    assert len(told) > 1 or name == "no step"


def test_long_runs_go_in_pieces_by_themselves(monkeypatch):
    expected = RUNS["one in ten"]()
    monkeypatch.setattr(chunks, "LONG", 600 * 32)
    pieces = []
    monkeypatch.setattr(chunks.Sizes, "measured", lambda self, steps, seconds: pieces.append(steps))
    monkeypatch.setattr(chunks, "FIRST", 32 * 100)
    got = RUNS["one in ten"]()
    assert_same_to_rounding(got, expected)
    assert len(pieces) in (0, 5), "six pieces, the last not waited for; or one, if the program is known"


def test_more_steps_than_are_counted_have_several_clocks(monkeypatch):
    """As without 64-bit integers above 2^31 steps, here above 100: each 64 steps count from 0."""
    with jax.enable_x64(False):
        expected = [RUNS[name]() for name in ("every step", "not finite")]
        monkeypatch.setattr(chunks, "COUNTER", 99)
        monkeypatch.setattr(chunks, "EPOCH", 64)
        got = [RUNS[name](progress=lambda step, of: None) for name in ("every step", "not finite")]
    for a, b in zip(got, expected, strict=True):
        np.testing.assert_allclose(a.t, b.t, rtol=3e-7)
        assert int(a.first_nonfinite) == int(b.first_nonfinite)
    np.testing.assert_allclose(got[0].y[0], expected[0].y[0], atol=1e-5)


def test_what_progress_raises_ends_the_run():
    def stop(step, of):
        if step > 50:
            raise StopIteration(step)

    with pytest.raises(StopIteration):
        oscillator(progress=stop)


def test_a_bar(capsys):
    oscillator(progress=True)
    assert "600/600" in capsys.readouterr().err
    oscillator(progress=False)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: oscillator(progress="yes"), r"progress must be a function \(step, num_steps\), got 'yes'; progress=True"),
        (lambda: oscillator(progress=lambda step: None), "progress must be a function"),
        (lambda: jax.jit(lambda: oscillator(progress=True).t)(), "progress needs a run outside of jit"),
        (lambda: jax.grad(lambda k: oscillator(args=k, progress=True).y[0][-1])(1.0), "leave progress out there"),
        (lambda: oscillator(progress=True, checkpoint="reversible"), 'must be None with checkpoint="reversible"'),
    ],
)  # fmt: skip
def test_progress_that_cannot_be_told_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


SCRIPT = """
import jax, jeuler, signal, sys, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs begin without it
scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks=1.0, kd=0.0, rest_length=1.0),))
state = jeuler.ParticleState([[0.0, 0.0], [1.5, 0.0]], [[0.0, 0.0], [0.0, 0.0]])
how = {"dt": 1e-3, "num_steps": 2**31 + 2**24, "save_every": 2**24}
how["progress"] = {"bar": True, "callback": lambda step, num_steps: None, "none": None}[sys.argv[2]]
print("begun", flush=True)
try:
    if sys.argv[1] == "solve":
        jax.block_until_ready(jeuler.solve(lambda t, y, a: -1e-9 * y, 1.0, **how))
    else:
        jax.block_until_ready(jeuler.simulate(scene, state, **how))
except KeyboardInterrupt:
    print("stopped", time.monotonic(), flush=True)
"""


@pytest.mark.parametrize(("what", "progress"), [("solve", "none"), ("solve", "callback"), ("simulate", "bar")])
def test_ctrl_c_stops_a_long_run_within_a_second(what, progress):
    source = pathlib.Path(jeuler.__file__).parents[1]
    environment = os.environ | {"PYTHONPATH": str(source)}
    command = [sys.executable, "-c", SCRIPT, what, progress]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen(command, env=environment, **pipes) as run:
        try:
            assert run.stdout.readline() == "begun\n"
            time.sleep(2.0)
            sent = time.monotonic()
            run.send_signal(signal.SIGINT)
            out, _ = run.communicate(timeout=60)
        finally:
            run.kill()
    word, when = out.split()
    assert word == "stopped"
    assert float(when) - sent < 1.0
