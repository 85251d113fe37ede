"""Benchmark of the correlation of one image pair on this machine, by stage, subset size, order and threads.

Absolute times drift with the machine's load and clock: every figure is the best of several runs, and an earlier result
is compared as a ratio.
"""

from __future__ import annotations

import json
import math
import platform
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask, Pixels
from ringdic.correlation.correlate import PointMatches, correlate_points, load_kernels, on_threads
from ringdic.correlation.grid import grid
from ringdic.correlation.machine import Machine, kernel_cost, measure_machine
from ringdic.correlation.prepared import Current, Reference, prepare_current, prepare_reference
from ringdic.correlation.refinement import refine
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status
from ringdic.errors import InputError
from ringdic.session.images import read_gray, read_mask

Say = Callable[[str], None]

_TOLERANCE = 1e-3  # px, at which the published figures of other programs are taken
_OFFSET = 0.3  # px, error of the start values from which the kernel alone is timed
# The fastest open program on two cores of an x86-64 processor with AVX-512, points/s by (radius, order): OpenCorr of
# August 2026 on the pair 201_1 → 201_2 of the MultiDIC rig, circle, 10 px apart.
PEER = {(16, 1): 27_500.0, (20, 1): 18_700.0, (20, 2): 9_980.0}
_PEER_WHOLE = {(20, 1): 0.80}  # s, on a crop about the region
_FINE, _DOUBLE = 1e-6, 9e-7  # px, tolerances of the finest run in single precision, and of one in double


@dataclass(frozen=True)
class _Pair:
    """An image pair and the points to match: images and mask (height, width), points xy (n, 2) px, grid step px."""

    reference: Image
    current: Image
    mask: Mask
    xy: Pixels
    step: int

    def prepare(self, settings: CorrelationSettings) -> tuple[Reference, Current]:
        """Both images, prepared anew."""
        return prepare_reference(self.reference, self.mask, settings), prepare_current(self.current, None, settings)


def bench_correlation(
    data: Path | None = None,
    *,
    step: int = 10,
    repeats: int = 5,
    interpolation: str = "cubic",
    say: Say = lambda _: None,
) -> dict[str, Any]:
    """Time the correlation of the pair 201_1 → 201_2 of the MultiDIC rig, or of a synthetic speckle pair.

    Parameters
    ----------
    data : folder that holds ``speckle/201_1.jpg``, ``speckle/201_2.jpg`` and ``roi_mask.png``; None for the synthetic
        pair.
    step : px, grid spacing. repeats : runs of which the best counts. interpolation : "cubic" or "quintic".
    say : called with a line of text for every figure.

    Returns
    -------
    result : a JSON object of machine, pair, points, image, interpolation, and

        ``runs``            for each radius, order and number of threads: the points/s of the kernel alone from start
                            values 0.3 px off, and of the refine stage; the seconds prepare, start, refine and whole;
                            the mean iterations and the share of matched points; the kernel's cycles per pixel and
                            iteration, and its share of what the core's arithmetic allows; for the rig's pair also the
                            points/s of another program
        ``stereo``          the pair of two cameras, 201_1 → 202_1; None where its image is missing
        ``double``          largest difference from double precision, px
        ``peak_memory_mb``  of a process that only correlates the pair

    Raises InputError if the images are missing.
    """
    reference, current, mask = _rig_pair(data) if data is not None else synthetic_pair()
    pair = _Pair(reference, current, mask, grid(mask, step)[0], step)
    load_kernels()
    machine = measure_machine()
    runs = list(_runs(pair, machine, interpolation, repeats, peer=data is not None, say=say))
    peak = _peak_memory(pair, CorrelationSettings(20, step, 1, interpolation=interpolation))
    stereo = _stereo(data, pair, interpolation, say) if data is not None else None
    double = _difference(pair, interpolation)
    say(f"largest difference from double precision: {double:.1e} px; peak memory {peak or math.nan:.0f} MB")
    return {
        "machine": _description(machine),
        "pair": "multidic_rig 201_1-201_2" if data is not None else "synthetic",
        "points": len(pair.xy),
        "image": list(reference.shape),
        "interpolation": interpolation,
        "runs": runs,
        "stereo": stereo,
        "double": double,
        "peak_memory_mb": peak,
    }


