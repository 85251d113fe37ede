"""The depth sweep on drawn images of a speckled cylinder: it is found wherever it is speckled, at its own radius."""

import cv2
import numpy as np
import pytest
from ringdic.correlation import CorrelationSettings, prepare_current
from ringdic.geometry.camera import Camera
from ringdic.sweep.proxies import cylinder_intersections
from ringdic.sweep.sweep import DepthSearch, DepthSweep, search_radii, sweep_depths

WIDTH, HEIGHT, RADIUS = 400, 480, 60.0
SETTINGS = CorrelationSettings(radius=10, step=10)
SEARCH = DepthSearch(57.0, 20.0, 65.0)
SPACING = 20  # of the lattice that these settings lead to, px


def camera_at(azimuth_deg: float) -> Camera:
    """At 350 mm from the axis, looking at it, 1.9 px/mm at the surface."""
    a = np.radians(azimuth_deg)
    centre = np.array([350 * np.cos(a), 350 * np.sin(a), 120.0])
    z = -np.array([np.cos(a), np.sin(a), 0.0])
    y = np.array([0.0, 0.0, -1.0])
    R = np.stack([np.cross(y, z), y, z])
    K = np.array([[650.0, 0, WIDTH / 2], [0, 650, HEIGHT / 2], [0, 0, 1]])
    P = K @ np.column_stack([R, -R @ centre])
    return Camera(f"c{azimuth_deg:g}", P / P[2, 3], (WIDTH, HEIGHT))


CAMERAS = camera_at(-12), camera_at(12)


def speckle() -> np.ndarray:
    """Speckle 1.6 mm wide on the cylinder rolled out, 0.2 mm a pixel, from -π on and from 0 mm up."""
    noise = np.random.default_rng(5).normal(0.0, 1.0, (1200, int(2 * np.pi * RADIUS / 0.2)))
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return (128.0 + 45.0 * smooth / smooth.std()).clip(0.0, 255.0).astype(np.float32)


def views(covered: np.ndarray | None = None) -> list[np.ndarray]:
    """What both cameras see of the cylinder before an even wall, each with its own noise.

    covered : (HEIGHT, WIDTH), of the first camera's image, where the cylinder is speckled; it is even elsewhere.
    """
    texture, rng = speckle(), np.random.default_rng(6)
    px = np.stack(np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT))), axis=-1)
    seen = []
    for each in CAMERAS:
        xyz = cylinder_intersections(each, px.reshape(-1, 2), np.array([RADIUS])).reshape(HEIGHT, WIDTH, 3)
        at = (np.arctan2(xyz[..., 1], xyz[..., 0]) + np.pi) * RADIUS / 0.2, xyz[..., 2] / 0.2
        grey = cv2.remap(texture, *(np.nan_to_num(axis, nan=-9.0).astype(np.float32) for axis in at), cv2.INTER_LINEAR)
        grey[np.isnan(xyz[..., 0])] = 90.0
        if covered is not None:
            to = np.nan_to_num(CAMERAS[0].project(xyz), nan=-9.0).astype(np.float32)
            of_first = cv2.remap(covered.astype(np.float32), to[..., 0], to[..., 1], cv2.INTER_NEAREST)
            grey[of_first < 0.5] = 90.0
        seen.append((grey + rng.normal(0.0, 1.0, grey.shape)).clip(0, 255).astype(np.uint8))
    return seen


def sweep_result(images: list[np.ndarray], mask: np.ndarray | None = None, min_positions: int = 0) -> DepthSweep:
    """Sweep between the two cameras' images."""
    radii = search_radii(CAMERAS, SEARCH)
    return sweep_depths(CAMERAS, images[0], prepare_current(images[1]), mask, radii, SEARCH, SETTINGS, min_positions)


def face_on(result: DepthSweep, limit_deg: float) -> np.ndarray:
    """Positions of the lattice where both cameras see the cylinder under less than this angle."""
    xyz = cylinder_intersections(CAMERAS[0], result.px, np.array([RADIUS]))[:, 0]
    normal = xyz * [1.0, 1.0, 0.0] / RADIUS
    steep = [each.incidence_cosine(xyz, normal) > np.cos(np.radians(limit_deg)) for each in CAMERAS]
    return np.logical_and(*steep).reshape(result.good.shape)


def test_the_cylinder_is_found_wherever_both_see_it_at_its_radius() -> None:
    result = sweep_result(views())
    inner = face_on(result, 50.0)
    assert inner.sum() > 100
    assert result.good[inner].all()
    assert not result.good[
        np.isnan(cylinder_intersections(CAMERAS[0], result.px, np.array([RADIUS]))[:, 0, 0]).reshape(inner.shape)
    ].any()
    xyz = result.xyz[result.good & inner]
    assert np.abs(np.hypot(xyz[:, 0], xyz[:, 1]) - RADIUS).max() < 1.5  # the radii of the sweep lie so far apart
    at = result.px.reshape(*inner.shape, 2)[result.good & inner]
    np.testing.assert_allclose(CAMERAS[0].project(xyz), at, atol=1e-6)
    match = at + result.warps.reshape(*inner.shape, 6)[result.good & inner, :2]
    truth = CAMERAS[1].project(cylinder_intersections(CAMERAS[0], at, np.array([RADIUS]))[:, 0])
    assert np.hypot(*(match - truth).T).max() < 1.5
    assert np.isnan(result.xyz[~result.good]).all()


@pytest.mark.parametrize("corner", [(160, 180), (180, 180), (160, 200), (180, 200)])
def test_a_small_piece_is_found_wherever_it_lies_on_the_lattice(corner: tuple[int, int]) -> None:
    covered = np.zeros((HEIGHT, WIDTH), bool)
    x, y = corner
    pieces = np.zeros((HEIGHT, WIDTH), bool)
    for down in (0, 120):
        covered[y + down - 12 : y + down + SPACING + 13, x - 12 : x + SPACING + 13] = True
        pieces[y + down : y + down + SPACING + 1, x : x + SPACING + 1] = True  # two positions each way
    result = sweep_result(views(covered), min_positions=4)
    column, row = result.px.astype(int).T
    wanted = pieces[row, column].reshape(result.good.shape)
    assert wanted.sum() == 8
    assert result.good[wanted].all()
    about = cv2.dilate(covered.astype(np.uint8), np.ones((23, 23), np.uint8))  # subsets that see some of the speckle
    assert not result.good[about[row, column].reshape(result.good.shape) == 0].any()


def test_with_a_mask_all_positions_inside_it_are_good_and_no_others() -> None:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[100:300, 170:230] = True
    result = sweep_result(views(), mask)
    column, row = result.px.astype(int).T
    inside = mask[row, column].reshape(result.good.shape)
    np.testing.assert_array_equal(result.good, inside)
