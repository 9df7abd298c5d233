"""A million members of a damped oscillator, 1,000 steps: `ensemble` beside ten batches of 100,000 by hand.

python benchmarks/ensembles.py million [MEMBERS]
python benchmarks/ensembles.py devices [MEMBERS]       on 1, 2, 4 and 8 devices of one machine
python benchmarks/ensembles.py processes [MEMBERS]     two processes by jax.distributed on loopback, beside one
python benchmarks/ensembles.py killed [MEMBERS]        the same, one killed at work: when the other ends, what it
                                                       says; both started again, beside a run in one go
python benchmarks/ensembles.py kills [TIMES]           one process, kill -9 at so many random moments, then gone on
"""

import json
import os
import pathlib
import random
import resource
import socket
import subprocess
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np

import jeuler

BATCH = 2**14


def drawn(count):
    rng = np.random.default_rng(0)
    ks, kd = rng.normal(10, 1, count), rng.normal(0.3, 0.03, count)
    return {"ks": np.asarray(ks, np.float32), "kd": np.asarray(kd, np.float32)}


def end(member):
    def field(t, y, args):
        return y[1], -args["ks"] * y[0] - args["kd"] * y[1]

    how = {"dt": 0.001, "num_steps": 1000, "step": jeuler.symplectic_euler_step, "save_every": 1000}
    return jeuler.solve(field, (jnp.float32(1), jnp.float32(0)), args=member, **how).y[0][-1]


def by_hand(members, batches=10):
    program = jax.jit(jax.vmap(end))
    size = len(members["ks"]) // batches
    parts = [{name: x[n * size : (n + 1) * size] for name, x in members.items()} for n in range(batches)]
    ends = np.concatenate([np.asarray(program(part)) for part in parts])
    return ends.mean(), ends.var(ddof=1), np.quantile(ends, (0.05, 0.5, 0.95))


def with_ensemble(members, **how):
    reduce = {"moments": jeuler.Moments(), "quantiles": jeuler.Quantiles((0.05, 0.5, 0.95))}
    found = jeuler.ensemble(end, members, reduce=reduce, **how)
    moments = found.reduced["moments"]
    return float(moments.mean), float(moments.variance), found.reduced["quantiles"].quantiles.tolist()


def million(count=1_000_000):
    members = drawn(count)
    seconds = {"ensemble": [], "by hand": []}
    for _ in range(3):  # in turn, so that both see the same load
        for name, way in {"ensemble": with_ensemble, "by hand": by_hand}.items():
            start = time.perf_counter()
            answer = way(members)
            seconds[name].append(time.perf_counter() - start)
            print(f"{name:10s} {seconds[name][-1]:6.2f} s, mean {answer[0]:.6f}, variance {answer[1]:.6e}, {answer[2]}")
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    ratio = np.median(seconds["ensemble"]) / np.median(seconds["by hand"])
    print(
        f"ratio of medians {ratio:.2f}, {1e6 * min(seconds['ensemble']) / count:.2f} ns a step, {most:.2f} GiB at most"
    )


def two_children(count, *folder, **how):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    children = [[sys.executable, __file__, "child", str(n), address, str(count), *folder] for n in range(2)]
    return [subprocess.Popen(child, stdout=subprocess.PIPE, **how) for child in children]


def answers_of(children):
    return [json.loads(child.communicate()[0].splitlines()[-1]) for child in children]


def members_kept(folder):
    state = pathlib.Path(folder, "state.npz")
    if not state.exists():
        return 0
    with np.load(state) as file:
        return json.loads(str(file["about"]))["steps"]