def _runs(
    pair: _Pair, machine: Machine, interpolation: str, repeats: int, *, peer: bool, say: Say
) -> Iterator[dict[str, Any]]:
    """Figures for each number of threads, radius and order; ``peer`` adds those of another program."""
    for threads in sorted({1, int(numba.config.NUMBA_NUM_THREADS)}):  # type: ignore[attr-defined]
        for radius, order in ((16, 1), (20, 1), (16, 2), (20, 2)):
            settings = CorrelationSettings(radius, pair.step, order, interpolation=interpolation, tolerance=_TOLERANCE)
            run = _measure(pair, settings, threads, repeats)
            run |= _roofline(settings, run, machine)
            if peer:
                run["peer_points_per_second"] = PEER.get((radius, order))
                run["peer_seconds"] = _PEER_WHOLE.get((radius, order))
            say(_line(run))
            yield run


def _description(machine: Machine) -> dict[str, Any]:
    """The processor and what was measured of it."""
    return {
        "processor": platform.processor() or platform.machine(),
        "llvm": _target(),
        "clock_ghz": machine.clock,
        "vector_operations_per_second": machine.operations,
        "memory_bytes_per_second": machine.bandwidth,
        "numba": numba.__version__,
    }


def read_result(path: Path) -> dict[str, Any]:
    """Read an earlier result of the benchmark from the JSON object that it printed.

    Raises InputError if the file cannot be read or holds no such result.
    """
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
    """Ratios of speed, new / old, of the runs that two results have in common: above 1 is faster.

    Each row holds radius, order and threads, and the ratios ``kernel``, ``refine`` and ``whole``. Raises InputError if
    the results have no run in common.
    """
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
    """Draw a speckle image, the same pattern moved and strained by up to 0.8 %, and a mask of a sixth of the image.

    Returns reference and current image (height, width) uint8 grey levels, each with noise of its own, and the mask
    (height, width) bool.
    """
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
    """Reference and current image and mask (height, width) of camera 201 of the MultiDIC rig."""
    reference = read_gray(folder / "speckle" / "201_1.jpg")
    current = read_gray(folder / "speckle" / "201_2.jpg")
    return reference, current, read_mask(folder / "roi_mask.png", (reference.shape[0], reference.shape[1]))


def _measure(pair: _Pair, settings: CorrelationSettings, threads: int, repeats: int) -> dict[str, Any]:
    """Speed of the whole correlation, of its stages, and of the kernel alone from start values 0.3 px off."""
    wholes, results, kernels, cpu = [], [], [], []
    for _ in range(repeats):
        began = time.perf_counter()
        prepared = pair.prepare(settings)
        results.append(correlate_points(*prepared, pair.xy, settings, threads=threads))
        wholes.append(time.perf_counter() - began)
    start, n = _offset_start(results[0]), len(pair.xy)
    with on_threads(threads):
        for _ in range(2 * repeats):
            began, cpu_began = time.perf_counter(), time.process_time()
            iterations = refine(*prepared, pair.xy, start, settings).iterations
            kernels.append(time.perf_counter() - began)
            cpu.append(time.process_time() - cpu_began)
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
    """Cost of a point of the kernel, and how near the kernel comes to what the core can do."""
    cost = kernel_cost(settings, run["iterations"])
    seconds = 1.0 / run["kernel_points_per_cpu_second"]
    return {
        "pixels": cost.pixels,
        "operations_per_point": cost.operations,
        "bytes_per_point": cost.bytes,
        "bound_points_per_second": cost.bound(machine) * run["threads"],
        "share_of_bound": 1.0 / (seconds * cost.bound(machine)),
        "cycles_per_pixel_and_iteration": seconds * machine.clock * 1e9 / (cost.pixels * run["iterations"]),
    }


def _line(run: dict[str, Any]) -> str:
    """The figures of a run in one line of text."""
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


