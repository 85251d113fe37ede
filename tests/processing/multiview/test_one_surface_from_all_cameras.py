"""The surface that several cameras see together, from exact geometry and from rendered images with truth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.charts.agreement import triangulate_agreeing
from ringdic.charts.patches import warps_between
from ringdic.correlation import CorrelationSettings
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import holes, inconsistent_edges, is_closed_tube, non_manifold_vertices
from ringdic.multiview.lattice import Pieces, SurfaceLattice, fit_pieces
from ringdic.multiview.motion import Motion
from ringdic.multiview.shape import reference_shape
from ringdic.multiview.surface import pair_indices, shape_settings, surface_of_tracks
from ringdic.multiview.tasks import MultiviewJob, shape_task
from ringdic.multiview.tube import lattice_faces
from ringdic.multiview.views import visibility
from ringdic.multiview.warps import surface_stencil
from ringdic.results.reader import read_results
from ringdic.results.writer import write_results
from ringdic.settings import BEST, CorrelationGroup
from ringdic.strain.deformation import deformation
from ringdic.sweep.proxies import cylinder_intersections
from ringdic.sweep.sweep import DepthSearch
from ringdic.tasks import LocalExecutor, Task, process_memory
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import paper_rig
from ringdic_node.virtual_rig.scenes.specimen import Limb, Specimen

SCALE = 0.25
LATTICE = SurfaceLattice(radius=57.0, columns=240, z=np.arange(10.0, 230.1, 1.5))


def calibrated_cameras(cameras: int = 12, scale: float = 1.0) -> list[Camera]:
    """The virtual rig's cameras as a perfect calibration has them."""
    found = []
    for camera in paper_rig(cameras, scale).cameras:
        lens = Intrinsics(camera.K, np.array(camera.distortion), (camera.width, camera.height))
        P = lens.K_undistorted @ np.column_stack([camera.R, camera.t])
        found.append(Camera(camera.id, P / P[2, 3], lens.size, lens))
    return found


CAMERAS = calibrated_cameras()


def cylinder(radius: float = 57.0) -> Pieces:
    return fit_pieces(LATTICE, np.full(LATTICE.shape, radius), 6.0)


def test_warps_are_those_of_exact_lines_of_sight_to_a_cylinder() -> None:
    """Second differences over one pixel of lines of sight cut with the cylinder itself, no pieces."""
    first, second = CAMERAS[0], CAMERAS[1]
    pieces = cylinder()
    visible, _ = visibility(pieces, (first, second), {}, 40.0, 30.0)
    nodes = tuple(index[::53] for index in np.nonzero(visible.all(axis=0)))
    theta, z = (place[nodes] for place in LATTICE.coordinates)
    px = np.rint(first.project(pieces.xyz[nodes]))
    stencil = surface_stencil(LATTICE, pieces.coefficients[nodes], theta, z, first, px, 3.0)
    assert np.abs(np.hypot(stencil[..., 0], stencil[..., 1]) - 57.0).max() < 1e-9
    warps = warps_between(second, px, stencil, 3.0)

    def moved(dx: float, dy: float) -> np.ndarray:
        at = px + np.array([dx, dy])
        return second.project(cylinder_intersections(first, at, np.array([57.0]))[:, 0]) - at

    assert len(px) > 50
    np.testing.assert_allclose(warps[:, :2], moved(0, 0), rtol=0, atol=1e-7)
    along_x, along_y = (moved(1, 0) - moved(-1, 0)) / 2, (moved(0, 1) - moved(0, -1)) / 2
    slopes = np.stack([along_x, along_y], axis=-1).reshape(-1, 4)
    # Over 3 px the third derivative shows too: up to 2e-5 /px², a sixth of which times 3² is 3e-5.
    np.testing.assert_allclose(warps[:, 2:6], slopes, rtol=0, atol=5e-5)
    xx = moved(1, 0) - 2 * moved(0, 0) + moved(-1, 0)
    yy = moved(0, 1) - 2 * moved(0, 0) + moved(0, -1)
    assert np.abs(xx[:, 0]).max() > 5e-4
    np.testing.assert_allclose(warps[:, [6, 9]], xx, rtol=0, atol=1e-5)
    np.testing.assert_allclose(warps[:, [8, 11]], yy, rtol=0, atol=1e-5)


