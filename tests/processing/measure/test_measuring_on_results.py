"""Places, lengths, sections and regions against a tube whose deformation is known everywhere."""

import csv
import io
import json

import numpy as np
import pytest
from ringdic.errors import ComputationError, InputError
from ringdic.geometry.camera import Camera
from ringdic.measure.extensometer import extensometer
from ringdic.measure.path import shortest_path
from ringdic.measure.place import Place, nearest_place, place_of_face, place_of_vertex
from ringdic.measure.region import AngularPatch, Ball, Box, Everything, Listed, region_statistics, statistics
from ringdic.measure.section import Cut, crossings, section
from ringdic.measure.series import time_series
from ringdic.measure.table import Table
from ringdic.measure.window_study import gauge, window_study
from ringdic.mesh.mesh import Mesh
from ringdic.results.evaluation import EvaluatedResults, Evaluation
from ringdic.results.results import Results
from ringdic.strain.window import strain_window

RADIUS, AROUND, ALONG = 50.0, 120, 31
STRETCH = (1.0, 1.1, 1.21)  # along z
LOST = 20 * ALONG + 15  # some vertex inside


def tube() -> tuple[np.ndarray, np.ndarray]:
    angle, z = np.meshgrid(np.arange(AROUND) * 2 * np.pi / AROUND, 2.5 * np.arange(ALONG), indexing="ij")
    vertices = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z], -1).reshape(-1, 3)
    n = np.arange(AROUND * ALONG).reshape(AROUND, ALONG)
    m = np.roll(n, -1, axis=0)
    a, b, c, d = (part.ravel() for part in (n[:, :-1], m[:, :-1], m[:, 1:], n[:, 1:]))
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def drawn_tube(lost: bool = False) -> Results:
    """A tube that is drawn by 10 % of its present length in each of two steps, its lower edge at rest."""
    reference, faces = tube()
    vertices = np.stack([reference * [1.0, 1.0, k] for k in STRETCH])
    status = np.zeros((3, len(reference)), dtype=np.int8)
    if lost:
        vertices[2, LOST] = np.nan
        status[2, LOST] = 3
    return Results(
        rig="tube", steps=("a", "b", "c"), cameras=(), pairs=(("1", "2"),), vertices_ref=reference, vertices=vertices,
        faces=faces, pair=np.zeros(len(faces), dtype=np.int64), vertex_pair=np.zeros(len(reference), dtype=np.int64),
        correlation=np.full((3, len(reference)), 0.01), sigma_xyz=np.full((3, len(reference), 3), 1e-3), status=status,
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen() -> EvaluatedResults:
    return EvaluatedResults(drawn_tube())


def on_tube(theta: float, z: float) -> tuple[float, float, float]:
    return RADIUS * np.cos(theta), RADIUS * np.sin(theta), z


# Places -----------------------------------------------------------------------------------------


def test_the_nearest_place_is_the_foot_of_the_perpendicular() -> None:
    mesh = Mesh(*tube())
    rng = np.random.default_rng(0)
    for _ in range(20):
        theta, z = rng.uniform(-np.pi, np.pi), rng.uniform(2, 70)
        outside = np.array([1.03, 1.03, 1.0]) * on_tube(theta, z)
        place = nearest_place(mesh, outside)
        foot = place.at(mesh.vertices, mesh.faces)
        normal = mesh.normals[place.face]
        away = outside - foot
        # Straight above the inside of a facet, or above an edge between two that are 3 degrees apart.
        assert np.linalg.norm(away - (away @ normal) * normal) <= np.linalg.norm(away) * np.sin(np.radians(3.0)) + 1e-9
        assert abs(np.hypot(*foot[:2]) - RADIUS) < RADIUS * (1 - np.cos(np.pi / AROUND)) + 1e-9
        assert foot[2] == pytest.approx(z, abs=1e-9)


def test_vertices_and_faces_are_places_too_and_wrong_ones_are_refused() -> None:
    mesh = Mesh(*tube())
    np.testing.assert_array_equal(place_of_vertex(mesh, 77).at(mesh.vertices, mesh.faces), mesh.vertices[77])
    np.testing.assert_allclose(place_of_face(mesh, 77).at(mesh.vertices, mesh.faces), mesh.centroids[77])
    with pytest.raises(InputError, match=r"no point 9999; there are 3720, from 0"):
        place_of_vertex(mesh, 9999)
    with pytest.raises(InputError, match="no face -1"):
        place_of_face(mesh, -1)
    with pytest.raises(InputError, match=r"30\.\d mm away from the surface; the nearest place on it is \(50\.0, 0\.0"):
        nearest_place(mesh, (80.0, 0.0, 25.0))
    assert nearest_place(mesh, (80.0, 0.0, 25.0), within=31.0)
    with pytest.raises(ValueError, match="not those of a place"):
        Place(0, (0.5, 0.5, 0.5), "")


# Time series ------------------------------------------------------------------------------------


def test_a_place_is_followed_with_its_fields(seen: EvaluatedResults) -> None:
    mesh = seen.results.mesh
    places = [nearest_place(mesh, on_tube(0.4, 33.0)), place_of_vertex(mesh, 10)]
    table = time_series(seen, places, ["displacement_z", "lambda2", "E2"])
    assert table["place"] == (places[0].label,) * 3 + ("point 10",) * 3
    assert table["step"] == (0, 1, 2) * 2
    z = np.array([33.0, mesh.vertices[10, 2]])
    for k, stretch in enumerate(STRETCH):
        np.testing.assert_allclose([table["z"][k], table["z"][3 + k]], stretch * z, atol=1e-9)
        np.testing.assert_allclose(table["displacement_z"][k], (stretch - 1) * 33.0, atol=1e-9)
        np.testing.assert_allclose(table["lambda2"][k], stretch, atol=1e-12)
        np.testing.assert_allclose(table["E2"][3 + k], (stretch**2 - 1) / 2, atol=1e-12)
    every = time_series(seen, places[:1])
    assert {entry.name for entry in seen.fields} <= {column.name for column in every.columns}
    with pytest.raises(InputError, match="no field 'stress'; there are displacement"):
        time_series(seen, places, ["stress"])
    with pytest.raises(InputError, match=r"no field 'window_E2'.*give a window"):
        time_series(seen, places, ["window_E2"])


def test_a_lost_place_is_lost_for_its_step_alone() -> None:
    seen = EvaluatedResults(drawn_tube(lost=True))
    table = time_series(seen, [place_of_vertex(seen.results.mesh, LOST)], ["displacement"])
    assert np.isfinite(table["displacement"][1])
    assert np.isnan(table["displacement"][2])
    assert table.rows()[2]["displacement"] is None


# Extensometers ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("begin", "end"), [((0.0, 10.0), (0.9, 60.0)), ((3.0, 5.0), (-3.0, 70.0)), ((1.0, 20.0), (2.5, 20.0))]
)
def test_the_shortest_way_on_a_tube_is_a_helix(begin: tuple[float, float], end: tuple[float, float]) -> None:
    mesh = Mesh(*tube())
    path = shortest_path(mesh, nearest_place(mesh, on_tube(*begin)), nearest_place(mesh, on_tube(*end)))
    turn = abs(np.mod(end[0] - begin[0] + np.pi, 2 * np.pi) - np.pi)
    facets = 2 * RADIUS * np.sin(np.pi / AROUND) * AROUND / (2 * np.pi)  # the polygon's way round, a radian
    assert path.length(mesh.vertices, mesh.faces) == pytest.approx(np.hypot(facets * turn, end[1] - begin[1]), rel=2e-4)
    line = path.line(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(line[0], on_tube(*begin), atol=0.1)
    angle = np.unwrap(np.arctan2(line[:, 1], line[:, 0]))
    slope = (end[1] - begin[1]) / (angle[-1] - angle[0])
    np.testing.assert_allclose(line[:, 2], begin[1] + slope * (angle - angle[0]), atol=0.1)


def test_a_way_across_a_plane_is_straight_and_round_a_hole_is_taut() -> None:
    n = 21
    x, y = np.meshgrid(np.arange(float(n)), np.arange(float(n)), indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    sheet = Mesh(
        np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)]),
        np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]),
    )
    rng = np.random.default_rng(5)
    for _ in range(10):
        p, q = np.column_stack([rng.uniform(0, 20, (2, 2)), [0, 0]])
        path = shortest_path(sheet, nearest_place(sheet, p), nearest_place(sheet, q))
        assert path.length(sheet.vertices, sheet.faces) == pytest.approx(np.linalg.norm(q - p), abs=1e-9)
    middle = sheet.centroids[:, :2]
    holed = Mesh(sheet.vertices, sheet.faces[~((np.abs(middle - 10) < 5).all(axis=1))])  # 5 … 15 cut out
    path = shortest_path(holed, nearest_place(holed, (2.0, 9.0, 0.0)), nearest_place(holed, (18.0, 9.0, 0.0)))
    assert path.length(holed.vertices, holed.faces) == pytest.approx(2 * np.hypot(3.0, 4.0) + 10.0, abs=1e-9)
    apart = Mesh(sheet.vertices, sheet.faces[np.abs(middle[:, 0] - 10) > 2])
    with pytest.raises(ComputationError, match="parts that do not touch"):
        shortest_path(apart, nearest_place(apart, (2.0, 9.0, 0.0)), nearest_place(apart, (18.0, 9.0, 0.0)))


