"""Four hundred wrong inputs, drawn with a fixed seed: how many are told in one line, raw, or taken in silence.

python benchmarks/slips.py [calls] [commands] [seed]       300 and 100 if nothing is said; all of them: 9999 9999
"""

import collections
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import slips  # of the tests


def main(calls=300, commands=100, seed=20240229):
    found = {}
    start = time.perf_counter()
    for name, call in slips.calls(min(calls, sum(1 for _ in slips.wrong_values())), seed).items():
        found[name] = slips.tried(call)
    with tempfile.TemporaryDirectory() as folder:
        for name, line in slips.commands(commands, Path(folder), seed).items():
            found[f"jeuler {name}"] = slips.commanded(line, folder)
    for name, what in found.items():
        if what not in ("told", "warned"):
            print(f"{what}\n    {name}", flush=True)
    counts = collections.Counter(what.split(":")[0] for what in found.values())
    print(f"{len(found)} wrong inputs in {time.perf_counter() - start:.0f} s: {dict(counts)}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
