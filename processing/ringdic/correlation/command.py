"""Correlation of two image files, as ``ringdic correlate`` offers it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Mask
from ringdic.correlation.correlate import Correlation, correlate_points, load_kernels, usable_threads
from ringdic.correlation.grid import grid
from ringdic.correlation.prepared import prepare_current, prepare_reference
from ringdic.correlation.propagation import Progress
from ringdic.correlation.settings import CorrelationSettings
from ringdic.errors import ComputationError, InputError
from ringdic.session.images import read_gray, read_mask


def correlate_files(
    reference: Path,
    current: Path,
    out: Path,
    settings: CorrelationSettings | None = None,
    *,
    mask: Path | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Match one image file in another and write ``points.npz``.

    The file holds xy (n, 2), uv (n, 2), gradient (n, 2, 2), zncc (n,), iterations (n,), status (n,), sigma (n, 2) and
    faces (m, 3). Returns points, good, seconds by stage (prepare, start, refine), points_per_second of the refine
    stage, and threads. InputError for unreadable files, images of different size, a mask without points;
    ComputationError if no point could be matched.
    """
    settings = settings or CorrelationSettings()
    out = Path(out)
    if not out.resolve().parent.is_dir():
        raise InputError(f"{out}: the folder does not exist; make it first")
    if out.is_dir():
        raise InputError(f"{out}: is a folder; give the name of a file, such as {out / 'points.npz'}")
    load_kernels()
    began = time.perf_counter()
    ref, cur = read_gray(reference), read_gray(current)
    if ref.shape != cur.shape:
        raise InputError(
            f"{reference} is {ref.shape[1]} x {ref.shape[0]} px but {current} is {cur.shape[1]} x {cur.shape[0]} px; "
            "the two images must have the same size"
        )
    region = read_mask(mask, ref.shape) if mask is not None else None
    xy, faces = grid(_inner(ref.shape, settings.radius) if region is None else region, settings.step)
    if not len(xy):
        raise InputError(
            f"{mask}: the mask contains no point of the {settings.step} px grid; mark more or choose a smaller step"
            if mask is not None
            else f"{reference}: {ref.shape[1]} x {ref.shape[0]} px leave no point of the {settings.step} px grid whose "
            f"subset of radius {settings.radius} px lies inside; choose a smaller radius or step"
        )
    prepared = prepare_reference(ref, region, settings), prepare_current(cur, None, settings)
    preparing = time.perf_counter() - began
    result = correlate_points(*prepared, xy, settings, threads=threads, progress=progress)
    if not result.good.any():
        raise ComputationError(
            f"{current}: none of the {len(xy)} points of {reference} was found in it; "
            "check that both images show the same surface in focus"
        )
    write_points(out, result, faces)
    seconds = {**result.seconds, "prepare": preparing + result.seconds["prepare"]}
    return {
        "points": len(xy),
        "good": int(result.good.sum()),
        "seconds": seconds,
        "points_per_second": len(xy) / max(seconds["refine"], 1e-9),
        "threads": usable_threads(threads),
    }


def write_points(path: Path, result: Correlation, faces: NDArray[np.int32]) -> None:
    """Write a correlation as ``points.npz``, aside first, so that a half-written file never bears the name."""
    path = Path(path)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            np.savez(
                file,
                xy=result.xy,
                uv=result.uv,
                gradient=result.gradient,
                zncc=result.zncc,
                iterations=result.iterations,
                status=result.status,
                sigma=result.sigma,
                faces=faces,
            )
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _inner(shape: tuple[int, ...], radius: int) -> Mask:
    """The image less the subset radius at its borders. (height, width) bool."""
    mask = np.zeros(shape, bool)
    mask[radius : shape[0] - radius, radius : shape[1] - radius] = True
    return mask
