"""Correlation of two whole images on a grid of points, from arrays or from files."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Mask
from ringdic.correlation.correlate import PointMatches, correlate_points, load_kernels, usable_threads
from ringdic.correlation.grid import grid
from ringdic.correlation.prepared import prepare_current, prepare_reference
from ringdic.correlation.propagation import Progress
from ringdic.correlation.repetition import find_repetition
from ringdic.correlation.settings import CorrelationSettings
from ringdic.correlation.status import Status
from ringdic.errors import ComputationError, InputError
from ringdic.findings import Finding, verdict_figures
from ringdic.session.images import read_gray, read_mask
from ringdic.settings import load_settings

_MOST = 0.5  # of the pattern, that must repeat itself to be named for why nothing was matched


def correlate_files(
    reference: Path,
    current: Path,
    out: Path,
    settings: CorrelationSettings | None = None,
    *,
    mask: Path | None = None,
    threads: int | None = None,
    accept: Sequence[str] = (),
) -> dict[str, Any]:
    """Match one image file in another and write ``points.npz``; returns the summary of ``ringdic correlate --json``.

    Parameters
    ----------
    reference, current : image files of one size.
    out : the file to write, see :func:`write_points`.
    settings : subset, grid and tolerances; the defaults unless given.
    mask : an image file of the reference's size; its pixels above 0 are the region of interest.
    threads : cores to use; all unless given.
    accept : codes of findings that do not forbid to use the matches.

    Returns
    -------
    The verdict, the findings and their sentences as warnings, numbers of points and of good points, seconds by stage
    (prepare, start, refine), points_per_second of the refine stage, and threads.

    Raises
    ------
    InputError : an unreadable file, images of different size, a mask without points, no folder to write into, a code
        that does not exist.
    ComputationError : no point could be matched.
    """
    settings = settings or CorrelationSettings()
    accept = load_settings(None, [f"accept={json.dumps(list(accept))}"]).accept  # known codes only
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
    matches, faces, findings = correlate_images(*images, region, settings, threads=threads, names=names, accept=accept)
    write_points(out, matches, faces)
    seconds = {**matches.seconds, "prepare": reading + matches.seconds["prepare"]}
    return {
        **verdict_figures(findings, accept),
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
    accept: Sequence[str] = (),
) -> tuple[PointMatches, NDArray[np.int32], list[Finding]]:
    """Match a grid of points of one image in another.

    Points where the pattern repeats itself are lost, since their matches may be wrong by its period.

    Parameters
    ----------
    reference, current : (height, width) grey levels of one size.
    region : (height, width) bool, the region of interest in the reference; without it the whole image, less the
        subset radius at its borders.
    settings : subset, grid and tolerances.
    threads : cores to use; all unless given.
    progress : is called with the points matched so far and their whole number.
    names : of the reference, the current image and the region, for sentences about them.
    accept : codes of findings that are accepted; with "repeating-pattern" the matches of a repeating pattern are kept.

    Returns
    -------
    The matches of the n points, faces (m, 3) int32, indices of the points of each triangle of the grid, and findings.

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
        raise InputError(_no_point(reference.shape, settings, names, masked=region is not None))
    prepared = prepare_reference(reference, region, settings), prepare_current(current, None, settings)
    preparing = time.perf_counter() - began
    matches = correlate_points(*prepared, xy, settings, threads=threads, progress=progress)
    began = time.perf_counter()
    textured = xy[matches.status != Status.NO_TEXTURE]
    repetition = find_repetition(reference, textured if len(textured) else xy, settings.radius, region)
    findings = repetition.findings(names[0])
    if not matches.good.any():
        repeats = repetition.share > _MOST
        why = findings[0].sentence if repeats else "check that both images show the same surface in focus"
        raise ComputationError(f"{names[1]}: none of the {len(xy)} points of {names[0]} was found in it; {why}")
    if findings and findings[0].code not in accept:
        matches = matches.without(repetition.ambiguous(xy), Status.AMBIGUOUS)
    matches.seconds["prepare"] += preparing + time.perf_counter() - began
    return matches, faces, findings


def _no_point(shape: tuple[int, ...], settings: CorrelationSettings, names: tuple[str, str, str], masked: bool) -> str:
    """The sentence about an image of some shape, or where it is masked its mask, that has no point of the grid."""
    if masked:
        return (
            f"{names[2]}: the mask contains no point of the {settings.step} px grid; mark more or choose a smaller step"
        )
    return (
        f"{names[0]}: {shape[1]} x {shape[0]} px leave no point of the {settings.step} px "
        f"grid whose subset of radius {settings.radius} px lies inside; choose a smaller radius or step"
    )


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
