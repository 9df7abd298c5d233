"""Completeness: every public name is documented, in the README, in the tables; importing stays light."""

import importlib
import importlib.util
import inspect
import pathlib
import re
import subprocess
import sys
import tomllib

import cases
import pytest

import jeuler
import jeuler.plotting

ROOT = pathlib.Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "jeuler"


@pytest.mark.parametrize("name", jeuler.__all__)
def test_public_name_has_a_full_docstring(name):
    doc = inspect.getdoc(getattr(jeuler, name))
    assert doc
    assert doc.splitlines()[0].endswith((".", ":"))
    gives_back = "Attributes:" in doc  # a class of results, which nobody makes
    for section in ("Example:", ">>>") if gives_back else ("Args:", "Example:", ">>>"):
        assert section in doc, section
    for section in ("Raises:", "Source:"):  # where there is something to say, and never to say that there is nothing
        assert not re.search(rf"{section}\s*(nothing|none|\.|$)", doc, flags=re.MULTILINE | re.IGNORECASE)
    assert "Returns:" in doc or not inspect.isfunction(getattr(jeuler, name))


@pytest.mark.parametrize("name", jeuler.plotting.__all__)
def test_figure_has_a_docstring_with_an_example(name):
    doc = inspect.getdoc(getattr(jeuler.plotting, name))
    for section in ("Args:", "Example:", ">>>"):
        assert section in doc, section
    if name in jeuler.plotting.teaching.__all__:  # they explain a formula
        assert re.search(r"\n\n {4}.*[=:].*\n", doc)
        assert "Raises:" in doc
        assert "Source:" in doc


@pytest.mark.parametrize("name", jeuler.__all__)
def test_public_name_has_a_line_in_the_readme(name):
    table = re.findall(r"^\| `(\w+)", (ROOT / "README.md").read_text(), flags=re.MULTILINE)
    assert name in table


def test_every_step_has_a_row():
    steps = {name for name in jeuler.__all__ if hasattr(getattr(jeuler, name), "increment")}
    assert steps == {method.step.__name__ for method in cases.METHODS.values()}


@pytest.mark.parametrize("package", ["forces", "effects", "contact", "samplers"])
def test_every_force_effect_sampler_and_collider_has_a_row(package):
    rows = [make() for make in cases.FORCES.values()] + [row.make() for row in cases.EFFECTS.values()]
    module = importlib.import_module(f"jeuler.{package}")
    public = {name for name in jeuler.__all__ if inspect.isclass(getattr(jeuler, name)) and hasattr(module, name)}
    public = {name for name in public if getattr(jeuler, name).__module__.startswith(f"jeuler.{package}")}
    assert len(public) >= 3
    assert public <= set().union(*map(cases.kinds_in, rows))


def test_public_names_are_sorted_and_exist():
    assert sorted(jeuler.__all__) == jeuler.__all__
    assert jeuler.__version__


def test_the_package_shows_its_public_names_and_its_namespaces():
    packages = [
        "accuracy",
        "contact",
        "diagnosis",
        "effects",
        "fitting",
        "forces",
        "meshes",
        "observing",
        "plotting",
        "samplers",
        "scenes",
        "steps",
    ]
    shown = [name for name in dir(jeuler) if not name.startswith("_")]
    assert shown == sorted({*jeuler.__all__, *packages})
    assert all(inspect.ismodule(getattr(jeuler, name)) for name in packages)


def test_import_brings_jax_and_nothing_heavier():
    heavy = "['diffrax', 'equinox', 'optax', 'optimistix', 'lineax', 'matplotlib', 'scipy.signal', 'tqdm']"
    code = (
        "import sys, jax; before = set(sys.modules); import jeuler; "
        f"print([m for m in {heavy} if m in sys.modules and m not in before])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "package", ["forces", "effects", "contact", "samplers", "steps", "fitting", "accuracy", "solving"]
)
def test_a_namespace_shows_just_its_public_names(package):
    module = importlib.import_module(f"jeuler.{package}")
    assert dir(module) == sorted(module.__all__)
    assert all(hasattr(module, name) for name in module.__all__)


@pytest.mark.parametrize("package", ["forces", "effects", "contact", "samplers", "steps"])
def test_a_catalogue_is_an_attribute_of_the_package_and_its_names_are_public(package):
    module = getattr(jeuler, package)
    assert inspect.ismodule(module)
    assert set(module.__all__) <= set(jeuler.__all__)
    assert all(getattr(module, name) is getattr(jeuler, name) for name in module.__all__)


def modules():
    names = [path.relative_to(SOURCE).with_suffix("").parts for path in SOURCE.rglob("*.py")]
    return [parts[:-1] if parts[-1] == "__init__" else parts for parts in names]


def test_no_module_shares_its_name_with_a_public_function():
    functions = {name for name in jeuler.__all__ if callable(getattr(jeuler, name))} | set(jeuler.plotting.__all__)
    assert not functions & {parts[-1] for parts in modules() if parts}
    assert callable(jeuler.solve)
    assert importlib.util.find_spec("jeuler.solve") is None


def test_two_files_stand_at_the_top_of_the_package():
    assert sorted(path.name for path in SOURCE.glob("*.py")) == ["__init__.py", "__main__.py"]


def test_the_version_is_the_same_everywhere():
    written = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert jeuler.__version__ == written
    assert f"\nversion: {written}\n" in (ROOT / "CITATION.cff").read_text()
    assert (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1].startswith(f"{written} (")
