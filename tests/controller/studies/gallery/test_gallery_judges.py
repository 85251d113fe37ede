"""The gallery finds the errors that are planted in a run, and no others."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera
from ringdic.results.results import Results
from ringdic_controller.studies.gallery.comparison import JudgedRun, judged
from ringdic_controller.studies.gallery.picture import draw_row
from ringdic_controller.studies.gallery.rows import MODERATE, gallery_rig, gallery_rows
from ringdic_controller.studies.gallery.sample import SurfaceSample
from ringdic_controller.studies.gallery.tables import GalleryEntry, write_gallery
from ringdic_controller.studies.solid_errors import normal_sigma
from ringdic_node.virtual_rig.bodies import upright_column
from ringdic_node.virtual_rig.scenes import SolidSpecimen

BODY = upright_column(30.0)
BEFORE, AFTER = SolidSpecimen(BODY), SolidSpecimen(BODY, MODERATE)
RIG = gallery_rig("ring12", 0.1)
SIGMA, SIGMA_MOVED = 0.02, 0.01  # mm
GENERATOR = np.random.default_rng(5)


@pytest.fixture(scope="module")
def sample() -> SurfaceSample:
    return SurfaceSample.of(BEFORE, AFTER, RIG.cameras, 3000)


def exact(low: float = 20.0, high: float = 230.0) -> Results:
    """Results without error on the wall of a rod of 30 mm, whose ends are at 15 and 235 mm, between two heights."""
    theta, z = np.meshgrid(np.arange(120) * 2 * np.pi / 120, np.linspace(low, high, 140), indexing="ij")
    i, j = np.meshgrid(np.arange(120), np.arange(139), indexing="ij")
    a, b = i * 140 + j, (i + 1) % 120 * 140 + j
    faces = np.concatenate([np.stack([a, b, b + 1], -1).reshape(-1, 3), np.stack([a, b + 1, a + 1], -1).reshape(-1, 3)])
    xyz = np.stack([30.0 * np.cos(theta), 30.0 * np.sin(theta), z], axis=-1).reshape(-1, 3)
    N, M = len(xyz), len(faces)
    cameras = tuple(Camera(c.id, c.K @ np.column_stack([c.R, c.t]), (c.width, c.height)) for c in RIG.cameras)
    return Results(
        "exact", ("before", "after"), cameras, (("cam_01", "cam_02"),), xyz, np.stack([xyz, AFTER.moved(xyz)]), faces,
        np.zeros(M, dtype=int), np.zeros(N, dtype=int), np.zeros((2, N)), np.full((2, N, 3), SIGMA),
        np.zeros((2, N), dtype=np.int8),
        sigma_displacement=np.full((2, N, 3), SIGMA_MOVED), sigma_lambda=np.full((2, M, 2), 1e-3),
    )  # fmt: skip


def test_exact_results_cover_the_wall_without_error(sample: SurfaceSample) -> None:
    figures = judged(exact(), BEFORE, AFTER, sample).figures
    assert figures.covered == pytest.approx(210.0 / 220.0, abs=0.01)
    assert figures.covered_later == pytest.approx(210.0 / 220.0, abs=0.01)
    assert figures.wrong == 0
    assert figures.shape_mm < 1e-9
    assert figures.displacement_mm < 1e-9
    assert figures.stretch_rms < 1e-9
    seen = 2 * np.pi * 30.0 * 220.0 / 100.0  # cm², no camera sees the ends below 60°
    assert figures.seen_cm2 == pytest.approx(seen, rel=0.1)


def test_planted_noise_is_measured_in_units_of_its_stated_deviation(sample: SurfaceSample) -> None:
    results = exact()
    noise = SIGMA * GENERATOR.normal(size=results.vertices_ref.shape)
    moved = 2.0 * SIGMA_MOVED * GENERATOR.normal(size=noise.shape)
    reference = results.vertices_ref + noise
    run = judged(
        replace(results, vertices_ref=reference, vertices=np.stack([reference, results.vertices[1] + noise + moved])),
        BEFORE, AFTER, sample,
    )  # fmt: skip
    assert run.figures.shape_mm == pytest.approx(SIGMA, rel=0.03)
    assert run.figures.spreads.position.plain == pytest.approx(1.0, rel=0.03)
    assert run.figures.spreads.position.robust == pytest.approx(1.0, rel=0.03)
    assert run.figures.spreads.displacement.plain == pytest.approx(2.0, rel=0.03)
    assert run.figures.displacement_mm == pytest.approx(2.0 * SIGMA_MOVED * np.sqrt(3.0), rel=0.03)
    assert run.figures.missed[0] == "coverage"
    assert "displacement" in run.figures.missed
    assert "shape" not in run.figures.missed


def test_wrong_points_are_counted_and_kept_out_of_the_rest(sample: SurfaceSample) -> None:
    results = exact()
    off = results.vertices.copy()
    off[:, :7] *= [1.1, 1.1, 1.0]  # 3 mm off the surface
    off[1, 100:105] += [0.0, 0.0, 1.5]
    off[1, 300:400] = np.nan  # lost, and so not wrong
    run = judged(replace(results, vertices_ref=off[0], vertices=off), BEFORE, AFTER, sample)
    assert run.figures.wrong == 12
    assert run.figures.shape_mm < 1e-9
    assert run.figures.displacement_mm < 1e-9
    assert run.figures.covered_later < run.figures.covered


def test_half_a_surface_covers_half(sample: SurfaceSample) -> None:
    covered = judged(exact(high=125.0), BEFORE, AFTER, sample).figures.covered
    assert covered == pytest.approx(105.0 / 220.0, abs=0.02)


def test_the_deviation_along_the_normal_follows_the_lines_of_sight() -> None:
    towards = GENERATOR.normal(size=(200, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    towards = towards[np.std(towards**2, axis=1) > 0.05]
    normals = np.roll(towards, 1, axis=0)
    covariance = 0.01**2 * np.eye(3) + 0.04**2 * towards[:, :, None] * towards[:, None, :]
    sigma = np.sqrt(np.einsum("nii->ni", covariance))
    true = np.sqrt(np.einsum("ni,nij,nj->n", normals, covariance, normals))
    np.testing.assert_allclose(normal_sigma(sigma, normals, towards), true, rtol=1e-6)


def test_rows_are_chosen_by_name_body_or_rig() -> None:
    names = [row.name for row in gallery_rows()]
    assert len(set(names)) == len(names) > 30
    assert [row.name for row in gallery_rows(["limb-turned-40-arc4"])] == ["limb-turned-40-arc4"]
    assert {row.body for row in gallery_rows(["bean"])} == {"bean"}
    assert {row.rig for row in gallery_rows(["rows2"])} == {"rows2"}
    assert len(gallery_rig("rows2", 0.1).cameras) == 18
    assert len(gallery_rig("arc2", 0.1).cameras) == 2
    with pytest.raises(InputError, match="there is no body, rig or row 'egg'"):
        gallery_rows(["egg"])


def test_tables_and_pictures_show_measured_and_refused_rows(tmp_path: Path, sample: SurfaceSample) -> None:
    run: JudgedRun = judged(exact(high=125.0), BEFORE, AFTER, sample)
    draw_row(tmp_path / "rod.png", "a rod", run, exact(high=125.0).vertices_ref)
    assert (tmp_path / "rod.png").stat().st_size > 10_000
    entries = [
        GalleryEntry("rod", 12.3, run.figures, picture="rod.png"),
        GalleryEntry("egg", 1.0, refusal="no camera pair gave a surface"),
    ]
    write_gallery(tmp_path, entries, {"scale": 0.1})
    stored = json.loads((tmp_path / "gallery.json").read_text(encoding="utf-8"))
    assert stored["rows"] == 2
    assert stored["reached"] == 0
    assert stored["entries"][0]["figures"]["wrong"] == 0
    assert stored["entries"][1]["refusal"] == "no camera pair gave a surface"
    page = (tmp_path / "gallery.md").read_text(encoding="utf-8")
    assert "| egg |" in page
    assert "![rod](rod.png)" in page
