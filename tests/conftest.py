"""Fixtures of the whole suite."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest


def _skip_or_fail(reason: str) -> None:
    """Skip with a clear reason; where everything is required (CI), fail with it."""
    if os.environ.get("RINGDIC_REQUIRE_DATA"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of shared reference data: ``shared/data`` beside the checkout, or RINGDIC_SHARED_DATA."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("RINGDIC_SHARED_DATA", default))
    if not (path / "multidic_rig" / "reference.npz").is_file():
        _skip_or_fail(f"SKIPPED FOR WANT OF DATA: no shared reference data at {path}")
    return path


_FIGURES = pytest.StashKey[list[tuple[str, str, str]]]()


@pytest.fixture(scope="session")
def figures(request: pytest.FixtureRequest) -> Callable[[str, str, str], None]:
    """Call it with what was measured, the figure and its bound: the table at the end of the run shows it."""
    kept = request.config.stash.setdefault(_FIGURES, [])

    def report(what: str, figure: str, bound: str) -> None:
        kept.append((what, figure, bound))

    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The figures that tests measured, beside their bounds."""
    rows = config.stash.get(_FIGURES, [])
    if rows:
        terminalreporter.section("figures measured")
        for what, figure, bound in rows:
            terminalreporter.write_line(f"{what:<62} {figure:>24}   {bound}")
