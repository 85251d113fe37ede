"""Machine code follows the sources: after an edit of any of them, no kernel of the old ones runs."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import ringdic
from ringdic import compiled

PACKAGE = Path(ringdic.__file__).parent

# One line through one triangle: the kernel of `projection` calls `near`, a kernel of another module.
COUNT_HITS = """import os
import numpy as np
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.projection import Projector
triangle = Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0, 1, 2]]))
hits = Projector(triangle, 1.0).hits(np.array([[0.3, 0.3, 0.1]]), np.array([[0.0, 0.0, 1.0]]))
print(len(hits.face), os.environ["NUMBA_CACHE_DIR"])
"""


def run(code: str, cache: Path, package: Path = PACKAGE, **environment: str) -> list[str]:
    """The words that a program of its own prints; a package of other sources may be imported in it."""
    inherited = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    path = os.pathsep.join([str(package.parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env={**inherited, "PYTHONPATH": path, "XDG_CACHE_HOME": str(cache), **environment},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_an_edit_of_a_called_kernel_in_another_module_changes_the_result(tmp_path: Path) -> None:
    package = tmp_path / "copy" / "ringdic"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    before = run(COUNT_HITS, tmp_path / "cache", package)
    nearest = package / "mesh" / "nearest.py"
    source = nearest.read_text(encoding="utf-8")
    assert source.count("    return count\n") == 1
    nearest.write_text(source.replace("    return count\n", "    return 0\n"), encoding="utf-8")
    after = run(COUNT_HITS, tmp_path / "cache", package)
    assert [before[0], after[0]] == ["1", "0"]
    assert before[1] != after[1]


def test_unchanged_sources_load_what_was_compiled(tmp_path: Path) -> None:
    compiling = f"""from ringdic.correlation.warming import on_compiling
with on_compiling(lambda: print("compiled")):
    exec({COUNT_HITS!r})"""
    assert run(compiling, tmp_path)[0] == "compiled"
    assert run(compiling, tmp_path)[0] == "1"


SHOW_FOLDER = "import os, ringdic; print(os.environ['NUMBA_CACHE_DIR'])"


def test_the_folder_that_the_user_chose_holds_the_folder_of_these_sources(tmp_path: Path) -> None:
    own = run(SHOW_FOLDER, tmp_path / "unused", NUMBA_CACHE_DIR=str(tmp_path / "chosen"))[0]
    assert Path(own).parent == tmp_path / "chosen"
    assert run(SHOW_FOLDER, tmp_path / "unused", NUMBA_CACHE_DIR=own)[0] == own  # as a child process inherits it
    assert not (tmp_path / "unused").exists()


def test_a_numba_that_is_imported_already_is_told(tmp_path: Path) -> None:
    shown = run("import numba, ringdic; print(numba.config.CACHE_DIR)", tmp_path)[0]
    assert Path(shown).parent == tmp_path / "ringdic"


def test_without_a_folder_that_can_be_written_a_temporary_one_serves(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    shown = run(SHOW_FOLDER, tmp_path / "file", TMPDIR=str(tmp_path))[0]
    assert Path(shown).parent.parent == tmp_path
    assert Path(shown).parent.stat().st_mode & 0o077 == 0


def folders(cache: Path) -> set[str]:
    return {path.name for path in (cache / "ringdic").iterdir()}


def test_the_folders_used_longest_ago_are_removed_but_never_one_in_use(tmp_path: Path) -> None:
    old = [tmp_path / "ringdic" / f"kernels-{k:016x}" for k in range(compiled.KEPT + 3)]
    for k, folder in enumerate(old):
        (folder / "mesh_0").mkdir(parents=True)
        os.utime(folder, (k, k))
    for name in ("notes", "kernels-ffffffffffffffff"):  # not ours, and one in which nothing was compiled
        (tmp_path / "ringdic" / name).mkdir()
    in_use = subprocess.Popen(
        [sys.executable, "-P", "-c", f"from ringdic import compiled\nfrom pathlib import Path\n"
         f"compiled._use(Path({str(old[0])!r}))\nprint(flush=True)\ninput()"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert in_use.stdout is not None
        in_use.stdout.readline()
        os.utime(old[0], (0, 0))
        new = Path(run(SHOW_FOLDER, tmp_path)[0])
        newest = {folder.name for folder in old[-compiled.KEPT :]}
        assert folders(tmp_path) == {"notes", new.name, old[0].name} | newest
    finally:
        in_use.communicate("\n", timeout=60)


def test_importing_is_quick_and_loads_neither_numba_nor_numpy(tmp_path: Path) -> None:
    assert run("import sys, ringdic; print({'numba', 'numpy'} & set(sys.modules))", tmp_path) == ["set()"]


@pytest.mark.parametrize("name", ["__pycache__/a.pyc", "notes.md"])
def test_only_sources_count(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.py").write_text("a = 1\n", encoding="utf-8")
    before = compiled.source_digest.__wrapped__(tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"a")
    assert compiled.source_digest.__wrapped__(tmp_path) == before
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert compiled.source_digest.__wrapped__(tmp_path) != before
