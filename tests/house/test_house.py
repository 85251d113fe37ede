"""The form of the house: sizes, one word for one thing, prose that stands on its own; rules in `docs/sentences.py`."""

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
ROOTS = ("processing/ringdic", "node_agent/ringdic_node", "controller/ringdic_controller")
TOP = {"pyproject.toml", "README.md", "Makefile", "CHANGELOG.md", "LICENSE", "CITATION.cff",
       "node_agent", "controller", "processing", "deploy", "docs", "tests"}  # fmt: skip

# Functions longer than a screen, and why.
LONG = {
    "processing/ringdic/api.py:correlate": "two thirds are its docstring with an example",
    "processing/ringdic/correlation/kernels.py:_refine_point": "one iteration of the kernel, in registers",
    "processing/ringdic/correlation/subset.py:_make_moments": "holds the function below, made for each order",
    "processing/ringdic/correlation/subset.py:sums": "the running sums of first or second order, in registers",
}


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


sentences = load("sentences")
FILES = sentences.sources([REPOSITORY / root for root in ROOTS])


@pytest.fixture(scope="module")
def places() -> list:
    return [place for path in FILES for place in sentences.places(path)]


def relative(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


def test_every_docstring_stands_on_its_own_and_gives_shapes_and_units(places) -> None:
    wrong = [f"{relative(at.path)}:{at.line} {at.name} {fault}" for at in places for fault in sentences.faults(at)]
    assert wrong == []


def test_the_rules_find_what_they_are_for(tmp_path: Path) -> None:
    file = tmp_path / "room.py"
    file.write_text(
        '"""A room."""\n'
        "def lifted(pixels: Pixels) -> Points:\n"
        '    """The same for one camera."""\n'
        "def moved(points: Points) -> Points:\n"
        '    """Positions after the motion. points : (n, 3) mm."""\n'
        "def lost(mask: Mask) -> Points:\n"
        '    """Points that are lost."""\n'
        "def kernel(out, weights):\n"
        '    """Sums of the weights, put into ``out``."""\n'
        "def bare() -> int: ...\n",
        encoding="utf-8",
    )
    faults = {at.name: list(sentences.faults(at)) for at in sentences.places(file)}
    assert faults[""] == faults["moved"] == faults["kernel"] == []
    assert faults["lifted"][0].startswith("leans on another")
    assert faults["lifted"][1:] == ["does not tell of pixels", "gives no shape", "gives no unit"]
    assert faults["lost"] == ["does not tell of mask", "gives no shape", "gives no unit"]
    assert faults["bare"] == ["has no docstring"]


def test_no_two_public_names_are_alike(places) -> None:
    same = {name: [relative(at.path) for at in found] for name, found in sentences.duplicates(places).items()}
    assert same == {}


def test_modules_have_at_most_500_lines_and_the_top_of_the_library_at_most_8_modules() -> None:
    assert [relative(path) for path in FILES if len(path.read_text(encoding="utf-8").splitlines()) > 500] == []
    assert len(list((REPOSITORY / "processing" / "ringdic").glob("*.py"))) <= 8


def test_functions_fit_a_screen_but_for_those_that_say_why() -> None:
    long = {
        f"{relative(path)}:{node.name}"
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno - node.lineno >= 60
    }
    assert long == set(LONG)


def test_types_of_arrays_are_defined_in_one_place() -> None:
    alias = re.compile(r"^(Array|Mask|Indices|Index|Ints|Points|Pixels|Vectors|Floats) = ", re.MULTILINE)
    having = [relative(path) for path in FILES if alias.search(path.read_text(encoding="utf-8"))]
    assert having == ["node_agent/ringdic_node/virtual_rig/arrays.py", "processing/ringdic/arrays.py"]


def test_the_top_of_the_repository_stays_as_it_is() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {line.split("/")[0] for line in listed.stdout.splitlines()}
    assert {name for name in top if not name.startswith(".")} == TOP
