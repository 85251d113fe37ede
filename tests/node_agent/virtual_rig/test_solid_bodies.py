"""Solid bodies: their motion, surface and images agree with exact solutions."""

import math

import cv2
import numpy as np
import pytest
from ringdic import correlate
from ringdic.calibration.dots import find_dots
from ringdic.calibration.target import identify_dots
from ringdic.session.rig import parse_rig
from ringdic_node.virtual_rig.bodies import branches, rounded_box, solid_bodies, upright_column
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.render import radiance, render
from ringdic_node.virtual_rig.rig import arc_rig, paper_rig, two_row_rig
from ringdic_node.virtual_rig.scenes import Solid, SolidMotion, SolidSpecimen, TargetScene
from ringdic_node.virtual_rig.solid import STEEPEST

BODIES = solid_bodies()
ANY = SolidMotion(
    stretch=0.04, axis=(0.6, 0.0, 0.8), swell=-0.05, swell_z=20.0, swell_width=60.0, twist=6e-4, bend=(3e-4, -2e-4),
    turn_deg=(20.0, -35.0, 110.0), shift=(4.0, -3.0, 7.0),
)  # fmt: skip


def ball(radius: float) -> Solid:
    return branches([(0.0, 0.0, 0.0, radius, 0.0, 0.0, 0.0, radius)], 0.0)


def rays(camera: VirtualCamera, px: np.ndarray) -> np.ndarray:
    """Unit directions in the world of the rays of distorted pixels (n, 2), by fixed-point iteration."""
    x = np.zeros((len(px), 3))
    x[:, 2] = 1.0
    for _ in range(60):
        x[:, :2] += (px - camera.project_local(x)) / [camera.K[0, 0], camera.K[1, 1]]
    return x / np.linalg.norm(x, axis=1, keepdims=True) @ camera.R


@pytest.mark.parametrize("name", BODIES)
def test_the_motion_is_inverted_exactly_and_the_surface_is_found(name: str) -> None:
    body = BODIES[name]()
    xyz, normals, area = body.sample(500)
    moved = SolidSpecimen(body, ANY)
    np.testing.assert_allclose(moved.moved_back(moved.moved(xyz)), xyz, atol=1e-10)
    np.testing.assert_allclose(body.nearest(xyz)[2], 0.0, atol=1e-7)
    off = np.random.default_rng(1).uniform(-0.5, 0.5, len(xyz))
    flat = np.linalg.norm(body.nearest(xyz + off[:, None] * normals)[0] - xyz, axis=1) < 1e-5
    assert flat.mean() > 0.97  # the others lie at a sharp edge
    np.testing.assert_allclose(body.nearest(xyz + off[:, None] * normals)[2][flat], off[flat], atol=1e-6)
    assert area > 0


@pytest.mark.parametrize("name", BODIES)
def test_no_step_along_a_ray_can_pass_the_surface(name: str) -> None:
    body = BODIES[name]()
    specimen = SolidSpecimen(body, ANY)
    R, t = body.pose
    rng = np.random.default_rng(2)
    xyz = specimen.moved(t + rng.uniform(-1.0, 1.0, (4000, 3)) * [110.0, 110.0, 130.0])

    def values(at: np.ndarray) -> np.ndarray:
        return body.values((specimen.moved_back(at) - t) @ R)[0]

    outside = values(xyz) > 0
    steps = 1e-3 * np.eye(3)
    slopes = [(values(xyz + step) - values(xyz - step))[outside] / 2e-3 for step in steps]
    assert outside.sum() > 100
    assert np.linalg.norm(slopes, axis=0).max() < STEEPEST


def test_the_stretches_of_simple_motions_are_exact() -> None:
    rod = upright_column(30.0)
    xyz, normals, _ = rod.sample(400)
    wall = np.abs(normals[:, 2]) < 1e-6
    xyz, normals = xyz[wall], normals[wall]
    along = SolidSpecimen(rod, SolidMotion(stretch=0.05)).stretches(xyz, normals)
    np.testing.assert_allclose(along, np.tile([1.0, 1.05], (len(xyz), 1)), atol=1e-9)
    wider = SolidSpecimen(rod, SolidMotion(swell=0.04, swell_width=1e9, turn_deg=(10.0, 70.0, -30.0)))
    np.testing.assert_allclose(wider.stretches(xyz, normals), np.tile([1.0, 1.04], (len(xyz), 1)), atol=1e-9)
    twisted = SolidSpecimen(rod, SolidMotion(twist=2e-3)).stretches(xyz, normals)
    shear = 2e-3 * 30.0  # simple shear: λ - 1/λ = γ
    np.testing.assert_allclose(twisted[:, 1] - 1.0 / twisted[:, 1], shear, atol=1e-8)
    np.testing.assert_allclose(twisted.prod(axis=1), 1.0, atol=1e-9)


