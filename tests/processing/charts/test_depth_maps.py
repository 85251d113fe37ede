"""Depth maps and charts of a rendered limb, whose truth is a formula: nothing is told of its shape or place."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from ringdic.charts.depth_map import DepthImages, DepthMap, measure_depths
from ringdic.charts.images import ChartImages
from ringdic.charts.matching import ChartMatches, match_chart
from ringdic.charts.patches import Patches, optical_axis
from ringdic.charts.plane_sweep import DepthRange
from ringdic.charts.views import ChartPlan, MappedSurface, chart_region, grid_to_the_border, plan_chart
from ringdic.correlation import CorrelationSettings, Status, grid
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.outliers import LostPoint
from ringdic.geometry.triangulation import triangulate
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes.specimen import Limb, Specimen

SCALE, RADIUS, STEP = 0.3, 10, 5
LIMB = Limb()
SPECIMEN = Specimen(LIMB, 0, seed=4)


def calibrated(camera) -> Camera:
    """A virtual camera as a perfect calibration has it."""
    lens = Intrinsics(camera.K, np.array(camera.distortion), (camera.width, camera.height))
    P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
    return Camera(camera.id, P / P[2, 3], lens.size, lens)


VIRTUAL = paper_rig(12, SCALE).cameras[:3]
CAMERAS = [calibrated(camera) for camera in VIRTUAL]
SPACE = DepthRange.of([calibrated(camera) for camera in paper_rig(12, SCALE).cameras])
SETTINGS = CorrelationSettings(radius=RADIUS, step=STEP)
PARTNERS = [(1, 2), (0, 2), (1, 0)]


def places(k: int, depth_map: DepthMap) -> np.ndarray:
    """Points in space of the places of a camera's depth map."""
    return depth_map.patches.points(CAMERAS[k], np.zeros((1, 2)))[:, 0]


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [render(camera, SPECIMEN, seed=7 + k) for k, camera in enumerate(VIRTUAL)]


@pytest.fixture(scope="module")
def maps(images: list[np.ndarray]) -> list[DepthMap]:
    reduced = DepthImages.of(CAMERAS, lambda k: images[k], SETTINGS)
    return [measure_depths(reduced, k, PARTNERS[k], SPACE, None) for k in range(3)]


@pytest.fixture(scope="module")
def plans(maps: list[DepthMap]) -> list[ChartPlan]:
    surfaces = {k: MappedSurface(CAMERAS[k], depth_map) for k, depth_map in enumerate(maps)}
    return [plan_chart(k, surfaces, 65.0, PARTNERS[k]) for k in range(3)]


@pytest.fixture(scope="module")
def middle(images: list[np.ndarray], maps: list[DepthMap], plans: list[ChartPlan]) -> ChartMatches:
    return match_chart(ChartImages(CAMERAS, lambda k: images[k], SETTINGS), 1, maps[1], plans[1], None)


def test_the_middle_of_the_rig_is_where_its_cameras_look() -> None:
    assert np.linalg.norm(SPACE.centre - [0.0, 0.0, 120.0]) < 5.0


def test_depths_lie_on_the_limb_wherever_two_cameras_face_it(maps: list[DepthMap], figures: Callable) -> None:
    """Affine subsets on a curved body are biased by up to 0.1 px, 0.06 mm of depth at this scale."""
    theta, z = np.meshgrid(np.linspace(-0.5, 1.6, 60), np.arange(15.0, 236.0, 5.0), indexing="ij")
    xyz = LIMB.position(theta, z, 0).reshape(-1, 3)
    tangents = LIMB.tangents(theta, z, 0).reshape(-1, 2, 3)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = np.stack([camera.incidence_cosine(xyz, normals) for camera in CAMERAS])
    for k, depth_map in enumerate(maps):
        distance = LIMB.material_coordinates(places(k, depth_map))[2]
        assert np.abs(distance).max() < 1.0
        assert np.median(np.abs(distance)) < 0.06
        others = np.delete(cosine, k, axis=0).max(axis=0)
        seen = CAMERAS[k].project(xyz[(cosine[k] > 0.6) & (others > 0.6)])
        apart = np.linalg.norm(depth_map.patches.px - seen[:, None], axis=2).min(axis=1)
        share = float((apart < depth_map.spacing).mean())
        figures(f"depth map of camera {k + 1}: measured of what two cameras see under 53°", f"{share:.1%}", "≥ 98 %")
        assert share >= 0.98


