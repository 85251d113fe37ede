"""Files and rooms that the pages name exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_NAMED = re.compile(r"`((?:processing|node_agent|controller|tests|docs|deploy)/[\w./-]+)`")


def test_files_that_pages_name_exist(pages: Path) -> None:
    texts = [*pages.rglob("*.md"), ROOT / "README.md"]
    named = {(page, name) for page in texts for name in _NAMED.findall(page.read_text(encoding="utf-8"))}
    assert named
    missing = [f"{page.name}: {name}" for page, name in sorted(named) if not (ROOT / name).exists()]
    assert not missing, missing


def test_modules_that_pages_name_exist(pages: Path) -> None:
    roots = {"ringdic": "processing", "ringdic_node": "node_agent", "ringdic_controller": "controller"}
    missing = []
    for page in pages.rglob("*.md"):
        for name in re.findall(r"`(ringdic(?:_node|_controller)?(?:\.[a-z_]+)+)`", page.read_text(encoding="utf-8")):
            parts = name.split(".")
            for length in (len(parts), len(parts) - 1):  # a module, or a function of one
                path = ROOT / roots[parts[0]] / Path(*parts[:length])
                if path.is_dir() or path.with_suffix(".py").is_file():
                    break
            else:
                missing.append(f"{page.name}: {name}")
    assert not missing, missing


@pytest.mark.parametrize("heading", ["Storeys and rooms of the library"])
def test_every_room_stands_on_a_storey(pages: Path, heading: str) -> None:
    section = (pages / "architecture.md").read_text(encoding="utf-8").split(f"## {heading}")[1].split("\n## ")[0]
    described = set(re.findall(r"`(\w+)`", section))
    library = ROOT / "processing" / "ringdic"
    rooms = {path.parent.name for path in library.glob("*/__init__.py")}
    modules = {path.stem for path in library.glob("*.py")} - {"__init__", "__main__"}
    assert rooms | modules <= described


def test_functions_that_pages_name_are_in_their_files(pages: Path) -> None:
    library = ROOT / "processing" / "ringdic"
    named = [
        (name, path)
        for page in pages.rglob("*.md")
        for name, path in re.findall(r"`(\w+)` in\s+`([\w/]+\.py)`", page.read_text(encoding="utf-8"))
    ]
    assert named
    for name, path in named:
        source = next((root / path for root in (ROOT, library) if (root / path).is_file()), None)
        assert source is not None, path
        assert re.search(rf"^(?:def |class )?{name}\b", source.read_text(encoding="utf-8"), re.MULTILINE), (name, path)
