"""The results file: what is written comes back, fields agree with the truth, and VTK's layout holds."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.geometry.outliers import LostPoint
from ringdic.results.fields import FIELDS, OPTIONAL_ARRAYS, Field
from ringdic.results.layout import SCHEMA
from ringdic.results.reader import (
    read_field,
    read_mesh,
    read_positions,
    read_results,
    read_summary,
    read_unmeasured,
)
from ringdic.results.results import Matches, Results
from ringdic.results.series import select_steps
from ringdic.results.unmeasured import UnmeasuredPlaces
from ringdic.results.writer import ResultsWriter, write_results
from ringdic.strain.window import strain_window

LOST = 7


def a_result() -> Results:
    """A 20 × 20 mm plate in two halves: step 1 turned and shifted, step 2 stretched by 1.2 along x; one point lost."""
    x, y = np.meshgrid(np.arange(0.0, 21.0, 4.0), np.arange(0.0, 21.0, 4.0), indexing="ij")
    reference = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    i = np.arange(36).reshape(6, 6)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    vertices = np.stack([reference, reference @ turn.T + [5.0, 6.0, 7.0], reference * [1.2, 1.0, 1.0]])
    vertices[2, LOST] = np.nan
    status = np.zeros((3, 36), dtype=np.int8)
    status[2, LOST] = 3
    rng = np.random.default_rng(0)
    K = np.array([[2600.0, -1.4, 820.0], [0.0, 2610.0, 616.0], [0.0, 0.0, 1.0]])
    P = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 8.0, 7.0], [0.1, 0.2, 0.4, 1.0]])
    lens = Intrinsics(K, np.array([0.1, -0.2, 1e-4, 2e-4, 0.0]), (1640, 1232))
    n = 36
    matches = Matches(
        cameras=("201", "202"), xy=rng.uniform(0, 900, (n, 2)), px=rng.uniform(0, 900, (3, 2, n, 2)),
        c_ls=rng.uniform(0, 0.1, (3, n)), sigma=rng.uniform(0, 0.1, (3, 2, n, 2)), status=status,
        vertex=np.arange(n), seconds={"refine": 1.5},
    )  # fmt: skip
    correlation = rng.uniform(0, 0.1, (3, n))
    correlation[2, LOST] = np.nan
    sigma = rng.uniform(0, 0.01, (3, n, 3))
    sigma[2, LOST] = np.nan
    return Results(
        rig="ring-2", steps=("0003-specimen", "0004-specimen", "0005-specimen"),
        cameras=(Camera("201", P, (1640, 1232), lens), Camera("202", P, (1640, 1232))), pairs=(("201", "202"),),
        vertices_ref=reference, vertices=vertices, faces=faces, pair=np.zeros(len(faces), dtype=np.int64),
        vertex_pair=np.zeros(n, dtype=np.int64), correlation=correlation, sigma_xyz=sigma, status=status,
        matches=(matches,), settings="[correlation]\nradius_px = 20\n", calibration={"201": {"rms": 0.3}},
        summary={"points": np.int64(36), "unknown": float("nan"), "list": np.arange(3.0)},
    )  # fmt: skip


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "results.h5"
    write_results(path, a_result())
    return path


def test_what_is_written_comes_back(written: Path) -> None:
    result, found = a_result(), read_results(written)
    for name in ("rig", "steps", "pairs", "settings", "calibration"):
        assert getattr(found, name) == getattr(result, name), name
    for name in ("vertices_ref", "vertices", "faces", "pair", "vertex_pair", "status"):
        np.testing.assert_array_equal(getattr(found, name), getattr(result, name), err_msg=name)
    np.testing.assert_allclose(found.correlation, result.correlation, rtol=1e-6)
    np.testing.assert_allclose(found.sigma_xyz, result.sigma_xyz, rtol=1e-6)
    assert found.summary == {"points": 36, "unknown": None, "list": [0.0, 1.0, 2.0]}
    for name in ("xy", "px", "c_ls", "sigma", "status", "vertex"):
        np.testing.assert_array_equal(getattr(found.matches[0], name), getattr(result.matches[0], name))
    assert found.matches[0].cameras == ("201", "202")
    assert found.matches[0].seconds == {"refine": 1.5}
    point = np.array([[10.0, 20.0, 30.0]])
    for before, after in zip(result.cameras, found.cameras, strict=True):
        assert (after.id, after.size) == (before.id, before.size)
        np.testing.assert_array_equal(after.project(point), before.project(point))


def test_unmeasured_places_come_back(tmp_path: Path) -> None:
    px, area = np.array([[20.0, 35.0], [50.0, 5.0]]), np.array([4.0, 2.5])
    places = UnmeasuredPlaces("202", px, 15.0, np.array([int(LostPoint.RESIDUAL), 32], np.int8), area)
    write_results(tmp_path / "results.h5", replace(a_result(), unmeasured=(places,)))
    (read,) = read_unmeasured(tmp_path / "results.h5")
    assert (read.camera, read.spacing) == ("202", 15.0)
    for name in ("px", "status", "area"):
        np.testing.assert_array_equal(getattr(read, name), getattr(places, name))
    assert len(read_results(tmp_path / "results.h5").unmeasured) == 1


def test_a_file_without_unmeasured_places_has_none(written: Path) -> None:
    assert read_unmeasured(written) == ()


def test_an_existing_file_is_never_replaced(written: Path) -> None:
    before = written.read_bytes()
    with pytest.raises(FileExistsError):
        write_results(written, a_result())
    assert written.read_bytes() == before


def test_the_fields_have_their_true_values(written: Path) -> None:
    result = a_result()
    touched = (result.faces == LOST).any(axis=1)
    E = (1.2**2 - 1) / 2
    truths = {"J": 1.2, "lambda1": 1.0, "lambda2": 1.2, "E1": 0.0, "E2": E, "e1": 0.0, "e2": (1 - 1.2**-2) / 2,
              "E_magnitude": E, "E_equivalent": 2 / 3 * E, "E_shear": E / 2, "area": 8.0, "pair": 0.0}  # fmt: skip
    for name, truth in truths.items():
        values, location = read_field(written, name, 2)
        assert location == "face"
        assert values.dtype == np.float32
        np.testing.assert_allclose(values[~touched], truth, atol=1e-6, err_msg=name)
        assert (np.isnan(values) == (touched & (name != "pair"))).all(), name
        turned, _ = read_field(written, name, 1)
        np.testing.assert_allclose(turned, {"J": 1, "lambda2": 1, "area": 8.0}.get(name, 1.0 * (name == "lambda1")),
                                   atol=1e-6)  # fmt: skip
    x, location = read_field(written, "displacement_x", 2)
    assert location == "point"
    np.testing.assert_allclose(np.delete(x, LOST), np.delete(0.2 * result.vertices_ref[:, 0], LOST), atol=1e-6)
    assert np.isnan(x[LOST])
    worst, _ = read_field(written, "face_correlation", 1)
    np.testing.assert_allclose(worst, result.correlation[1][result.faces].max(axis=1), rtol=1e-6)


def test_without_its_rigid_motion_a_turned_plate_has_not_moved(written: Path) -> None:
    with_motion, _ = read_field(written, "displacement", 1)
    assert with_motion.max() > 10.0
    without, _ = read_field(written, "displacement", 1, rigid_motion_removed=True)
    np.testing.assert_allclose(without, 0.0, atol=1e-5)
    np.testing.assert_allclose(read_positions(written, 1, True), a_result().vertices_ref, atol=1e-10)
    np.testing.assert_array_equal(read_positions(written, 1), a_result().vertices[1])
    result = read_results(written)
    np.testing.assert_allclose(result.deformation(1, rigid_motion_removed=True).e, 0.0, atol=1e-12)


def optional(entry: Field) -> bool:
    """Whether a result need not have the field."""
    groups = ("Over the strain window", "Uncertainty")
    return (entry.group in groups and entry.of != ("sigma_xyz",)) or entry.name == "chi2"


def test_every_field_of_the_table_can_be_read_at_every_step(written: Path) -> None:
    summary = read_summary(written)
    assert (summary["points"], summary["faces"], len(summary["steps"])) == (36, 50, 3)
    assert [row["name"] for row in summary["fields"]] == [entry.name for entry in FIELDS if not optional(entry)]
    for row in summary["fields"]:
        for step in range(3):
            for removed in (False, True):
                values, location = read_field(written, row["name"], step, removed)
                assert location == row["location"]
                assert values.shape == ((36,) if location == "point" else (50,))
                spans = row["steps_without_rigid_motion"] if removed and row["rigid"] else row["steps"]
                assert spans[step] == pytest.approx([np.nanmin(values), np.nanmax(values)])
    lambda2 = next(row for row in summary["fields"] if row["name"] == "lambda2")
    assert lambda2["range"] == pytest.approx([1.0, 1.2])
    assert lambda2["centre"] == 1.0


def everything_known() -> Results:
    """The same with a strain window and with every deviation that can be known."""
    result, rng = a_result(), np.random.default_rng(6)
    settings = "[correlation]\nradius_px = 20\n[strain]\nwindow_mm = 12.0\n"
    return replace(
        result, settings=settings, sigma_displacement=rng.uniform(0, 0.01, (3, 36, 3)),
        sigma_lambda=rng.uniform(0, 1e-3, (3, 50, 2)), chi2=rng.uniform(0, 3, (3, 36)),
        sigma_calibration=rng.uniform(0, 0.01, (3, 36, 3)),
        sigma_displacement_calibration=rng.uniform(0, 0.01, (3, 36, 3)),
        sigma_lambda_calibration=rng.uniform(0, 1e-3, (3, 50, 2)),
    )  # fmt: skip


def test_what_is_known_beside_the_rest_has_its_fields(tmp_path: Path) -> None:
    result, path = everything_known(), tmp_path / "results.h5"
    write_results(path, result)
    summary = read_summary(path)
    assert [row["name"] for row in summary["fields"]] == [entry.name for entry in FIELDS]
    back = read_results(path)
    for name in OPTIONAL_ARRAYS:
        np.testing.assert_allclose(getattr(back, name), getattr(result, name), rtol=1e-6)
    joint = np.hypot(result.sigma_lambda, result.sigma_lambda_calibration)
    for name, values in (
        ("sigma_lambda2", joint[1, :, 1]), ("sigma_lambda_noise2", result.sigma_lambda[1, :, 1]),
        ("sigma_lambda_calibration2", result.sigma_lambda_calibration[1, :, 1]),
        ("sigma_noise", np.linalg.norm(result.sigma_xyz[1], axis=1)),
    ):  # fmt: skip
        np.testing.assert_allclose(read_field(path, name, 1)[0], values, rtol=1e-6, err_msg=name)
    for name, parts in (
        ("sigma", [result.sigma_xyz[1], result.sigma_calibration[1]]),
        ("sigma_displacement", [result.sigma_displacement[1], result.sigma_displacement_calibration[1]]),
    ):
        total = np.linalg.norm(np.concatenate(parts, axis=1), axis=1)
        np.testing.assert_allclose(read_field(path, name, 1)[0], total, rtol=1e-6, err_msg=name)
    found = result.deformation(2)
    whole = np.isfinite(found.J)
    sigma_E2, _ = read_field(path, "sigma_E2", 2)  # dE = λ dλ
    np.testing.assert_allclose(sigma_E2[whole], (found.lambda2 * joint[2, :, 1])[whole], rtol=1e-6)
    over = result.deformation(2, window=strain_window(result.mesh, 12.0))
    for name in ("lambda2", "E2", "E_equivalent"):
        np.testing.assert_allclose(read_field(path, f"window_{name}", 2)[0], getattr(over, name), rtol=1e-6, atol=1e-7)
    hencky, _ = read_field(path, "window_hencky2", 2)
    np.testing.assert_allclose(hencky, np.log(over.lambda2), atol=1e-7)
    seth_hill, _ = read_field(path, "seth_hill2:0.25", 2)
    np.testing.assert_allclose(seth_hill, (found.lambda2**0.5 - 1) * 2, atol=1e-7)


def test_from_one_step_to_the_next_deviations_are_those_of_two_images() -> None:
    result = everything_known()
    rng = np.random.default_rng(7)
    one, noise = 0.003, rng.normal(0, 0.003, (3, 20000))  # of the reference image and of two steps' images
    stated = np.full((3, 36, 3), one * np.sqrt(2.0))
    result = replace(result, sigma_displacement=stated, sigma_lambda=np.full((3, 50, 2), 1e-3))
    steps = [result.fields(k, previous=True) for k in range(3)]
    spread = np.std((noise[2] - noise[0]) - (noise[1] - noise[0]))
    np.testing.assert_allclose(steps[2].point["sigma_displacement"], spread, rtol=0.03)
    np.testing.assert_allclose(steps[1].point["sigma_displacement"], stated[1])  # the step before is the reference
    # A triangle that was stretched before the step has longer edges, and its stretch is surer.
    wanted = 1e-3 / np.sqrt(result.deformation(1).J)
    np.testing.assert_allclose(steps[2].face["sigma_lambda1"], wanted)
    assert not {"sigma_displacement_calibration", "sigma_lambda_calibration1"} & steps[2].names
    moved = result.vertices[2] - result.vertices[1]
    np.testing.assert_array_equal(steps[2].point["displacement"], moved)


def test_a_run_without_a_window_says_how_to_have_one(written: Path) -> None:
    with pytest.raises(InputError, match=r"no field 'window_E2': the run had no strain window.*--window 5"):
        read_field(written, "window_E2", 1)
    with pytest.raises(InputError, match="no field 'sigma_E1': the run did not find it"):
        read_field(written, "sigma_E1", 1)


def test_a_step_takes_a_bounded_number_of_bytes(tmp_path: Path) -> None:
    write_results(tmp_path / "results.h5", everything_known())
    with h5py.File(tmp_path / "results.h5") as file:
        sizes = {place: sum(d.nbytes for d in file[f"VTKHDF/{place}"].values()) for place in ("PointData", "CellData")}
    assert sizes["PointData"] / (3 * 36) <= 100 - 24  # a position takes 24
    assert sizes["CellData"] / (3 * 50) <= 130


def test_a_mesh_is_read_alone(written: Path) -> None:
    mesh = read_mesh(written)
    np.testing.assert_array_equal(mesh.vertices, a_result().vertices_ref)
    assert mesh.areas.sum() == pytest.approx(400.0)


def test_the_vtkhdf_group_has_no_missing_points_and_consistent_offsets(written: Path) -> None:
    with h5py.File(written) as file:
        group = file["VTKHDF"]
        assert group.attrs["Type"] == b"PolyData"
        assert group.attrs["Version"].tolist() == [2, 0]
        assert np.isfinite(group["Points"][:]).all()
        steps, points, faces = group["Steps"].attrs["NSteps"], group["NumberOfPoints"][0], len(a_result().faces)
        assert group["Points"].shape == (steps * points, 3)
        assert group["Steps/PointOffsets"][:].tolist() == [0, points, 2 * points]
        assert group["Polygons/Connectivity"].shape == (3 * faces,)
        assert group["Polygons/Offsets"].shape == (faces + 1,)
        for place, rows in (("PointData", points), ("CellData", faces)):
            assert set(group[place]) == set(group[f"Steps/{place}Offsets"])
            for name, values in group[place].items():
                same = name in ("area", "pair")  # at all steps: stored once
                assert len(values) == (rows if same else steps * rows), name
                assert group[f"Steps/{place}Offsets"][name][:].tolist() == ([0] * 3 if same else [0, rows, 2 * rows])


def test_vtk_reads_every_step(written: Path) -> None:
    reader_module = pytest.importorskip("vtkmodules.vtkIOHDF", reason="the vtk package is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = reader_module.vtkHDFReader()
    reader.SetFileName(str(written))
    for step, expected in enumerate(a_result().vertices):
        reader.SetStep(step)
        reader.Update()
        data = reader.GetOutputDataObject(0)
        points = vtk_to_numpy(data.GetPoints().GetData())
        finite = np.isfinite(expected).all(axis=1)
        np.testing.assert_array_equal(points[finite], expected[finite])
        values, _ = read_field(written, "lambda2", step)
        np.testing.assert_array_equal(vtk_to_numpy(data.GetCellData().GetArray("lambda2")), values)
        pair = vtk_to_numpy(data.GetCellData().GetArray("pair"))
        np.testing.assert_array_equal(pair, a_result().pair)
        assert data.GetNumberOfCells() == 50


def test_what_cannot_be_read_is_said(written: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no field 'lambda9'; there are displacement"):
        read_field(written, "lambda9", 1)
    with pytest.raises(InputError, match="no step 3; there are 3"):
        read_field(written, "lambda1", 3)
    with pytest.raises(InputError, match="process the session first"):
        read_summary(tmp_path / "none.h5")
    (tmp_path / "broken.h5").write_bytes(b"not HDF5")
    with pytest.raises(InputError, match=r"broken\.h5: not readable"):
        read_results(tmp_path / "broken.h5")
    with h5py.File(tmp_path / "other.h5", "w"):
        pass
    with pytest.raises(InputError, match="not results"):
        read_mesh(tmp_path / "other.h5")


@pytest.mark.parametrize(
    ("schema", "remedy"), [(SCHEMA + 1, "update RingDIC"), (SCHEMA - 1, "process the session again")]
)
def test_a_file_of_another_schema_is_refused_by_every_reader(written: Path, schema: int, remedy: str) -> None:
    with h5py.File(written, "a") as file:
        file["ringdic"].attrs["schema"] = schema
    sentence = rf"results\.h5: results of schema {schema}, but this version reads schema {SCHEMA}; {remedy}"
    for read in (
        read_results, read_summary, read_mesh, lambda path: read_positions(path, 0),
        lambda path: read_field(path, "lambda1", 0),
    ):  # fmt: skip
        with pytest.raises(InputError, match=sentence):
            read(written)


def test_a_file_that_was_not_written_to_its_end_is_refused(tmp_path: Path) -> None:
    path, whole = tmp_path / "results.h5", a_result()
    with ResultsWriter(path, select_steps(whole, [0]), whole.steps):
        pass  # a run that died
    with pytest.raises(InputError, match=r"results\.h5: the results were not written to their end"):
        read_summary(path)


def test_what_a_reader_does_not_know_is_ignored(written: Path) -> None:
    with h5py.File(written, "a") as file:
        own, group = file["ringdic"], file["VTKHDF"]
        for place in (file, own, own["matches"], own["matches/0"], own["cameras"], own["cameras/201"], group):
            place.attrs["of_a_later_version"] = "anything"
            place.create_group("of_a_later_version")["values"] = np.zeros(3)
        for place in ("PointData", "CellData"):
            group[place]["of_a_later_version"] = np.zeros(5)
    result, found = a_result(), read_results(written)
    np.testing.assert_array_equal(found.vertices, result.vertices)
    np.testing.assert_array_equal(found.matches[0].px, result.matches[0].px)
    assert len(found.matches) == 1
    assert [camera.id for camera in found.cameras] == ["201", "202"]
    assert read_summary(written)["cameras"] == ["201", "202"]
    values, location = read_field(written, "lambda2", 2)
    assert (values.shape, location) == ((50,), "face")
    np.testing.assert_array_equal(read_positions(written, 1), result.vertices[1])
    assert len(read_mesh(written).faces) == 50


def test_results_that_do_not_fit_together_cannot_be_built() -> None:
    with pytest.raises(ValueError, match="correlation has shape"):
        replace(a_result(), correlation=np.zeros((2, 36)))
    lost = a_result().vertices_ref.copy()
    lost[0] = np.nan
    with pytest.raises(ValueError, match="without a reference position"):
        replace(a_result(), vertices_ref=lost)