def test_an_extensometer_follows_its_material(seen: EvaluatedResults) -> None:
    mesh = seen.results.mesh
    along = extensometer(seen, nearest_place(mesh, on_tube(0.5, 10)), nearest_place(mesh, on_tube(0.5, 60)))
    np.testing.assert_allclose(along["along_surface"], 50.0 * np.array(STRETCH), rtol=1e-9)
    np.testing.assert_allclose(along["straight"], 50.0 * np.array(STRETCH), rtol=1e-9)
    np.testing.assert_allclose(along["strain_along_surface"], np.array(STRETCH) - 1, atol=1e-9)
    across = extensometer(seen, nearest_place(mesh, on_tube(0, 30)), nearest_place(mesh, on_tube(2.0, 30)))
    np.testing.assert_allclose(across["strain_along_surface"], 0.0, atol=1e-6)
    np.testing.assert_allclose(across["straight"], 2 * RADIUS * np.sin(1.0), rtol=1e-3)
    assert across["along_surface"][0] == pytest.approx(2.0 * RADIUS, rel=1e-3)
    previous = EvaluatedResults(seen.results, Evaluation(previous=True))
    step = extensometer(previous, nearest_place(mesh, on_tube(0.5, 10)), nearest_place(mesh, on_tube(0.5, 60)))
    np.testing.assert_allclose(step["strain_straight"], [0.0, 0.1, 0.1], atol=1e-9)