def killed(count=30_000_000):
    """kill -9 of one of two processes at work: the other ends, and says why; both go on when they are started again."""
    in_one_go = answers_of(two_children(count))[0]
    for victim in (1, 0):
        with tempfile.TemporaryDirectory() as folder, open(f"{folder}/words", "w+") as words:
            children = two_children(count, f"{folder}/run", stderr=words)
            while not pathlib.Path(folder, "run", "state.npz").exists():
                time.sleep(0.1)
            time.sleep(3)
            children[victim].kill()
            start, told = time.perf_counter(), None
            while children[1 - victim].poll() is None and time.perf_counter() < start + 60:
                time.sleep(0.1)
                if told is None and "a process of the ensemble has ended" in pathlib.Path(folder, "words").read_text():
                    told = time.perf_counter() - start
            print(
                f"process {victim} killed: the other said so after {told or np.nan:.1f} s and ended after "
                f"{time.perf_counter() - start:.1f} s with code {children[1 - victim].poll()}"
            )
            for child in children:
                child.kill()
                child.wait()
            words.seek(0)
            said = [line for line in words.read().splitlines() if "Error" in line or "heartbeat" in line]
            print(*[line[:300] for line in said], sep="\n")
            print(f"{members_kept(f'{folder}/run'):,} of {count:,} members are kept")
            answers = answers_of(two_children(count, f"{folder}/run"))
            print("gone on, equal to a run in one go to the bit:", answers == [in_one_go, in_one_go])


def kills(times=20):
    count, rng, same, killed, kept = 10_000_000, random.Random(0), 0, 0, []
    expected = list(with_ensemble(drawn(count), batch=BATCH))
    for _ in range(times):
        with tempfile.TemporaryDirectory() as folder:
            child = subprocess.Popen([sys.executable, __file__, "alone", str(count), folder], stdout=subprocess.PIPE)
            child.stdout.readline()
            time.sleep(rng.uniform(0, 5))
            killed += child.poll() is None
            child.kill()
            child.wait()
            kept.append(members_kept(folder))
            how = {"resume": folder, "checkpoint_every": 10 * BATCH}
            same += list(with_ensemble(drawn(count), batch=BATCH, **how)) == expected
    print(f"{killed} of {times} killed, {min(kept):,} to {max(kept):,} of {count:,} members done: {same} bit-identical")


def processes(count=100_000):
    answers = answers_of(two_children(count))
    print("two processes", answers[0])
    print("the same in both", answers[0] == answers[1])
    print("one process  ", with_ensemble(drawn(count), batch=BATCH))


def devices(count=1_000_000):
    """The same members on 1, 2, 4 and 8 devices that JAX makes of this machine's cores."""
    for number in (1, 2, 4, 8):
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={number}"
        command = [sys.executable, __file__, "on_devices", str(count)]
        subprocess.run(command, env=os.environ | {"XLA_FLAGS": flags}, check=True)


def on_devices(count):
    mesh = jax.make_mesh((jax.device_count(),), ("member",))
    members = drawn(count)
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        with_ensemble(members, mesh=mesh, batch=2**17)
        seconds.append(time.perf_counter() - start)
    print(f"{mesh.size} devices {min(seconds[1:]):.2f} s, first call {seconds[0]:.2f} s")


def alone(count, folder):
    members = drawn(int(count))
    print("begun", flush=True)
    with_ensemble(members, batch=BATCH, resume=folder, checkpoint_every=10 * BATCH)


def child(number, address, count, folder=None):
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(address, num_processes=2, process_id=int(number), heartbeat_timeout_seconds=20)
    mesh = jax.make_mesh((jax.device_count(),), ("member",))
    members = drawn(int(count))
    print("begun", flush=True)
    print(json.dumps(with_ensemble(members, mesh=mesh, batch=BATCH, resume=folder)))


if __name__ == "__main__":
    task, *rest = sys.argv[1:]
    if task in ("child", "alone"):
        {"child": child, "alone": alone}[task](*rest)
    else:
        tasks = {
            "million": million,
            "processes": processes,
            "killed": killed,
            "kills": kills,
            "devices": devices,
            "on_devices": on_devices,
        }
        tasks[task](*map(int, rest))
