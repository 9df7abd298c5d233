"""Runs kept on disk go on with the numbers of a run in one go, whatever stopped them, and say what is wrong."""

import json
import pathlib
import resource
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jeuler

pytestmark = pytest.mark.optimised  # it is about bits

JET = jeuler.Emitter(60.0, [0.0, 0.0], jeuler.Normal(0.0, jnp.ones(2)), max_births=2, bursts=((0.5, 3),))
SPARKS = jeuler.SubEmitter(2, jeuler.Normal(0.0, jnp.ones(2)), max_births=4)
POOL = jeuler.Scene((jeuler.Gravity([0.0, -9.8]),), (jeuler.Lifetime(0.4), SPARKS, JET, jeuler.Trail(3, every=2)))


def fountain(num_steps, **how):
    key = jax.random.key(3)
    return jeuler.simulate(POOL, jeuler.empty_pool(64, 2), dt=0.01, num_steps=num_steps, save_every=10, key=key, **how)


def circle(num_steps, dt=0.01, step=jeuler.euler_step, **how):
    return jeuler.solve(
        lambda t, y, a: (y[1], -a * y[0]), (1.0, 0.0), args=2.0, dt=dt, num_steps=num_steps, step=step, **how
    )


def assert_same(a, b):
    for x, y in zip(jax.tree.leaves((a.t, a.y)), jax.tree.leaves((b.t, b.y)), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))
    assert int(a.first_nonfinite) == int(b.first_nonfinite)


def test_a_run_with_births_goes_on_for_more_steps_and_after_an_interrupt(tmp_path):
    whole = fountain(600, resume=tmp_path / "whole")
    fountain(200, resume=tmp_path / "a", checkpoint_every=70)

    def interrupt(step, num_steps):
        if step > 400:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fountain(600, resume=tmp_path / "a", checkpoint_every=70, progress=interrupt)
    assert_same(fountain(600, resume=tmp_path / "a"), whole)
    again = fountain(600, resume=tmp_path / "a")  # a finished run does nothing
    assert again.y.position[-1].shape == (64, 2)
    np.testing.assert_array_equal(jnp.asarray(again.y.position), jnp.asarray(whole.y.position))


def test_a_process_killed_at_any_moment_leaves_a_run_that_goes_on(tmp_path):
    script = pathlib.Path(tmp_path, "run.py")
    script.write_text(
        "import jax, jeuler\njax.config.update('jax_enable_x64', True)\n"
        "def field(t, y, args): return -y\n"
        f"jeuler.solve(field, 1.0, dt=1e-6, num_steps=10**9, save_every=1000, resume={str(tmp_path / 'b')!r}, checkpoint_every=10**4)\n"
    )
    child = subprocess.Popen([sys.executable, script])
    for _ in range(600):
        time.sleep(0.05)
        if (tmp_path / "b" / "state.npz").exists():
            break
    child.kill()
    child.wait()
    with np.load(tmp_path / "b" / "state.npz") as file:
        done = json.loads(str(file["about"]))["steps"]
    assert done >= 10**4
    steps = (done // 1000 + 2) * 1000

    def run(**how):
        def field(t, y, args):
            return -y

        return jeuler.solve(field, 1.0, dt=1e-6, num_steps=steps, save_every=1000, **how)

    assert_same(run(resume=tmp_path / "b"), run(resume=tmp_path / "whole"))


def test_three_thousand_million_steps_are_counted(tmp_path):
    circle(20, save_every=10, resume=tmp_path / "run")
    state = tmp_path / "run" / "state.npz"
    with np.load(state) as file:
        about, leaves = json.loads(str(file["about"])), {name: file[name] for name in file.files if name != "about"}
    about |= {"steps": about["steps"] + 3_000_000_000, "base": 3_000_000_000}
    np.savez(state, about=json.dumps(about), **leaves)
    run = circle(3_000_000_040, save_every=10, resume=tmp_path / "run")
    np.testing.assert_allclose(run.t[-2:], [30_000_000.3, 30_000_000.4], rtol=1e-14)
    expected = circle(40, save_every=10, resume=tmp_path / "few")
    np.testing.assert_array_equal(np.asarray(run.y[0]), np.asarray(expected.y[0]))


@pytest.mark.parametrize("before", [2**31 - 2, 3_000_000_000])
def test_a_scene_with_births_counts_three_thousand_million_steps(before):
    pool = jeuler.empty_pool(64, 2).replace(steps=jnp.uint32(before), births=jnp.int32(2**31 - 2))
    pool = pool.replace(missed_births=jnp.int32(0))
    how = {"dt": 0.01, "key": jax.random.key(3)}
    run = jeuler.simulate(POOL, pool, num_steps=4, **how)
    assert run.y.steps.tolist() == [before + n for n in range(5)]
    alive = run.y.alive.sum(axis=1).tolist()
    born = [(n * int(0.6 * 2**32) + 2**22) >> 32 for n in range(before, before + 5)]  # 0.6 a step
    expected = [count - born[0] for count in born]
    assert alive == expected
    assert run.y.births.tolist() == [min(2**31 - 2 + n, 2**31 - 1) for n in expected]
    parts = jeuler.simulate(POOL, jax.tree.map(lambda x: x[2], run.y), num_steps=2, t0=run.t[2], **how)
    np.testing.assert_array_equal(parts.y.position[1:], run.y.position[3:])


def test_a_scene_refuses_more_steps_than_have_random_numbers_of_their_own(tmp_path):
    with pytest.raises(ValueError, match="at most 4,294,967,295"):
        fountain(5_000_000_000, resume=tmp_path / "run")


def test_other_runs_and_broken_folders_are_told(tmp_path):
    circle(20, resume=tmp_path / "run")
    for other in ({"dt": 0.02}, {"step": jeuler.rk4_step}, {"save_every": 2}):
        with pytest.raises(ValueError, match="holds another run"):
            circle(20, resume=tmp_path / "run", **other)
    with pytest.raises(ValueError, match="num_steps must be at least 20"):
        circle(10, resume=tmp_path / "run")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "letter.txt").write_text("mine")
    with pytest.raises(ValueError, match="something else"):
        circle(20, resume=tmp_path / "foreign")
    with pytest.raises(ValueError, match="is a file"):
        circle(20, resume=tmp_path / "foreign" / "letter.txt")
    state = tmp_path / "run" / "state.npz"
    state.write_bytes(state.read_bytes()[:100])
    with pytest.raises(ValueError, match="cannot be read"):
        circle(20, resume=tmp_path / "run")
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda y: circle(20, resume=tmp_path / "run"))(1.0)
    with pytest.raises(ValueError, match="needs resume"):
        circle(20, checkpoint_every=5)


def test_a_full_disk_is_told_and_the_last_state_stays(tmp_path):
    circle(1_000, resume=tmp_path / "run")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, limits[1]))
    try:
        with pytest.raises(OSError, match="state after 1,000 steps is kept"):
            circle(50_000, resume=tmp_path / "run")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert_same(circle(2_000, resume=tmp_path / "run"), circle(2_000, resume=tmp_path / "whole"))


def test_frames_can_be_read_by_others(tmp_path):
    run = circle(20, resume=tmp_path / "run", save=lambda t, y: {"position": y[0], "both": jnp.stack(y)})
    frames = xarray.open_zarr(tmp_path / "run" / "frames.zarr", consolidated=False)
    np.testing.assert_array_equal(frames.position, np.asarray(run.y["position"]))
    assert frames.both.dims[0] == "frame"
    assert frames.both.shape == (21, 2)