def test_the_slants_of_a_depth_map_are_those_of_the_limb(maps: list[DepthMap]) -> None:
    theta, z, _ = LIMB.material_coordinates(places(1, maps[1]))
    tangents = LIMB.tangents(theta, z, 0)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off = np.degrees(np.arccos(np.clip(np.sum(normals * maps[1].patches.normals(CAMERAS[1]), axis=1), -1, 1)))
    assert np.median(off) < 2.0


def test_each_camera_gets_what_it_faces_most_squarely(maps: list[DepthMap], plans: list[ChartPlan]) -> None:
    """The cameras stand at 0, 30 and 60°; charts exceed their share by a step of the lattice, 5 mm or 5°."""
    azimuth = []
    for k, (depth_map, plan) in enumerate(zip(maps, plans, strict=True)):
        xyz = places(k, depth_map)[plan.inside]
        azimuth.append(np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])))
        assert k not in plan.sees
    assert np.percentile(azimuth[0], 95) < 15.0 + 10.0
    assert np.percentile(np.abs(azimuth[1] - 30.0), 95) < 15.0 + 10.0
    assert np.percentile(azimuth[2], 5) > 45.0 - 10.0
    assert np.histogram(np.concatenate(azimuth), np.arange(-20.0, 81.0, 10.0))[0].min() > 20
    assert (plans[1].sees[0] & plans[1].sees[2])[plans[1].inside].mean() > 0.6


def test_a_chart_is_matched_without_the_bias_of_flat_subsets(middle: ChartMatches, figures: Callable) -> None:
    """With the measured curvature held, the points lie on the limb to a few hundredths of a pixel (0.3 mm).

    Flat subsets of 10 px between neighbouring cameras are biased by 0.03 px, 0.02 mm inwards.
    """
    sure = np.nanmax(middle.sigma, axis=(0, 2)) < 0.05
    xyz = triangulate([CAMERAS[c] for c in middle.cameras], middle.px)
    known = np.isfinite(xyz).all(axis=1)
    distance = LIMB.material_coordinates(xyz[known & sure])[2]
    scatter, bias = 1.4826 * float(np.median(np.abs(distance))), float(np.median(distance))
    figures("chart of a limb at 0.3 scale: distance from the surface, robust", f"{scatter:.4f} mm", "≤ 0.006")
    figures("chart of a limb at 0.3 scale: bias", f"{bias:+.4f} mm", "≤ 0.003")
    assert known.mean() > 0.95  # the others lie at the rim of the pattern
    assert np.abs(distance).max() < 1.0
    assert scatter <= 0.006
    assert abs(bias) <= 0.003


def test_what_a_reflection_hides_from_one_camera_is_matched_in_the_next(
    images: list[np.ndarray], maps: list[DepthMap], plans: list[ChartPlan]
) -> None:
    spot = LIMB.position(np.radians([25.0]), np.array([120.0]), 0)  # the first camera faces it most squarely
    spoilt = images[0].copy()
    cv2.circle(spoilt, tuple(np.rint(CAMERAS[0].project(spot)[0]).astype(int).tolist()), 4 * RADIUS, 255, -1)
    seen = ChartImages(CAMERAS, lambda k: spoilt if k == 0 else images[k], SETTINGS)
    chart = match_chart(seen, 1, maps[1], plans[1], None)
    here = np.linalg.norm(chart.xy - CAMERAS[1].project(spot), axis=1) < 2 * RADIUS
    good = dict(zip(chart.cameras.tolist(), chart.status == Status.GOOD, strict=True))
    assert here.sum() > 40
    assert not good[0][here].any()
    assert good[2][here].mean() > 0.98


