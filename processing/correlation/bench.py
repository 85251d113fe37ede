"""How fast the correlation is on this machine: one image pair, by stage, subset size, order and threads.

Absolute times drift with the machine's load and clock: every figure is the best of several runs, and an earlier
result is compared as a ratio.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from processing.correlation.correlate import Correlation, correlate, load_kernels, on_threads
from processing.correlation.grid import grid
from processing.correlation.prepared import prepare_current, prepare_reference
from processing.correlation.propagation import refine
from processing.correlation.settings import CorrelationSettings
from processing.errors import InputError
from processing.images import read_gray, read_mask

Image = NDArray[np.uint8]
Say = Callable[[str], None]

_TOLERANCE = 1e-3  # px, at which the published figures of other programs are taken
_OFF = 0.3  # px the start values of the kernel alone are off


def bench_correlation(
    data: Path | None = None,
    *,
    step: int = 10,
    repeats: int = 5,
    interpolation: str = "cubic",
    say: Say = lambda _: None,
) -> dict[str, Any]:
    """Figures of the correlation on the pair 201_1 → 201_2 of the MultiDIC rig, or on a synthetic speckle pair.

    data : the folder that holds ``speckle/201_1.jpg``, ``speckle/201_2.jpg`` and ``roi_mask.png``. Returns machine,
    pair, points and ``runs``: for each radius, order and number of threads the points/s of the kernel alone from
    start values 0.3 px off, those of the refine stage, the seconds prepare, start, refine and whole (in memory), the
    mean iterations, and the share matched; and peak_memory_mb of the process. InputError if the images are missing.
    """
    reference, current, mask = _rig_pair(data) if data is not None else synthetic_pair()
    xy, _ = grid(mask, step)
    load_kernels()
    runs = []
    for threads in sorted({1, int(numba.config.NUMBA_NUM_THREADS)}):  # type: ignore[attr-defined]
        for radius, order in ((16, 1), (20, 1), (16, 2), (20, 2)):
            settings = CorrelationSettings(radius, step, order, interpolation=interpolation, tolerance=_TOLERANCE)
            run = _measure(reference, current, mask, xy, settings, threads, repeats)
            say(
                f"radius {radius}, order {order}, {threads} threads: {run['kernel_points_per_second']:,.0f} points/s, "
                f"whole pair {run['seconds']['whole']:.3f} s"
            )
            runs.append(run)
    return {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "llvm": _target(),
            "numba": numba.__version__,
        },
        "pair": "multidic_rig 201_1-201_2" if data is not None else "synthetic",
        "points": len(xy),
        "image": list(reference.shape),
        "interpolation": interpolation,
        "runs": runs,
        "peak_memory_mb": _peak_memory(),
    }


def read_result(path: Path) -> dict[str, Any]:
    """An earlier result of the benchmark, the JSON object it printed. InputError if the file holds none."""
    try:
        result = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except ValueError as error:
        raise InputError(f"{path}: not a JSON file ({error}); give what `ringdic bench --json` printed") from error
    if not isinstance(result, dict) or not isinstance(result.get("correlation"), dict):
        raise InputError(f"{path}: not a result of the benchmark; give what `ringdic bench --json` printed")
    return result


def ratios(new: dict[str, Any], old: dict[str, Any]) -> list[dict[str, Any]]:
    """Ratios new / old of the runs that both results hold: above 1 is faster. InputError if they share none."""
    before = {_identity(run): run for run in old["correlation"].get("runs", [])}
    rows = [
        {
            **{name: run[name] for name in ("radius", "order", "threads")},
            "kernel": run["kernel_points_per_second"] / before[_identity(run)]["kernel_points_per_second"],
            "refine": run["refine_points_per_second"] / before[_identity(run)]["refine_points_per_second"],
            "whole": before[_identity(run)]["seconds"]["whole"] / run["seconds"]["whole"],
        }
        for run in new["correlation"]["runs"]
        if _identity(run) in before
    ]
    if not rows:
        raise InputError("the two results have no run in common; compare results of the same command")
    return rows


def synthetic_pair(height: int = 2464, width: int = 3280) -> tuple[Image, Image, NDArray[np.bool_]]:
    """Speckle, the same moved and strained by a few per cent, and a region of about a sixth of the image."""
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(size=(height, width)).astype(np.float32), (0, 0), 2.0)
    speckle = 128.0 + 45.0 * noise / float(noise.std())
    warp = np.array([[1.004, 0.006, -4.3], [-0.003, 0.992, 6.8]])
    moved = cv2.warpAffine(speckle, warp, (width, height), flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101)
    mask = np.zeros((height, width), bool)
    mask[height // 10 : height - height // 10, 2 * width // 5 : 3 * width // 5] = True

    def camera(image: NDArray) -> Image:
        return np.clip(np.rint(image + rng.normal(0.0, 1.5, image.shape)), 0, 255).astype(np.uint8)

    return camera(speckle), camera(np.asarray(moved)), mask


def _rig_pair(folder: Path) -> tuple[Image, Image, NDArray[np.bool_]]:
    reference = read_gray(folder / "speckle" / "201_1.jpg")
    current = read_gray(folder / "speckle" / "201_2.jpg")
    return reference, current, read_mask(folder / "roi_mask.png", (reference.shape[0], reference.shape[1]))


def _measure(
    reference: Image, current: Image, mask: NDArray[np.bool_], xy: NDArray[np.float64],
    settings: CorrelationSettings, threads: int, repeats: int,
) -> dict[str, Any]:  # fmt: skip
    wholes, results, kernels, cpu = [], [], [], []
    for _ in range(repeats):
        began = time.perf_counter()
        prepared = prepare_reference(reference, mask, settings), prepare_current(current, None, settings)
        results.append(correlate(*prepared, xy, settings, threads=threads))
        wholes.append(time.perf_counter() - began)
    start, n = _start_off(results[0]), len(xy)
    with on_threads(threads):
        for _ in range(2 * repeats):
            began, worked = time.perf_counter(), time.process_time()
            _, _, iterations, _, _ = refine(*prepared, xy, start, settings)
            kernels.append(time.perf_counter() - began)
            cpu.append(time.process_time() - worked)
    stages = {name: min(r.seconds[name] for r in results) for name in ("prepare", "start", "refine")}
    return {
        "radius": settings.radius,
        "order": settings.order,
        "threads": threads,
        "kernel_points_per_second": n / min(kernels),
        "kernel_points_per_cpu_second": n / min(cpu),  # what a core does when other programs leave it alone
        "refine_points_per_second": n / stages["refine"],
        "seconds": {**stages, "whole": min(wholes)},
        "iterations": float(iterations.mean()),
        "matched": float(results[0].good.mean()),
    }


def _start_off(result: Correlation) -> NDArray[np.float64]:
    """Start values (n, 12): the displacement found, 0.3 px off in a direction of its own, and its gradient."""
    start = np.zeros((len(result.xy), 12))
    angle = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(start))
    start[:, [0, 6]] = result.uv + _OFF * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    start[:, [1, 2, 7, 8]] = result.gradient.reshape(-1, 4)
    return start


def _identity(run: dict[str, Any]) -> tuple[int, int, int]:
    return run["radius"], run["order"], run["threads"]


def _peak_memory() -> float | None:
    """Largest resident set of this process so far, MB; None where the system does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _target() -> str:
    from llvmlite.binding import get_host_cpu_name

    return str(get_host_cpu_name())
