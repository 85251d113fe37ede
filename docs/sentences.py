"""Every first sentence of the code in one list, and what the docstrings of public names lack.

``python docs/sentences.py [FOLDER ...]`` prints a line for each module and each public class, function and method:
where it is and the first sentence of its docstring. ``--check`` prints what breaks the rules of `faults` instead.
Without folders, all three source roots are read.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOTS = ("processing", "node_agent", "controller")
LEANING = re.compile(r"(The same|See|As)\b")
ARRAYS = re.compile(r"\b(Floats|Points|Vectors|Pixels|Mask|Indices|Image|Radiance|NDArray)\b")
SHAPE = re.compile(r"\((\.\.\.|\w+|[0-9]+ ?[A-Za-z]+)( ?[-+*/×] ?\w+)*,[^()]*\)")
UNIT = re.compile(
    r"mm|\bpx\b|\brad\b|degrees|µm|\bns\b|\bseconds\b|[Gg]rey level|no unit|\bbool|\bint|ind(ex|ices)|stretch|strain|"
    r"\bsRGB\b|\bshare|\bnumber|\bunit\b|\bones? for\b|0 \.\.\. |0 to \d|\bC_LS\b|ZNCC|status"
)
Named = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Place:
    """A module (``name`` empty), or a class, function or method in it, with its docstring, "" where there is none."""

    path: Path
    line: int
    name: str
    text: str
    node: ast.Module | Named

    @property
    def public(self) -> bool:
        """Whether no part of the name begins with an underscore."""
        return not any(part.startswith("_") for part in self.name.split("."))

    @property
    def first_sentence(self) -> str:
        """The docstring to its first full stop, on one line."""
        paragraph = " ".join(self.text.split("\n\n")[0].split())
        return re.split(r"(?<=[.!?]) (?=[A-Z`\"])", paragraph)[0]


def places(path: Path) -> Iterator[Place]:
    """The module of a file and all classes, functions and methods in it, but for those inside functions."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    yield Place(path, 1, "", ast.get_docstring(tree) or "", tree)
    waiting: list[tuple[str, ast.Module | ast.ClassDef]] = [("", tree)]
    while waiting:
        prefix, parent = waiting.pop(0)
        for node in parent.body:
            if isinstance(node, Named):
                name = prefix + node.name
                yield Place(path, node.lineno, name, ast.get_docstring(node) or "", node)
                if isinstance(node, ast.ClassDef):
                    waiting.append((f"{name}.", node))


def sources(folders: list[Path]) -> list[Path]:
    """The Python files below some folders, in order."""
    return sorted({path for folder in folders for path in ([folder] if folder.is_file() else folder.rglob("*.py"))})


def faults(place: Place) -> Iterator[str]:
    """What is wrong with a docstring, a phrase for each fault.

    A docstring stands on its own: it never begins by leaning on another. Every public name has one. Where arrays
    come in, go out or are fields, it names each of them and gives shapes and units; a compiled kernel, which has no
    annotations, names all its parameters.
    """
    if LEANING.match(place.text):
        yield f"leans on another: {place.first_sentence!r}"
    if not place.public:
        return
    if not place.text:
        yield "has no docstring"
        return
    arrays = list(_arrays(place.node))
    missing = [name for name in arrays if name != "return" and not re.search(rf"(?<!\w){name}(?!\w)", place.text)]
    if missing:
        yield f"does not tell of {', '.join(missing)}"
    if _annotated(place.node) and arrays and not SHAPE.search(place.text):
        yield "gives no shape"
    if _annotated(place.node) and arrays and not UNIT.search(place.text):
        yield "gives no unit"


def _arrays(node: ast.Module | Named) -> Iterator[str]:
    """Names of the parameters or fields that hold arrays, and "return"; all parameters where none is annotated."""
    if isinstance(node, ast.ClassDef):
        for field in node.body:
            named = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            if named and ARRAYS.search(ast.unparse(field.annotation)) and not field.target.id.startswith("_"):
                yield field.target.id
        return
    if isinstance(node, ast.Module):
        return
    for argument in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]:
        if argument.arg in ("self", "cls", "typingctx"):
            continue
        if not _annotated(node) or (
            argument.annotation is not None and ARRAYS.search(ast.unparse(argument.annotation))
        ):
            yield argument.arg
    if node.returns is not None and ARRAYS.search(ast.unparse(node.returns)):
        yield "return"


def _annotated(node: ast.Module | Named) -> bool:
    """Whether types are written down: of everything but compiled kernels."""
    if isinstance(node, ast.Module | ast.ClassDef):
        return True
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return node.returns is not None or any(argument.annotation for argument in arguments)


def duplicates(all_places: list[Place]) -> dict[str, list[Place]]:
    """Public classes and functions of modules that share their name with another, by name.

    ``main``, the entry of a command, may stand in several modules.
    """
    by_name: dict[str, list[Place]] = defaultdict(list)
    for place in all_places:
        if place.name not in ("", "main") and "." not in place.name and place.public:
            by_name[place.name].append(place)
    return {name: found for name, found in by_name.items() if len(found) > 1}


def main() -> int:
    """Print the sentences, or what is wrong; 1 if anything is."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--check", action="store_true", help="print what breaks the rules")
    options = parser.parse_args()
    root = Path(__file__).resolve().parents[1]
    files = sources(options.folders or [root / name for name in ROOTS])
    found = [place for path in files for place in places(path)]
    if not options.check:
        for place in found:
            if place.public:
                sys.stdout.write(
                    f"{place.path.relative_to(root) if place.path.is_absolute() else place.path}"
                    f":{place.line} {place.name}\n    {place.first_sentence}\n"
                )
        return 0
    wrong = [f"{place.path}:{place.line} {place.name} {fault}" for place in found for fault in faults(place)]
    for name, same in duplicates(found).items():
        wrong.append(f"{name} means several things: {', '.join(f'{at.path}:{at.line}' for at in same)}")
    sys.stdout.write("".join(f"{line}\n" for line in wrong) + f"{len(wrong)} faults\n")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