def test_points_of_a_chart_lie_on_whole_pixels_of_its_camera(middle: ChartMatches) -> None:
    assert middle.cameras[0] == 1
    assert np.array_equal(middle.px[0], middle.xy)
    assert (middle.xy % 1 == 0).all()
    assert (np.abs(middle.xy - STEP * np.rint(middle.xy / STEP)) < STEP / 2).all()


def test_an_image_without_texture_gives_no_depth(images: list[np.ndarray]) -> None:
    even = np.full_like(images[0], 90)
    depths = measure_depths(
        DepthImages.of(CAMERAS, lambda k: even if k == 0 else images[k], SETTINGS), 0, (1,), SPACE, None
    )
    assert len(depths.patches.px) == 0
    assert len(depths.textured) == 0


def test_edges_alone_are_no_pattern(images: list[np.ndarray], maps: list[DepthMap]) -> None:
    """Bright rails beside the limb have contrast, but vary in one direction only."""
    with_rails = images[0].copy()
    rows = np.arange(len(with_rails)) % 60 < 6
    with_rails[rows, :200] = 230
    reduced = DepthImages.of(CAMERAS, lambda k: with_rails if k == 0 else images[k], SETTINGS)
    found = measure_depths(reduced, 0, (1,), SPACE, None)
    rails = found.textured[:, 0] < 160
    assert rails.sum() > 100
    before = maps[0].patterned[maps[0].textured[:, 0] < 160].sum()
    assert found.patterned[rails].sum() <= before + 2
    assert maps[0].patterned.mean() > 0.5  # the rest is the rig


def test_a_view_more_oblique_than_the_limit_is_not_used(
    images: list[np.ndarray], maps: list[DepthMap], plans: list[ChartPlan]
) -> None:
    chart = match_chart(ChartImages(CAMERAS, lambda k: images[k], SETTINGS), 1, maps[1], plans[1], None, 45.0)
    theta, z, _ = LIMB.material_coordinates(triangulate([CAMERAS[c] for c in chart.cameras], chart.px))
    known = np.isfinite(theta)
    tangents = LIMB.tangents(theta[known], z[known], 0)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    xyz = LIMB.position(theta[known], z[known], 0)
    for slot, c in enumerate(chart.cameras):
        used = np.isfinite(chart.px[slot, known, 0])
        incidence = np.degrees(np.arccos(CAMERAS[c].incidence_cosine(xyz, normals)[used]))
        assert np.percentile(incidence, 98) < 48.0  # the normal of a measured surface is good to 3°, not at its rim
    assert (chart.status == LostPoint.OBLIQUE).any()


def speckled_plate() -> tuple[np.ndarray, DepthMap]:
    """Image of a speckled square, px 100 to 299 each way, before a dark wall, and its depth map."""
    rng = np.random.default_rng(3)
    grey = np.full((400, 400), 20, np.uint8)
    grey[100:300, 100:300] = cv2.resize(rng.integers(60, 230, (50, 50)).astype(np.uint8), (200, 200))
    px = np.stack(np.meshgrid(np.arange(105.0, 300.0, 15.0), np.arange(105.0, 300.0, 15.0)), axis=-1).reshape(-1, 2)
    n = len(px)
    patches = Patches(px, np.full(n, 1 / 400), np.zeros((n, 2)), np.zeros((n, 3)))
    return grey, DepthMap(15, patches, np.full(n, 1e-7), px, np.ones(len(px), bool), 1.0)


def region_of(grey: np.ndarray, plate: DepthMap) -> tuple[np.ndarray, np.ndarray]:
    return chart_region(grey, plate, np.ones(len(plate.patches.px), bool), RADIUS)


