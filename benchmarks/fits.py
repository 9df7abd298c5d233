"""Fits of springs: nets of many springs, a chain beside mujoco.sysid, coverage of errors, starts that are wrong.

    python benchmarks/fits.py net [particles]      about 6 springs a particle, a decade of ks and kd, 0.1 % noise
    python benchmarks/fits.py cloth [side]         the cloth of 70 by 70 particles, 28,565 springs
    python benchmarks/fits.py chain [N ...]        time from data to answer of a chain of N masses, N + 1 springs
    python benchmarks/fits.py coverage             how often nominal 95 % intervals hold the truth, 500 records each
    python benchmarks/fits.py starts [cases]       one oscillator, starts wrong by up to 100, and aliased tenfold
    python benchmarks/fits.py net_starts [cases] [first]   a net of 5 by 5, the same, from case ``first`` on
    python benchmarks/fits.py kills [kills] [kind] fits killed at random moments, taken up again: the same bits or not;
                                                   of all five kinds, or only the one of this number
    python benchmarks/fits.py profiles [side]      profile intervals of single springs of a cloth

Data are made by diffrax's Tsit5 at 1e-9, or exactly; the fit runs RK4. mujoco.sysid is left out where it is not there.
"""

import collections
import hashlib
import os
import subprocess
import sys
import tempfile
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.signal import lfilter
from scipy.spatial import Delaunay

import jeuler

jax.config.update("jax_enable_x64", True)


def made(scene, x, v, mass, times):
    """Positions by an accurate solver of another kind."""
    controller = diffrax.PIDController(rtol=1e-9, atol=1e-9)
    return np.asarray(
        diffrax.diffeqsolve(
            diffrax.ODETerm(scene.vector_field),
            diffrax.Tsit5(),
            0.0,
            times[-1],
            1e-3,
            (jnp.asarray(x), jnp.asarray(v)),
            args=jnp.asarray(mass),
            saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
            stepsize_controller=controller,
            max_steps=1_000_000,
        ).ys[0]
    )


def net(particles=170, seed=0):
    """A thrown 3-D Delaunay net without its longest tenth of springs; 51 samples in 1 s."""
    random = np.random.default_rng(seed)
    x = random.uniform(0, 0.6 * particles ** (1 / 3), size=(particles, 3))
    pairs = {tuple(sorted((int(a), int(b)))) for s in Delaunay(x).simplices for a in s for b in s if a != b}
    edges = np.array(sorted(pairs))
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    edges = edges[length < np.quantile(length, 0.9)]
    recovered(x, edges, np.ones(particles), random)