def test_cameras_see_the_nodes_that_face_them() -> None:
    pieces = cylinder()
    visible, cosine = visibility(pieces, CAMERAS, {}, 60.0, 0.0)
    towards = np.array([camera.centre for camera in CAMERAS])[:, None, None] - pieces.xyz
    normal = pieces.xyz * np.array([1, 1, 0]) / 57.0
    true = np.sum(towards * normal, axis=-1) / np.linalg.norm(towards, axis=-1)
    np.testing.assert_allclose(cosine, true, atol=1e-9)
    assert not visible[true < 0.5].any()
    inside = [((px := camera.project(pieces.xyz)) >= 0).all(-1) & (px < camera.size).all(-1) for camera in CAMERAS]
    assert visible[(true > 0.5) & np.array(inside)].mean() > 0.99
    assert np.median(visible.sum(axis=0)) >= 3


def test_a_mask_and_a_hidden_place_are_not_seen() -> None:
    theta, z = LATTICE.coordinates
    collar = 57.0 + 12.0 * np.exp(-(((z - 120.0) / 4.0) ** 2))  # stands 12 mm out at half height
    down = np.array([-np.sqrt(0.5), 0.0, -np.sqrt(0.5)])  # a camera 45° above the middle looks down on it
    right = np.array([0.0, 1.0, 0.0])
    R = np.stack([right, np.cross(down, right), down])
    centre = np.array([0.0, 0.0, 120.0]) - 350.0 * down
    P = np.diag([1000.0, 1000.0, 1.0]) @ np.column_stack([R, -R @ centre])
    P[:2] += np.outer([600.0, 600.0], P[2])
    above = Camera("above", P / P[2, 3], (1200, 1200))
    free, _ = visibility(fit_pieces(LATTICE, collar, 4.0), [above], {}, 80.0, 0.0)
    plain, _ = visibility(cylinder(), [above], {}, 80.0, 0.0)
    # The collar's shadow ends where the line over its edge meets the cylinder again.
    assert not free[0][(np.abs(z - 111.0) < 2) & plain[0]].any()
    assert plain[0][np.abs(z - 111.0) < 2].any()
    clear = (z < 95.0) & (np.cos(theta) > 0.9) & plain[0]
    assert clear.any()
    assert free[0][clear].all()
    camera = CAMERAS[0]
    mask = np.zeros((camera.size[1], camera.size[0]), bool)
    mask[:, : camera.size[0] // 2] = True
    masked, _ = visibility(cylinder(), [camera], {camera.id: mask}, 60.0, 0.0)
    assert masked.any()
    assert (camera.project(cylinder().xyz[masked[0]])[:, 0] < camera.size[0] / 2).all()


def test_a_lattice_with_lost_nodes_is_still_one_sheet() -> None:
    xyz = cylinder().xyz
    whole, used = lattice_faces(xyz)
    mesh = Mesh(xyz[used], whole)
    assert is_closed_tube(mesh)
    assert len(whole) == 2 * LATTICE.columns * (len(LATTICE.z) - 1)
    assert np.einsum("mi,mi->m", mesh.area_vectors[:, :2], mesh.centroids[:, :2]).min() > 0
    rng = np.random.default_rng(0)
    xyz[rng.random(LATTICE.shape) < 0.02] = np.nan
    xyz[30:33, 40:43] = np.nan
    faces, used = lattice_faces(xyz)
    mesh = Mesh(xyz[used], faces)
    assert len(np.unique(faces)) == len(mesh.vertices)
    assert len(inconsistent_edges(mesh)) == 0
    assert len(non_manifold_vertices(mesh)) == 0
    assert np.einsum("mi,mi->m", mesh.area_vectors[:, :2], mesh.centroids[:, :2]).min() > 0


def test_loose_nodes_at_the_rim_are_no_part_of_the_sheet_and_a_patch_is() -> None:
    xyz = cylinder().xyz
    xyz[:, :4] = np.nan
    xyz[100:102, :2] = cylinder().xyz[100:102, :2]
    faces, used = lattice_faces(xyz)
    assert used[1].min() == 4
    assert is_closed_tube(Mesh(xyz[used], faces))
    xyz[50:80, :3] = cylinder().xyz[50:80, :3]
    _, (column, row) = lattice_faces(xyz)
    assert set(column[row < 4]) == set(range(50, 80))


def test_a_view_that_contradicts_the_others_is_dropped_and_two_that_do_are_no_point() -> None:
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(40, 55, 300), rng.uniform(-20, 20, 300), rng.uniform(60, 180, 300)])
    cameras = [CAMERAS[k] for k in (11, 0, 1)]
    noise = 0.01
    px = np.stack([camera.project(xyz) for camera in cameras]) + noise * rng.standard_normal((3, 300, 2))
    px[2, :20] += [0.0, 3.0]
    px[2, 20:40] = np.nan
    px[1, 20:40] += [0.0, 3.0]
    points, used = triangulate_agreeing(cameras, px, np.full(px.shape, noise))
    assert not used[2, :20].any()
    assert used[:2, :20].all()
    assert np.isnan(points.xyz[20:40]).all()
    assert used[:, 40:].all()
    good = np.r_[0:20, 40:300]
    error = (points.xyz - xyz)[good]
    whitened = np.einsum("ni,nij,nj->n", error, np.linalg.inv(points.covariance[good]), error)
    assert whitened.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6 / len(good)))