def test_a_rigid_motion_stretches_nothing() -> None:
    specimen = SolidSpecimen(BODIES["limb-tilted"](), SolidMotion(turn_deg=(30.0, -80.0, 200.0), shift=(5.0, 6.0, 7.0)))
    xyz, normals, _ = specimen.solid.sample(300)
    np.testing.assert_allclose(specimen.stretches(xyz, normals), 1.0, atol=1e-9)
    moved = specimen.moved(xyz)
    np.testing.assert_allclose(
        np.linalg.norm(moved - moved[0], axis=1), np.linalg.norm(xyz - xyz[0], axis=1), atol=1e-9
    )


@pytest.mark.parametrize(
    ("body", "area"),
    [
        (ball(40.0), 4 * math.pi * 40.0**2),
        (upright_column(30.0), 2 * math.pi * 30.0 * (220.0 + 30.0)),
        (
            rounded_box((90.0, 60.0, 120.0), 8.0, 10.0),
            2 * (74 * 44 + 44 * 104 + 104 * 74) + 2 * math.pi * 8 * (74 + 44 + 104) + 4 * math.pi * 8**2,
        ),
    ],
)
def test_the_sample_stands_for_the_surfaces_area(body: Solid, area: float) -> None:
    xyz, normals, each = body.sample(20_000)
    assert each * len(xyz) == pytest.approx(area, rel=0.03)  # four standard deviations of the count
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)
    high = xyz[:, 2] > 125.0
    assert high.mean() == pytest.approx(0.5, abs=0.02)


def test_rays_meet_a_ball_where_they_should() -> None:
    specimen = SolidSpecimen(ball(40.0), SolidMotion(turn_deg=(10.0, 20.0, 30.0), shift=(3.0, -4.0, 5.0)))
    centre, start = np.array([3.0, -4.0, 130.0]), np.array([300.0, 50.0, 200.0])
    aims = centre + np.random.default_rng(3).uniform(-50.0, 50.0, (3000, 3))
    d = (aims - start) / np.linalg.norm(aims - start, axis=1, keepdims=True)
    b = d @ (centre - start)
    root = b**2 - np.sum((centre - start) ** 2) + 40.0**2
    found = specimen.hit_distances(np.tile(start, (len(d), 1)), d)
    clear = np.abs(root) > 1e-2  # a ray that only grazes the ball may pass
    np.testing.assert_array_equal(found[clear] > 0, root[clear] > 0)
    met = found > 0
    np.testing.assert_allclose(found[met], b[met] - np.sqrt(root[met]), atol=2e-9 + 1e-12 * 300)


def test_the_silhouette_of_a_ball_is_its_tangent_cone() -> None:
    camera = arc_rig(2, 30.0, 0.12).cameras[0]
    body = ball(50.0)
    picture = radiance(camera, SolidSpecimen(body))
    empty = radiance(camera, SolidSpecimen(body, SolidMotion(shift=(0.0, 0.0, 5000.0))))
    towards = np.array([0.0, 0.0, 125.0]) - camera.centre
    far = float(np.linalg.norm(towards))
    half = math.asin(50.0 / far)
    across = np.linalg.svd(towards[None])[2][1:]
    turn = np.linspace(0.0, 2.0 * math.pi, 720, endpoint=False)[:, None]
    rim = towards / far * math.cos(half) + math.sin(half) * (np.cos(turn) * across[0] + np.sin(turn) * across[1])
    outline = camera.project(camera.centre + 100.0 * rim).astype(np.float32)
    depth = np.array(
        [
            [cv2.pointPolygonTest(outline, (float(u), float(v)), True) for u in range(camera.width)]
            for v in range(camera.height)
        ]
    )
    np.testing.assert_array_equal(picture[depth < -2.0], empty[depth < -2.0])
    assert (np.abs(picture - empty)[depth > 1.0] > 1e-6).mean() > 0.995
    edge = np.abs(depth) <= 1.0  # a pixel shows the body where one of its four samples, at a quarter pixel, meets it
    assert 0.5 < (np.abs(picture - empty)[edge] > 0.01).mean() < 0.8


