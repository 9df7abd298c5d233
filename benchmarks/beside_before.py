"""This checkout against an older one, on the works of ``run.py``, in turn: what a change cost or gained.

    git worktree add --detach ../older COMMIT
    python benchmarks/beside_before.py ../older/src [--rounds 9] [--only NAME]

Each checkout runs in a process of its own, and the two take turns, so that what else the machine does hits both alike.
Prints the time of now over that of before, the median and the least of the rounds' ratios, forward and gradient, in
float32.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import statistics
import subprocess
import sys
import time

HERE = pathlib.Path(__file__).parent


def serve(only: str) -> None:
    """Run, at each line that comes, what it names, and answer with the seconds; first tell the names."""
    import oscillator
    from peers import jeuler_simulate
    from works import works

    def oscillations():
        made = oscillator.runs(only="jeuler")
        return [made["jeuler", kind] for kind in (0, 1)]

    makers = {oscillator.NAME: oscillations}
    makers |= {work.name: lambda work=work: jeuler_simulate(work) for work in works(small=False)}
    print("\t".join(name for name in makers if only in name), flush=True)
    made: dict = {}
    for line in sys.stdin:
        name, kind = line.rstrip("\n").split("\t")
        if name not in made:
            made = {name: makers[name]()}
        run = made[name][int(kind)]
        run()
        start = time.perf_counter()
        run()
        print(time.perf_counter() - start, flush=True)


def start(source: pathlib.Path, only: str) -> subprocess.Popen:
    environment = os.environ | {"PYTHONPATH": str(source.resolve())}
    command = [sys.executable, __file__, "--serve", "--only", only]
    return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def ask(process: subprocess.Popen, name: str, kind: int) -> float:
    process.stdin.write(f"{name}\t{kind}\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=pathlib.Path, nargs="?", help="the src folder of the older checkout")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--only", default="", help="only works whose name contains this")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.only)
        return
    if options.source is None or not (options.source / "jeuler").is_dir():
        parser.error("name the src folder of the older checkout, the one that holds jeuler/")
    now, before = start(HERE.parent / "src", options.only), start(options.source, options.only)
    names = now.stdout.readline().rstrip("\n").split("\t")
    before.stdout.readline()
    print("| now / before | forward: median, least | gradient: median, least |", "|---|--:|--:|", sep="\n", flush=True)
    for name in names:
        cells = []
        for kind in (0, 1):
            ratios = [ask(now, name, kind) / ask(before, name, kind) for _ in range(options.rounds + 1)][1:]
            cells.append(f"{statistics.median(ratios):.2f}, {min(ratios):.2f}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    for process in (now, before):
        process.stdin.close()
        process.wait()


if __name__ == "__main__":
    main()