def test_subsets_keep_away_from_the_silhouette_and_no_point_lies_beyond_their_pixels() -> None:
    """The contrast between a plate and what stands behind it is not the plate's own."""
    subsets, points = region_of(*speckled_plate())
    rows, columns = np.flatnonzero(subsets.any(axis=1)), np.flatnonzero(subsets.any(axis=0))
    from_border = [rows[0] - 100, 299 - rows[-1], columns[0] - 100, 299 - columns[-1]]
    assert min(from_border) >= 2
    assert max(from_border) <= 6
    assert points[subsets].mean() > 0.99
    assert not points[~subsets].any()


def test_twice_as_fine_pixels_show_the_same_pattern() -> None:
    grey, plate = speckled_plate()
    patches = replace(plate.patches, px=2.0 * plate.patches.px + 0.5)
    textured = 2.0 * plate.textured + 0.5
    finer = replace(plate, spacing=2 * plate.spacing, patches=patches, textured=textured)
    doubled = np.repeat(np.repeat(grey, 2, axis=0), 2, axis=1)
    for once, twice in zip(
        chart_region(grey, plate, np.ones(len(patches.px), bool), 10),
        chart_region(doubled, finer, np.ones(len(patches.px), bool), 20),
        strict=True,
    ):
        rows, columns = (np.flatnonzero(once.any(axis=axis)) for axis in (1, 0))
        finer_rows, finer_columns = (np.flatnonzero(twice.any(axis=axis)) for axis in (1, 0))
        for one, other in ((rows, finer_rows), (columns, finer_columns)):
            assert np.abs(2 * one[[0, -1]] + 0.5 - other[[0, -1]]).max() <= 1.5
        assert twice.sum() == pytest.approx(4 * once.sum(), rel=0.02)


def test_a_gap_between_speckles_belongs_to_the_pattern_and_a_hole_as_large_as_a_subset_does_not() -> None:
    grey, plate = speckled_plate()
    rows, columns = np.indices(grey.shape)
    for centre, radius in (((150, 150), 0.7 * RADIUS), ((240, 240), 1.8 * RADIUS)):
        grey[np.hypot(columns - centre[0], rows - centre[1]) < radius] = 140
    subsets, points = region_of(grey, plate)
    assert subsets[140:161, 140:161].all()
    assert points[140:161, 140:161].all()
    assert not subsets[240, 240]


def test_a_lamp_beside_the_surface_is_no_part_of_it_and_a_small_reflection_is() -> None:
    grey, plate = speckled_plate()
    grey[180:210, 270:300] = 255
    grey[150:152, 150:152] = 255
    subsets, points = region_of(grey, plate)
    assert not subsets[180:210, 270:300].any()
    assert not points[180:210, 270:300].any()
    assert subsets[140:160, 140:160].all()


@pytest.mark.parametrize("step", [5, 10])
def test_the_grid_ends_at_the_border_of_its_mask(step: int) -> None:
    rows, columns = np.indices((101, 141))
    mask = np.hypot(columns - 70.0, rows - 50.0) < 41.7
    xy, faces = grid_to_the_border(mask, step)
    column, row = xy.astype(int).T
    assert mask[row, column].all()
    assert (np.abs(xy - step * np.rint(xy / step)) < step / 2).all()
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    on_grid = (xy % step == 0).all(axis=1)
    assert not inner[row, column][~on_grid].any()
    first, second = xy[faces[:, 1]] - xy[faces[:, 0]], xy[faces[:, 2]] - xy[faces[:, 0]]
    area = -0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    assert (area > 0).all()

    plain_area = 0.5 * step**2 * len(grid(mask, step)[1])
    assert mask.sum() - area.sum() < 0.6 * (mask.sum() - plain_area)


def test_cameras_that_look_in_parallel_have_a_finite_middle() -> None:
    first = CAMERAS[0]
    P = first.P.copy()
    P[:, 3] -= P[:, :3] @ np.array([0.0, 40.0, 0.0])
    second = Camera("beside", P, first.size, first.intrinsics)
    centre = DepthRange.of([first, second]).centre
    assert np.isfinite(centre).all()
    assert np.linalg.norm(np.cross(centre - 0.5 * (first.centre + second.centre), optical_axis(first))) < 1e-6
