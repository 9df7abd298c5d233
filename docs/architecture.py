"""The numbers and the picture of docs/architecture.md, from the code itself.

python docs/architecture.py            writes docs/architecture.png and the table between the marks in architecture.md
python docs/architecture.py --check    exit status 1 if that table is not what the code says now
"""

from __future__ import annotations

import ast
import json
import os
import pathlib
import subprocess
import sys
import tomllib

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "jeuler"
PAGE, PICTURE = ROOT / "docs" / "architecture.md", ROOT / "docs" / "architecture.png"
BEGIN, END = "<!-- numbers: docs/architecture.py -->", "<!-- end of numbers -->"


def modules() -> dict[str, ast.Module]:
    """Every module of the package by its dotted name below jeuler, "" for the package itself."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text())
    return found


def imports_of(name: str, tree: ast.Module) -> set[str]:
    """The modules of jeuler that a module imports, wherever it does."""
    known = set(modules_by_name)
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == "jeuler":
            base = node.module.partition(".")[2]
            deeper = {f"{base}.{alias.name}".lstrip(".") for alias in node.names}
            found |= (deeper & known) or {base}
        elif isinstance(node, ast.Import):
            found |= {a.name.partition(".")[2] for a in node.names if a.name.partition(".")[0] == "jeuler"}
    return {other for other in found if other and other != name}


def layers() -> list[list[str]]:
    """The layers of the linter's contract, top first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return [[part.strip() for part in layer.split("|")] for layer in contracts[0]["layers"]]


def package_arrows() -> dict[tuple[str, str], int]:
    """How many imports go from one package to another."""
    arrows: dict[tuple[str, str], int] = {}
    for name, tree in modules_by_name.items():
        for other in imports_of(name, tree):
            pair = name.partition(".")[0], other.partition(".")[0]
            if pair[0] and pair[0] != pair[1]:
                arrows[pair] = arrows.get(pair, 0) + 1
    return arrows


def functions() -> list[tuple[int, str]]:
    """(lines without the docstring, name) of every function, the longest first."""
    found = []
    for module, tree in modules_by_name.items():
        for node in ast.walk(tree):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                doc = node.body[0] if ast.get_docstring(node) else None
                lines = (node.end_lineno or 0) - node.lineno + 1 - (doc.end_lineno - doc.lineno + 1 if doc else 0)
                found.append((lines, f"{module}.{node.name}"))
    return sorted(found, reverse=True)


def public_definitions() -> list[tuple[str, ast.AST]]:
    """Every class and function without an underscore at the top of a module, and the methods of such classes."""
    found: list[tuple[str, ast.AST]] = []
    for module, tree in modules_by_name.items():
        for node in tree.body:
            if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_"):
                found.append((f"{module}.{node.name}", node))
    return found


def typed_share() -> str:
    """What pyright knows of the public API."""
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "pyright", "--pythonpath", sys.executable]
    command += ["--verifytypes", "jeuler", "--ignoreexternal", "--outputjson"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}, check=False)
    report = json.loads(done.stdout[done.stdout.index("{") :])
    return f"{100 * report['typeCompleteness']['completenessScore']:.0f} %"


def numbers() -> list[tuple[str, str]]:
    """The rows of the table."""
    lines = {path.relative_to(PACKAGE): len(path.read_text().splitlines()) for path in PACKAGE.rglob("*.py")}
    longest_file = max(lines, key=lambda path: lines[path])
    module_arrows = sum(len(imports_of(name, tree)) for name, tree in modules_by_name.items())
    length, name = functions()[0]
    definitions = public_definitions()
    documented = sum(ast.get_docstring(node) is not None for _, node in definitions)  # type: ignore[arg-type]
    packages = {name.partition(".")[0] for name in modules_by_name if "." in name}
    entered = packages_of_a_run()
    return [
        ("files at the top of the package", str(len(list(PACKAGE.glob("*.py"))))),
        ("packages", str(len(packages))),
        ("modules, packages' own files among them", str(len(modules_by_name))),
        ("lines", f"{sum(lines.values()):,}"),
        ("longest file", f"{lines[longest_file]} lines, `{longest_file}`"),
        ("longest function, without its docstring", f"{length} lines, `{name}`"),
        ("functions over 60 lines", str(sum(length > 60 for length, _ in functions()))),
        ("imports between modules", str(module_arrows)),
        ("imports between packages, each pair once", str(len(package_arrows()))),
        ("layers of the linter, imports that it ignores", f"{len(layers())}, {ignored_imports()}"),
        ("packages that `simulate` enters, `_core` and `_jax` apart", f"{len(entered)}: {', '.join(entered)}"),
        ("documented classes and functions without an underscore", f"{100 * documented / len(definitions):.0f} %"),
        ("public names whose type pyright knows", typed_share()),
    ]


