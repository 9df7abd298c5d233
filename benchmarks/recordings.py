"""The command line on recordings as they come: right numbers, seconds and memory of whole processes, damage, kills.

    python benchmarks/recordings.py                      everything; about half an hour on two cores
    python benchmarks/recordings.py quirks FOLDER        every file of a folder (default tests/data/recordings)
    python benchmarks/recordings.py measured FOLDER      the measured files of ../shared/data
    python benchmarks/recordings.py pendulum FOLDER      its single pendulum to 55 s: what each friction leaves
    python benchmarks/recordings.py long                 18,000 and 1,000,000 rows, 723 rows, reading 100,000 rows
    python benchmarks/recordings.py damaged [COUNT]      damaged files, each by a process of its own
    python benchmarks/recordings.py users                six kinds of file as a new user goes: look, then its command
    python benchmarks/recordings.py killed [COUNT]       a fit killed at random moments: earlier outputs stay whole

Each line: what it is, seconds by the clock, MB at most, what came out.
"""

from __future__ import annotations

import json
import os
import pathlib
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np

ROOT = pathlib.Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

KS, KD = 20.0, 0.05
EDGES = "1-anchor,1-2,2-anchor"


def whole(
    *arguments: str, limit: float = 120, after: Callable[[], bool] | None = None
) -> tuple[int, float, float, str]:
    """Exit code, seconds, MB at most and standard error of ``python -m jeuler ARGUMENTS`` as a process of its own.

    Killed after ``limit`` seconds, which are counted from when ``after()`` is true, if it is given.
    """
    started = time.perf_counter()
    with tempfile.TemporaryFile("w+") as error:
        command = [sys.executable, "-m", "jeuler", *arguments]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=error)
        counted = None if after else started
        while counted is None or time.perf_counter() - counted < limit:
            if counted is None and after():
                counted = time.perf_counter()
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            time.sleep(0.002 if after else 0.02)
        else:
            process.kill()
            _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        error.seek(0)
        return process.returncode, time.perf_counter() - started, usage.ru_maxrss / 1024, error.read()


def fitted(path: pathlib.Path | str, *arguments: str) -> tuple[dict, str]:
    """The result of a fit and its seconds and MB in words; {} where it was refused."""
    with tempfile.TemporaryDirectory() as folder:
        out = os.path.join(folder, "out.json")
        picture = os.path.join(folder, "fit.png")
        code, seconds, memory, error = whole("fit", str(path), *arguments, "--json", out, "--plot", picture)
        words = f"{seconds:6.1f} s {memory:6.0f} MB"
        if code:
            return {}, f"{words}  exit {code}: {error.strip()[-300:]}"
        with open(out) as file:
            return json.load(file), words


def quirks(folder: str = str(ROOT / "tests/data/recordings")) -> None:
    """Every recording of the folder by the plain command, against the truth in its README."""
    for path in sorted(pathlib.Path(folder).glob("*.[ct]*")):
        two = path.name.startswith("two_carts")
        told, words = fitted(path, "--mass", *(["0.4036,1", "--edges", EDGES] if two else ["0.25"]))
        for spring in told.get("springs", []):
            words += f"  ks {spring['ks']:.5g}, kd {spring['kd']:.4g}"
            if not two and "five" not in path.name:
                off = 100 * (spring["ks"] / KS - 1), 100 * (spring["kd"] / KD - 1)
                words += f" (off {off[0]:+.2f} %, {off[1]:+.2f} %)"
        print(f"{path.name:<36} {words}", *(f"WARNING {w}" for w in told.get("warnings", [])), flush=True)


def measured(folder: str = str(ROOT.parent / "shared" / "data")) -> None:
    """The four measured files by one command each."""
    data = pathlib.Path(folder)
    rows = [
        ("pendulum_single", ["--pendulum", "--to", "10", "--mass", "1"]),
        ("pendulum_single", ["--pendulum", "--to", "55", "--mass", "1", "--friction", "compare"]),
        ("pendulum_double", ["--from", "55", "--mass", "1,?", "--edges", EDGES]),
        ("silverbox_multisine", ["--columns", "y_V", "--input", "u_V", "--cubic", "--mass", "1"]),
        ("sphere_in_water", ["--from", "0.75", "--mass", "1", "--friction", "compare"]),
    ]
    for name, arguments in rows:
        told, words = fitted(data / f"{name}.csv", *arguments)
        if told:
            modes = ", ".join(f"{m['natural_frequency']:.5g}" for m in told["modes"])
            words += f"  ks {told['springs'][0]['ks']:.6g}, modes {modes} rad/s, residual "
            words += (
                f"{100 * told['share_of_amplitude']:.2g} % of the amplitude, lag one {told['residual_lag_one']:.2f}"
            )
            words += "".join(f"; {row['friction']} {row['score']:.3g}" for row in told.get("comparison", []))
        print(f"{name} {' '.join(arguments):<66} {words}", flush=True)


