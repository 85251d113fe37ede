"""How much is tried: a little in the suite, and 100 times as much with ``make fuzz`` (RINGDIC_FUZZ=100)."""

import os

import pytest


@pytest.fixture(scope="session")
def scale() -> int:
    """Factor on the number of inputs."""
    return int(os.environ.get("RINGDIC_FUZZ", "1"))


@pytest.fixture(scope="session")
def seed() -> int:
    """Seed of what is tried: RINGDIC_FUZZ_SEED, or always the same."""
    return int(os.environ.get("RINGDIC_FUZZ_SEED", "14"))
