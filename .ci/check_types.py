"""Types as a user meets them: mypy on the README's examples and the notebooks' code, and how much of the API is typed.

python .ci/check_types.py      Exit status 1 where mypy complains, or pyright knows less than 98 % of the public names.
"""

from __future__ import annotations

import doctest
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
LEAST_TYPED = 98.0  # per cent
MYPY = ["--ignore-missing-imports", "--check-untyped-defs", "--warn-unused-ignores", "--no-error-summary"]


def readme_code() -> str:
    """The README's doctests as one program."""
    return "".join(example.source for example in doctest.DocTestParser().get_examples((ROOT / "README.md").read_text()))


def notebook_code(path: pathlib.Path) -> str:
    """A notebook's cells as one program; lines of magic are left out."""
    cells = json.loads(path.read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return re.sub(r"^%.*$", "", code, flags=re.MULTILINE)


def check_examples() -> int:
    """mypy's exit status on all examples, each a module of its own."""
    programs = {"readme": readme_code()}
    programs |= {f"notebook_{path.stem}": notebook_code(path) for path in sorted((ROOT / "notebooks").glob("*.ipynb"))}
    with tempfile.TemporaryDirectory() as folder:
        for name, code in programs.items():
            pathlib.Path(folder, f"{name}.py").write_text(code)
        command = [sys.executable, "-m", "mypy", "--config-file=", *MYPY, *(f"{name}.py" for name in programs)]
        done = subprocess.run(command, cwd=folder, env={**os.environ, "MYPYPATH": str(ROOT / "src")}, check=False)
    print(f"mypy on {len(programs)} examples: {'complaints' if done.returncode else 'clean'}")
    return done.returncode


def typed_share() -> float:
    """The share of public names whose type pyright knows, in per cent."""
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    command += ["--verifytypes", "jeuler", "--ignoreexternal", "--outputjson"]
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path, "PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=env, check=False)
    report = json.loads(done.stdout[done.stdout.index("{") :])
    return 100 * report["typeCompleteness"]["completenessScore"]


def main() -> int:
    failed = check_examples()
    share = typed_share()
    print(f"typed: {share:.1f} % of the public API, at least {LEAST_TYPED} wanted")
    return int(bool(failed) or share < LEAST_TYPED)


if __name__ == "__main__":
    sys.exit(main())
