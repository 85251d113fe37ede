"""Unmeasured places of a plate with holes, whose areas are known exactly, and their reasons."""

from dataclasses import replace

import numpy as np
import pytest
from ringdic.charts.depth_map import DepthMap
from ringdic.charts.patches import Patches, depths
from ringdic.charts.surface import ReferenceSurface
from ringdic.charts.unmeasured import unmeasured_places
from ringdic.correlation import Status
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.outliers import LostPoint
from ringdic.results.unmeasured import UnmeasuredPlaces, unmeasured_areas, unmeasured_findings
from ringdic_node.virtual_rig.rig import paper_rig

MIDDLE = np.array([40.0, 0.0, 120.0])
ACROSS, UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
NORMAL = np.cross(ACROSS, UP)
SIDE = 60.0  # mm, half the plate's side
SPACING = 9
ROD = 40.0  # mm, its radius


def calibrated(camera) -> Camera:
    """A virtual camera as a perfect calibration has it."""
    lens = Intrinsics(camera.K, np.array(camera.distortion), (camera.width, camera.height))
    P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
    return Camera(camera.id, P / P[2, 3], lens.size, lens)


RING = [calibrated(camera) for camera in paper_rig(12, 0.3).cameras]
CAMERAS = [RING[11], RING[1]]  # 30° to either side of the plate's normal


def on_plate(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (xyz - MIDDLE) @ ACROSS, (xyz - MIDDLE) @ UP


def depth_map(camera: Camera, hidden=lambda a, b: np.zeros(a.shape, bool)) -> DepthMap:
    """The exact map of a textured plate, without depths where hidden."""
    grid = [np.arange(SPACING, side - SPACING, SPACING) for side in camera.size]
    px = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)

    def hit(at):
        rays = camera.ray(at)
        return camera.centre + rays * ((MIDDLE - camera.centre) @ NORMAL / (rays @ NORMAL))[..., None]

    a, b = on_plate(hit(px))
    px = px[(abs(a) < SIDE) & (abs(b) < SIDE)]
    a, b = on_plate(hit(px))
    known = px[~hidden(a, b)]
    inverse = [1.0 / depths(camera, hit(known + shift)) for shift in ([0, 0], [1, 0], [-1, 0], [0, 1], [0, -1])]
    slope = np.stack([inverse[1] - inverse[2], inverse[3] - inverse[4]], axis=1) / 2.0
    n = len(known)
    patches = Patches(known, inverse[0], slope, np.zeros((n, 3)))
    return DepthMap(SPACING, patches, np.full(n, 1e-6), px, np.ones(len(px), bool), 1.0)


NOTHING_LOST = np.zeros((0, 4), np.int64)


def rolled(xyz: np.ndarray) -> np.ndarray:
    """The plate rolled about a rod."""
    a, b = on_plate(xyz)
    turn = (a / ROD)[:, None]
    return MIDDLE + ROD * ((np.cos(turn) - 1.0) * NORMAL + np.sin(turn) * ACROSS) + b[:, None] * UP


def map_of_rod(camera: Camera, bare) -> DepthMap:
    """The exact map of the rolled plate, without depths where it is bare."""
    axis = MIDDLE - ROD * NORMAL

    def hit(at):
        rays, start = camera.ray(at), camera.centre - axis
        across = rays * [1.0, 1.0, 0.0]
        middle, square = -np.sum(across * start, axis=1), np.sum(across**2, axis=1)
        root = middle**2 - square * (start[0] ** 2 + start[1] ** 2 - ROD**2)
        with np.errstate(invalid="ignore"):
            return camera.centre + rays * ((middle - np.sqrt(root)) / square)[:, None]

    grid = [np.arange(SPACING, side - SPACING, SPACING) for side in camera.size]
    px = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)
    shifts = ([0, 0], [1, 0], [-1, 0], [0, 1], [0, -1])
    whole = np.all([np.isfinite(hit(px + shift)).all(axis=1) for shift in shifts], axis=0)
    px = px[whole & (abs(hit(px)[:, 2] - MIDDLE[2]) < SIDE)]
    off = hit(px) - axis
    known = px[~bare(ROD * np.arctan2(off @ ACROSS, off @ NORMAL), off @ UP)]
    inverse = [1.0 / depths(camera, hit(known + shift)) for shift in shifts]
    slope = np.stack([inverse[1] - inverse[2], inverse[3] - inverse[4]], axis=1) / 2.0
    n = len(known)
    patches = Patches(known, inverse[0], slope, np.zeros((n, 3)))
    return DepthMap(SPACING, patches, np.full(n, 1e-6), px, np.ones(len(px), bool), 1.0)


def surface(hole, lost_at=NOTHING_LOST) -> ReferenceSurface:
    """The plate's triangles, without those whose middle lies in a hole."""
    at = np.arange(-SIDE, SIDE + 1.0, 2.0)
    a, b = (each.ravel() for each in np.meshgrid(at, at, indexing="ij"))
    xyz = MIDDLE + a[:, None] * ACROSS + b[:, None] * UP
    n = len(at)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([first, first + n, first + n + 1], axis=1), np.stack([first, first + n + 1, first + 1], axis=1)]
    )
    middle = xyz[faces].mean(axis=1)
    faces = faces[~hole(*on_plate(middle))]
    N, views = len(xyz), np.zeros((2, len(xyz), 2))
    nothing = np.zeros(N)
    return ReferenceSurface(
        xyz, faces, np.zeros(N, np.int64), views, views, views, np.zeros((2, N, 5), np.float32), np.ones(2), nothing,
        nothing.astype(np.int64), nothing, np.zeros((N, 4, 2), np.int64), np.zeros((0, 2), np.int64), lost_at,
        np.zeros((0, 8)),
    )  # fmt: skip


