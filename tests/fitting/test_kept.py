"""A fit that is killed goes on to the same result, bit by bit; one that is interrupted returns the best so far."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jeuler
from jeuler.fitting import problem as problems
from jeuler.fitting.kept import Record

T = np.linspace(0, 2, 24)
Y = 2 * np.exp(-1.3 * T) + 0.02 * np.random.default_rng(0).normal(size=24)
START = {"a": 1.0, "k": 0.2}
FIRST = np.where(T < 1, 1.0, 0.0)
SWING = 1 + 0.3 * np.cos(3 * np.linspace(0, 4, 41))


def decay(p, y):
    return p["a"] * jnp.exp(-p["k"] * T) - y


def by_rows(p, rows):
    return p["a"] * jnp.exp(-p["k"] * rows[:, 0]) - rows[:, 1]


def in_windows(**options):
    state = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, 1.0])
    seen = np.stack([np.full(41, np.nan), SWING], 1)[:, :, None]
    scene = jeuler.Scene((jeuler.Springs([[0, 1]], 5.0, 0.5, 1.0),))
    options |= {"optimizer": optax.adam(0.1), "minibatch": 2, "start": "given", "max_iterations": 12}
    return jeuler.fit_springs(
        scene, state, np.linspace(0, 4, 41), seen, dt=0.1, step=jeuler.symplectic_euler_step, step_bias=False, **options
    )


def one(residual=decay, data=Y, **fixed):
    return lambda **options: jeuler.fit(residual, START, data=data, progress=False, **fixed, **options)


ROWS = np.stack([T, Y], axis=1)
BY_ROWS = {"residual": by_rows, "data": ROWS, "minibatch": 5, "max_iterations": 17}
FITS = {
    "stages": one(stages=[FIRST], tolerance=1e-12),
    "a robust loss": one(loss="soft_l1"),
    "starts": one(starts=4, positive=True),
    "without a Jacobian": one(stages=[FIRST]),
    "starts without a Jacobian": one(starts=3, positive=True),
    "adam": one(optimizer=optax.adam(0.1), max_iterations=12, stages=[FIRST]),
    "minibatches": one(optimizer=optax.adam(0.1), **BY_ROWS),
    "windows of springs": in_windows,
}


class Killed(BaseException):
    """As a process ends: nothing is caught, nothing is cleaned up."""


@pytest.fixture
def stopped(monkeypatch):
    """A fit stopped after it has written its state so many times."""

    def run(fit, path, writes, by):
        save, written = Record.save, []

        def save_and_stop(self, *arguments):
            self.pause = 0.0
            save(self, *arguments)
            written.append(1)
            if len(written) == writes:
                raise by

        with monkeypatch.context() as patch:
            patch.setattr(Record, "save", save_and_stop)
            return fit(resume=path)

    return run


def same(found, whole):
    """Whether two fits are equal in every number."""
    leaves, structure = jax.tree.flatten(found)
    others, other = jax.tree.flatten(whole)
    return structure == other and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(leaves, others, strict=True))


@pytest.mark.optimised
@pytest.mark.parametrize("name", FITS)
def test_killed_or_interrupted_it_goes_on_to_the_same_bits(name, tmp_path, stopped, monkeypatch):
    if "without" in name:
        monkeypatch.setattr(problems, "MOST_COLUMNS", 0)
    fit, path = FITS[name], tmp_path / "state"
    whole = fit()
    for writes in (1,) if "minibatch" in name or "windows" in name else (1, 1, 2):  # again and again, some steps on
        with pytest.raises(Killed):
            stopped(fit, path, writes, Killed)
    begun = stopped(fit, path, 1, KeyboardInterrupt)
    assert begun.message.startswith("interrupted: the best so far")
    assert not begun.converged
    assert np.isfinite(begun.loss)
    history = begun.history if len(begun.history) else begun.starts["loss"]
    assert np.isclose(begun.loss, [history[-1], np.min(history)]).any()
    assert same(fit(resume=path), whole)
    assert [file.name for file in tmp_path.iterdir()] == ["state"]


def test_a_file_of_another_fit_is_refused(tmp_path, stopped):
    path = tmp_path / "state"
    with pytest.raises(Killed):
        stopped(FITS["starts"], path, 1, Killed)
    others = [one(starts=5, positive=True), one(positive=True), one(data=Y + 1, starts=4), FITS["adam"]]
    for other in others:
        with pytest.raises(ValueError, match="holds another fit"):
            other(resume=path)
    descended = tmp_path / "descended"
    with pytest.raises(Killed):
        stopped(FITS["adam"], descended, 1, Killed)
    adam = {"optimizer": optax.adam(0.1), "max_iterations": 12, "stages": [FIRST]}
    for other in (
        adam | {"optimizer": optax.sgd(0.1)},
        adam | {"optimizer": optax.adam(0.2)},
        adam | {"optimizer": optax.adam(optax.piecewise_constant_schedule(0.1, {10: 0.5}))},
        adam | {"scale": {"a": 2.0, "k": 1.0}},
        adam | {"residual": lambda p, y: 2 * decay(p, y)},
    ):
        with pytest.raises(ValueError, match="holds another fit"):
            one(**other)(resume=descended)
    for words in ("no file of ours", ""):
        path.write_text(words)
        if words:
            with pytest.raises(ValueError, match="is not the state of a fit"):
                one()(resume=path)
    assert one()(resume=path).converged  # an empty file, as mkstemp makes, is a fresh start
