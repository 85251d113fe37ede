"""Correlation of two whole images on a grid of points, from arrays or from files."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Mask
from ringdic.correlation.correlate import PointMatches, correlate_points, load_kernels, usable_threads
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
) -> dict[str, Any]:
    """Match one image file in another and write ``points.npz``; returns the summary of ``ringdic correlate --json``.

    Parameters
    ----------
    reference, current : image files of one size.
    out : the file to write, see :func:`write_points`.
    settings : subset, grid and tolerances; the defaults unless given.
    mask : an image file of the reference's size; its pixels above 0 are the region of interest.
    threads : cores to use; all unless given.

    Returns
    -------
    Numbers of points and of good points, seconds by stage (prepare, start, refine), points_per_second of the refine
    stage, and threads.

    Raises
    ------
    InputError : an unreadable file, images of different size, a mask without points, no folder to write into.
    ComputationError : no point could be matched.
    """
    settings = settings or CorrelationSettings()
    out = Path(out)
    if not out.resolve().parent.is_dir():
        raise InputError(f"{out}: the folder does not exist; make it first")
    if out.is_dir():
        raise InputError(f"{out}: is a folder; give the name of a file, such as {out / 'points.npz'}")
    load_kernels()
    began = time.perf_counter()
    images = read_gray(reference), read_gray(current)
    region = None if mask is None else read_mask(mask, (images[0].shape[0], images[0].shape[1]))
    reading = time.perf_counter() - began
    names = str(reference), str(current), str(mask)
    matches, faces = correlate_images(*images, region, settings, threads=threads, names=names)
    write_points(out, matches, faces)
    seconds = {**matches.seconds, "prepare": reading + matches.seconds["prepare"]}
    return {
        "points": len(matches.xy),
        "good": int(matches.good.sum()),
        "seconds": seconds,
        "points_per_second": len(matches.xy) / max(seconds["refine"], 1e-9),
        "threads": usable_threads(threads),
    }


def correlate_images(
    reference: NDArray,
    current: NDArray,
    region: Mask | None,
    settings: CorrelationSettings,
    *,
    threads: int | None = None,
    progress: Progress | None = None,
    names: tuple[str, str, str] = ("the reference image", "the current image", "the mask"),
) -> tuple[PointMatches, NDArray[np.int32]]:
    """Match a grid of points of one image in another.

    Parameters
    ----------
    reference, current : (height, width) grey levels of one size.
    region : (height, width) bool, the region of interest in the reference; without it the whole image, less the
        subset radius at its borders.
    settings : subset, grid and tolerances.
    threads : cores to use; all unless given.
    progress : is called with the points matched so far and their whole number.
    names : of the reference, the current image and the region, for sentences about them.

    Returns
    -------
    The matches of the n points, and faces (m, 3) int32, indices of the points of each triangle of the grid.

    Raises
    ------
    InputError : images of different size, a region without points.
    ComputationError : no point could be matched.
    """
    load_kernels()
    began = time.perf_counter()
    if reference.shape != current.shape:
        raise InputError(
            f"{names[0]} is {reference.shape[1]} x {reference.shape[0]} px but {names[1]} is "
            f"{current.shape[1]} x {current.shape[0]} px; the two images must have the same size"
        )
    xy, faces = grid(_inner(reference.shape, settings.radius) if region is None else region, settings.step)
    if not len(xy):
        raise InputError(
            f"{names[2]}: the mask contains no point of the {settings.step} px grid; mark more or choose a smaller step"
            if region is not None
            else f"{names[0]}: {reference.shape[1]} x {reference.shape[0]} px leave no point of the {settings.step} px "
            f"grid whose subset of radius {settings.radius} px lies inside; choose a smaller radius or step"
        )
    prepared = prepare_reference(reference, region, settings), prepare_current(current, None, settings)
    preparing = time.perf_counter() - began
    matches = correlate_points(*prepared, xy, settings, threads=threads, progress=progress)
    if not matches.good.any():
        raise ComputationError(
            f"{names[1]}: none of the {len(xy)} points of {names[0]} was found in it; "
            "check that both images show the same surface in focus"
        )
    matches.seconds["prepare"] += preparing
    return matches, faces


def write_points(path: Path, matches: PointMatches, faces: NDArray[np.int32]) -> None:
    """Write the matches of an image pair as ``points.npz``; the file appears under its name when it is whole.

    path : the file. matches : of n points. faces : (m, 3) int32, indices of the points of each triangle.

    The file holds the arrays xy (n, 2) px, uv (n, 2) px, gradient (n, 2, 2), zncc (n,), iterations (n,), status (n,),
    sigma (n, 2) px and faces (m, 3).
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            names = ("xy", "uv", "gradient", "zncc", "iterations", "status", "sigma")
            np.savez(file, faces=faces, **{name: getattr(matches, name) for name in names})
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _inner(shape: tuple[int, ...], radius: int) -> Mask:
    """The image less the subset radius at its borders. (height, width) bool."""
    mask = np.zeros(shape, bool)
    mask[radius : shape[0] - radius, radius : shape[1] - radius] = True
    return mask