def test_images_of_a_plate_that_moves_rigidly_correlate_to_the_true_displacement() -> None:
    camera = arc_rig(2, 30.0, 0.2).cameras[1]
    plate = BODIES["plate-tangent"]()
    after = SolidSpecimen(plate, SolidMotion(turn_deg=(1.0, -0.7, 1.5), shift=(1.3, -0.8, 1.1)))
    images = [render(camera, scene, seed) for seed, scene in enumerate((SolidSpecimen(plate), after))]
    mask = np.zeros(images[0].shape, dtype=bool)
    corners = np.array([[0.75, y, z] for y, z in ((-60, -90), (60, -90), (60, 90), (-60, 90))])
    R, t = plate.pose
    outline = camera.project(corners @ R.T + t)
    mask[:] = cv2.fillConvexPoly(mask.astype(np.uint8), np.rint(outline).astype(np.int32), 1) > 0
    matches = correlate(*images, mask=mask, radius=12, step=8, progress=False)
    assert matches.good.mean() > 0.98
    px = matches.xy[matches.good]
    d = rays(camera, px)
    depth = SolidSpecimen(plate).hit_distances(np.tile(camera.centre, (len(d), 1)), d)
    xyz = camera.centre + depth[:, None] * d
    true = camera.project(after.moved(xyz)) - px
    error = matches.displacement[matches.good] - true
    sigma = matches.sigma[matches.good]
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert 0.8 < math.sqrt(np.mean((error / sigma) ** 2)) < 1.4


def test_an_image_out_of_focus_is_the_sharp_one_blurred() -> None:
    camera = arc_rig(2, 30.0, 0.1).cameras[0]
    sharp = radiance(camera, SolidSpecimen(BODIES["limb"]()))
    soft = radiance(camera, SolidSpecimen(BODIES["limb"](), defocus=1.4))
    np.testing.assert_allclose(
        soft, cv2.GaussianBlur(sharp, (15, 15), 1.4, borderType=cv2.BORDER_REFLECT_101), atol=1e-5
    )


def test_a_body_hides_another() -> None:
    camera = paper_rig(12, 0.2).cameras[4]  # at 120°, nearly on the line of both rods
    specimen = SolidSpecimen(BODIES["two-rods"]())
    xyz, normals, _ = specimen.solid.sample(4000)
    R, _ = specimen.solid.pose
    upright = np.abs(xyz[:, 2] - 125.0) < 70.0
    far = (xyz @ R[:, 0] < 0) & upright & (np.sum(normals * (camera.centre - xyz), axis=1) > 0.3 * 350.0)
    seen = specimen.visible([camera], xyz[far], normals[far], 80.0)[0]
    # The near rod, of 22 mm, hides what lies on a line of sight that passes its axis nearer than that.
    axis, sight = 37.5 * R[:2, 0], xyz[far, :2] - camera.centre[:2]
    normal = np.stack([-sight[:, 1], sight[:, 0]], axis=1) / np.linalg.norm(sight, axis=1, keepdims=True)
    gap = np.abs(normal @ (axis - camera.centre[:2]))
    assert 0.2 < seen.mean() < 0.8
    np.testing.assert_array_equal(seen[np.abs(gap - 22.0) > 0.1], gap[np.abs(gap - 22.0) > 0.1] > 22.0)


def test_the_second_row_sees_enough_of_the_target_to_be_calibrated() -> None:
    rig = two_row_rig(12, 6, 0.3)
    camera = rig.cameras[13]
    image = render(camera, TargetScene(), 1)
    described = parse_rig(rig.rig_toml())
    dots = identify_dots(find_dots(image, described.target), described.target, camera.azimuth_deg, camera=camera.id)
    assert len(dots) > 100
    np.testing.assert_allclose(dots.px, camera.project(dots.xyz), atol=0.4)  # a centroid is not its centre's image
    assert ("cam_01", "cam_02") in described.pairs
    assert len(described.pairs) == 12 + 6 + 6


def test_an_arc_stands_about_the_azimuth_that_bodies_face() -> None:
    azimuths = [camera.azimuth_deg for camera in arc_rig(4).cameras]
    assert azimuths == [0.0, 30.0, 60.0, 90.0]
    assert [camera.azimuth_deg for camera in arc_rig(2).cameras] == [30.0, 60.0]
