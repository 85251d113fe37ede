"""Calibration of one camera: its lens from images of the board, its projection from an image of the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Pixels
from ringdic.calibration import dlt
from ringdic.calibration.board import board_points, count_squares, find_corners
from ringdic.calibration.dots import find_dots
from ringdic.calibration.intrinsics import VIEWS_NEEDED, IntrinsicsFit, calibrate_intrinsics
from ringdic.calibration.target import DotObservations, identify_dots
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.json_values import from_json_value, json_value
from ringdic.session.rig import Rig

#: Largest standard error of a focal length that counts as determined, as a part of it.
_FOCAL_UNCERTAINTY = 0.03
#: Least residual of a dot that is a gross error, px.
_OUTLIER_FLOOR = 0.3
#: Parts of the dots that are held out in turn.
_FOLDS = 5


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera with the target dots and the board fit from which it was calibrated.

    camera : projection and lens.
    dots : the n dots of the target that were used.
    residuals : (n, 2) undistorted px, measured minus projected positions of the dots.
    left_out : number of dots that were identified but left out as gross errors.
    fit : the fit of the lens to the board, or None where the lens was given or distortion is not corrected.
    centroid_shift : (n, 2) px, bias of the dots' centroids: centroid of the image minus projection of the centre. Zero
        after the direct linear transformation, which neglects the difference.
    views : names of the board images in which the board was detected, in the order of the fit's views.
    blank : names of the board images in which it was not.
    held_out : (n, 2) px, measured minus predicted positions of the dots in the image, each predicted from the target's
        nominal geometry by a calibration in which the dot took no part; None where this was not tried.
    """

    camera: Camera
    dots: DotObservations
    residuals: Pixels
    left_out: int
    fit: IntrinsicsFit | None
    centroid_shift: Pixels
    views: tuple[str, ...] = ()
    blank: tuple[str, ...] = ()
    held_out: Pixels | None = None

    def __post_init__(self) -> None:
        if self.residuals.shape != (len(self.dots), 2) or self.centroid_shift.shape != (len(self.dots), 2):
            raise ValueError("a calibration needs one residual and one shift of the centroid for each dot")

    @property
    def dot_centres(self) -> Pixels:
        """Measured image positions of the dots' centres: centroids without their bias, (n, 2) px."""
        return self.dots.px - self.centroid_shift

    @property
    def control_points(self) -> Pixels:
        """Image positions of the dots as control points, with the errors that they have when held out, (n, 2) px.

        Triangulated, they come back at `dots.xyz` but for these errors. Without ``held_out``, the measured centres.
        """
        return self.dot_centres if self.held_out is None else self.camera.project(self.dots.xyz) + self.held_out

    @property
    def residual_rms(self) -> float:
        """RMS length of the dots' residuals, undistorted px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))

    def to_dict(self) -> dict[str, Any]:
        """The calibration as JSON values."""
        own = {
            name: json_value(getattr(self, name))
            for name in ("residuals", "left_out", "centroid_shift", "views", "blank", "held_out")
        }
        camera = {name: json_value(getattr(self.camera, name)) for name in ("size", "P", "intrinsics")}
        fit = None if self.fit is None else self.fit.to_dict()
        return {"camera": self.camera.id, **camera, "intrinsics_fit": fit, "dots": self.dots.to_dict(), **own}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> CameraCalibration:
        """The calibration from the JSON values of :meth:`to_dict`."""
        lens, fit = values["intrinsics"], values["intrinsics_fit"]
        intrinsics = None if lens is None else from_json_value(Intrinsics, lens)
        width, height = values["size"]
        return cls(
            Camera(values["camera"], np.array(values["P"], dtype=float), (int(width), int(height)), intrinsics),
            DotObservations.from_dict(values["dots"]),
            np.array(values["residuals"], dtype=float).reshape(-1, 2),
            int(values["left_out"]),
            None if fit is None else IntrinsicsFit.from_dict(fit),
            np.array(values["centroid_shift"], dtype=float).reshape(-1, 2),
            tuple(values["views"]),
            tuple(values["blank"]),
            None if values["held_out"] is None else np.array(values["held_out"], dtype=float).reshape(-1, 2),
        )


def calibrate_camera(
    rig: Rig,
    camera_id: str,
    board_images: Sequence[NDArray[np.generic]],
    target_image: NDArray[np.generic],
    *,
    distortion: bool = True,
    intrinsics: Intrinsics | None = None,
    radial: int | None = None,
    tangential: bool = True,
    skew: bool = True,
    fewest_terms: bool = False,
    drop_percentile: float = 80.0,
    board_names: Sequence[str] | None = None,
) -> CameraCalibration:
    """Calibrate a camera from its images of the board and of the target.

    Parameters
    ----------
    board_images, target_image : grey, (height, width), all of one size; uint8, uint16 or float in 0 … 255.
    distortion : False calibrates by the DLT alone, without the board images.
    intrinsics : the lens, where the rig gives it; the board images are then not used.
    radial, tangential, skew, fewest_terms, drop_percentile : of the lens model, as in `calibrate_intrinsics`.
    board_names : names of the board images; None numbers them from 1.

    Raises
    ------
    InputError : a lens of another size, too few views of the board, or a target that is not identified.
    ComputationError : the views do not determine the lens, or the dots the projection.
    """
    size = (target_image.shape[1], target_image.shape[0])
    lens = intrinsics if distortion else None
    if lens is not None and lens.size != size:
        raise InputError(
            f"camera {camera_id}: its intrinsics are for images of {lens.size[0]} x {lens.size[1]} "
            f"pixels, the target image is {size[0]} x {size[1]}; give intrinsics made at this size"
        )
    fit = None
    views: tuple[str, ...] = ()
    blank: tuple[str, ...] = ()
    if distortion and lens is None:
        names = [str(i + 1) for i in range(len(board_images))] if board_names is None else list(board_names)
        corners = _board_corners(rig, camera_id, board_images)
        views = tuple(name for name, view in zip(names, corners, strict=True) if view is not None)
        blank = tuple(name for name, view in zip(names, corners, strict=True) if view is None)
        fit = calibrate_intrinsics(
            [view for view in corners if view is not None], board_points(rig.board), size,
            radial=radial, tangential=tangential, skew=skew, fewest_terms=fewest_terms, drop_percentile=drop_percentile,
        )  # fmt: skip
        _require_focal_length(camera_id, fit)
        lens = fit.intrinsics
    entry = rig.camera(camera_id)
    dots = identify_dots(
        find_dots(target_image, rig.target), rig.target, entry.azimuth_deg,
        camera=camera_id, intrinsics=lens, rotation_deg=entry.rotation_deg, height_mm=entry.height_mm,
    )  # fmt: skip
    return replace(_dlt_calibration(camera_id, size, dots, lens, fit), views=views, blank=blank)


def _board_corners(rig: Rig, camera_id: str, images: Sequence[NDArray[np.generic]]) -> list[Pixels | None]:
    """Corners of the board (n, 2) px in each image, None where the whole board is not detected.

    Raises InputError where it is detected in fewer than ``VIEWS_NEEDED`` images.
    """
    corners = [find_corners(image, rig.board.inner_corners) for image in images]
    count = sum(view is not None for view in corners)
    if count < VIEWS_NEEDED:
        across, along = rig.board.squares
        counted = {count_squares(image, rig.board) for image in images[:2]} if count == 0 and len(images) > 1 else set()
        if len(counted) == 1 and (other := counted.pop()) is not None:
            raise InputError(
                f"camera {camera_id}: its board images show a checkerboard of {other[0]} x {other[1]} squares, [board] "
                f"squares in rig.toml says {across} x {along}; correct it, or take images of that board"
            )
        raise InputError(
            f"camera {camera_id}: the checkerboard was found in {count} of {len(images)} board images; the lens "
            f"needs at least {VIEWS_NEEDED}. Check that every image shows the whole board, sharp and without glare, "
            f"and that [board] squares in rig.toml ({across} x {along}) counts its squares; or give the camera an "
            "intrinsics file, or switch calibration.distortion off"
        )
    return corners


def _require_focal_length(camera_id: str, fit: IntrinsicsFit) -> None:
    """Raise ComputationError where the views leave the focal length too uncertain."""
    focal, uncertainty = fit.intrinsics.K[0, 0], fit.sigma[0]
    if not uncertainty <= _FOCAL_UNCERTAINTY * focal:
        raise ComputationError(
            f"camera {camera_id}: the {len(fit.inliers)} views of the checkerboard do not determine its focal length "
            f"({focal:.0f} ± {uncertainty:.0f} px); tilt the board by 20° to 45° in several directions"
        )


def _dlt_calibration(
    camera_id: str, size: tuple[int, int], dots: DotObservations, lens: Intrinsics | None, fit: IntrinsicsFit | None
) -> CameraCalibration:
    """The calibration whose projection is the DLT of the dots without gross errors."""
    undistorted = dots.px if lens is None else lens.to_undistorted(dots.px)
    L, inliers = dlt.solve_dlt_robust(dots.xyz, undistorted, sigmas=5.0, floor=_OUTLIER_FLOOR)
    used = dots.subset(inliers)
    camera = Camera(camera_id, dlt.to_projection(L), size, lens)
    return CameraCalibration(
        camera=camera,
        dots=used,
        residuals=dlt.residuals(L, used.xyz, undistorted[inliers]),
        left_out=int((~inliers).sum()),
        fit=fit,
        centroid_shift=np.zeros((len(used), 2)),
        held_out=_held_out(camera, used, undistorted[inliers]),
    )


def _held_out(camera: Camera, dots: DotObservations, undistorted: Pixels) -> Pixels:
    """Measured minus predicted positions of the dots in the image, each fold predicted by the DLT of the others.

    undistorted : (n, 2) px, of the dots. Returns (n, 2) px.
    """
    residuals = np.empty((len(dots), 2))
    fold = (dots.rows + 2 * dots.columns) % _FOLDS
    for each in range(_FOLDS):
        out = fold == each
        P = dlt.to_projection(dlt.solve_dlt(dots.xyz[~out], undistorted[~out]))
        residuals[out] = dots.px[out] - replace(camera, P=P).project(dots.xyz[out])
    return residuals