def pendulum(folder: str = str(ROOT.parent / "shared" / "data")) -> None:
    """The friction of the bearing: a damper and air; with a dry bearing; with a dry one that falls with the speed.

    What a wrong friction leaves is a pattern: the model swings too far at some times and not far enough at others, and
    so too late or too early. Each window of 2 s tells how far: the parts of its residual along the angle and the speed.
    """
    import jax
    import jax.numpy as jnp

    import jeuler

    jax.config.update("jax_enable_x64", True)
    times, columns = jeuler.read_trajectory(os.path.join(folder, "pendulum_single.csv"), si=True)
    angle = next(iter(columns.values()))[times <= 55]

    def without(v, p):
        return p["kd"] * v + p["quadratic"] * v * jnp.abs(v)

    def three(v, p):
        return p["kd"] * v + p["quadratic"] * v * jnp.abs(v) + p["dry"] * jnp.tanh(v / 0.05)

    def falling(v, p):
        more = 1 + p["more"] * jnp.exp(-jnp.abs(v) / p["speed"])
        return p["quadratic"] * v * jnp.abs(v) + p["dry"] * more * jnp.tanh(v / 0.05)

    def run(friction, p):
        def motion(t, y, args):
            return jnp.stack([y[1], -p["w2"] * jnp.sin(y[0] - p["zero"]) - friction(y[1], p)])

        return jeuler.solve(motion, p["start"], dt=0.01, num_steps=len(angle) - 1, step=jeuler.rk4_step).y

    def left(moved):
        """The largest part that the swing is off by, and s that it is late by, in a window of 2 s after the first."""
        parts = []
        for k in range(200, len(angle) - 200, 200):
            swing, speed = moved[k : k + 200].T
            along = np.stack([swing, -speed, np.ones(200)], axis=1)
            parts.append(np.linalg.lstsq(along, angle[k : k + 200] - swing)[0][:2])
        return np.abs(parts).max(axis=0)

    begin = {"w2": 64.1, "zero": 0.0, "start": jnp.array([angle[0], 1.9]), "quadratic": 0.006}
    for friction, own in (
        (without, {"kd": 0.1}),
        (three, {"kd": 0.0, "dry": 0.15}),
        (falling, {"dry": 0.12, "more": 1.5, "speed": 2.0}),
    ):
        began = time.process_time()
        found = jeuler.fit(lambda p, data, f=friction: run(f, p)[:, 0] - data, {**begin, **own}, data=angle)
        swing, late = left(np.asarray(run(friction, found.params)))
        numbers = ", ".join(f"{name} {float(found.params[name]):.4g}" for name in ("w2", "quadratic", *own))
        share = 100 * np.sqrt(found.loss) / np.abs(angle).max()
        print(
            f"{friction.__name__}: {numbers}; {share:.3g} % of the amplitude, swing off by {100 * swing:.2g} % and "
            f"{1e3 * late:.2g} ms at most, lag one {found.autocorrelation:.3f}, "
            f"{time.process_time() - began:.1f} s of CPU; {found.message}",
            flush=True,
        )


def long() -> None:
    """Long recordings, whole processes, and how long 100,000 rows take to read."""
    from commands import quirks as made

    with tempfile.TemporaryDirectory() as folder:
        for rows, rate in ((18_000, 60), (100_000, 200), (1_000_000, 5_000), (1_000_000, 60)):
            t = np.arange(rows) / rate
            x = 0.3 + 0.05 * np.exp(-1e-2 * t) * np.cos(8.9437 * t)
            x += np.random.default_rng(8).normal(0, 2e-4, rows)
            path = os.path.join(folder, f"{rows}_{rate}.csv")
            np.savetxt(path, np.column_stack([t, x]), "%.6f", delimiter=",", header="t,x", comments="")
            told, words = fitted(path, "--mass", "0.25")
            print(
                f"{rows} rows at {rate} Hz  {words}  ks {told['springs'][0]['ks'] if told else '-'} (20.00)", flush=True
            )
        path = os.path.join(folder, "sphere.csv")
        t = np.arange(723) / 120
        np.savetxt(path, np.column_stack([t, made.swing(t)]), "%.6f", delimiter=",", header="t,x", comments="")
        print(f"723 rows, viscous  {fitted(path, '--mass', '0.25')[1]}", flush=True)
        print(f"723 rows, quadratic too  {fitted(path, '--mass', '0.25', '--drag', 'quadratic')[1]}", flush=True)
        import jeuler

        path = os.path.join(folder, "100000_200.csv")
        seconds = []
        for _ in range(5):
            started = time.perf_counter()
            jeuler.read_trajectory(path)
            seconds.append(time.perf_counter() - started)
        print(f"100000 rows read in {min(seconds):.3f} s (the least of 5)", flush=True)


