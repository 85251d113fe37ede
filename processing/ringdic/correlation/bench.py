"""How fast the correlation is on this machine: one image pair, by stage, subset size, order and threads.

Absolute times drift with the machine's load and clock: every figure is the best of several runs, and an earlier
result is compared as a ratio.
"""

from __future__ import annotations

import json
import math
import platform
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Mask
from ringdic.correlation.correlate import Correlation, correlate_points, load_kernels, on_threads
from ringdic.correlation.grid import grid
from ringdic.correlation.machine import Machine, kernel_cost, measure_machine
from ringdic.correlation.prepared import prepare_current, prepare_reference
from ringdic.correlation.refinement import refine
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status
from ringdic.errors import InputError
from ringdic.session.images import read_gray, read_mask

Image = NDArray[np.uint8]
Say = Callable[[str], None]

_TOLERANCE = 1e-3  # px, at which the published figures of other programs are taken
_OFF = 0.3  # px the start values of the kernel alone are off
# The fastest open program on two cores of an x86-64 processor with AVX-512, points/s by (radius, order): OpenCorr of
# August 2026 on the pair 201_1 → 201_2 of the MultiDIC rig, circle, 10 px apart.
PEER = {(16, 1): 27_500.0, (20, 1): 18_700.0, (20, 2): 9_980.0}
_PEER_WHOLE = {(20, 1): 0.80}  # s, on a crop about the region
_FINE, _DOUBLE = 1e-6, 9e-7  # px, tolerances of the finest run in single precision, and of one in double


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
    mean iterations, the share matched, cycles per pixel and iteration of the kernel, its share of what the core's
    arithmetic allows, and for the rig's pair the peer's points/s; ``stereo``, the pair 201_1 → 202_1 (None without);
    ``double``, the largest difference from double precision, px; and peak_memory_mb of a process that only correlates
    the pair, images in memory. InputError if the
    images are missing.
    """
    reference, current, mask = _rig_pair(data) if data is not None else synthetic_pair()
    xy, _ = grid(mask, step)
    load_kernels()
    machine = measure_machine()
    runs = []
    for threads in sorted({1, int(numba.config.NUMBA_NUM_THREADS)}):  # type: ignore[attr-defined]
        for radius, order in ((16, 1), (20, 1), (16, 2), (20, 2)):
            settings = CorrelationSettings(radius, step, order, interpolation=interpolation, tolerance=_TOLERANCE)
            run = _measure(reference, current, mask, xy, settings, threads, repeats)
            run |= _roofline(settings, run, machine)
            if data is not None:
                run["peer_points_per_second"] = PEER.get((radius, order))
                run["peer_seconds"] = _PEER_WHOLE.get((radius, order))
            say(_told(run))
            runs.append(run)
    peak = _peak_memory(reference, current, mask, xy, CorrelationSettings(20, step, 1, interpolation=interpolation))
    stereo = _stereo(data, reference, mask, xy, step, interpolation) if data is not None else None
    if stereo is not None:
        say(
            f"201_1 to 202_1, radius 20, order 2: {stereo['matched']} of {len(xy)} points in "
            f"{stereo['cpu_seconds']:.2f} CPU-s (peer: 8,875 in 10), kernel "
            f"{stereo['kernel_points_per_second']:,.0f} points/s"
        )
    double = _difference(reference, current, mask, xy, step, interpolation)
    say(f"largest difference from double precision: {double:.1e} px; peak memory {peak or math.nan:.0f} MB")
    return {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "llvm": _target(),
            "clock_ghz": machine.clock,
            "vector_operations_per_second": machine.operations,
            "memory_bytes_per_second": machine.bandwidth,
            "numba": numba.__version__,
        },
        "pair": "multidic_rig 201_1-201_2" if data is not None else "synthetic",
        "points": len(xy),
        "image": list(reference.shape),
        "interpolation": interpolation,
        "runs": runs,
        "stereo": stereo,
        "double": double,
        "peak_memory_mb": peak,
    }


def read_result(path: Path) -> dict[str, Any]:
    """An earlier result of the benchmark, the JSON object it printed. InputError if the file holds none."""
    try:
        result = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except ValueError as error:
        raise InputError(f"{path}: not a JSON file ({error}); give what `ringdic bench --json` printed") from error
    if not isinstance(result, dict) or not any(isinstance(part, dict) for part in result.values()):
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


def synthetic_pair(height: int = 2464, width: int = 3280) -> tuple[Image, Image, Mask]:
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


def _rig_pair(folder: Path) -> tuple[Image, Image, Mask]:
    reference = read_gray(folder / "speckle" / "201_1.jpg")
    current = read_gray(folder / "speckle" / "201_2.jpg")
    return reference, current, read_mask(folder / "roi_mask.png", (reference.shape[0], reference.shape[1]))


def _measure(
    reference: Image, current: Image, mask: Mask, xy: Floats,
    settings: CorrelationSettings, threads: int, repeats: int,
) -> dict[str, Any]:  # fmt: skip
    wholes, results, kernels, cpu = [], [], [], []
    for _ in range(repeats):
        began = time.perf_counter()
        prepared = prepare_reference(reference, mask, settings), prepare_current(current, None, settings)
        results.append(correlate_points(*prepared, xy, settings, threads=threads))
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


def _roofline(settings: CorrelationSettings, run: dict[str, Any], machine: Machine) -> dict[str, float]:
    """What the kernel asks of a core for a point, and how near it comes to what the core can do."""
    asked = kernel_cost(settings, run["iterations"])
    seconds = 1.0 / run["kernel_points_per_cpu_second"]
    return {
        "pixels": asked.pixels,
        "operations_per_point": asked.operations,
        "bytes_per_point": asked.bytes,
        "bound_points_per_second": asked.bound(machine) * run["threads"],
        "share_of_bound": 1.0 / (seconds * asked.bound(machine)),
        "cycles_per_pixel_and_iteration": seconds * machine.clock * 1e9 / (asked.pixels * run["iterations"]),
    }


def _told(run: dict[str, Any]) -> str:
    """One line about a run."""
    peer, peer_seconds = run.get("peer_points_per_second"), run.get("peer_seconds")
    return (
        f"radius {run['radius']}, order {run['order']}, {run['threads']} threads: kernel "
        f"{run['kernel_points_per_second']:,.0f} points/s ({run['kernel_points_per_cpu_second']:,.0f} a CPU-s, "
        f"{run['cycles_per_pixel_and_iteration']:.1f} cycles per pixel and iteration, "
        f"{100 * run['share_of_bound']:.0f} % of the arithmetic's bound), refine stage "
        f"{run['refine_points_per_second']:,.0f}"
        + (f" (peer {peer:,.0f} on 2 threads)" if peer else "")
        + f", whole pair {run['seconds']['whole']:.3f} s"
        + (f" (peer {peer_seconds:.2f})" if peer_seconds else "")
    )


def _stereo(
    data: Path, reference: Image, mask: Mask, xy: Floats, step: int, interpolation: str
) -> dict[str, Any] | None:
    """The neighbouring camera, second order: gradients up to 0.65. None where its image is missing."""
    path = data / "speckle" / "202_1.jpg"
    if not path.is_file():
        return None
    settings = CorrelationSettings(20, step, 2, interpolation=interpolation, tolerance=_TOLERANCE)
    current, seconds, cpu = read_gray(path), [], []
    for _ in range(3):
        prepared = prepare_reference(reference, mask, settings), prepare_current(current, None, settings)
        began, worked = time.perf_counter(), time.process_time()
        result = correlate_points(*prepared, xy, settings)
        seconds.append(time.perf_counter() - began)
        cpu.append(time.process_time() - worked)
    start, kernel = _start_off(result), []
    for _ in range(3):
        began = time.perf_counter()
        refine(*prepared, xy, start, settings)
        kernel.append(time.perf_counter() - began)
    return {
        "matched": int(result.good.sum()),
        "seconds": min(seconds),
        "cpu_seconds": min(cpu),
        "kernel_points_per_second": len(xy) / min(kernel),
        "largest_gradient": float(np.nanpercentile(np.abs(result.gradient), 99.9)),
    }


def _difference(reference: Image, current: Image, mask: Mask, xy: Floats, step: int, interpolation: str) -> float:
    """Largest difference between the matches in single and in double precision, of every seventh point, px."""
    xy, found = xy[::7], []
    start = None
    for tolerance in (_FINE, _DOUBLE):
        settings = CorrelationSettings(20, step, 1, interpolation=interpolation, tolerance=tolerance)
        prepared = prepare_reference(reference, mask, settings), prepare_current(current, None, settings)
        if start is None:
            start = _start_off(correlate_points(*prepared, xy, settings))
        status, _, _, _, parameters = refine(*prepared, xy, start, settings)
        found.append(np.where((status == Status.GOOD)[:, None], parameters[:, [0, 6]], np.nan))
    return float(np.nanmax(np.abs(found[1] - found[0])))


def _start_off(result: Correlation) -> Floats:
    """Start values (n, 12): the displacement found, 0.3 px off in a direction of its own, and its gradient."""
    start = np.zeros((len(result.xy), 12))
    angle = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(start))
    uv = np.where(result.good[:, None], result.uv, np.nan)
    start[:, [0, 6]] = uv + _OFF * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    start[:, [1, 2, 7, 8]] = result.gradient.reshape(-1, 4)
    return start


def _identity(run: dict[str, Any]) -> tuple[int, int, int]:
    return run["radius"], run["order"], run["threads"]


def _peak_memory(
    reference: Image, current: Image, mask: Mask, xy: Floats, settings: CorrelationSettings
) -> float | None:
    """Largest resident set, MB, of a process of its own that correlates the pair; None where the system tells none."""
    if sys.platform == "win32":
        return None
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as child:
        return child.submit(_peak_of_pair, reference, current, mask, xy, settings).result()


def _peak_of_pair(reference: Image, current: Image, mask: Mask, xy: Floats, settings: CorrelationSettings) -> float:
    correlate_points(
        prepare_reference(reference, mask, settings), prepare_current(current, None, settings), xy, settings
    )
    status = Path("/proc/self/status")
    if status.is_file():  # a child's rusage on Linux would begin with its parent's size
        peak = next(line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
        return float(peak.split()[1]) / 2**10
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _target() -> str:
    from llvmlite.binding import get_host_cpu_name

    return str(get_host_cpu_name())
