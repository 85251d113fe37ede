"""The wheel, with the packages of an extra and no others: what it brings works, and what is missing is named."""

import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib.metadata import distribution, packages_distributions
from pathlib import Path

import pytest
import ringdic
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[2]
Installed = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without the page."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(folder),
        str(REPOSITORY),
    ]
    environment = {**os.environ, "RINGDIC_SKIP_PAGE": "1"}
    subprocess.run(command, env=environment, cwd=folder, check=True, timeout=600)
    return next(folder.glob("*.whl"))


def required(requirement: Requirement, known: set[tuple[str, str]]) -> set[str]:
    """Names of the distributions that a requirement needs, itself included; ``known`` holds those seen already."""
    names = {requirement.name}
    for extra in {"", *requirement.extras}:
        if (requirement.name, extra) in known:
            continue
        known.add((requirement.name, extra))
        for text in distribution(requirement.name).requires or []:
            further = Requirement(text)
            if further.marker is None or further.marker.evaluate({"extra": extra}):
                names |= required(further, known)
    return names


@pytest.fixture
def installed(wheel: Path, tmp_path: Path) -> Callable[[str], Installed]:
    """Call it with an extra, or "": a function that runs a module with the wheel and just what the extra requires."""

    def install(extra: str) -> Installed:
        site = tmp_path / "site"
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
            about = archive.read(f"ringdic-{ringdic.__version__}.dist-info/METADATA").decode()
        names, known = {"ringdic"}, set[tuple[str, str]]()
        for text in re.findall(r"^Requires-Dist: (.*)$", about, re.MULTILINE):
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"extra": extra}):
                names |= required(requirement, known)
        wanted = {canonicalize_name(name) for name in names}
        missing = [
            package
            for package, owners in packages_distributions().items()
            if not wanted & {canonicalize_name(owner) for owner in owners} and not package.startswith("ringdic")
        ]
        environment = {**os.environ, "PYTHONPATH": str(site)}

        def run(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
            code = (
                f"import runpy, sys; sys.modules.update(dict.fromkeys({missing})); sys.argv[1:] = {list(arguments)}; "
            )
            return subprocess.run(
                [sys.executable, "-P", "-c", f"{code} runpy.run_module({module!r}, run_name='__main__')"],
                env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
            )  # fmt: skip

        return run

    return install


def test_the_wheel_is_typed_and_has_both_commands(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        about = f"ringdic-{ringdic.__version__}.dist-info"
        entries = archive.read(f"{about}/entry_points.txt").decode()
    assert {f"{package}/py.typed" for package in ("ringdic", "ringdic_node", "ringdic_controller")} <= set(names)
    assert {name.partition("/")[0] for name in names} == {"ringdic", "ringdic_node", "ringdic_controller", about}
    assert "ringdic = ringdic.__main__:main" in entries
    assert "ringdic-node = ringdic_node.cli:main" in entries


def test_a_plain_installation_is_a_node(installed: Callable[[str], Installed]) -> None:
    run = installed("")
    node = run("ringdic_node", "--help")
    assert (node.returncode, node.stderr) == (0, "")
    library = run("ringdic", "process", "session")
    assert (library.returncode, library.stdout) == (2, "")
    assert library.stderr.endswith("install it with: pip install 'ringdic[processing]'\n")
    assert library.stderr.count("\n") == 1


def test_the_extra_processing_is_the_whole_library(installed: Callable[[str], Installed], tmp_path: Path) -> None:
    run = installed("processing")
    every = """import pkgutil, ringdic
from importlib import import_module
for module in pkgutil.walk_packages(ringdic.__path__, "ringdic."):
    if "__main__" not in module.name:
        import_module(module.name)"""
    (tmp_path / "site" / "import_all.py").write_text(every, encoding="utf-8")
    assert run("import_all").stderr == ""
    shown = run("ringdic", "--help")
    assert (shown.returncode, shown.stderr) == (0, "")
    for command in ("import", "process", "correlate", "export", "report", "measure", "overlay", "animate", "strain"):
        assert f" {command} " in shown.stdout
    demo = run("ringdic", "demo")
    assert demo.returncode == 2
    assert demo.stderr.endswith("install it with: pip install 'ringdic[controller]'\n")