def _stereo(data: Path, pair: _Pair, interpolation: str, say: Say) -> dict[str, Any] | None:
    """Speed between two neighbouring cameras, second order, gradients up to 0.65; None where the image is missing."""
    path = data / "speckle" / "202_1.jpg"
    if not path.is_file():
        return None
    settings = CorrelationSettings(20, pair.step, 2, interpolation=interpolation, tolerance=_TOLERANCE)
    stereo, seconds, cpu, kernel = replace(pair, current=read_gray(path)), [], [], []
    for _ in range(3):
        prepared = stereo.prepare(settings)
        began, cpu_began = time.perf_counter(), time.process_time()
        result = correlate_points(*prepared, pair.xy, settings)
        seconds.append(time.perf_counter() - began)
        cpu.append(time.process_time() - cpu_began)
    start = _offset_start(result)
    for _ in range(3):
        began = time.perf_counter()
        refine(*prepared, pair.xy, start, settings)
        kernel.append(time.perf_counter() - began)
    figures = {
        "matched": int(result.good.sum()),
        "seconds": min(seconds),
        "cpu_seconds": min(cpu),
        "kernel_points_per_second": len(pair.xy) / min(kernel),
        "largest_gradient": float(np.nanpercentile(np.abs(result.gradient), 99.9)),
    }
    say(
        f"201_1 to 202_1, radius 20, order 2: {figures['matched']} of {len(pair.xy)} points in "
        f"{figures['cpu_seconds']:.2f} CPU-s (peer: 8,875 in 10), kernel "
        f"{figures['kernel_points_per_second']:,.0f} points/s"
    )
    return figures


def _difference(pair: _Pair, interpolation: str) -> float:
    """Largest difference between the matches in single and in double precision, of every seventh point, px."""
    xy, displacements = pair.xy[::7], []
    start = None
    for tolerance in (_FINE, _DOUBLE):
        settings = CorrelationSettings(20, pair.step, 1, interpolation=interpolation, tolerance=tolerance)
        prepared = pair.prepare(settings)
        if start is None:
            start = _offset_start(correlate_points(*prepared, xy, settings))
        matches = refine(*prepared, xy, start, settings)
        good = (matches.status == Status.GOOD)[:, None]
        displacements.append(np.where(good, matches.parameters[:, [0, 6]], np.nan))
    return float(np.nanmax(np.abs(displacements[1] - displacements[0])))


def _offset_start(result: PointMatches) -> Floats:
    """Start values (n, 12) of the matched displacements, each 0.3 px off in a random direction, and their gradients."""
    start = np.zeros((len(result.xy), 12))
    angle = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(start))
    uv = np.where(result.good[:, None], result.uv, np.nan)
    start[:, [0, 6]] = uv + _OFFSET * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    start[:, [1, 2, 7, 8]] = result.gradient.reshape(-1, 4)
    return start


def _identity(run: dict[str, Any]) -> tuple[int, int, int]:
    """Radius, order and threads, by which runs of two results are compared."""
    return run["radius"], run["order"], run["threads"]


def _peak_memory(pair: _Pair, settings: CorrelationSettings) -> float | None:
    """Largest resident memory, MB, of a process of its own that correlates the pair; None where it cannot be known."""
    if sys.platform == "win32":
        return None
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as child:
        return child.submit(_peak_of_pair, pair, settings).result()


def _peak_of_pair(pair: _Pair, settings: CorrelationSettings) -> float:
    """Correlate the pair in this process; largest resident memory, MB, so far."""
    correlate_points(*pair.prepare(settings), pair.xy, settings)
    status = Path("/proc/self/status")
    if status.is_file():  # a child's rusage on Linux would begin with its parent's size
        peak = next(line for line in status.read_text(encoding="ascii").splitlines() if line.startswith("VmHWM"))
        return float(peak.split()[1]) / 2**10
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def _target() -> str:
    """Name of the processor for which LLVM compiles."""
    from llvmlite.binding import get_host_cpu_name

    return str(get_host_cpu_name())