def packages_of_a_run() -> list[str]:
    """The packages that the module of `simulate` needs, directly or not, below the layers of forces and contact."""
    seen, waiting = set(), ["particles._simulate"]
    while waiting:
        name = waiting.pop()
        if name in seen or name not in modules_by_name:
            continue
        seen.add(name)
        waiting += imports_of(name, modules_by_name[name])
    return sorted({name.partition(".")[0] for name in seen} - {"_core", "_jax"})


def ignored_imports() -> int:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    return sum(len(contract.get("ignore_imports", ())) for contract in contracts)


def table() -> str:
    return "\n".join(["| | |", "|---|--:|", *(f"| {what} | {number} |" for what, number in numbers())])


def draw() -> None:
    """The layers as rows of boxes, imports as lines from the upper to the lower box."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    rows, arrows = layers(), package_arrows()
    width, height = 1.9, 0.5
    figure, ax = plt.subplots(figsize=(9, 8.5), layout="constrained")
    place = {
        name: ((k - (len(row) - 1) / 2) * 2.6, -1.25 * y) for y, row in enumerate(rows) for k, name in enumerate(row)
    }
    for (above, below), count in sorted(arrows.items()):
        if below.startswith("_") and above != "_jax":
            continue  # all may import these two
        (x0, y0), (x1, y1) = place[above], place[below]
        bend = 0.0 if abs(y0 - y1) < 1.5 else (0.12 if x0 <= x1 else -0.12)
        style = {"arrowstyle": "-|>", "connectionstyle": f"arc3,rad={bend}", "shrinkA": 0, "shrinkB": 0}
        far = abs(y0 - y1) > 1.5
        style |= {"color": "0.75" if far else "0.35", "linewidth": 0.6 if far else 0.7 + 0.1 * min(count, 12)}
        ends = {"xy": (x1, y1 + height / 2), "xytext": (x0, y0 - height / 2)}
        ax.annotate("", **ends, arrowprops=style, zorder=1 if far else 2)  # type: ignore[arg-type]
    counts = {name: sum(m.partition(".")[0] == name for m in modules_by_name) for name in place}
    for name, (x, y) in place.items():
        box = plt.Rectangle((x - width / 2, y - height / 2), width, height, zorder=3)
        box.set(facecolor="#fff3d6" if name in ("_core", "_jax") else "#dbe9f6", edgecolor="0.3", linewidth=0.8)
        ax.add_patch(box)
        ax.text(x, y, f"{name}  {counts[name]}", ha="center", va="center", fontsize=10, zorder=4)
    ax.set(xlim=(-5.1, 5.1), ylim=(-1.25 * len(rows) + 0.7, 0.5))
    ax.set_aspect("equal")
    ax.set_axis_off()
    figure.savefig(PICTURE, dpi=130)


def main() -> int:
    begin, _, rest = PAGE.read_text().partition(BEGIN)
    old, _, end = rest.partition(END)
    new = f"\n{table()}\n"
    if "--check" in sys.argv:
        print("docs/architecture.md is up to date" if old == new else f"{new}\nrun python docs/architecture.py")
        return int(old != new)
    PAGE.write_text(begin + BEGIN + new + END + end)
    draw()
    print(table())
    return 0


modules_by_name = modules()

if __name__ == "__main__":
    sys.exit(main())