def damaged(count: str = "200") -> None:
    """Damaged files: exit code 2 and one line with the place, or a result; seconds and MB of each at most."""
    from commands import damaged as made

    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        earlier = pathlib.Path("out.json"), pathlib.Path("fit.png")
        slowest, largest, refused, bad = 0.0, 0.0, 0, []
        for kind, raw in made.files(int(count)):
            pathlib.Path("d.csv").write_bytes(raw)
            for path in earlier:
                path.write_text("old")
            arguments = ["d.csv", "--mass", "0.25", "--json", "out.json", "--plot", "fit.png"]
            code, seconds, memory, error = whole("fit", *arguments)
            slowest, largest = max(slowest, seconds), max(largest, memory)
            one_line = error.startswith("jeuler fit: error: d.csv: ") and error.count("\n") == 1
            placed = re.search(r"d\.csv: (line \d+|no data|not a text file|\d+ rows|nothing moves)", error)
            told = json.loads(earlier[0].read_text()) if code == 0 else {}
            if code == 2 and one_line and placed and all(path.read_text() == "old" for path in earlier):
                refused += 1
            elif code or error or (abs(told["springs"][0]["ks"] / KS - 1) > 0.005 and not told["warnings"]):
                bad.append(kind)
                print(f"  BAD {kind}: exit {code}, {error[-300:]} {told.get('springs')}", flush=True)
        print(f"{count} damaged files: {refused} refused with their place, {len(bad)} bad, the rest fitted")
        print(f"  at most {slowest:.1f} s and {largest:.0f} MB", flush=True)


def killed(count: str = "20") -> None:
    """A fit killed at random moments: each output is what stood there before, or whole."""
    from commands import quirks as made

    random = np.random.default_rng(17)
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        pathlib.Path("good.csv").write_text("t,x\n" + made.table(made.T, made.swing()))
        outputs = {"out.json": "}\n", "fit.svg": "</svg>\n", "fit.html": "</html>"}
        arguments = ["fit", "good.csv", "--json", "out.json", "--plot", "fit.svg", "--report", "fit.html"]
        duration = min(whole(*arguments)[1] for _ in range(3))
        states = {"old": 0, "whole": 0, "torn": 0}
        for k in range(int(count)):
            for path in outputs:
                pathlib.Path(path).write_text("old")
            # every second one while the outputs are written: from when the first of them has changed or has begun to
            begun = (lambda: any(p.name.startswith(".jeuler") for p in pathlib.Path().iterdir())) if k % 2 else None
            whole(*arguments, limit=random.uniform(0, 0.4) if begun else random.uniform(0, duration), after=begun)
            for left in pathlib.Path().glob(".jeuler-*"):
                left.unlink()
            for path, ending in outputs.items():
                text = pathlib.Path(path).read_text()
                states["old" if text == "old" else "whole" if text.rstrip().endswith(ending.strip()) else "torn"] += 1
        print(f"{count} fits of {duration:.1f} s killed: outputs {states}", flush=True)


def users() -> None:
    """Six kinds of file: ``look``, then the command that it suggests with the mass put in: two steps."""
    import xlwt
    from commands import quirks as made

    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        made.write(pathlib.Path(folder))
        book = xlwt.Workbook()
        sheet = book.add_sheet("Raw Data")
        columns = {"Time (s)": made.T, "Linear Acceleration y (m/s^2)": made.acceleration(seed=2)}
        for k, (name, column) in enumerate(columns.items()):
            sheet.write(0, k, name)
            for row, value in enumerate(column, 1):
                sheet.write(row, k, float(value))
        book.save("phyphox.xls")
        lines = (f"{1000 * t:.0f},{1000 * x:.2f}" for t, x in zip(made.T, made.swing(), strict=True))
        pathlib.Path("arduino.txt").write_text("Ready\nmillis,dist_mm\n" + "\n".join(lines) + "\n")
        for name in ("phyphox.csv", "phyphox.xls", "tracker.txt", "pasco.csv", "vernier.csv", "arduino.txt"):
            look = subprocess.run(
                [sys.executable, "-m", "jeuler", "look", name], capture_output=True, text=True, check=True
            )
            command = look.stdout.strip().splitlines()[-1].split("python -m jeuler fit ")[1].replace("KG", "0.25")
            path, *arguments = shlex.split(command)
            told, words = fitted(path, *arguments)
            off = [100 * (told["springs"][0][name] / truth - 1) for name, truth in (("ks", KS), ("kd", KD))]
            print(f"{name:<14} fit {command:<40} {words}  off {off[0]:+.2f} %, {off[1]:+.2f} %", *told["warnings"])


PARTS = {
    "quirks": quirks,
    "measured": measured,
    "pendulum": pendulum,
    "long": long,
    "damaged": damaged,
    "users": users,
    "killed": killed,
}

if __name__ == "__main__":
    if len(sys.argv) > 1:
        PARTS[sys.argv[1]](*sys.argv[2:])
    else:
        for part in PARTS.values():
            part()
