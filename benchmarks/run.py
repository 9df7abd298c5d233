"""Run every peer on the same work, in turn, and print what it took.

    python benchmarks/run.py [--all] [--rounds 7] [--platform gpu] [--out benchmarks/results]

Times are medians over the rounds, in nanoseconds per spring (or free particle, or oscillator) and step; in a round each
peer runs in turn, forward and gradient, so that what else the machine does hits all alike. The peers' results are
compared before they are timed. Needs jax-md and warp-lang beside jeuler's own dependencies; a peer that is not
installed is left out, and said so. On a GPU, JAX's CUDA wheels are all that is needed beside: the programs of JAX and
Warp run there, C and NumPy on the CPU.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import os
import pathlib
import platform
import statistics
import subprocess
import sys
import time

import jax
import memory
import numpy as np
import oscillator
from peers import PEERS
from works import works

NEEDS = {"jax-md (no damper)": "jax_md", "Warp": "warp"}
FORWARD, GRADIENT = 0, 1


def interleaved(runs: dict, rounds: int) -> dict:
    """Median seconds of each function in ``runs``. In a round each runs twice, and the second time counts: the first
    finds the caches and the memory as another peer left them, which a loop of a user does not."""
    seconds: dict = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            run()
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(times) for name, times in seconds.items()}


def measure(work, rounds: int) -> dict:
    """(peer, forward or gradient) to nanoseconds per unit and step."""
    runs = {}
    for name, peer in PEERS.items():
        if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
            continue
        for kind, function in zip((FORWARD, GRADIENT), peer(work), strict=True):
            if function is not None:
                runs[name, kind] = function
    compare(work, runs)
    seconds = interleaved(runs, rounds)
    return {key: 1e9 * value / work.units / work.steps for key, value in seconds.items()}


def compare(work, runs) -> None:
    """All peers come to the same end: the moves agree to 1e-3 of the largest and one rounding of the positions a step
    (jax-md has no damper, and may not)."""
    start = work.position.reshape(-1, 3)
    moves = {n: np.asarray(run()).reshape(-1, 3) - start for (n, kind), run in runs.items() if kind == FORWARD}
    largest, rounding = np.abs(moves["jeuler"]).max(), work.steps * np.spacing(np.abs(start).max())
    for name, move in moves.items():
        error = np.abs(move - moves["jeuler"]).max() / largest
        if error > 1e-3 + rounding / largest and name != "jax-md (no damper)":
            raise SystemExit(f"{work.name}: {name} disagrees with jeuler by {error:.1e}")
    slopes = {n: run() for (n, kind), run in runs.items() if kind == GRADIENT and n != "jax-md (no damper)"}
    for name, slope in slopes.items():
        for mine, other in zip(slopes["jeuler"], slope, strict=True):
            error = np.abs(np.ravel(mine) - np.ravel(other)).max() / max(np.abs(mine).max(), 1e-9)
            if error > 1e-2 and work.edges.size:
                print(f"  note: gradient of {name} differs from jeuler's by {error:.1e}", flush=True)


def versions() -> str:
    cpu = platform.processor() or platform.machine()
    if pathlib.Path("/proc/cpuinfo").exists():
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), cpu)
    names = ["jax", "jaxlib", "numpy", "diffrax", "jax-md", "warp-lang"]
    found = []
    for name in names:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            found.append(f"{name} not installed")
    try:
        compiler = subprocess.run(
            ["gcc", "-dumpfullversion"], capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        compiler = "not installed"
    device = jax.devices()[0]
    cpu += "" if device.platform == "cpu" else f" with {device.device_kind}"
    head = f"{cpu}, {os.cpu_count()} cores, {platform.system()}; Python {platform.python_version()}, float32, "
    return head + ", ".join(found) + f", gcc {compiler}"


def cell(value: float | None) -> str:
    return "-" if value is None else f"{value:,.1f}" if value < 100 else f"{value:,.0f}"


def table(results: dict) -> str:
    """One row a peer, two columns a work: forward and gradient."""
    peers = list(dict.fromkeys(peer for times in results.values() for peer, _ in times))
    lines = ["| ns per spring and step | " + " | ".join(f"{work}: forward | gradient" for work in results) + " |"]
    lines.append("|---|" + "--:|--:|" * len(results))
    for peer in peers:
        cells = [cell(times.get((peer, kind))) for times in results.values() for kind in (FORWARD, GRADIENT)]
        lines.append(f"| {peer} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def figure(results: dict, path: pathlib.Path) -> None:
    """Bars on a logarithmic scale, one panel a work; forward full, gradient hatched."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(4, len(results))
    rows = -(-len(results) // columns)
    fig, axes = plt.subplots(
        rows, columns, figsize=(max(7, 3.6 * columns), 3.1 * rows + 0.4), squeeze=False, layout="constrained"
    )
    for ax in axes.ravel()[len(results) :]:
        ax.axis("off")
    peers = [peer for peer in PEERS if any((peer, FORWARD) in times for times in results.values())]
    for index, (ax, (work, times)) in enumerate(zip(axes.ravel(), results.items(), strict=False)):
        for place, peer in enumerate(peers):
            color = "tab:orange" if peer == "jeuler" else "tab:blue"
            for kind, shift, alpha in ((FORWARD, -0.2, 1.0), (GRADIENT, 0.2, 0.45)):
                if (peer, kind) in times:
                    ax.barh(place + shift, times[peer, kind], height=0.38, color=color, alpha=alpha)
        ax.set_yticks(range(len(peers)), [""] * len(peers) if index % columns else peers)
        ax.set_ylim(len(peers) - 0.5, -0.5)
        ax.set_xscale("log")
        ax.set_xlim(left=min(times.values()) / 3)
        ax.set_title(work, fontsize=9)
        ax.set_xlabel("ns per unit and step", fontsize=8)
    fig.suptitle("Forward (full) and reverse gradient (pale); shorter is better", fontsize=10)
    fig.savefig(path, dpi=130)


def on(kind: str | None) -> None:
    """Have JAX run on a device of this kind, or end with one line that says what there is instead."""
    if kind is None:
        return
    # "gpu" is no word for jax_platforms: it asks for CUDA and ROCm at once, and fails where one of the two is missing
    jax.config.update("jax_platforms", "cpu" if kind == "cpu" else "")
    if (found := jax.default_backend()) != kind:
        hint = "; on a machine with an NVIDIA GPU, pip install 'jax[cuda13]'" if kind == "gpu" else ""
        sys.exit(f"run.py: JAX finds no {kind} here, only a {found}{hint}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="also the large systems, up to a million springs")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--no-memory", action="store_true", help="leave the table of memory out")
    parser.add_argument("--only", default="", help="only works whose name contains this")
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path(__file__).parent / "results")
    parser.add_argument("--platform", choices=["cpu", "gpu", "tpu"], help="where JAX runs; without it, where it would")
    options = parser.parse_args()
    on(options.platform)
    if jax.config.jax_enable_x64:
        sys.exit("run the benchmark without jax_enable_x64")
    options.out.mkdir(parents=True, exist_ok=True)
    print(versions(), flush=True)
    results = {}
    if options.only in oscillator.NAME:
        runs = oscillator.runs()
        seconds = interleaved(runs, options.rounds)
        results[oscillator.NAME] = {key: 1e9 * s / oscillator.STEPS for key, s in seconds.items()}
        print(table({oscillator.NAME: results[oscillator.NAME]}), flush=True)
    for work in works(small=not options.all):
        if options.only in work.name:
            results[work.name] = measure(work, options.rounds)
            print(table({work.name: results[work.name]}), flush=True)
    parts = [versions(), table(results), *([] if options.no_memory else [memory.table()])]
    text = "\n\n".join(parts) + "\n"
    print(text)
    (options.out / "results.md").write_text(text)
    figure(results, options.out / "results.png")


if __name__ == "__main__":
    main()
