"""The main job from a shell: ``python -m jeuler fit FILE``."""

from __future__ import annotations

import time

STARTED = time.perf_counter()

import argparse  # noqa: E402
import sys  # noqa: E402
from typing import Any, NoReturn  # noqa: E402


class Once(argparse.Action):
    """The value of an option, given once and not empty. Files, which are no option, are as many as there are."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        if option_string:
            given = namespace.__dict__.setdefault("given", set())
            if self.dest in given:
                parser.error(f"{option_string} must be given once, got two; leave one out")
            if not isinstance(values, (int, float)) and (not isinstance(values, str) or not values.strip()):
                parser.error(f"{option_string} must have a value, got none; leave it out for what it is without it")
            given.add(self.dest)
        setattr(namespace, self.dest, values)


EPILOG = """examples:
  python -m jeuler fit                                  a built-in example
  python -m jeuler look swing.csv                       what is understood of a file, and the command to fit it
  python -m jeuler fit swing.csv --mass 0.25            one particle on a spring to a fixed point
  python -m jeuler fit drop.csv --from 0.75 --drag quadratic
  python -m jeuler fit two.csv --mass 0.2,0.3 --edges 1-anchor,1-2
  python -m jeuler find tracks.csv --mass 0.05          which particles are joined, and by what springs"""


OBSERVED = ("position", "angle", "acceleration", "velocity", "angular velocity")


class Parser(argparse.ArgumentParser):
    """Bad usage is one line and exit code 2. Options are written in full, and once."""

    def __init__(self, **how: Any) -> None:
        super().__init__(**how, allow_abbrev=False)
        self.register("action", None, Once)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def parser() -> Parser:
    top = Parser(prog="jeuler", description="Springs, particles and ODEs in JAX.")
    jobs = top.add_subparsers(dest="job", required=True, metavar="{fit,look,find}", parser_class=Parser)
    fit = jobs.add_parser(
        "fit",
        help="recover stiffness ks and damping kd of a measured oscillation",
        description="Recover stiffness ks and damping kd of a measured oscillation.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    fit.add_argument(
        "files", nargs="*", metavar="FILE", help="a recording as it was exported; several: one spring, different masses"
    )
    _add_reading(fit)
    _add_model(fit)
    add = fit.add_argument
    add("--plot", metavar="OUT.png", help="where the picture goes (default jeuler_fit.png); - is standard output")
    add("--json", metavar="OUT.json", help="write the result as JSON too; - is standard output")
    add("--report", metavar="OUT.html", help="write the fit as one HTML page too, which needs no network")
    add("--max-iterations", type=int, default=200, help="the most iterations of each stage of the fit (default 200)")
    add("--no-cache", action="store_true", help="keep no compiled programs in the user's cache folder, use none")
    look = jobs.add_parser(
        "look",
        help="say what is understood of a recording, and the fit command that it suggests",
        description="Say what is understood of a recording, and the fit command that it suggests.",
    )
    look.add_argument("file", metavar="FILE", help="a recording as it was exported")
    _add_reading(look)
    find = jobs.add_parser(
        "find",
        help="find which tracked particles are joined by springs, and ks, kd and rest length of each",
        description="Find which tracked particles are joined by springs, and ks, kd and rest length of each.",
    )
    find.add_argument("file", metavar="FILE", help="tracks as they were exported, such as x1,y1,x2,y2, ... over time")
    _add_reading(find, tracks=True)
    add = find.add_argument
    add("--mass", help="mass of the particles in kg, one number or one each: 0.2,0.3; inf for a pinned one (default 1)")
    add("--gravity", metavar="X,Y", help="the acceleration that acts on all, m/s^2: 0,-9.81 (default: none)")
    add("--sigma", type=float, help="the noise of the positions in m (default: estimated)")
    add("--plot", metavar="OUT.png", help="where the picture goes (default jeuler_find.png); - is standard output")
    add("--json", metavar="OUT.json", help="write the result as JSON too; - is standard output")
    return top


def _add_reading(job: argparse.ArgumentParser, tracks: bool = False) -> None:
    """Options that correct how a recording is understood."""
    add = job.add_argument
    add("--columns", help="columns to use, by name: x1,y1,x2,y2 (default: by quantity, said in the result)")
    if tracks:
        job.set_defaults(observe=None, input=None, support=None)
    else:
        _add_quantities(job)
    add("--dim", type=int, help="coordinates a particle, where the names do not tell")
    add("--time", metavar="NAME", help="the time column (default: the one that is named so)")
    add("--run", metavar="N", help="which run, or all in one fit (default: the one with the most rows)")
    add("--unit", metavar="x=mm,t=ms", help="units of columns, where their names do not tell or are wrong")
    add("--skip", type=int, metavar="N", help="leave out the first lines of the file")
    add("--from", dest="begin", type=float, metavar="T", help="leave out what was measured before this time, s")
    add("--to", dest="end", type=float, metavar="T", help="leave out what was measured after this time, s")


def _add_quantities(job: argparse.ArgumentParser) -> None:
    """Options that say what was measured."""
    add = job.add_argument
    add("--observe", choices=OBSERVED, help="the quantity to use (default: position before angle before acceleration)")
    add("--input", metavar="NAME", help="the column of a measured force; its gain is fitted")
    add("--support", metavar="NAME", help="the column of the measured position of what the spring hangs on")


def _add_model(job: argparse.ArgumentParser) -> None:
    """Options that say what is fitted."""
    add = job.add_argument
    add("--mass", help="mass of the particles in kg, one number or one each: 0.2,0.3; ? to be found (default 1)")
    add("--dt", type=float, help="step size of the simulation in s (default: an 80th of a period)")
    add("--edges", help="springs: 1-2 between particles 1 and 2, 1-anchor to a fixed point (default: an anchor each)")
    add("--start", help="where the search starts: ks=20,kd=0.3 (default: read off the data)")
    add("--friction", help="viscous, quadratic, dry, several joined by +, or compare (default viscous)")
    add("--drag", choices=["quadratic"], help="the same as --friction viscous+quadratic")
    add("--cubic", action="store_true", help="add a cubic term to the spring: ks x + k3 x^3")
    add(
        "--drift",
        type=int,
        nargs="?",
        const=1,
        metavar="N",
        help="the zero moves, by a polynomial of degree N (default 1)",
    )
    add(
        "--delay", help="s by which channels are late: 0,0.02, one a particle; ? to be found, fit for all but the first"
    )
    add("--pendulum", action="store_true", help="a pendulum at any angle instead of a linear spring")


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, or 2 with one line on standard error for bad input."""
    arguments = parser().parse_args(argv)
    import jax

    jax.config.update("jax_enable_x64", True)
    if argv is None and arguments.job == "fit" and not arguments.no_cache:
        from jeuler.commands.program_cache import keep_programs

        keep_programs()
    from jeuler.commands.find_file import find_file
    from jeuler.commands.fit_file import fit_file
    from jeuler.commands.look_file import look_file

    try:
        if arguments.job == "look":
            look_file(arguments)
        elif arguments.job == "find":
            find_file(arguments)
        else:
            fit_file(arguments, STARTED if argv is None else time.perf_counter())
    except (ValueError, OSError) as error:
        print(f"jeuler {arguments.job}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
