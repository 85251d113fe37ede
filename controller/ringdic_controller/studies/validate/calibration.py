"""Calibrations compared with the true cameras: Tables 1 and 2, Fig. 6, and the diameter from exact pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ringdic.arrays import Floats
from ringdic.calibration.bundle import centroid_shift
from ringdic.calibration.calibrated_rig import CalibratedRig, control_points
from ringdic.calibration.camera_calibration import CameraCalibration
from ringdic.calibration.dots import find_dots
from ringdic.calibration.target import DotObservations, identify_dots
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.triangulation import triangulate
from ringdic.session.images import read_gray
from ringdic.session.rig import Rig
from ringdic.strain.rigid_motion import kabsch
from ringdic_node.virtual_rig.lens import VirtualCamera

from ringdic_controller.studies.validate.figures import Figure, Findings
from ringdic_controller.studies.validate.scenery import STAGE
from ringdic_controller.studies.validate.shapes import fitted_cylinder

# Table 1 of Solav et al. 2018: over the twelve cameras.
_TABLE_1 = (
    ("fx", "px", "2611.7 ± 5.8", 2),
    ("fy", "px", "2615.4 ± 5.6", 2),
    ("skew", "px", "−1.37 ± 0.37", 3),
    ("cx", "px", "1246.5 ± 34.5", 2),
    ("cy", "px", "1627.7 ± 16.9", 2),
    ("k1", "", "0.179 ± 0.018", 4),
    ("k2", "", "−0.295 ± 0.167", 4),
    ("p1", "", "1.5e-4 ± 2.3e-4", 6),
    ("p2", "", "6.8e-4 ± 6.6e-4", 6),
    ("k3", "", "−0.19 ± 0.45", 4),
)
_SIXTY_DEGREES = 0.5


def true_camera(camera: VirtualCamera) -> Camera:
    """The library's `Camera` with the true pose and lens of a camera of the virtual rig."""
    size = camera.width, camera.height
    lens = Intrinsics(camera.K, camera.distortion, size)
    P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
    return Camera(camera.id, P / P[2, 3], size, lens)


def table_1(rings: Mapping[str, CalibratedRig], true: Mapping[str, Camera], scale: float) -> Findings:
    """Intrinsics (Table 1): mean and standard deviation over the cameras, at full scale, and RMS error.

    rings : calibrations by way of processing. true : true cameras by id. scale : of the images.
    """
    inner = {way: _inner({id_: each.camera for id_, each in ring.cameras.items()}) for way, ring in rings.items()}
    truth = _inner(true)
    figures = []
    for k, (name, unit, paper, digits) in enumerate(_TABLE_1):
        size = 1.0 / scale if unit == "px" else 1.0
        shift = 0.5 * (size - 1.0) if name in ("cx", "cy") else 0.0  # pixel centres: x_full = (x + 0.5) / scale - 0.5
        means = {way: size * each[:, k].mean() + shift for way, each in {"true": truth, **inner}.items()}
        spread = {"true": size * truth[:, k].std(), **{way: size * each[:, k].std() for way, each in inner.items()}}
        rms = {way: size * float(np.sqrt(np.mean((each[:, k] - truth[:, k]) ** 2))) for way, each in inner.items()}
        shown, deviation = paper.split(" ± ")
        figures += [
            Figure("Table 1", f"{name}, mean", unit, means, shown, digits=digits),
            Figure("Table 1", f"{name}, STD over cameras", unit, spread, deviation, digits=digits),
            Figure("Table 1", f"{name}, RMS error", unit, rms, digits=digits + 1),
        ]
    return Findings(tuple(figures), {"true": truth, **inner})


def table_2(rings: Mapping[str, CalibratedRig], pairs: tuple[tuple[str, str], ...]) -> Findings:
    """Reconstruction error of the control points over all camera pairs (Table 2)."""
    means, rms, curves = {}, {}, {}
    for way, ring in rings.items():
        each = [control_points(ring.cameras[a], ring.cameras[b]) for a, b in pairs]
        weights = np.array([error.points for error in each])
        mean = np.average([error.mean_vector for error in each], axis=0, weights=weights)
        means[way] = float(np.linalg.norm(mean))
        rms[way] = float(np.sqrt(np.average([error.rms**2 for error in each], weights=weights)))
        curves[way] = [error.rms for error in each]
    figures = (
        Figure("Table 2", "control points, mean vector", "mm", means, "0.002"),
        Figure("Table 2", "control points, RMS", "mm", rms, "0.047", 0.004),
    )
    return Findings(figures, {"rms": curves})