@dataclass(frozen=True)
class Images:
    """Rendered images of three neighbouring cameras at two steps of the limb."""

    cameras: list[Camera]
    grey: dict[tuple[str, int], np.ndarray]

    def __call__(self, camera_id: str, step: int) -> np.ndarray | None:
        return self.grey.get((camera_id, step))


STEP = 2  # of the limb's load: strains of several per cent


@pytest.fixture(scope="module")
def limb() -> Images:
    rig = paper_rig(12, SCALE)
    chosen = (11, 0, 1)
    grey = {
        (rig.cameras[k].id, n): render(rig.cameras[k], Specimen(Limb(), step), seed=10 * k + n)
        for k in chosen
        for n, step in enumerate((0, STEP))
    }
    cameras = calibrated_cameras(12, SCALE)
    return Images([cameras[k] for k in chosen], grey)


CORRELATION = CorrelationSettings(radius=8, step=5)
SEARCH = DepthSearch(radius=57.0, reach=20.0, incidence=65.0)


def measured(images: Images, **more):
    masks = more.get("masks", {})
    return reference_shape(images.cameras, lambda id_: images(id_, 0), masks, [(0, 1), (1, 2)], SEARCH, CORRELATION)


@pytest.fixture(scope="module")
def shape(limb: Images):
    return measured(limb)


def test_the_shape_of_a_limb_from_three_cameras(limb: Images, shape, figures) -> None:
    _, z, distance = Limb().material_coordinates(shape.xyz)
    speckled = (z > 5) & (z < 245)
    rms, worst = float(np.sqrt(np.mean(distance[speckled] ** 2))), float(np.abs(distance[speckled]).max())
    normals = shape.pieces.normals[shape.node[:, 0], shape.node[:, 1]]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", normals, shape.covariance, normals))
    figures("three cameras at quarter scale: limb's shape, RMS", f"{1e3 * rms:.1f} µm", "≤ 40")
    assert rms < 0.04  # a tenth of a pixel
    assert worst < 0.4
    assert np.median(np.abs(distance / sigma)[speckled]) < 1.0  # 0.67 of a normal distribution, the floor included
    mesh = Mesh(shape.xyz, shape.faces)
    assert len(non_manifold_vertices(mesh)) == 0
    assert len(holes(mesh, above=5.0)) == 0
    # The part of the limb that two of the three cameras see under 60° is there.
    theta, height = np.meshgrid(np.linspace(0, 2 * np.pi, 200, endpoint=False), np.arange(12.0, 230.0, 3.0))
    place = Limb().position(theta, height, 0)
    along, up = np.moveaxis(Limb().tangents(theta, height, 0), -2, 0)
    normal = np.cross(along, up)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    seen_by = sum(camera.incidence_cosine(place, normal) > 0.5 for camera in limb.cameras)
    inside = sum(
        ((px := camera.project(place)) > 10).all(-1) & (px < np.array(camera.size) - 10).all(-1)
        for camera in limb.cameras
    )
    wanted = place[(seen_by >= 2) & (inside == 3)]
    gap = np.array([np.linalg.norm(shape.xyz - p, axis=1).min() for p in wanted])
    assert (gap < 2.0).mean() > 0.98


def test_points_rest_on_whole_pixels_of_their_reference_camera(shape) -> None:
    own = shape.px[shape.reference, np.arange(len(shape.xyz))]
    assert (own == np.rint(own)).all()
    assert (np.isfinite(shape.px[..., 0]).sum(axis=0) >= 2).all()


