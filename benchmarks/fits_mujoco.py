"""The same springs from the same data by jeuler and by mujoco.sysid: seconds from the data to the answer, and errors.

    pip install 'mujoco[sysid]'
    python benchmarks/fits_mujoco.py [N ...] [--draws 0:5]    chains of N masses between walls, N + 1 springs; 3 20 100
    python benchmarks/fits_mujoco.py [N ...] --sums 0:8       errors of the two sums, see below, both by jeuler

Unit masses on a line, springs as spatial tendons with stiffness and damping of each, 4 s at dt = 0.01 by RK4 in both,
positions of all masses at 401 times with noise of 1 mm, made by diffrax's Tsit5 at 1e-9. Each draw has its own springs,
velocities and noise; of several the medians are compared. Each fit runs in a process of its own without a compilation
cache, so that jeuler's seconds hold all of its compilation; imports are counted apart, those of SciPy that either makes
at its first fit too.

The two do not minimise the same sum: sysid divides the residual of each mass by the norm of its displacements, jeuler
by one sigma for all, which is what noise of 1 mm everywhere asks for. A third fit, by jeuler with the weights of sysid,
shows that the two end at the same minimum of the same sum, so that ``--sums`` has the errors of both without sysid.
"""

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time

begun = time.perf_counter()


def chain(count, seed=0):
    """Positions at rest, velocities, ks and kd of a chain, (particle,) and (spring,)."""
    import numpy as np

    random = np.random.default_rng(seed)
    x = np.arange(count + 2.0)
    v = random.normal(size=count + 2)
    v[[0, -1]] = 0
    return x, v, random.uniform(50, 150, count + 1), random.uniform(0.2, 0.8, count + 1)


def record(count, draw, path):
    """What is measured: (time, mass) with noise."""
    import jax
    import numpy as np
    from fits import made

    import jeuler

    jax.config.update("jax_enable_x64", True)
    x, v, ks, kd = chain(count, draw)
    edges = np.stack([np.arange(count + 1), np.arange(1, count + 2)], axis=1)
    mass = np.where(np.isin(np.arange(count + 2), [0, count + 1]), np.inf, 1.0)
    times = np.linspace(0, 4, 401)
    y = made(jeuler.Scene((jeuler.Springs(edges, ks, kd, 1.0),)), x[:, None], v[:, None], mass, times)
    np.save(path, y[:, 1:-1, 0] + 1e-3 * np.random.default_rng(1000 * draw + 1).normal(size=(401, count)))


def by_jeuler(x, v, y, weights=None):
    """Fitted ks, kd and the standard errors of ks."""
    import numpy as np

    import jeuler

    count = len(x) - 2
    edges = np.stack([np.arange(count + 1), np.arange(1, count + 2)], axis=1)
    mass = np.where(np.isin(np.arange(count + 2), [0, count + 1]), np.inf, 1.0)
    positions = np.full((401, count + 2, 1), np.nan)
    positions[:, 1:-1, 0] = y
    scene = jeuler.Scene((jeuler.Springs(edges, np.full(count + 1, 80.0), np.full(count + 1, 0.4), 1.0),))
    state = jeuler.ParticleState(x[:, None], v[:, None], mass)
    options = {"dt": 0.01, "weights": weights, "progress": False}
    found = jeuler.fit_springs(scene, state, np.linspace(0, 4, 401), positions, **options)
    return found.ks, found.kd, found.stderr["ks"]


def by_jeuler_weighted(x, v, y):
    """The same, with the residual of each mass over the norm of its displacements, as mujoco.sysid has it."""
    import numpy as np

    weights = np.ones(len(x))
    weights[1:-1] = 1 / np.sum((y - x[1:-1]) ** 2, axis=0)
    return by_jeuler(x, v, y, weights[:, None])


def by_mujoco(x, v, y):
    """The same by mujoco.sysid with its default optimiser, and its intervals over 1.96."""
    import mujoco
    import numpy as np
    from mujoco import sysid

    count = len(x) - 2
    bodies = "".join(
        f'<body name="b{k}" pos="{x[k]} 0 0"><joint name="j{k}" type="slide" axis="1 0 0"/>'
        f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><site name="s{k}"/></body>'
        for k in range(1, count + 1)
    )
    tendons = "".join(
        f'<spatial name="t{k}" stiffness="80" damping="0.4" springlength="1">'
        f'<site site="s{k}"/><site site="s{k + 1}"/></spatial>'
        for k in range(count + 1)
    )
    sensors = "".join(f'<jointpos name="p{k}" joint="j{k}"/>' for k in range(1, count + 1))
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.01" integrator="RK4" gravity="0 0 0"><flag contact="disable"/></option>'
        f'<worldbody><site name="s0"/><site name="s{count + 1}" pos="{x[-1]} 0 0"/>{bodies}</worldbody>'
        f"<tendon>{tendons}</tendon><sensor>{sensors}</sensor></mujoco>"
    )
    model = spec.compile()
    params = sysid.ParameterDict()

    def modifier(name, field):
        def write(spec, parameter):
            value = getattr(spec.tendon(name), field)
            if np.ndim(value):
                value[0] = parameter.value[0]
            else:
                setattr(spec.tendon(name), field, parameter.value[0])

        return write

    for field, start, high in (("stiffness", 80.0, 1000.0), ("damping", 0.4, 10.0)):
        for k in range(count + 1):
            params.add(sysid.Parameter(f"{field}{k}", start, 0.0, high, modifier=modifier(f"t{k}", field)))
    times = np.linspace(0, 4, 401)
    sequence = sysid.ModelSequences(
        "chain",
        spec,
        "measured",
        sysid.create_initial_state(model, np.zeros(count), v[1:-1], np.zeros(0)),
        sysid.TimeSeries(times, np.zeros((401, 0))),
        # states, not sensors: those of a step are taken before it, and lag by dt
        sysid.TimeSeries.from_names(times, y - x[1:-1], model, [f"j{k}_qpos" for k in range(1, count + 1)]),
    )
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    found, result = sysid.optimize(initial_params=params, residual_fn=residual, optimizer="mujoco", verbose=False)
    residuals, _, _ = residual(result.x, found)
    _, intervals = sysid.calculate_intervals(residuals, result.jac)
    return found.as_vector()[: count + 1], found.as_vector()[count + 1 :], intervals[: count + 1] / 1.96


