"""The judges of the validation: what is exact has no error, each known error shows where it should."""

import numpy as np
import pytest
from ringdic.geometry.camera import Camera
from ringdic.results.results import Matches, Results
from ringdic_controller.studies.validate.calibration import ExactRays, true_camera
from ringdic_controller.studies.validate.cylinder import CylinderRun, diameter, figure_7a, figure_7b, separate_errors
from ringdic_controller.studies.validate.figures import BETTER, PAPER, Figure
from ringdic_controller.studies.validate.limb import LimbRun, compare_spoilt, figure_9
from ringdic_controller.studies.validate.report import blindness
from ringdic_controller.studies.validate.scenery import Scenery
from ringdic_controller.studies.validate.shapes import fitted_cylinder
from ringdic_controller.studies.validate.tracks import Tracks, mismatch
from ringdic_node.virtual_rig.scenes import Cylinder, Limb, Specimen

SCENERY = Scenery(scale=0.25, boards=1, cylinder=2, limb=2)
RIG = SCENERY.rig
TRUE = {camera.id: true_camera(camera) for camera in RIG.cameras}
IDS = list(TRUE)
PAIRS = tuple(zip(IDS, IDS[1:] + IDS[:1], strict=True))
TURN = 2 * np.pi


def tube(columns: int, rows: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Material coordinates and triangles of a closed tube, normals outwards."""
    theta, z = np.meshgrid(np.arange(columns) * TURN / columns, np.linspace(low, high, rows), indexing="ij")
    i, j = np.meshgrid(np.arange(columns), np.arange(rows - 1), indexing="ij")
    a, b = i * rows + j, (i + 1) % columns * rows + j
    faces = np.concatenate([np.stack([a, b, b + 1], -1).reshape(-1, 3), np.stack([a, b + 1, a + 1], -1).reshape(-1, 3)])
    return theta.ravel(), z.ravel(), faces


def exact(surface: Cylinder | Limb, steps: list[int], keep: np.ndarray | None = None, columns: int = 150) -> Results:
    """Results of a run without error, every camera on its own points; ``keep`` are the triangles that are measured."""
    theta, z, faces = tube(columns, 90, 6.0 if isinstance(surface, Limb) else 13.0, 244.0)
    vertices = np.array([surface.position(theta, z, step) for step in steps])
    tangents = surface.tangents(theta, z, 0)
    normals = np.cross(tangents[:, 0], tangents[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    F, N = vertices.shape[:2]
    matches = []
    for id_, camera in TRUE.items():
        seen = np.flatnonzero(camera.incidence_cosine(vertices[0], normals) > 0.5)
        px = camera.project(vertices[:, seen])[:, None]
        shape = F, len(seen)
        matches.append(
            Matches(
                (id_,), px[0, 0], px, np.zeros(shape), np.full(px.shape, 0.01), np.zeros(shape, dtype=np.int8), seen
            )
        )
    faces = faces if keep is None else faces[keep]
    return Results(
        "exact", tuple(f"step {k}" for k in steps), tuple(TRUE.values()), PAIRS, vertices[0], vertices, faces,
        np.zeros(len(faces), dtype=int), np.zeros(N, dtype=int), np.zeros((F, N)), np.zeros((F, N, 3)),
        np.zeros((F, N), dtype=np.int8), tuple(matches),
    )  # fmt: skip


def values(figures: tuple[Figure, ...], way: str = BETTER) -> dict[str, float]:
    return {figure.quantity: figure.values[way] for figure in figures if way in figure.values}


@pytest.fixture(scope="module")
def cylinder() -> Results:
    return exact(Cylinder(), [0, 1, 2])


def test_the_processing_projects_as_the_simulated_camera_does() -> None:
    xyz = Limb().position(np.linspace(0, 6, 40), np.linspace(10, 240, 40), 1)
    for camera in RIG.cameras[:3]:
        facing = xyz[xyz @ (camera.centre * [1, 1, 0]) > 0]
        np.testing.assert_allclose(TRUE[camera.id].project(facing), camera.project(facing), atol=1e-7)


def test_a_cylinder_is_fitted_wherever_it_stands() -> None:
    rng = np.random.default_rng(4)
    angle, h = rng.uniform(0, TURN, 3000), rng.uniform(-100, 100, 3000)
    radii = 57.01 + rng.normal(0, 0.002, 3000)
    lean = np.array([0.02, -0.01, 1.0]) / np.linalg.norm([0.02, -0.01, 1.0])
    a = np.cross(lean, [0, 1, 0]) / np.linalg.norm(np.cross(lean, [0, 1, 0]))
    ring = np.outer(radii * np.cos(angle), a) + np.outer(radii * np.sin(angle), np.cross(lean, a))
    found = fitted_cylinder(ring + np.outer(h, lean) + [1.0, -2.0, 120.0])
    assert found.diameter == pytest.approx(114.02, abs=5 * 0.004 / np.sqrt(3000))
    assert found.spread == pytest.approx(0.004, rel=0.1)


def test_exact_lines_of_sight_in_true_cameras_give_the_true_diameter() -> None:
    rays = ExactRays.of(TRUE, PAIRS)
    assert abs(rays.diameter_bias(TRUE)) < 1e-9


def test_a_calibration_of_the_wrong_radius_shows_on_exact_lines_of_sight() -> None:
    grown = np.diag([1.001, 1.001, 1.0, 1.0])  # every camera believes the world that much wider about the axis
    cameras = {}
    for id_, camera in TRUE.items():
        P = camera.P @ np.linalg.inv(grown)
        cameras[id_] = Camera(id_, P / P[2, 3], camera.size, camera.intrinsics)
    assert ExactRays.of(TRUE, PAIRS).diameter_bias(cameras) == pytest.approx(0.114, abs=1e-6)


def test_an_exact_cylinder_has_no_error_in_any_figure(cylinder: Results) -> None:
    runs = {BETTER: CylinderRun.of(cylinder)}
    found = values(diameter(runs, PAIRS).figures)
    found |= values(figure_7a(runs, PAIRS).figures)
    found |= values(figure_7b(runs, Cylinder(), PAIRS).figures)
    found |= values(separate_errors(runs, ExactRays.of(TRUE, PAIRS), TRUE, TRUE).figures)
    assert len(found) > 15
    for name, value in found.items():
        assert abs(value) < 1e-6, name


def test_a_bias_of_the_matching_shows_in_true_cameras_and_not_on_exact_lines_of_sight(cylinder: Results) -> None:
    # Each second camera sees everything 0.1 px to the right of where it is: disparities are wrong by that.
    shifted = []
    for k, matches in enumerate(cylinder.matches):
        off = np.array([0.1 * (k % 2), 0.0])
        shifted.append(
            Matches(
                matches.cameras, matches.xy + off, matches.px + off, matches.c_ls, matches.sigma, matches.status,
                matches.vertex,
            )
        )  # fmt: skip
    tracks = Tracks.of(_with_matches(cylinder, tuple(shifted)))
    run = CylinderRun(cylinder, TRUE, tracks)
    found = values(separate_errors({BETTER: run}, ExactRays.of(TRUE, PAIRS), TRUE, TRUE).figures)
    assert abs(found["diameter, exact lines of sight, this calibration"]) < 1e-9
    assert mismatch(tracks, TRUE, PAIRS).mean() > 0.01  # 0.1 px are 0.04 mm here, to either side by turns


def test_two_meshes_of_neighbouring_pairs_are_compared_over_the_image_they_share() -> None:
    surface = Cylinder()
    parts, offset, vertices = [], 0, []
    for k, pair in enumerate(PAIRS[:2]):
        middle = np.arctan2(*(TRUE[pair[0]].centre + TRUE[pair[1]].centre)[[1, 0]])
        theta, z = (
            a.ravel()
            for a in np.meshgrid(middle + np.linspace(-0.5, 0.5, 60) + 0.003 * k, np.linspace(60, 110, 50) + 0.4 * k)
        )
        xyz = surface.position(theta, z, 0)
        lifted = xyz * ([1.001, 1.001, 1.0] if k else [1.0, 1.0, 1.0])  # the second pair measures 57 µm too far out
        n = len(xyz)
        for id_ in pair:
            px = TRUE[id_].project(lifted)
            parts.append(
                Matches((id_,), px, px[None, None], np.zeros((1, n)), np.full((1, 1, n, 2), 0.01),
                        np.zeros((1, n), dtype=np.int8), offset + np.arange(n))
            )  # fmt: skip
        vertices.append(lifted)
        offset += n
    xyz = np.concatenate(vertices)
    n = len(xyz)
    results = Results(
        "two", ("0",), tuple(TRUE.values()), PAIRS, xyz, xyz[None], np.array([[0, 1, 61]]), np.zeros(1, dtype=int),
        np.zeros(n, dtype=int), np.zeros((1, n)), np.zeros((1, n, 3)), np.zeros((1, n), dtype=np.int8), tuple(parts),
    )  # fmt: skip
    distances = mismatch(Tracks.of(results), TRUE, PAIRS)
    assert len(distances) > 500
    # Carried along the lines of sight of the shared camera, 0.057 mm along the normal are as much over the cosine.
    assert 0.057 <= np.median(distances) < 0.057 / np.cos(np.radians(50))
    assert distances.min() > 0.0565


def test_an_exact_limb_has_no_error_in_any_figure() -> None:
    scenes = [scene for scene in SCENERY.scenes("limb") if isinstance(scene, Specimen)]
    results = exact(Limb(), [0, 1, 2])
    found = values(figure_9({BETTER: LimbRun.of(results, scenes)}, scenes, RIG.cameras).figures)
    assert found["one closed tube"] == 1.0
    assert found["covered of what two cameras see under 60°"] > 99.0  # the tube ends a millimetre inside the band
    for name in ("points wrong by more than 1 mm", "displacement, RMS, worst step", "points lost after the reference",
                 "distance from the true surface, RMS", "non-manifold edges", "holes above 5 mm²"):  # fmt: skip
        assert abs(found[name]) < 1e-8, name
    assert found["stretches, STD, worst step"] < 2e-3  # triangles of 2.5 mm are flat


def test_what_a_run_loses_is_compared_with_what_was_spoilt() -> None:
    scenes = [scene for scene in SCENERY.scenes("spoilt") if isinstance(scene, Specimen)]
    steps = [scene.step for scene in scenes]
    theta, z, faces = tube(150, 90, 6.0, 244.0)
    worn = scenes[-1].damage.worn(theta, z)
    clean = LimbRun.of(exact(Limb(), steps), [Specimen(Limb(), step) for step in steps])
    nothing_lost = LimbRun.of(exact(Limb(), steps), scenes)
    worn_lost = LimbRun.of(exact(Limb(), steps, ~worn[faces].any(axis=1)), scenes)
    found = compare_spoilt({PAPER: nothing_lost, BETTER: worn_lost}, {PAPER: clean, BETTER: clean}, scenes, RIG.cameras)
    none, some = values(found.figures, PAPER), values(found.figures, BETTER)
    assert none["lost area"] == 0.0
    patches = sum(np.pi * patch.half_arc * patch.half_height for patch in scenes[-1].damage.patches) / 100
    assert some["lost area"] == pytest.approx(patches, rel=0.35)  # cm²: the limb is not 57 mm wide all over, and rims
    assert some["blind area, fewer than two clean views"] >= 0.9 * patches * 0.8
    assert some["spoilt area, in any view"] > some["blind area, fewer than two clean views"]
    assert some["lost points without a reason"] == 0.0


def test_a_figure_says_whether_it_is_reached() -> None:
    assert Figure("e", "q", "mm", {BETTER: -0.003}, limit=0.003).reached
    assert Figure("e", "q", "mm", {BETTER: -0.0031}, limit=0.003).reached is False
    assert Figure("e", "q", "%", {BETTER: 98.5}, limit=98.0, least=True).reached
    assert Figure("e", "q", "mm", {PAPER: 1.0}, limit=0.003).reached is None
    assert Figure("e", "q", "mm", {BETTER: float("nan")}, limit=0.003).reached is False


def test_a_figure_alike_both_ways_does_not_see_the_errors() -> None:
    table = blindness(
        [
            Figure("Table 2", "control points, RMS", "mm", {PAPER: 0.0020, BETTER: 0.0015}, "0.047"),
            Figure("diameter", "bias, all views", "mm", {PAPER: -0.054, BETTER: 0.0003}, "−0.07"),
            Figure("Fig. 9", "displacement", "mm", {PAPER: 1.0, BETTER: 0.0}),
        ]
    )
    assert [(row["figure"], row["sees the errors"]) for row in table] == [
        ("Table 2: control points, RMS", "no"),
        ("diameter: bias, all views", "yes"),
    ]


def _with_matches(results: Results, matches: tuple[Matches, ...]) -> Results:
    return Results(
        results.rig, results.steps, results.cameras, results.pairs, results.vertices_ref, results.vertices,
        results.faces, results.pair, results.vertex_pair, results.correlation, results.sigma_xyz, results.status,
        matches,
    )  # fmt: skip