def areas(places: list[UnmeasuredPlaces]) -> dict:
    return unmeasured_areas(places, 100.0 * 144.0)


def unmeasured(maps, measured, incidence=65.0):
    return unmeasured_places(CAMERAS, maps, measured, incidence, MIDDLE)


def window(a, b):
    """24 cm² in the plate's middle."""
    return (abs(a) < 30.0) & (abs(b) < 20.0)


def nowhere(a, b):
    return np.zeros(np.shape(a), bool)


def test_a_covered_plate_has_nothing_unmeasured_but_its_rim() -> None:
    found = areas(unmeasured([depth_map(camera) for camera in CAMERAS], surface(nowhere)))
    assert found["total_cm2"] == 0.0
    assert found["seen_by_one_cm2"] == 0.0
    assert unmeasured_findings(found) == []


@pytest.mark.parametrize("hidden", [nowhere, window])
def test_a_hole_counts_once_with_its_area_whether_its_depth_is_known(hidden) -> None:
    """Two cameras see it at 30°; cells of 7 mm draw its edges to half a cell at random."""
    maps = [depth_map(camera, hidden) for camera in CAMERAS]
    found = areas(unmeasured(maps, surface(window)))
    assert found["total_cm2"] == pytest.approx(24.0, rel=0.12)
    assert found["seen_by_one_cm2"] == 0.0
    assert sum(found["by_reason"].values()) == pytest.approx(found["total_cm2"], abs=0.02)


def test_the_reason_is_that_of_the_chart_s_points_lost_there() -> None:
    camera = CAMERAS[0]
    a, b = (each.ravel() for each in np.meshgrid(np.arange(-30, 31, 3.0), np.arange(-20, 21, 3.0)))
    px = camera.project(MIDDLE + a[:, None] * ACROSS + b[:, None] * UP)
    status = np.where(a < 0, Status.LOW_ZNCC, LostPoint.RESIDUAL)
    lost = np.column_stack([np.zeros(len(a)), px, status]).astype(np.int64)
    found = areas(unmeasured([depth_map(camera) for camera in CAMERAS], surface(window, lost)))["by_reason"]
    assert found["low_zncc"] == pytest.approx(12.0, rel=0.25)
    assert found["residual"] == pytest.approx(12.0, rel=0.25)


def test_what_one_camera_alone_shows_is_not_counted_but_listed() -> None:
    maps = [depth_map(CAMERAS[0], window), depth_map(CAMERAS[1])]
    a, b = on_plate(maps[1].patches.points(CAMERAS[1], np.zeros((1, 2)))[:, 0])
    bare = ~window(a, b)
    there = np.array([tuple(at) in set(map(tuple, maps[1].patches.px[bare])) for at in maps[1].textured])
    maps[1] = replace(
        maps[1],
        patches=maps[1].patches.part(bare),
        textured=maps[1].textured[there],
        patterned=maps[1].patterned[there],
    )
    found = areas(unmeasured(maps, surface(window)))
    assert found["seen_by_one_cm2"] == pytest.approx(24.0, rel=0.3)
    assert found["total_cm2"] < 2.0


def test_what_only_one_camera_sees_squarely_enough_is_oblique() -> None:
    found = areas(unmeasured([depth_map(camera) for camera in CAMERAS], surface(window), incidence=25.0))
    assert list(found["by_reason"]) == ["oblique"]


def test_the_sides_of_a_rod_are_oblique_but_a_hole_in_its_front_counts() -> None:
    """Beyond 14° of its front nothing is known, and from 35° on one of the cameras sees it at over 65°."""
    squarely = 0.01 * 2 * 2 * SIDE * ROD * np.radians(35.0 - 14.0)
    counted = []
    for half in (0.0, 10.0):

        def bare(a, b, half=half):
            return (abs(a) > ROD * np.radians(14.0)) | ((abs(a) < half) & (abs(b) < 30.0))

        plate = surface(bare)
        measured = replace(plate, xyz=rolled(plate.xyz))
        found = areas(unmeasured([map_of_rod(camera, bare) for camera in CAMERAS], measured))
        counted.append(found["total_cm2"] - found["by_reason"].get("oblique", 0.0))
    assert 0.0 < counted[0] < squarely
    assert counted[1] - counted[0] > 0.9 * 12.0


def test_a_surface_behind_a_hole_does_not_cover_it() -> None:
    """The far side of a body shows through a hole of its near side; it faces away."""
    plate = surface(window)
    far = plate.xyz - 50.0 * NORMAL
    inwards = plate.faces[:, ::-1] + len(plate.xyz)
    both = replace(plate, xyz=np.concatenate([plate.xyz, far]), faces=np.concatenate([plate.faces, inwards]))
    found = areas(unmeasured([depth_map(camera) for camera in CAMERAS], both))
    assert found["total_cm2"] == pytest.approx(24.0, rel=0.12)


def test_a_sentence_names_the_largest_reason_with_its_area_and_what_to_do() -> None:
    maps = [depth_map(camera, window) for camera in CAMERAS]
    found = areas(unmeasured(maps, surface(window)))
    (finding,) = unmeasured_findings(found)
    sentence = finding.sentence
    assert f"{found['total_cm2']:.1f} of " in sentence
    assert "no match in another camera; draw masks" in sentence


def test_a_camera_without_any_depth_has_estimated_areas() -> None:
    everywhere = [depth_map(camera, lambda a, b: np.ones(a.shape, bool)) for camera in CAMERAS]
    found = areas(unmeasured(everywhere, surface(lambda a, b: np.ones(a.shape, bool))))
    assert 60.0 < found["total_cm2"] + found["rim_cm2"] + found["seen_by_one_cm2"] < 220.0
