"""The surface about edges of bodies, where it ends or its curvature changes within a subset, against exact truth."""

from dataclasses import dataclass

import numpy as np
import pytest
from ringdic.charts.chart import chart_with_uncertainty
from ringdic.charts.depth_map import DepthImages, measure_depths
from ringdic.charts.images import ChartImages
from ringdic.charts.matching import match_chart
from ringdic.charts.plane_sweep import DepthRange
from ringdic.charts.surface import ReferenceSurface, reference_surface
from ringdic.charts.views import MappedSurface, plan_chart
from ringdic.correlation import CorrelationSettings
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.uncertainty.position import covariance, position_gain
from ringdic_node.virtual_rig.bodies import solid_bodies
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import arc_rig
from ringdic_node.virtual_rig.scenes import SolidMotion, SolidSpecimen

SETTINGS = CorrelationSettings(radius=10, step=5)
VIRTUAL = arc_rig(4, 30.0, 0.3).cameras


def calibrated(camera) -> Camera:
    """A virtual camera as a perfect calibration has it."""
    lens = Intrinsics(camera.K, np.array(camera.distortion), (camera.width, camera.height))
    P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
    return Camera(camera.id, P / P[2, 3], lens.size, lens)


CAMERAS = [calibrated(camera) for camera in VIRTUAL]


@dataclass(frozen=True)
class Measured:
    """A surface, its distance from the body (n,) mm, outside positive, and the standard deviation stated for that."""

    surface: ReferenceSurface
    distance: np.ndarray
    sigma: np.ndarray


def measured(body: str, k: int, partners: list[int]) -> Measured:
    """The chart of camera k of a body, matched with its partners."""
    solid = solid_bodies()[body]()
    specimen = SolidSpecimen(solid, SolidMotion(), 12)
    grey = {c: render(VIRTUAL[c], specimen, seed=7 + c) for c in [k, *partners]}
    space = DepthRange.of(CAMERAS)
    reduced = DepthImages.of(CAMERAS, grey.__getitem__, SETTINGS)
    order = {c: sorted(set(grey) - {c}, key=lambda other, c=c: abs(other - c)) for c in grey}
    maps = {c: measure_depths(reduced, c, order[c], space, None) for c in grey}
    plan = plan_chart(k, {c: MappedSurface(CAMERAS[c], depth_map) for c, depth_map in maps.items()}, 65.0, order[k])
    images = ChartImages(CAMERAS, grey.__getitem__, SETTINGS)
    matches = match_chart(images, k, maps[k], plan, None)
    noise = np.array([maps[c].grey_noise for c in matches.cameras])
    surface = reference_surface(CAMERAS, [chart_with_uncertainty(images, matches, noise)], SETTINGS.step, 0.05)
    _, normals, distance = solid.nearest(surface.xyz)
    gain = position_gain(CAMERAS, surface.xyz, surface.sigma)
    sigma = covariance(gain, np.nan_to_num(surface.scatter))
    return Measured(surface, distance, np.sqrt(np.einsum("ni,nij,nj->n", normals, sigma, normals)))


@pytest.fixture(scope="module")
def box() -> Measured:
    return measured("box-90", 2, [1, 3])


def test_the_change_of_curvature_at_rounded_edges_is_part_of_what_is_stated(box: Measured) -> None:
    ratio = box.distance / box.sigma
    assert np.sqrt(np.mean(ratio**2)) < 1.3
    assert 0.5 < 1.4826 * np.median(np.abs(ratio)) < 1.3


def test_what_is_stated_on_the_flat_sides_has_no_part_due_to_edges(box: Measured) -> None:
    assert np.median(box.sigma) < 0.012  # the noise of the matches alone


def test_no_point_lies_beyond_the_edge_of_a_plate() -> None:
    plate = measured("plate-axis", 3, [1, 2])
    assert len(plate.distance) > 200
    assert np.abs(plate.distance).max() < 0.4
    assert np.sqrt(np.mean(plate.distance**2)) < 0.03
