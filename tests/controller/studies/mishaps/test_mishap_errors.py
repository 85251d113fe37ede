"""The errors of a run are those that are planted in it, at all steps and beside the σ that it states."""

from dataclasses import replace

import numpy as np
import pytest
from ringdic.geometry.camera import Camera
from ringdic.results.results import Results
from ringdic_controller.studies.gallery.rows import MODERATE, gallery_rig
from ringdic_controller.studies.mishaps.errors import run_errors, uncovered_shares
from ringdic_controller.studies.mishaps.measurement import SHARES, motion_share, moving_specimens
from ringdic_node.virtual_rig.bodies import upright_column
from ringdic_node.virtual_rig.scenes import SolidSpecimen

BODY = upright_column(30.0)
SPECIMENS = [SolidSpecimen(BODY, motion_share(MODERATE, share)) for share in SHARES]
SIGMA, SIGMA_MOVED = 0.02, 0.01  # mm


def exact() -> Results:
    """Results of two steps without error on the wall of a rod of 30 mm."""
    theta, z = np.meshgrid(np.arange(60) * 2 * np.pi / 60, np.linspace(30.0, 220.0, 70), indexing="ij")
    i, j = np.meshgrid(np.arange(60), np.arange(69), indexing="ij")
    a, b = i * 70 + j, (i + 1) % 60 * 70 + j
    faces = np.concatenate([np.stack([a, b, b + 1], -1).reshape(-1, 3), np.stack([a, b + 1, a + 1], -1).reshape(-1, 3)])
    xyz = np.stack([30.0 * np.cos(theta), 30.0 * np.sin(theta), z], axis=-1).reshape(-1, 3)
    N, M = len(xyz), len(faces)
    cameras = tuple(
        Camera(c.id, c.K @ np.column_stack([c.R, c.t]), (c.width, c.height)) for c in gallery_rig("arc4", 0.1).cameras
    )
    return Results(
        "exact", ("before", "half", "whole"), cameras, (("cam_01", "cam_02"),), xyz,
        np.stack([each.moved(xyz) for each in SPECIMENS]), faces, np.zeros(M, dtype=int), np.zeros(N, dtype=int),
        np.zeros((3, N)), np.full((3, N, 3), SIGMA), np.zeros((3, N), dtype=np.int8),
        sigma_displacement=np.full((3, N, 3), SIGMA_MOVED), sigma_lambda=np.full((3, M, 2), 1e-3),
    )  # fmt: skip


def with_vertices(results: Results, vertices: np.ndarray) -> Results:
    return replace(results, vertices_ref=vertices[0], vertices=vertices)


def test_exact_results_have_no_errors() -> None:
    errors = run_errors(exact(), SPECIMENS)
    assert errors.measured == (4200, 4200, 4200)
    assert errors.wrong == errors.beyond == 0.0
    assert max(errors.shape_mm, errors.displacement_mm, errors.stretch) < 1e-9
    assert errors.holds_in_sigma


def test_wrong_points_count_wherever_they_are_wrong_and_lost_ones_nowhere() -> None:
    vertices = exact().vertices.copy()
    vertices[:, :42] *= [1.05, 1.05, 1.0]  # 1.5 mm off the surface
    vertices[2, 100:142] += [0.0, 0.0, 1.5]
    vertices[1, 300:400] = np.nan
    errors = run_errors(with_vertices(exact(), vertices), SPECIMENS)
    assert errors.wrong == pytest.approx(84 / 4200)
    assert errors.measured == (4200, 4100, 4200)
    assert errors.shape_mm == pytest.approx(1.5 * np.sqrt(42 / 4200), rel=1e-6)
    assert not errors.holds_in_sigma  # 1 % of the points 75 σ off


def test_what_is_not_covered_is_told_of_all_and_of_each_camera() -> None:
    results, cameras = exact(), gallery_rig("arc4", 0.1).cameras
    whole = uncovered_shares(results, SPECIMENS, cameras)
    low = results.vertices_ref[results.faces, 2].max(axis=1) < 125.0
    half = replace(results, faces=results.faces[low], pair=results.pair[low], sigma_lambda=None)
    lower = uncovered_shares(half, SPECIMENS, cameras)
    assert whole.keys() == lower.keys() == {"", *(camera.id for camera in cameras)}
    for id_ in whole:
        assert whole[id_] < 0.15  # the ends of the wall
        assert 0.4 < lower[id_] < 0.7
    assert uncovered_shares(results, SPECIMENS, cameras[:1]) == {"": 1.0, cameras[0].id: 1.0}


@pytest.mark.parametrize(("factor", "holds"), [(1.0, True), (2.0, False)])
def test_noise_of_the_size_stated_holds_and_twice_as_much_does_not(factor: float, holds: bool) -> None:
    generator = np.random.default_rng(8)
    noise = factor * SIGMA_MOVED * generator.normal(size=exact().vertices.shape)
    noise[0] = 0.0
    errors = run_errors(with_vertices(exact(), exact().vertices + noise), SPECIMENS)
    assert errors.displacement_mm == pytest.approx(factor * SIGMA_MOVED * np.sqrt(3.0), rel=0.02)
    assert errors.spread == pytest.approx(factor, rel=0.03)
    assert errors.holds_in_sigma == holds


def test_a_share_of_a_motion_goes_from_rest_to_the_whole() -> None:
    rest, half, whole = moving_specimens(MODERATE)
    xyz = np.random.default_rng(2).uniform(-50.0, 50.0, (50, 3)) + np.array([0.0, 0.0, 125.0])
    assert np.allclose(rest.moved(xyz), xyz)
    assert whole.motion == MODERATE
    far = np.linalg.norm(whole.moved(xyz) - xyz, axis=1)
    assert np.linalg.norm(half.moved(xyz) - 0.5 * (xyz + whole.moved(xyz)), axis=1).max() < 0.05 * far.max()
