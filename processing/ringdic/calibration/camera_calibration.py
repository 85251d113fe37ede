"""One camera calibrated: its lens from the board, its place from the target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats
from ringdic.calibration import dlt
from ringdic.calibration.board import board_points, find_corners
from ringdic.calibration.dots import find_dots
from ringdic.calibration.intrinsics import (
    VIEWS_NEEDED,
    IntrinsicsFit,
    calibrate_intrinsics,
    intrinsics_from_dict,
    intrinsics_to_dict,
)
from ringdic.calibration.target import DotObservations, identify
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.session.rig import Rig

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
    views : names of the board images on which the fit rests or which it left out, in its order.
    blank : names of the board images in which the board was not found.
    """

    camera: Camera
    dots: DotObservations
    residuals: Floats
    left_out: int
    fit: IntrinsicsFit | None
    centroid_shift: Floats
    views: tuple[str, ...] = ()
    blank: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.residuals.shape != (len(self.dots), 2) or self.centroid_shift.shape != (len(self.dots), 2):
            raise ValueError("a calibration needs one residual and one shift of the centroid for each dot")

    @property
    def dot_centres(self) -> Floats:
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
            "views": list(self.views),
            "blank": list(self.blank),
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
            tuple(values["views"]),
            tuple(values["blank"]),
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
    fewest_terms: bool = False,
    drop_percentile: float = 80.0,
    board_names: Sequence[str] | None = None,
    max_incidence_deg: float = 55.0,
    linear_light: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> CameraCalibration:
    """One camera from its images of the board and of the target.

    board_images, target_image : grey, (height, width), all of one size; uint8, uint16 or float in 0 … 255.
    distortion : False calibrates by the DLT alone; the board images are not looked at.
    intrinsics : the lens, where the rig gives it; the board images are not looked at.
    radial, tangential, skew, fewest_terms, drop_percentile : see ``calibrate_intrinsics``.
    board_names : what to call the board images; None numbers them from 1.
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
    found: tuple[str, ...] = ()
    blank: tuple[str, ...] = ()
    if not distortion:
        intrinsics = None
    elif intrinsics is not None:
        if intrinsics.size != size:
            raise InputError(
                f"camera {camera_id}: its intrinsics are for images of {intrinsics.size[0]} x {intrinsics.size[1]} "
                f"pixels, the target image is {width} x {height}; give intrinsics made at this size"
            )
    else:
        names = [str(i + 1) for i in range(len(board_images))] if board_names is None else list(board_names)
        views = _find_views(rig, camera_id, board_images, progress)
        found = tuple(name for name, view in zip(names, views, strict=True) if view is not None)
        blank = tuple(name for name, view in zip(names, views, strict=True) if view is None)
        fit = calibrate_intrinsics(
            [view for view in views if view is not None],
            board_points(rig.board),
            size,
            radial=radial,
            tangential=tangential,
            skew=skew,
            fewest_terms=fewest_terms,
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
        height_mm=entry.height_mm,
        max_incidence_deg=max_incidence_deg,
    )
    return replace(_place(camera_id, size, observed, intrinsics, fit), views=found, blank=blank)


def _find_views(
    rig: Rig, camera_id: str, images: Sequence[Image], progress: Callable[[int, int], None] | None
) -> list[Floats | None]:
    """Corners of the board in each image, None where it is not seen whole."""
    views = []
    for number, image in enumerate(images, start=1):
        views.append(find_corners(image, rig.board.inner_corners))
        if progress is not None:
            progress(number, len(images))
    found = sum(view is not None for view in views)
    if found < VIEWS_NEEDED:
        across, along = rig.board.squares
        raise InputError(
            f"camera {camera_id}: the checkerboard was found in {found} of {len(images)} board images; the lens "
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
