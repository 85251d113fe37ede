"""Fixtures of the whole suite."""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import pytest
from playwright.sync_api import Browser, sync_playwright
from ringdic.session.records import read_capture_record

# As in a command: the matrices are small, and more threads would only wait. Read when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _skip_or_fail(reason: str) -> NoReturn:
    """Skip with a clear reason; where everything is required (CI), fail with it."""
    if os.environ.get("RINGDIC_REQUIRE_DATA"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def skip_or_fail() -> Callable[[str], NoReturn]:
    """Call it with what is wanting: the test is skipped; where everything is required (CI), it fails."""
    return _skip_or_fail


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of shared reference data: ``shared/data`` beside the checkout, or RINGDIC_SHARED_DATA."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("RINGDIC_SHARED_DATA", default))
    if not (path / "multidic_rig" / "reference.npz").is_file():
        _skip_or_fail(f"SKIPPED FOR WANT OF DATA: no shared reference data at {path}")
    return path


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """The folder of small inputs with known answers: ``shared/cases`` beside the checkout, or RINGDIC_SHARED_CASES.

    Where only the folder of reference data is named, the one beside that.
    """
    default = Path(__file__).resolve().parents[2] / "shared" / "cases"
    if "RINGDIC_SHARED_DATA" in os.environ:
        default = Path(os.environ["RINGDIC_SHARED_DATA"]).parent / "cases"
    path = Path(os.environ.get("RINGDIC_SHARED_CASES", default))
    if not (path / "README.md").is_file():
        _skip_or_fail(f"SKIPPED FOR WANT OF DATA: no shared cases at {path}")
    return path


_TARGET_AND_BOARD = """
[target]
kind = "dot-cylinder"
radius_mm = 57.0
rows = 20
row_spacing_mm = 12.0
first_row_z_mm = 10.0
columns = 14
column_spacing_mm = 12.0
dot_size_mm = 4.0
[board]
kind = "checkerboard"
squares = [15, 20]
square_mm = 10.0
"""


@pytest.fixture(scope="session")
def rig_toml() -> Callable[[str, Sequence[str]], str]:
    """Call it with a rig's name and its cameras' ids, evenly spread round the ring: the text of a whole rig.toml.

    It ends with the cameras; a further table may be written behind it.
    """

    def text(name: str, cameras: Sequence[str]) -> str:
        entries = (
            f'[[cameras]]\nid = "{camera}"\nazimuth_deg = {360.0 * i / len(cameras)}\n'
            for i, camera in enumerate(cameras)
        )
        return f'[rig]\nname = "{name}"{_TARGET_AND_BOARD}' + "".join(entries)

    return text


@pytest.fixture(scope="session")
def differing_images() -> Callable[[Path], list[str]]:
    """Call it with a session folder: the files of its captures that differ from the records, or are in one alone."""

    def differing(session: Path) -> list[str]:
        faults = []
        for path in sorted(session.glob("captures/*/capture.json")):
            cameras = read_capture_record(path).cameras.values()
            recorded = {(entry.file, entry.sha256) for entry in cameras if entry.file is not None}
            images = [image for image in path.parent.iterdir() if image.name != path.name]
            found = {(image.name, hashlib.sha256(image.read_bytes()).hexdigest()) for image in images}
            faults += [f"{path.parent.name}/{name}" for name, _ in sorted(recorded ^ found)]
        return faults

    return differing


@pytest.fixture(scope="session")
def chromium() -> dict[str, Any]:
    """How Chromium is launched: the one on the path, or RINGDIC_CHROMIUM; it asks nobody on the network."""
    path = os.environ.get("RINGDIC_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        _skip_or_fail("SKIPPED FOR WANT OF A BROWSER: install the package 'chromium'")
    arguments = [
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        arguments.append("--no-sandbox")  # root's Chromium has none
    return {"executable_path": path, "args": arguments, "timeout": 60_000}


@pytest.fixture(scope="module")
def browser(chromium: dict[str, Any]) -> Iterator[Browser]:
    """A running Chromium. It ends with the module: Playwright's event loop holds the thread of the tests."""
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(**chromium)
        yield launched
        launched.close()


_FIGURES = pytest.StashKey[list[tuple[str, str, str]]]()


@pytest.fixture(scope="session")
def figures(request: pytest.FixtureRequest) -> Callable[[str, str, str], None]:
    """Call it with what was measured, the figure and its bound: the table at the end of the run shows it."""
    kept = request.config.stash.setdefault(_FIGURES, [])

    def report(what: str, figure: str, bound: str) -> None:
        kept.append((what, figure, bound))

    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """A worker of several hands its figures on."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["figures"] = session.config.stash.get(_FIGURES, [])


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Take over the figures of a worker that ends."""
    node.config.stash.setdefault(_FIGURES, []).extend(getattr(node, "workeroutput", {}).get("figures", []))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The figures that tests measured, beside their bounds."""
    rows = config.stash.get(_FIGURES, [])
    if rows:
        terminalreporter.section("figures measured")
        for what, figure, bound in rows:
            terminalreporter.write_line(f"{what:<62} {figure:>24}   {bound}")