def figure_6(
    rings: Mapping[str, CalibratedRig], rig: Rig, images: Mapping[str, Path], pairs: tuple[tuple[str, str], ...]
) -> Findings:
    """The target moved by a stage (Fig. 6): length of the motion, and residual of the control points after a rigid fit.

    images : of the moved target, by camera.
    """
    lengths, misfits, curves = {}, {}, {}
    for way, ring in rings.items():
        moved = {id_: _moved_dots(ring.cameras[id_], rig, image) for id_, image in images.items()}
        before, after = [], []
        for pair in pairs:
            X, Y = _stage_points(ring, rig, pair, moved)
            before.append(X)
            after.append(Y)
        X, Y = np.concatenate(before), np.concatenate(after)
        residuals = np.linalg.norm(kabsch(X, Y).apply(X) - Y, axis=1)
        lengths[way] = float(np.linalg.norm((Y - X).mean(axis=0)))
        misfits[way] = float(np.sqrt(np.mean(residuals**2)))
        curves[way] = residuals.tolist()
    true = float(np.linalg.norm(STAGE))
    figures = (
        Figure("Fig. 6", "5 mm stage: superimposed RMS", "mm", misfits, "0.017", 0.004),
        Figure("Fig. 6", "5 mm stage: length − 5", "mm", {w: v - true for w, v in lengths.items()}, "", 0.001),
    )
    return Findings(figures, {"residuals": curves})


@dataclass(frozen=True)
class ExactRays:
    """Exact pixels of points on a perfect cylinder, for each camera pair that sees them at less than 60° to the normal.

    pairs : P pairs of camera ids. px : of each pair (2, n, 2) px, distorted, in its first and second camera.
    """

    pairs: tuple[tuple[str, str], ...]
    px: tuple[Floats, ...]

    @classmethod
    def of(cls, true: Mapping[str, Camera], pairs: tuple[tuple[str, str], ...], radius: float = 57.0) -> ExactRays:
        """Project points every three degrees and twenty millimetres into the true cameras."""
        angle, z = (a.ravel() for a in np.meshgrid(np.arange(0, 2 * np.pi, np.pi / 60), np.linspace(15, 235, 12)))
        normals = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        xyz = radius * normals + np.outer(z, [0, 0, 1])
        pixels = []
        for pair in pairs:
            both = np.min([true[id_].incidence_cosine(xyz, normals) for id_ in pair], axis=0) > _SIXTY_DEGREES
            pixels.append(np.stack([true[id_].project(xyz[both]) for id_ in pair]))
        return cls(pairs, tuple(pixels))

    def diameter_bias(self, cameras: Mapping[str, Camera]) -> float:
        """Diameter of the cylinder fitted to these points triangulated with a calibration, minus the true one, mm."""
        points = [triangulate([cameras[id_] for id_ in pair], px) for pair, px in zip(self.pairs, self.px, strict=True)]
        return fitted_cylinder(np.concatenate(points)).diameter - 114.0


def _inner(cameras: Mapping[str, Camera]) -> Floats:
    """Intrinsics fx fy s cx cy k1 k2 p1 p2 k3 of every camera that has a lens, (C, 10)."""
    lenses = [camera.intrinsics for camera in cameras.values() if camera.intrinsics is not None]
    return np.array([[L.K[0, 0], L.K[1, 1], L.K[0, 1], L.K[0, 2], L.K[1, 2], *L.distortion] for L in lenses])


def _moved_dots(calibration: CameraCalibration, rig: Rig, image: Path) -> DotObservations:
    """Dots found and numbered in the image of the moved target by one camera."""
    camera = calibration.camera
    entry = rig.camera(camera.id)
    return identify_dots(
        find_dots(read_gray(image), rig.target),
        rig.target,
        entry.azimuth_deg,
        camera=camera.id,
        intrinsics=camera.intrinsics,
        rotation_deg=entry.rotation_deg,
    )


def _stage_points(
    ring: CalibratedRig, rig: Rig, pair: tuple[str, str], moved: Mapping[str, DotObservations]
) -> tuple[Floats, Floats]:
    """Positions of the dots that a camera pair sees, before and after the motion: two arrays (n, 3) mm."""
    calibrations = [ring.cameras[id_] for id_ in pair]
    observed = [each.dots for each in calibrations] + [moved[id_] for id_ in pair]
    places = [
        {dot: i for i, dot in enumerate(zip(each.rows.tolist(), each.columns.tolist(), strict=True))}
        for each in observed
    ]
    common = sorted(set.intersection(*(set(place) for place in places)))
    chosen = [[place[dot] for dot in common] for place in places]
    cameras = [each.camera for each in calibrations]
    before = np.stack([each.dot_centres[rows] for each, rows in zip(calibrations, chosen[:2], strict=True)])
    after = np.stack([each.px[rows] for each, rows in zip(observed[2:], chosen[2:], strict=True)])
    if ring.bundle is not None:  # the bundle adjustment distinguishes a dot's centroid from its projected centre
        rows, columns = (np.array(names) for names in zip(*common, strict=True))
        after -= np.stack(
            [centroid_shift(each, rig.target, rows, columns, translation=np.array(STAGE)) for each in cameras]
        )
    return triangulate(cameras, before), triangulate(cameras, after)
