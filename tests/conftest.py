"""Fixtures of the whole suite."""

import os
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
