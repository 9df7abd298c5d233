"""Windows: a large pool at the price of what is alive, to the last bit the same run."""

import jax
import numpy as np
import pytest

from jeuler import Cone, Emitter, FromDisc, Gravity, Lifetime, LinearDrag, OverLife, Scene, Springs, Uniform, simulate
from jeuler.particles.state import empty_pool
from jeuler.particles.windows import ladder

JET = Emitter(
    200.0, FromDisc([0.0, 0.0], 0.1), Cone([0.0, 1.0], Uniform(4.0, 6.0), 0.2), lifetime=Uniform(0.1, 0.4),
    bursts=((0.3, 2),),
    max_births=4,
)  # fmt: skip
SCENE = Scene(
    (Gravity([0.0, -9.81]), LinearDrag(0.3, air=[1.0, 0.0])), (JET, Lifetime(), OverLife("opacity", [1.0, 0.0]))
)


@pytest.mark.optimised
def test_a_run_in_windows_is_the_same_run():
    def run(windows):
        return simulate(
            SCENE, empty_pool(200, 2), dt=0.01, num_steps=80, save_every=5, key=jax.random.key(0), windows=windows,
            compensated=True,
        )  # fmt: skip

    whole, parts = jax.jit(run, static_argnums=0)(()), jax.jit(run, static_argnums=0)((24, 48, 100))
    assert int(whole.y.alive[-1].sum()) > 30, "it has outgrown the smallest window"
    assert int(whole.y.missed_births[-1]) == 0
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        assert np.allclose(a, b, rtol=1e-13, atol=1e-15)
    assert np.array_equal(whole.y.alive, parts.y.alive)


def test_the_gradient_flows_through_windows():
    def height(scene, windows):
        end = simulate(
            scene, empty_pool(60, 2), dt=0.01, num_steps=10, save_every=5, key=jax.random.key(0), windows=windows
        )
        return end.y.position[-1, :, 1].sum()

    whole, parts = (jax.jit(jax.grad(height), static_argnums=1)(SCENE, windows) for windows in ((), (40,)))
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
        assert np.allclose(a, b, rtol=1e-10, atol=1e-14)


def test_sizes_are_chosen_for_a_pool_of_any_capacity(monkeypatch):
    assert np.allclose(ladder(200_000)[-3:], (70_710, 100_000, 141_421), atol=1)
    assert ladder(200_000)[0] < 5000
    assert ladder(1000) == (), "a small pool is one window"
    monkeypatch.setattr("jeuler.particles.windows.SMALLEST", 20)

    def end(windows):
        return simulate(
            SCENE, empty_pool(200, 2), dt=0.01, num_steps=20, save_every=5, key=jax.random.key(0), windows=windows
        ).y  # fmt: skip

    whole, chosen = end(()), end("auto")
    assert np.allclose(whole.position, chosen.position, rtol=1e-13, atol=1e-15)
    assert np.array_equal(whole.alive, chosen.alive)
    program = str(jax.make_jaxpr(lambda: end("auto"))())
    assert "cond" in program, "the run is in windows"


def test_what_cannot_run_in_windows_is_refused():
    def run(scene, windows=(4,), pool=None):
        simulate(scene, pool or empty_pool(9, 2), dt=0.1, num_steps=1, key=jax.random.key(0), windows=windows)

    with pytest.raises(ValueError, match=r"increasing order, got \(8, 4\)"):
        run(SCENE, (8, 4))
    with pytest.raises(ValueError, match=r'windows must be "auto" or sizes'):
        run(SCENE, "small")
    unbounded = Emitter(1.0, [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match=r"Emitter.max_births = None; pass max_births"):
        run(Scene(effects=(unbounded,)))
    with pytest.raises(ValueError, match=r"windows need forces and effects that take any number .* Springs does not"):
        run(Scene((Springs([[0, 8]], 1.0, 0.0, 1.0),), SCENE.effects))
    with pytest.raises(ValueError, match="every particle is always alive"):
        run(Scene(), pool=empty_pool(9, 2).replace(alive=None))
