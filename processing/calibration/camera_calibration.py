"""One camera calibrated: its lens from the board, its place from the target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.calibration import dlt
from processing.calibration.board import board_points, find_corners
from processing.calibration.dots import find_dots
from processing.calibration.intrinsics import (
    VIEWS_NEEDED,
    IntrinsicsFit,
    calibrate_intrinsics,
    intrinsics_from_dict,
    intrinsics_to_dict,
)
from processing.calibration.target import DotObservations, identify
from processing.camera import Camera, Intrinsics
from processing.errors import ComputationError, InputError
from processing.rig import Rig

Array = NDArray[np.float64]
Image = NDArray[np.generic]

#: A focal length less certain than this part of itself is not one.
_FOCAL_UNCERTAINTY = 0.03
#: Dots nearer than this to their projection are never gross errors, px.
_OUTLIER_FLOOR = 0.3


@dataclass(frozen=True)
class CameraCalibration:
    """A calibrated camera and what it rests on.

    camera : projection and lens.
    dots : the dots of the target that were used.
    residuals : (n, 2) measured minus projected, undistorted px.
    left_out : number of dots recognised but left out as gross errors.
    fit : the fit of the lens to the board, or None where it was given or distortion is not corrected.
    centroid_shift : (n, 2) centroid of a dot's image minus the image of its centre, px, as far as it is modelled: zero
        after the direct linear transformation, which takes the one for the other.
    """

    camera: Camera
    dots: DotObservations
    residuals: Array
    left_out: int
    fit: IntrinsicsFit | None
    centroid_shift: Array

    def __post_init__(self) -> None:
        if self.residuals.shape != (len(self.dots), 2) or self.centroid_shift.shape != (len(self.dots), 2):
            raise ValueError("a calibration needs one residual and one shift of the centroid for each dot")

    @property
    def dot_centres(self) -> Array:
        """Images of the dots' centres, measured. (n, 2) px."""
        return self.dots.px - self.centroid_shift

    @property
    def residual_rms(self) -> float:
        """RMS distance of the dots from their projection, undistorted px."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        lens = self.camera.intrinsics
        return {
            "camera": self.camera.id,
            "size": list(self.camera.size),
            "P": self.camera.P.tolist(),
            "intrinsics": None if lens is None else intrinsics_to_dict(lens),
            "intrinsics_fit": None if self.fit is None else self.fit.to_dict(),
            "dots": self.dots.to_dict(),
            "residuals": self.residuals.tolist(),
            "left_out": self.left_out,
            "centroid_shift": self.centroid_shift.tolist(),
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> CameraCalibration:
        """The calibration of :meth:`to_dict`."""
        width, height = values["size"]
        lens, fit = values["intrinsics"], values["intrinsics_fit"]
        return cls(
            Camera(
                values["camera"],
                np.array(values["P"], dtype=float),
                (int(width), int(height)),
                None if lens is None else intrinsics_from_dict(lens),
            ),
            DotObservations.from_dict(values["dots"]),
            np.array(values["residuals"], dtype=float).reshape(-1, 2),
            int(values["left_out"]),
            None if fit is None else IntrinsicsFit.from_dict(fit),
            np.array(values["centroid_shift"], dtype=float).reshape(-1, 2),
        )


def calibrate_camera(
    rig: Rig,
    camera_id: str,
    board_images: Sequence[Image],
    target_image: Image,
    *,
    distortion: bool = True,
    intrinsics: Intrinsics | None = None,
    radial: int | None = None,
    tangential: bool = True,
    skew: bool = True,
    drop_percentile: float = 80.0,
    max_incidence_deg: float = 55.0,
    linear_light: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CameraCalibration:
    """One camera from its images of the board and of the target.

    board_images, target_image : grey, (height, width), all of one size; uint8, uint16 or float in 0 … 255.
    distortion : False calibrates by the DLT alone; the board images are not looked at.
    intrinsics : the lens, where the rig gives it; the board images are not looked at.
    radial, tangential, skew, drop_percentile : see ``calibrate_intrinsics``.
    max_incidence_deg : dots seen more obliquely are not used.
    linear_light : images are sRGB-coded.
    progress : called with (images done, images in all).

    Raises InputError for images of different sizes, too few views of the board, a target that is not recognised;
    ComputationError where the views do not determine the lens.
    """
    height, width = target_image.shape
    size = (width, height)
    for number, image in enumerate(board_images, start=1):
        if image.shape != target_image.shape:
            raise InputError(
                f"camera {camera_id}: board image {number} is {image.shape[1]} x {image.shape[0]} pixels, the target "
                f"image is {width} x {height}; all images of a camera must have one size"
            )
    fit = None
    if not distortion:
        intrinsics = None
    elif intrinsics is not None:
        if intrinsics.size != size:
            raise InputError(
                f"camera {camera_id}: its intrinsics are for images of {intrinsics.size[0]} x {intrinsics.size[1]} "
                f"pixels, the target image is {width} x {height}; give intrinsics made at this size"
            )
    else:
        views = _find_views(rig, camera_id, board_images, progress)
        fit = calibrate_intrinsics(
            views,
            board_points(rig.board),
            size,
            radial=radial,
            tangential=tangential,
            skew=skew,
            drop_percentile=drop_percentile,
        )
        _require_focal_length(camera_id, fit)
        intrinsics = fit.intrinsics
    entry = rig.camera(camera_id)
    observed = identify(
        find_dots(target_image, rig.target, linear_light=linear_light),
        rig.target,
        entry.azimuth_deg,
        camera=camera_id,
        intrinsics=intrinsics,
        rotation_deg=entry.rotation_deg,
        max_incidence_deg=max_incidence_deg,
    )
    return _place(camera_id, size, observed, intrinsics, fit)


def _find_views(
    rig: Rig, camera_id: str, images: Sequence[Image], progress: Callable[[int, int], None] | None
) -> list[Array]:
    """Corners of the board in each image that shows all of it."""
    views = []
    for number, image in enumerate(images, start=1):
        corners = find_corners(image, rig.board.inner_corners)
        if corners is not None:
            views.append(corners)
        if progress is not None:
            progress(number, len(images))
    if len(views) < VIEWS_NEEDED:
        across, along = rig.board.squares
        raise InputError(
            f"camera {camera_id}: the checkerboard was found in {len(views)} of {len(images)} board images; the lens "
            f"needs at least {VIEWS_NEEDED}. Check that every image shows the whole board, sharp and without glare, "
            f"and that [board] squares in rig.toml ({across} x {along}) counts its squares; or give the camera an "
            "intrinsics file, or switch calibration.distortion off"
        )
    return views


def _require_focal_length(camera_id: str, fit: IntrinsicsFit) -> None:
    focal, uncertainty = fit.intrinsics.K[0, 0], fit.sigma[0]
    if not uncertainty <= _FOCAL_UNCERTAINTY * focal:
        raise ComputationError(
            f"camera {camera_id}: the {len(fit.kept)} views of the checkerboard do not determine its focal length "
            f"({focal:.0f} ± {uncertainty:.0f} px); tilt the board by 20° to 45° in several directions"
        )


def _place(
    camera_id: str, size: tuple[int, int], observed: DotObservations, lens: Intrinsics | None, fit: IntrinsicsFit | None
) -> CameraCalibration:
    """The camera's projection from its dots, gross errors left out."""
    undistorted = observed.px if lens is None else lens.to_undistorted(observed.px)
    L, kept = dlt.solve_dlt_robust(observed.xyz, undistorted, sigmas=5.0, floor=_OUTLIER_FLOOR)
    used = observed.chosen(kept)
    return CameraCalibration(
        camera=Camera(camera_id, dlt.to_projection(L), size, lens),
        dots=used,
        residuals=dlt.residuals(L, used.xyz, undistorted[kept]),
        left_out=int((~kept).sum()),
        fit=fit,
        centroid_shift=np.zeros((len(used), 2)),
    )
