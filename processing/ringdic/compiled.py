"""The folder in which numba keeps the compiled kernels, named by the contents of all sources of the library.

numba looks only at the file of a compiled function when it decides whether its machine code on disk is still valid.
A kernel contains the kernels that it calls, also those of other modules; after one of these was edited or updated,
the old machine code would still be loaded. Hence each state of the sources has a cache folder of its own:

``CACHE/kernels-<first 16 digits of the sources' SHA-256>``, where ``CACHE`` is the environment's ``NUMBA_CACHE_DIR``
or, without it, a folder ``ringdic`` in the user's cache directory. Folders used longest ago are removed, unless a
running process uses them. Inside the folder, numba itself separates processors and versions of numba.

The module needs the standard library only and is called when :mod:`ringdic` is imported.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sys
from functools import cache
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows, which does not remove a file that is open
    fcntl = None  # type: ignore[assignment]

KEPT = 8  # folders; one takes about 15 MB
_PACKAGE = Path(__file__).resolve().parent
_VARIABLE = "NUMBA_CACHE_DIR"
_NAME = re.compile(r"kernels-[0-9a-f]{16}")
_IN_USE = "in-use"  # a file that every process holds open, and locked, until it ends


@cache
def source_digest(package: Path = _PACKAGE) -> str:
    """SHA-256 of all Python sources below a folder, by relative path and content, as 64 hexadecimal digits.

    The library's own digest is computed at import: a file that is edited later does not change it.
    """
    paths = [Path(folder, name) for folder, _, names in os.walk(package) for name in names if name.endswith(".py")]
    digest = hashlib.sha256()
    for path in sorted(paths):
        source = path.read_bytes()
        digest.update(f"{path.relative_to(package).as_posix()} {len(source)}\n".encode())
        digest.update(source)
    return digest.hexdigest()


def choose_cache_folder() -> None:
    """Set numba's cache folder to the one of these sources, for this process and those that it starts.

    To be called before a kernel is imported. Where the folder cannot be written, a temporary one of the user is taken.
    """
    name = f"kernels-{source_digest()[:16]}"
    for parent in (_cache_folder, _temporary_folder):
        with contextlib.suppress(OSError, RuntimeError):  # not writable; no home directory
            folder = parent() / name
            _use(folder)
            os.environ[_VARIABLE] = str(folder)
            numba = sys.modules.get("numba")
            if numba is not None:  # it has read its environment already
                numba.config.CACHE_DIR = str(folder)
            return


def _cache_folder() -> Path:
    """Parent of all cache folders: the environment's ``NUMBA_CACHE_DIR`` or a folder in the user's cache directory."""
    chosen = os.environ.get(_VARIABLE)
    if chosen:
        path = Path(chosen).absolute()
        return path.parent if _NAME.fullmatch(path.name) else path  # as a parent process has set it
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base).absolute() / "ringdic"


def _temporary_folder() -> Path:
    """A folder for temporary files that only this user can write to: machine code is loaded from it."""
    import tempfile  # hardly ever needed, and slow to import

    if not hasattr(os, "getuid"):
        return Path(tempfile.gettempdir()) / "ringdic"
    folder = Path(tempfile.gettempdir()) / f"ringdic-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    state = folder.lstat()
    if folder.is_symlink() or state.st_uid != os.getuid() or state.st_mode & 0o022:
        return Path(tempfile.mkdtemp(prefix="ringdic-"))
    return folder


def _use(folder: Path) -> None:
    """Create the folder if missing, and mark it as in use until this process ends; OSError where it is not writable."""
    is_new = not folder.is_dir()
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            mark = os.open(folder / _IN_USE, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another process has just removed the folder
            continue
        if fcntl is None:
            break
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(mark, fcntl.LOCK_SH)
        if os.fstat(mark).st_nlink:
            break
        os.close(mark)  # the folder was removed in between
    os.utime(folder)
    if is_new:
        _remove_old(folder.parent)


def _remove_old(parent: Path) -> None:
    """Remove folders that no process uses: those without kernels, and all but the ``KEPT`` that were used last."""
    with contextlib.suppress(OSError):  # another process removes them too
        folders = [path for path in parent.iterdir() if _NAME.fullmatch(path.name)]
        filled = [path for path in folders if any(entry.name != _IN_USE for entry in path.iterdir())]
        newest = sorted(filled, key=lambda path: path.stat().st_mtime)[-KEPT:]
        for folder in folders:
            if folder not in newest:
                _remove(folder)


def _remove(folder: Path) -> None:
    """Remove a folder unless a process uses it: then its mark can be neither locked nor, on Windows, removed."""
    from shutil import rmtree  # hardly ever needed, and slow to import

    with contextlib.suppress(OSError):
        if fcntl is None:
            (folder / _IN_USE).unlink(missing_ok=True)
            rmtree(folder)
            return
        with (folder / _IN_USE).open("ab") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            rmtree(folder)
