"""After the warm-up a job finds every kernel that follows its matching compiled."""

import importlib
from pathlib import Path

from numba.core.dispatcher import Dispatcher
from ringdic.jobs.pipeline import process_session
from ringdic.jobs.warm_up import run_small_plate
from ringdic.settings import load_settings

MODULES = (
    "mesh.adjacency", "mesh.kernels", "mesh.nearest", "mesh.projection", "geometry.lens", "geometry.kernels",
    "merging.kernels", "merging.mismatch", "merging.stars", "results.ranges", "strain.kernels",
)  # fmt: skip


def compiled() -> set[tuple[str, str]]:
    """Every kernel of these modules with the types that it was compiled or loaded for."""
    return {
        (f"{name}.{kernel}", str(types))
        for name in MODULES
        for kernel, value in vars(importlib.import_module(f"ringdic.{name}")).items()
        if isinstance(value, Dispatcher)
        for types in value.signatures
    }


def test_a_job_needs_no_kernel_that_the_warm_up_left_out(session: Path) -> None:
    run_small_plate()
    before = compiled()
    assert any(name == "merging.stars.stars" for name, _ in before)
    process_session(session, load_settings(None, ["correlation.radius_px=12", "correlation.step_px=8"]))
    assert sorted(compiled() - before) == []
