"""The main job from a shell: ``python -m jeuler fit FILE``."""

from __future__ import annotations

import time

STARTED = time.perf_counter()

import argparse  # noqa: E402
import sys  # noqa: E402
from typing import NoReturn  # noqa: E402

EPILOG = """examples:
  python -m jeuler fit                                  a built-in example
  python -m jeuler fit swing.csv --mass 0.25            one particle on a spring to a fixed point
  python -m jeuler fit drop.csv --from 0.75 --drag quadratic
  python -m jeuler fit two.csv --mass 0.2,0.3 --edges 1-anchor,1-2"""


class Parser(argparse.ArgumentParser):
    """Bad usage is one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def parser() -> Parser:
    top = Parser(prog="jeuler", description="Springs, particles and ODEs in JAX.")
    jobs = top.add_subparsers(dest="job", required=True, metavar="{fit}", parser_class=Parser)
    fit = jobs.add_parser(
        "fit",
        help="recover stiffness ks and damping kd of a measured oscillation",
        description="Recover stiffness ks and damping kd of a measured oscillation.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = fit.add_argument
    add("file", nargs="?", metavar="FILE", help="CSV or TSV: a time column in s, then positions in m, x1 y1 x2 y2 ...")
    add("--mass", default="1", help="mass of the particles in kg, one number or one each: 0.2,0.3 (default 1)")
    add("--dt", type=float, help="step size of the simulation in s (default: a 40th of a period)")
    add("--edges", help="springs: 1-2 between particles 1 and 2, 1-anchor to a fixed point (default: an anchor each)")
    add("--start", help="where the search starts: ks=20,kd=0.3 (default: read off the spectrum and the decay)")
    add("--drag", choices=["quadratic"], help="add a drag force -c |v| v and fit c as well")
    add("--columns", help="position columns to use, by name: x1,y1,x2,y2 (default: all that are named so, or all)")
    add("--dim", type=int, help="coordinates a particle, where the names do not tell")
    add("--from", dest="begin", type=float, metavar="T", help="leave out what was measured before this time, s")
    add("--to", dest="end", type=float, metavar="T", help="leave out what was measured after this time, s")
    add("--plot", metavar="OUT.png", help="where the picture goes (default jeuler_fit.png)")
    add("--json", metavar="OUT.json", help="write the result as JSON too")
    add("--max-iterations", type=int, default=200, help="the most iterations of each stage of the fit (default 200)")
    return top


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, or 2 with one line on standard error for bad input."""
    arguments = parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    from jeuler.commands.fit_file import fit_file

    try:
        fit_file(arguments, STARTED if argv is None else time.perf_counter())
    except (ValueError, OSError) as error:
        print(f"jeuler fit: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