TOOLS = {"jeuler": by_jeuler, "mujoco": by_mujoco, "jeuler, sysid's weights": by_jeuler_weighted}


def one(tool, count, draw, path):
    """One fit in this process; prints its numbers."""
    import numpy as np

    if tool == "mujoco":
        from mujoco import sysid  # noqa: F401
    else:
        import jax

        import jeuler

        jax.config.update("jax_enable_x64", True)
        jeuler.fit_springs  # noqa: B018  # loads what fits
    for module in ("scipy.interpolate", "scipy.optimize", "scipy.sparse.linalg", "scipy.stats", "tqdm"):
        importlib.import_module(module)
    x, v, ks, kd = chain(count, draw)
    y = np.load(path)
    imported, busy = time.perf_counter(), time.process_time()
    with open(os.devnull, "w") as quiet:  # sysid prints its iterations
        out, sys.stdout = sys.stdout, quiet
        found_ks, found_kd, error = (np.asarray(a, float) for a in TOOLS[tool](x, v, y))
        sys.stdout = out
    done, busy = time.perf_counter(), time.process_time() - busy
    numbers = {"fit": done - imported, "cpu": busy, "import": imported - begun}
    numbers |= {
        name: float(np.median(np.abs(a / b - 1))) for name, a, b in (("ks", found_ks, ks), ("kd", found_kd, kd))
    }
    numbers["covered"] = float(np.mean(np.abs(found_ks - ks) < 1.96 * error))
    numbers["found"] = [*found_ks, *found_kd]
    print(json.dumps(numbers))


def fitted(count, draw):
    """The numbers of each tool for one draw of springs, velocities and noise."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    numbers = {}
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "y.npy")
        record(count, draw, path)
        for tool in TOOLS:
            command = [sys.executable, __file__, "--one", tool, str(count), str(draw), path]
            text = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
            numbers[tool] = found = json.loads(text.splitlines()[-1])
            print(
                f"N = {count}, draw {draw}, {tool}: {found['fit']:.2f} s, of CPU {found['cpu']:.2f} s "
                f"(import {found['import']:.2f} s); median errors ks {found['ks']:.3%}, kd {found['kd']:.2%}; "
                f"95 % intervals of ks hold {found['covered']:.0%}",
                flush=True,
            )
    return numbers


def main(counts, draws):
    from statistics import median

    for count in counts:
        numbers = [fitted(count, draw) for draw in draws]
        faster = median(each["jeuler"]["fit"] / each["mujoco"]["fit"] for each in numbers)
        print(f"N = {count}, medians of {len(numbers)} draws: jeuler takes {faster:.3f} of mujoco.sysid's time")
        for name in ("ks", "kd"):
            ours, its = (median(each[tool][name] for each in numbers) for tool in ("jeuler", "mujoco"))
            print(f"  error of {name}: jeuler {ours:.3%}, mujoco.sysid {its:.3%}")
        pairs = [
            (a, b)
            for each in numbers
            for a, b in zip(each["jeuler, sysid's weights"]["found"], each["mujoco"]["found"], strict=True)
        ]
        apart = median(abs(a / b - 1) for a, b in pairs)
        print(f"  with the same weights the two differ by {apart:.1e} (relative, median)", flush=True)


def sums(counts, draws):
    """Median errors of the springs by one sigma for all and by the weights of sysid, both by jeuler, draw by draw."""
    from statistics import median

    import jax
    import numpy as np

    jax.config.update("jax_enable_x64", True)
    words = "ks {:.3%}, kd {:.2%}; by sysid's weights ks {:.3%}, kd {:.2%}"
    for count in counts:
        errors = []
        for draw in draws:
            with tempfile.TemporaryDirectory() as folder:
                record(count, draw, os.path.join(folder, "y.npy"))
                y = np.load(os.path.join(folder, "y.npy"))
            x, v, ks, kd = chain(count, draw)
            found = [fit(x, v, y)[:2] for fit in (by_jeuler, by_jeuler_weighted)]
            errors.append([np.median(np.abs(a / b - 1)) for each in found for a, b in zip(each, (ks, kd), strict=True)])
            print(f"N = {count}, draw {draw}:", words.format(*errors[-1]), flush=True)
        print(f"N = {count}, medians of {len(errors)} draws:", words.format(*map(median, zip(*errors, strict=True))))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        one(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
    else:
        words, what, draws = sys.argv[1:], main, range(1)
        for option, run in (("--draws", main), ("--sums", sums)):
            if option in words:
                k = words.index(option)
                words, what, draws = words[:k] + words[k + 2 :], run, range(*map(int, words[k + 1].split(":")))
        what([int(n) for n in words] or [3, 20, 100], draws)