def test_an_extensometer_over_lost_material_says_so_by_nan_and_keeps_its_chord() -> None:
    seen = EvaluatedResults(drawn_tube(lost=True))
    mesh = seen.results.mesh
    x, y, z = mesh.vertices[LOST]
    found = extensometer(seen, nearest_place(mesh, (x, y, z - 11)), nearest_place(mesh, (x, y, z + 11.0)))
    assert np.isfinite(found["along_surface"]).tolist() == [True, True, False]
    assert np.isfinite(found["straight"]).all()


# Sections ---------------------------------------------------------------------------------------


def test_a_section_across_the_tube_is_one_closed_line(seen: EvaluatedResults) -> None:
    found = crossings(seen.results.mesh, Cut.at_height(33.3))
    assert len(found.faces) == 2 * AROUND
    assert set(found.line) == {0}
    assert (np.diff(found.along) > 0).all()
    circumference = 2 * AROUND * RADIUS * np.sin(np.pi / AROUND)
    ends = found.along[0] + circumference - found.along[-1]  # the closing half segments
    assert ends < 2 * circumference / AROUND
    middle = found.at(seen.results.vertices_ref)
    np.testing.assert_allclose(middle[:, 2], 33.3, atol=1e-9)
    neighbours = np.linalg.norm(np.diff(middle, axis=0), axis=1)
    assert neighbours.max() < circumference / AROUND  # no jump: each follows its neighbour