def test_the_motion_of_the_limb_from_three_cameras(
    limb: Images, shape, motion_of_shape: Callable[..., Motion], figures
) -> None:
    motion = motion_of_shape(limb.cameras, shape, limb, 2, CORRELATION, 0.1)
    theta, z, _ = Limb().material_coordinates(shape.xyz)
    speckled = (z > 5) & (z < 245)
    true = [Limb().position(theta, z, step) for step in (0, STEP)]
    error = np.linalg.norm(motion.xyz[1] - shape.xyz - (true[1] - true[0]), axis=1)[speckled]
    rms = float(np.sqrt(np.nanmean(error**2)))
    figures("three cameras at quarter scale: displacement, RMS", f"{1e3 * rms:.1f} µm", "≤ 20")
    assert np.isfinite(error).mean() > 0.98
    assert rms < 0.02
    assert np.nanmax(error) < 0.4
    whole = speckled[shape.faces].all(axis=1)
    found = deformation(shape.xyz, motion.xyz[1], shape.faces)
    exact = deformation(true[0], true[1], shape.faces)
    assert np.nanstd((found.lambda2 - exact.lambda2)[whole]) < 3e-3
    # A camera that drops out does not move the points: they are labels that all cameras share.
    without = Images(limb.cameras, {key: grey for key, grey in limb.grey.items() if key != (limb.cameras[2].id, 1)})
    fewer = motion_of_shape(limb.cameras, shape, without, 2, CORRELATION, 0.1)
    both = np.isfinite(fewer.xyz[1, :, 0]) & np.isfinite(motion.xyz[1, :, 0]) & speckled
    assert 0.3 < both.mean() < 0.9
    assert np.abs(np.median((fewer.xyz - motion.xyz)[1, both], axis=0)).max() < 1e-3


def test_two_cameras_are_enough_and_a_third_that_sees_nothing_is_named(limb: Images, tmp_path: Path) -> None:
    ids = [camera.id for camera in limb.cameras]
    grey = {id_: limb.grey[id_, 0] for id_ in ids[:2]}
    grey[ids[2]] = np.full_like(grey[ids[0]], 128)
    images = {id_: tmp_path / f"{id_}.png" for id_ in ids}
    for id_, path in images.items():
        assert cv2.imwrite(str(path), grey[id_])
    settings = BEST.model_copy(update={"correlation": CorrelationGroup(radius_px=8, step_px=5)})
    correlation = CorrelationSettings(**settings.correlation.keywords)
    pairs = [(ids[0], ids[1]), (ids[1], ids[2])]
    numbers, how = tuple(pair_indices(limb.cameras, pairs)), shape_settings(settings)
    arguments = (tuple(limb.cameras), numbers, SEARCH, correlation, how, images, {})
    job = MultiviewJob(tuple(limb.cameras), Task("shape", "shape", shape_task, arguments, tmp_path), ((), (), ()))
    process_memory.clear()
    LocalExecutor(1).run(job.tasks, lambda *_: None)
    surface = surface_of_tracks("ring", limb.cameras, pairs, ["reference"], *job.outputs(), settings)
    results = surface.results
    assert [sentence for sentence in surface.warnings if ids[2] in sentence]
    assert len(surface.warnings) == 1
    assert set(surface.drift) == set(ids[:2])
    assert set(results.pair) == {0}
    assert len(results.vertices_ref) > 1000
    assert surface.agreement["views"] == 2.0
    _, z, distance = Limb().material_coordinates(results.vertices_ref)
    speckled = (z > 5) & (z < 245)
    assert np.abs(distance[speckled]).max() < 0.5
    assert np.sqrt(np.mean(distance[speckled] ** 2)) < 0.04  # a tenth of a pixel
    assert {matches.cameras for matches in results.matches} == {(ids[0],), (ids[1],)}
    write_results(tmp_path / "results.h5", results)
    again = read_results(tmp_path / "results.h5")
    for one, other in zip(results.matches, again.matches, strict=True):
        assert one.cameras == other.cameras
        np.testing.assert_array_equal(one.px, other.px)


def test_cameras_that_see_nothing_in_common_are_refused(limb: Images) -> None:
    blank = {key: np.full_like(grey, 128) for key, grey in limb.grey.items()}
    with pytest.raises(ComputationError, match="speckled"):
        measured(Images(limb.cameras, blank))