def cloth(side=70, seed=0):
    """A square cloth with structural, shear and bend springs, thrown, one edge pinned; 51 samples in 1 s."""
    random, index = np.random.default_rng(seed), np.arange(side * side).reshape(side, side)
    a, b = index, index.T
    pairs = [(m[:, :-k], m[:, k:]) for k in (1, 2) for m in (a, b)]
    pairs += [(a[:-1, :-1], a[1:, 1:]), (a[:-1, 1:], a[1:, :-1])]
    edges = np.concatenate([np.stack([m.ravel(), n.ravel()], axis=1) for m, n in pairs])
    edges = edges[(edges >= side).any(axis=1)]  # between two that are pinned nothing can be seen
    x = np.stack([index.ravel() % side, index.ravel() // side, 0 * index.ravel()], axis=1) * 0.6
    x = x + 0.05 * random.normal(size=x.shape)  # in a plane, what pulls across it would be blind
    return recovered(x, edges, np.where(np.arange(side * side) < side, np.inf, 1.0), random)


def recovered(x, edges, mass, random):
    """Springs of a decade of ks and kd from 0.1 % noise: seconds from the data to the answer, and errors."""
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    ks, kd = 50 * 10 ** random.uniform(size=len(edges)), 0.3 * 10 ** random.uniform(size=len(edges))
    v, times = np.where(np.isinf(mass)[:, None], 0, random.normal(size=x.shape)), np.linspace(0, 1, 51)
    clean = made(jeuler.Scene((jeuler.Springs(edges, ks, kd, length),)), x, v, mass, times)
    y = clean + 1e-3 * np.std(clean - clean.mean(axis=0)) * random.normal(size=clean.shape)
    start = jeuler.Scene((jeuler.Springs(edges, np.full(len(edges), 100.0), np.ones(len(edges)), length),))
    begun, busy = time.perf_counter(), time.process_time()
    found = jeuler.fit_springs(start, jeuler.ParticleState(x, v, mass), times, y, dt=0.01, progress=False)
    seconds, busy = time.perf_counter() - begun, time.process_time() - busy
    print(f"{len(edges)} springs: {seconds:.1f} s ({busy:.1f} s of CPU), {len(found.history)} iterations")
    print(f"  {found.message}")
    for name, truth in (("ks", ks), ("kd", kd)):
        error = np.abs(np.asarray(found.params[name]) / truth - 1)
        print(f"  {name}: median error {np.median(error):.3%}, worst {error.max():.2%}", flush=True)
        if found.stderr is not None:
            off = np.abs(np.asarray(found.params[name]) - truth) / np.asarray(found.stderr[name])
            print(f"    95 % intervals hold {np.mean(off < 1.96):.1%}", flush=True)
    return found


def chain(count, seed=0):
    """N masses between two walls on N + 1 springs, 4 s at dt = 0.01, noise 1 mm: seconds and errors."""
    random = np.random.default_rng(seed)
    x = np.arange(count + 2.0)[:, None]
    edges = np.stack([np.arange(count + 1), np.arange(1, count + 2)], axis=1)
    mass = np.where(np.isin(np.arange(count + 2), [0, count + 1]), np.inf, 1.0)
    v = np.where(np.isinf(mass)[:, None], 0, random.normal(size=x.shape))
    ks, kd = random.uniform(50, 150, count + 1), random.uniform(0.2, 0.8, count + 1)
    times = np.linspace(0, 4, 401)
    y = made(jeuler.Scene((jeuler.Springs(edges, ks, kd, 1.0),)), x, v, mass, times)
    y = y + 1e-3 * random.normal(size=y.shape)
    y[:, [0, -1]] = np.nan
    start = jeuler.Scene((jeuler.Springs(edges, np.full(count + 1, 80.0), np.full(count + 1, 0.4), 1.0),))
    for run in ("first", "second"):
        begun = time.perf_counter()
        found = jeuler.fit_springs(start, jeuler.ParticleState(x, v, mass), times, y, dt=0.01, progress=False)
        seconds = time.perf_counter() - begun
        errors = ", ".join(f"{n} {np.median(np.abs(found.params[n] / t - 1)):.2%}" for n, t in (("ks", ks), ("kd", kd)))
        print(f"jeuler, N = {count}, {run} fit: {seconds:.2f} s; median errors {errors}; {found.message}", flush=True)


def coverage(repeats=500):
    """Share of nominal 95 % intervals that hold the truth, for frequency, decay and both amplitudes of a swing."""
    t = np.linspace(0, 10, 400)

    def residual(p, y):
        swing = jnp.exp(-p["g"] * t) * (p["a"] * jnp.cos(p["w"] * t) + p["b"] * jnp.sin(p["w"] * t))
        return swing - y

    truth = {"a": 1.0, "b": 0.2, "g": 0.2, "w": 3.0}
    clean = np.asarray(residual(truth, jnp.zeros(len(t))))
    random = np.random.default_rng(1)
    for rho in (0.0, 0.5, 0.9):
        hits, white = collections.Counter(), collections.Counter()
        for _ in range(repeats):
            noise = 0.02 * lfilter([1], [1, -rho], random.normal(size=len(t) + 500))[500:]
            found = jeuler.fit(residual, {"a": 0.8, "b": 0.0, "g": 0.1, "w": 3.1}, data=clean + noise, progress=False)
            for name, value in truth.items():
                off = abs(float(found.params[name]) - value)
                hits[name] += off < 1.96 * float(found.stderr[name])
                white[name] += off < 1.96 * float(found.stderr_white[name])
        shown = ", ".join(f"{name} {hits[name] / repeats:.1%} ({white[name] / repeats:.1%})" for name in truth)
        print(f"AR(1) rho = {rho}: {shown}; in brackets what independent noise would give", flush=True)


def starts(cases=100):
    """Oscillators of any ks, mass, damping; starts wrong by up to 100, a third aliased: right, said, or silent."""
    random, counted = np.random.default_rng(7), collections.Counter()
    for case in range(cases):
        ks, mass = 10 ** random.uniform(0, 3), 10 ** random.uniform(-1, 1)
        w0, z = np.sqrt(ks / mass), 10 ** random.uniform(-2.5, -0.7)
        aliased = case % 3 == 0
        samples = random.uniform(0.2, 0.4) if aliased else random.uniform(8, 40)  # a period
        t = np.arange(24 if aliased else 101) * 2 * np.pi / w0 / samples
        g, w = z * w0, w0 * np.sqrt(1 - z**2)
        noise = 10 ** random.uniform(-4, -2) * random.normal(size=len(t))
        y = np.full((len(t), 2, 1), np.nan)
        y[:, 1, 0] = 1 + 0.3 * np.exp(-g * t) * (np.cos(w * t) + g / w * np.sin(w * t)) + noise
        factor = random.choice([0.01, 1 / 30, 0.1, 1 / 3, 1, 3, 10, 30, 100])
        scene = jeuler.Scene((jeuler.Springs([[0, 1]], ks * factor, 2 * z * np.sqrt(ks * mass), 1.0),))
        state = jeuler.ParticleState([[0.0], [1.3]], jnp.zeros((2, 1)), mass=[jnp.inf, mass])
        dt = 2 * np.pi / w0 / 60
        count = 512 * int(np.ceil(t[-1] / dt / 512))  # so that cases share their programs
        found = jeuler.fit_springs(scene, state, t, y, dt=dt, num_steps=count, progress=False)
        off = abs(float(found.ks) - ks)
        right = off < 0.01 * ks or off < 4 * float(found.stderr["ks"])
        verdict = "right" if right else "said" if found.message != "converged" else "SILENT"
        counted[("aliased, " if aliased else "") + verdict] += 1
        if not right and not aliased:
            print(case, factor, ks, float(found.ks), found.message)
    print(dict(counted))


def net_starts(cases=100, first=0):
    """A hanging net of 5 by 5 with 36 springs: starts wrong by up to 100, from the data and from the given values."""
    random, counted = np.random.default_rng(11), collections.Counter()
    i = np.arange(25).reshape(5, 5)
    edges = np.concatenate(
        [np.stack([i[:, :-1], i[:, 1:]], -1).reshape(-1, 2), np.stack([i[:-1], i[1:]], -1).reshape(-1, 2)]
    )
    x = np.stack([i.ravel() % 5, -(i.ravel() // 5), 0 * i.ravel()], axis=1).astype(float)
    mass = np.where(np.arange(25) < 5, np.inf, 1.0)
    edges = edges[(edges >= 5).any(axis=1)]
    for case in range(cases):
        ks, kd = 100 * 10 ** random.uniform(-0.5, 0.5, 36), 10 ** random.uniform(-1, 0, 36)
        v = np.where(np.isinf(mass)[:, None], 0, random.normal(size=x.shape))
        aliased, start = case % 4 > 1, ("data", "given")[case % 2]
        # 5.6 samples a period of the fastest mode, 0.22 s, or 0.2: a tenth of what would tell it from slower ones
        t = np.arange(21) * 1.1 if aliased else np.arange(51) * 0.04
        truth = jeuler.Scene((jeuler.Springs(edges, ks, kd, 1.0), jeuler.Gravity([0.0, -9.81, 0.0])))
        noise = 10 ** random.uniform(-4, -2.5)
        errors = noise * random.normal(size=(51, 25, 3))
        factor = random.choice([0.01, 1 / 30, 0.1, 1 / 3, 1, 3, 10, 30, 100])
        if case < first:
            continue
        y = made(truth, x, v, mass, t) + errors[: len(t)]
        scene = jeuler.Scene(
            (jeuler.Springs(edges, np.full(36, 100.0) * factor, np.full(36, 0.3), 1.0), truth.forces[1])
        )
        state, dt = jeuler.ParticleState(x, v, mass), 0.01 if not aliased else 0.025
        try:
            found = jeuler.fit_springs(scene, state, t, y, dt=dt, start=start, max_iterations=60, progress=False)
        except ValueError as error:
            counted[f"{start}, {'aliased, ' if aliased else ''}refused"] += 1
            print(case, start, f"{factor:.3g}", aliased, "refused", str(error)[:200], flush=True)
            continue
        off, error = np.abs(np.asarray(found.ks) - ks), np.asarray(found.stderr["ks"])
        right = np.mean((off < 0.02 * ks) | (off < 4 * error)) > 0.97
        verdict = "right" if right else "said" if found.message != "converged" else "SILENT"
        counted[f"{start}, {'aliased, ' if aliased else ''}{verdict}"] += 1
        print(case, start, f"{factor:.3g}", aliased, verdict, found.message[:200], flush=True)
    print(dict(counted))


SLOW = 0.03  # s that an evaluation of the residual takes, so that there are moments between them


def slow_fit(kind, path):
    """One of the fits that are killed; what it found as a digest of all its numbers."""
    t = np.linspace(0, 3, 60)
    y = 2 * np.exp(-0.5 * t) * np.cos(6 * t) + 0.1 * np.random.default_rng(0).normal(size=60)

    def residual(p, data):
        jax.debug.callback(lambda: time.sleep(SLOW))
        t, y = data[:, 0], data[:, 1]
        return p["a"] * jnp.exp(-p["k"] * t) * jnp.cos(p["w"] * t) + jnp.sum(p.get("more", jnp.zeros(1))) - y

    start, adam = {"a": 1.0, "k": 0.1, "w": 4.6}, {"optimizer": optax.adam(0.02), "max_iterations": 120}
    options = {
        "search": {"tolerance": 1e-13, "stages": [np.where(t < end, 1.0, 0.0) for end in (0.3, 0.6, 1.2, 2.0)]},
        "starts": {"starts": 24, "positive": True},
        "descent": adam,
        "minibatches": adam | {"minibatch": 16},
        "without a Jacobian": {"loss": "huber", "loss_scale": 0.05},
    }[kind]
    if kind == "without a Jacobian":
        start = start | {"more": jnp.zeros(600)}
    print("begun", flush=True)
    found = jeuler.fit(residual, start, data=np.stack([t, y], 1), resume=path, progress=False, **options)
    digest = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(found)))
    print(digest.hexdigest(), found.message[:60], flush=True)


def kills(count=20, only=None):
    """Each kind of fit killed at random moments, one after the other, and then left to end."""
    random, kinds = np.random.default_rng(0), ["search", "starts", "descent", "minibatches", "without a Jacobian"]
    for kind in kinds if only is None else kinds[only : only + 1]:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "slow_fit", kind]
            path, killed, taken_up = os.path.join(folder, "state"), 0, 0
            whole = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[1]
            for _ in range(count // len(kinds)):
                before = os.path.getmtime(path) if os.path.exists(path) else 0.0
                taken_up += before > 0
                with subprocess.Popen([*command, path], stdout=subprocess.PIPE, text=True) as running:
                    while running.poll() is None and not (os.path.exists(path) and os.path.getmtime(path) > before):
                        time.sleep(0.01)
                    time.sleep(random.uniform(0.0, 1.5))  # some moment after its first write
                    killed += running.poll() is None
                    running.kill()
            last = subprocess.run([*command, path], capture_output=True, text=True, check=True).stdout.splitlines()[1]
            left = sorted(os.listdir(folder))
        same = "the same bits" if last == whole else "OTHER"
        print(
            f"{kind}: killed {killed} times, taken up {taken_up} times: {same}; left {left}; {whole[65:]}", flush=True
        )


def profiles(side=20):
    """Profile intervals of single springs of a cloth, in seconds and standard errors."""
    found = cloth(side)
    for name in ("ks[17]", "kd[17]", "ks[100]"):
        begun, busy = time.perf_counter(), time.process_time()
        error, interval = found.standard_error(name), found.profile(name)
        seconds, busy = time.perf_counter() - begun, time.process_time() - busy
        ends = [(end - interval.value) / error for end in (interval.lower, interval.upper)]
        print(f"{name}: {ends[0]:.3f} to {ends[1]:+.3f} standard errors, ends found: {interval.converged}", end="; ")
        print(f"{seconds:.1f} s ({busy:.1f} s of CPU)", flush=True)


if __name__ == "__main__":
    what, *words = sys.argv[1:] or ["net"]
    if what == "slow_fit":
        slow_fit(words[0], words[1] if words[1:] else None)
        sys.exit()
    numbers = [int(word) for word in words]
    if what in ("net_starts", "kills"):
        {"net_starts": net_starts, "kills": kills}[what](*numbers)
    else:
        run = {
            "net": net,
            "cloth": cloth,
            "chain": chain,
            "coverage": coverage,
            "starts": starts,
            "profiles": profiles,
        }[what]
        for number in numbers or [None]:
            run(*([number] if number else []))