def test_a_section_carries_material_fields(seen: EvaluatedResults) -> None:
    table = section(seen, Cut.at_azimuth(np.radians(31.0)), ["displacement_z", "lambda2"])
    step, s, z0 = (np.array(table[name]) for name in ("step", "s", "z_reference"))
    last = step == 2
    np.testing.assert_allclose(np.array(table["z"])[last], 1.21 * z0[last], atol=1e-9)
    np.testing.assert_allclose(np.array(table["displacement_z"])[last], 0.21 * z0[last], atol=1e-9)
    np.testing.assert_allclose(np.array(table["lambda2"])[last], 1.21, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.diff(s[last])), np.abs(np.diff(z0[last])), atol=1e-9)  # straight up or down
    azimuth = np.degrees(np.arctan2(table["y_reference"], table["x_reference"]))
    np.testing.assert_allclose(azimuth, 31.0, atol=1e-9)  # not the far side of the plane
    assert table.notes == (f"{last.sum()} triangles crossed on 1 line",)


def test_a_section_through_vertices_and_of_two_parts_is_whole() -> None:
    mesh = Mesh(*tube())
    through = crossings(mesh, Cut.at_height(25.0))  # a row of vertices lies on it
    assert len(through.faces) == 2 * AROUND
    both = crossings(mesh, Cut((0.0, 0.0, 0.0), (0.0, 2.0, 0.1)))
    assert set(both.line) == {0, 1}  # two sides of the tube
    with pytest.raises(InputError, match=r"misses the surface, which spans .* z 0\.0 … 75\.0 mm"):
        crossings(mesh, Cut.at_height(80.0))
    with pytest.raises(InputError, match="normal with a direction"):
        Cut((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


# Regions ----------------------------------------------------------------------------------------


def test_regions_hold_what_they_say() -> None:
    mesh = Mesh(*tube())
    x, y, z = mesh.centroids.T
    angle = np.degrees(np.arctan2(y, x))
    np.testing.assert_array_equal(Box((0, 0, 10), (60, 60, 20)).faces(mesh), (x >= 0) & (y >= 0) & (abs(z - 15) <= 5))
    distance = np.linalg.norm(mesh.centroids - [50, 0, 30], axis=1)
    np.testing.assert_array_equal(Ball((50, 0, 30), 12.0).faces(mesh), distance <= 12)
    across = AngularPatch((np.radians(170.0), np.radians(-170.0)), (10.0, 20.0)).faces(
        mesh
    )  # over the seam of the angle
    np.testing.assert_array_equal(across, (np.abs(angle) >= 170) & (abs(z - 15) <= 5))
    assert AngularPatch((0.0, 2 * np.pi), (0.0, 75.0)).faces(mesh).all()
    assert np.flatnonzero(Listed((3, 5)).faces(mesh)).tolist() == [3, 5]
    for refused, words in (
        (lambda: Listed((9999999,)).faces(mesh), "no face 9999999"),
        (lambda: Box((0, 0, 20), (1, 1, 10)), "first corner of a box is the lower one"),
        (lambda: Ball((0, 0, 0), 0.0), "above 0 mm"),
        (lambda: AngularPatch((0.0, 1.0), (20.0, 10.0)), "lower one"),
    ):
        with pytest.raises(InputError, match=words):
            refused()


def test_statistics_are_weighted_by_area() -> None:
    values, weights = np.array([1.0, 3.0, np.nan, 5.0]), np.array([1.0, 2.0, 7.0, 1.0])
    found = statistics(values, weights)
    assert found["mean"] == pytest.approx(3.0)
    assert found["std"] == pytest.approx(np.sqrt((4 + 0 + 4) / 4))
    assert found["rms"] == pytest.approx(np.sqrt((1 + 18 + 25) / 4))
    assert (found["min"], found["median"], found["max"]) == (1.0, 3.0, 5.0)
    assert (found["measured"], found["lost"]) == (3, 1)
    nothing = statistics(np.array([np.nan]), np.array([1.0]))
    assert np.isnan(nothing["mean"])
    assert (nothing["measured"], nothing["lost"]) == (0, 1)


def test_the_mean_over_a_region_is_the_integral_over_its_area() -> None:
    seen = EvaluatedResults(drawn_tube(lost=True))
    table = region_statistics(seen, Box((-60, -60, 0), (60, 60, 75.0)), ["displacement_z", "lambda2"])
    rows = {(row["field"], row["step"]): row for row in table.rows()}
    # u_z rises linearly with z, and every vertex stands for the area round it: the mean is that at half height.
    assert rows["displacement_z", 1]["mean"] == pytest.approx(0.1 * 37.5, abs=1e-9)
    assert rows["displacement_z", 1]["unit"] == "mm"
    assert rows["lambda2", 2]["mean"] == pytest.approx(1.21, abs=1e-9)
    assert (rows["lambda2", 2]["lost"], rows["lambda2", 1]["lost"], rows["displacement_z", 2]["lost"]) == (6, 0, 1)
    assert region_statistics(seen, Everything(), ["J"])["measured"][0] == len(seen.results.faces)
    with pytest.raises(InputError, match="holds no triangle"):
        region_statistics(seen, Ball((0, 0, 0), 1.0))


# Windows and tables -----------------------------------------------------------------------------


def test_a_study_of_windows_shows_the_scatter_fall_and_the_strain_stay() -> None:
    still = drawn_tube()
    noise = np.random.default_rng(3).normal(0, 0.01, still.vertices[1:].shape)
    noisy = Results(**{**vars(still), "vertices": np.concatenate([still.vertices[:1], still.vertices[1:] + noise])})
    table = window_study(noisy, [0.0, 8.0, 16.0])
    last = np.array(table["step"]) == 2
    scatter = np.array(table["lambda2_std"])[last]
    assert (np.diff(scatter) < 0).all()
    np.testing.assert_allclose(np.array(table["lambda2_median"])[last], 1.21, atol=2e-3)
    spacing = gauge(noisy, 0.0).step
    assert spacing == pytest.approx(2 * RADIUS * np.sin(np.pi / AROUND), rel=0.05)  # 2.5 and 2.6 mm
    assert np.median(strain_window(noisy.mesh, 8.0).points) == np.array(table["points"])[last][1]
    with pytest.raises(InputError, match="0 or more"):
        window_study(noisy, [-1.0])


def test_the_gauge_knows_the_subset_from_the_camera_and_the_settings() -> None:
    K = np.array([[2000.0, 0.0, 500.0], [0.0, 2000.0, 500.0], [0.0, 0.0, 1.0]])
    R = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # looks along -x from x = 300
    camera = Camera("1", K @ np.column_stack([R, -R @ [300.0, 0.0, 40.0]]), (1000, 1000))
    y, z = np.meshgrid(np.arange(-10.0, 11.0, 2.0), np.arange(30.0, 51.0, 2.0), indexing="ij")
    plate = np.column_stack([np.full(y.size, 100.0), y.ravel(), z.ravel()])
    i = np.arange(121).reshape(11, 11)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    results = Results(
        rig="one", steps=("a",), cameras=(camera,), pairs=(("1", "2"),), vertices_ref=plate, vertices=plate[None],
        faces=faces, pair=np.zeros(len(faces), dtype=np.int64), vertex_pair=np.zeros(121, dtype=np.int64),
        correlation=np.zeros((1, 121)), sigma_xyz=np.zeros((1, 121, 3)), status=np.zeros((1, 121), dtype=np.int8),
        settings="[correlation]\nradius_px = 14\n[strain]\nwindow_mm = 6.0\n",
    )  # fmt: skip
    held = gauge(results, results.window_mm)
    assert held.step == pytest.approx(2.0)
    assert held.subset == pytest.approx(29 / (2000 / 200), rel=1e-3)  # 10 px a mm at 200 mm
    assert held.length == pytest.approx(6.0 + 2.9, rel=1e-3)
    nobody = Results(**{**vars(results), "cameras": ()})
    assert np.isnan(gauge(nobody, 6.0).length)


def test_a_table_is_the_same_in_csv_and_json() -> None:
    rows = [{"name": 'a, "b"', "x": 1.5, "n": 3}, {"name": "c", "x": float("nan"), "n": np.int64(4)}]
    table = Table.of_rows(rows, {"x": "mm"}, ["a note"])
    read = list(csv.DictReader(io.StringIO(table.to_csv())))
    assert read == [{"name": 'a, "b"', "x [mm]": "1.5", "n": "3"}, {"name": "c", "x [mm]": "", "n": "4"}]
    found = json.loads(json.dumps(table.to_json()))
    assert found["rows"] == [{"name": 'a, "b"', "x": 1.5, "n": 3}, {"name": "c", "x": None, "n": 4}]
    assert (found["units"], found["notes"]) == ({"x": "mm"}, ["a note"])
    with pytest.raises(KeyError):
        table["y"]
