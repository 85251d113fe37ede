"""Measured properties of cameras and pattern: image size, scale, distance, exposure, speckle size, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Floats
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.report.speckle import speckle_size
from ringdic.results.results import Results
from ringdic.session.folder import Capture, Session
from ringdic.session.images import read_gray
from ringdic.uncertainty.noise import flat_noise, rest_noise

_SQUARELY = 0.8  # cosine of incidence above which a point counts for a camera's figures
_FEWEST = 20
_SIDE = 1200  # px, of the part of an image that is looked at


@dataclass(frozen=True)
class CameraFacts:
    """Properties of one camera at the reference step, over the points that it sees squarely; None where unknown.

    size : (width, height) px. stand_off : mm, median distance of the points. scale : px a mm across the line of sight.
    field : (width, height) mm that the image shows at that distance. focal : px. speckle : px, see ``speckle_size``.
    noise : standard deviation of the grey levels. at_rest : whether from captures at rest, else from flat places.
    exposure : µs. gain : analogue.
    """

    camera: str
    size: tuple[int, int]
    stand_off: float | None = None
    scale: float | None = None
    field: tuple[float, float] | None = None
    focal: float | None = None
    speckle: float | None = None
    noise: float | None = None
    at_rest: bool = False
    contrast: float | None = None
    exposure: float | None = None
    gain: float | None = None

    @property
    def speckle_mm(self) -> float | None:
        """Size of the speckles on the surface, mm."""
        return None if self.speckle is None or self.scale is None else self.speckle / self.scale


def camera_facts(session: Session, results: Results) -> tuple[CameraFacts, ...]:
    """Measure the properties of every calibrated camera, from its reference image and its images at rest."""
    captures = {capture.id: capture for capture in session.captures}
    reference = captures.get(results.steps[0])
    at_rest = session.of_kind("static")
    mesh = results.mesh
    normals = mesh.vertex_normals
    return tuple(_facts(camera, mesh, normals, reference, at_rest) for camera in results.cameras)


def _facts(
    camera: Camera, mesh: Mesh, normals: Floats, reference: Capture | None, at_rest: tuple[Capture, ...]
) -> CameraFacts:
    lens = camera.intrinsics
    values: dict[str, object] = {"focal": None if lens is None else float(np.sqrt(lens.K[0, 0] * lens.K[1, 1]))}
    with np.errstate(invalid="ignore"):
        xyz = mesh.vertices[camera.incidence_cosine(mesh.vertices, normals) > _SQUARELY]
    px, slope = camera.project_with_jacobian(xyz)
    shown = ((px > 0) & (px < np.array(camera.size) - 1.0)).all(axis=1)
    px, slope, xyz = px[shown], slope[shown], xyz[shown]
    if len(px) >= _FEWEST:
        scale = float(np.median(np.sqrt(np.prod(np.linalg.svd(slope, compute_uv=False), axis=1))))
        values |= {
            "stand_off": float(np.median(np.linalg.norm(xyz - camera.centre, axis=1))),
            "scale": scale,
            "field": (camera.size[0] / scale, camera.size[1] / scale),
        }
    record = None if reference is None else reference.record.cameras.get(camera.id)
    if record is not None:
        values |= {"exposure": record.exposure_us, "gain": record.metadata.get("AnalogueGain")}
    if reference is not None and camera.id in reference.images and len(px) >= _FEWEST:
        values |= _of_images(camera, px, reference, at_rest)
    return CameraFacts(camera.id, camera.size, **values)  # type: ignore[arg-type]


def _of_images(
    camera: Camera, px: Floats, reference: Capture, at_rest: tuple[Capture, ...]
) -> dict[str, float | bool | None]:
    """Speckle size, contrast and noise in the part of the reference image around the middle of the points px (n, 2)."""
    middle = np.median(px, axis=0)
    low = np.maximum(np.maximum(px.min(axis=0), middle - _SIDE / 2), 0).astype(int)
    high = np.minimum(np.minimum(px.max(axis=0), middle + _SIDE / 2), np.array(camera.size) - 1).astype(int) + 1
    if (high - low).min() < 32:
        return {}
    part = (slice(low[1], high[1]), slice(low[0], high[0]))
    image = read_gray(reference.images[camera.id])[part]
    rest = [read_gray(capture.images[camera.id])[part] for capture in at_rest[:3] if camera.id in capture.images]
    rest = [each for each in rest if each.shape == image.shape]
    noise = rest_noise([image, *rest]) if rest else flat_noise(image)
    return {
        "speckle": speckle_size(image, px - low, noise),
        "noise": float(np.sqrt(noise)),
        "at_rest": bool(rest),
        "contrast": float(image.std()),
    }
