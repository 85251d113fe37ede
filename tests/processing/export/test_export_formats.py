"""Every export format, read back by a reader that is not the writer's, carries the same surface and fields."""

import base64
import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import h5py
import numpy as np
import pandas
import pytest
import trimesh
from ringdic.errors import InputError
from ringdic.export import FORMATS, export
from ringdic.results.evaluation import Evaluation
from ringdic.results.reader import read_field, read_summary
from ringdic.results.results import Results
from ringdic.results.writer import write_results
from ringdic.strain.window import strain_window
from scipy.io import loadmat

LOST = 4
STEPS = ("0003-specimen", "0004-specimen")


def bent_sheet() -> Results:
    """A cylindrical sheet of two camera pairs, stretched by 1.1 along z, with one point lost in the step."""
    angle, z = np.meshgrid(np.linspace(-0.4, 0.4, 6), np.linspace(0, 30, 5), indexing="ij")
    reference = np.column_stack([57 * np.cos(angle.ravel()), 57 * np.sin(angle.ravel()), z.ravel()])
    i = np.arange(30).reshape(6, 5)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([reference, reference * [1.0, 1.0, 1.1]])
    vertices[1, LOST] = np.nan
    rng = np.random.default_rng(4)
    correlation, sigma = rng.uniform(0, 0.05, (2, 30)), rng.uniform(0, 0.01, (2, 30, 3))
    correlation[1, LOST] = sigma[1, LOST] = np.nan
    status = np.isnan(correlation).astype(np.int8)
    return Results(
        rig="two pairs", steps=STEPS, cameras=(), pairs=(("1", "2"), ("2", "3")), vertices_ref=reference,
        vertices=vertices, faces=faces, pair=np.where(np.arange(40) < 20, 0, np.where(np.arange(40) < 36, 1, -1)),
        vertex_pair=np.zeros(30, dtype=np.int64), correlation=correlation, sigma_xyz=sigma, status=status,
    )  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "session"
    (path / "results" / "0001").mkdir(parents=True)
    write_results(path / "results" / "0001" / "results.h5", bent_sheet())
    return path


def test_npz_has_exactly_the_agreed_arrays(session: Path) -> None:
    result = bent_sheet()
    path = export(session, "npz")
    assert path == session / "results" / "0001" / "results.npz"
    with np.load(path) as arrays:
        shapes = {name: arrays[name].shape for name in arrays}
        assert shapes == {
            "vertices_ref": (30, 3), "vertices": (2, 30, 3), "faces": (40, 3), "lambda1": (2, 40), "lambda2": (2, 40),
            "J": (2, 40), "E": (2, 40, 3, 3), "correlation": (2, 30), "sigma_xyz": (2, 30, 3),
            "sigma_displacement": (2, 30, 3), "sigma_lambda": (2, 40, 2), "pair": (40,),
        }  # fmt: skip
        np.testing.assert_array_equal(arrays["vertices"], result.vertices)
        np.testing.assert_array_equal(arrays["faces"], result.faces)
        np.testing.assert_array_equal(arrays["pair"], result.pair)
        np.testing.assert_allclose(arrays["correlation"], result.correlation, rtol=1e-6)
        np.testing.assert_allclose(arrays["E"][0], 0.0, atol=1e-12)  # the reference: identity
        np.testing.assert_allclose(arrays["lambda1"][0], 1.0, atol=1e-12)
        whole = ~(result.faces == LOST).any(axis=1)
        np.testing.assert_allclose(arrays["lambda2"][1][whole], 1.1, atol=1e-12)
        np.testing.assert_allclose(arrays["J"][1][whole], 1.1, atol=1e-12)
        np.testing.assert_allclose(arrays["E"][1][whole][:, 2, 2], (1.1**2 - 1) / 2, atol=1e-12)
        assert np.isnan(arrays["E"][1][~whole]).all()


def with_deviations(calibrated: bool = True) -> Results:
    """The sheet with standard deviations; those by the calibration are unknown at one point and one triangle."""
    rng = np.random.default_rng(8)
    sheet = replace(
        bent_sheet(), sigma_displacement=rng.uniform(0, 0.01, (2, 30, 3)), sigma_lambda=rng.uniform(0, 1e-3, (2, 40, 2))
    )
    if not calibrated:
        return sheet
    unsure = {"sigma_calibration": rng.uniform(0, 0.02, (2, 30, 3)),
              "sigma_displacement_calibration": rng.uniform(0, 0.02, (2, 30, 3)),
              "sigma_lambda_calibration": rng.uniform(0, 2e-3, (2, 40, 2))}  # fmt: skip
    for values in unsure.values():
        values[:, 11] = np.nan
    return replace(sheet, **unsure)


def lay_down(result: Results, path: Path) -> Path:
    """A session of these results."""
    (path / "results" / "0001").mkdir(parents=True)
    write_results(path / "results" / "0001" / "results.h5", result)
    return path


def loaded(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as arrays:
        return dict(arrays)


def joined(noise: np.ndarray, calibration: np.ndarray) -> np.ndarray:
    """Root of the sum of the squares, of the noise alone where the part of the calibration is unknown."""
    return np.where(np.isnan(calibration), noise, np.sqrt(noise**2 + calibration**2))


def test_deviations_in_the_arrays_join_noise_and_calibration(tmp_path: Path) -> None:
    sheet = with_deviations()
    wanted = {
        "sigma_xyz": joined(sheet.sigma_xyz, sheet.sigma_calibration),
        "sigma_displacement": joined(sheet.sigma_displacement, sheet.sigma_displacement_calibration),
        "sigma_lambda": joined(sheet.sigma_lambda, sheet.sigma_lambda_calibration),
        "sigma_calibration": sheet.sigma_calibration,
    }
    path = lay_down(sheet, tmp_path / "calibrated")
    npz, mat = loaded(export(path, "npz")), loadmat(export(path, "mat"))
    for name, values in wanted.items():
        np.testing.assert_allclose(npz[name], values, rtol=1e-6, err_msg=name)
        np.testing.assert_array_equal(mat[name], npz[name], err_msg=name)
    # Between two steps the part of the calibration is unknown, as it is in a run that calibrates each camera alone.
    alone = with_deviations(calibrated=False)
    between = export(path, "npz", tmp_path / "between.npz", Evaluation(previous=True))
    for out in (between, export(lay_down(alone, tmp_path / "alone"), "npz")):
        arrays = loaded(out)
        for name in ("sigma_displacement", "sigma_lambda"):
            np.testing.assert_allclose(arrays[name], getattr(alone, name), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(arrays["sigma_xyz"], alone.sigma_xyz, rtol=1e-6)
    assert "sigma_calibration" not in arrays
    arrays = loaded(export(lay_down(bent_sheet(), tmp_path / "unknown"), "npz"))
    assert np.isnan(arrays["sigma_displacement"]).all()
    assert np.isnan(arrays["sigma_lambda"]).all()


def test_every_format_has_the_same_deviations_under_the_same_names(tmp_path: Path) -> None:
    sheet = with_deviations()
    path = lay_down(sheet, tmp_path / "session")
    moved = joined(sheet.sigma_displacement, sheet.sigma_displacement_calibration)[1]
    stretch = joined(sheet.sigma_lambda, sheet.sigma_lambda_calibration)[1, :, 1]
    tables = export(path, "csv")
    points, faces = (pandas.read_csv(tables / f"{STEPS[1]}-{kind}.csv") for kind in ("points", "faces"))
    np.testing.assert_allclose(points["sigma_displacement [mm]"], np.linalg.norm(moved, axis=1), rtol=1e-6)
    by_noise = np.linalg.norm(sheet.sigma_displacement[1], axis=1)
    np.testing.assert_allclose(points["sigma_displacement_noise [mm]"], by_noise, rtol=1e-6)
    np.testing.assert_allclose(faces["sigma_lambda2"], stretch, rtol=1e-6)
    with h5py.File(export(path, "vtkhdf")) as file:
        group = file["VTKHDF"]
        np.testing.assert_allclose(group["PointData/sigma_displacement"][30:], moved, rtol=1e-6)
        np.testing.assert_allclose(group["PointData/sigma_displacement_noise"][30:], by_noise, rtol=1e-6)
        np.testing.assert_allclose(
            group["PointData/sigma_displacement_calibration"][30:], sheet.sigma_displacement_calibration[1], rtol=1e-6
        )
        np.testing.assert_allclose(group["CellData/sigma_lambda2"][40:], stretch, rtol=1e-6)
    solid = trimesh.load(export(path, "ply") / f"{STEPS[1]}.ply", process=False)
    stored = np.ravel(solid.metadata["_ply_raw"]["face"]["data"]["sigma_lambda2"])
    np.testing.assert_allclose(stored, stretch[~(sheet.faces == LOST).any(axis=1)], rtol=1e-6)


def test_mat_counts_from_one(session: Path, tmp_path: Path) -> None:
    arrays = loadmat(export(session, "mat", tmp_path / "sheet.mat"))
    np.testing.assert_array_equal(arrays["faces"], bent_sheet().faces + 1)
    np.testing.assert_array_equal(arrays["vertices"], bent_sheet().vertices)
    assert set(np.unique(arrays["pair"])) == {0, 1, 2}
    assert [str(name[0]) for name in arrays["steps"].ravel()] == list(STEPS)


def test_csv_has_a_row_for_every_point_and_face(session: Path, tmp_path: Path) -> None:
    folder = export(session, "csv", tmp_path / "tables")
    with (folder / f"{STEPS[1]}-points.csv").open(encoding="utf-8") as file:
        points = list(csv.DictReader(file))
    with (folder / f"{STEPS[1]}-faces.csv").open(encoding="utf-8") as file:
        faces = list(csv.DictReader(file))
    result = bent_sheet()
    assert (len(points), len(faces)) == (30, 40)
    assert points[LOST]["x [mm]"] == ""
    assert float(points[LOST]["x_reference [mm]"]) == pytest.approx(result.vertices_ref[LOST, 0], abs=1e-6)
    assert float(points[9]["displacement_z [mm]"]) == pytest.approx(0.1 * result.vertices_ref[9, 2], abs=1e-5)
    last = faces[-1]
    assert [int(last[f"vertex{i}"]) for i in (1, 2, 3)] == result.faces[-1].tolist()
    assert float(last["lambda2"]) == pytest.approx(1.1, abs=1e-6)


@pytest.mark.parametrize("rigid_motion_removed", [False, True])
def test_csv_has_centroids_and_their_displacement(session: Path, tmp_path: Path, rigid_motion_removed: bool) -> None:
    result = bent_sheet()
    folder = export(session, "csv", tmp_path / "tables", Evaluation(rigid_motion_removed=rigid_motion_removed))
    faces = pandas.read_csv(folder / f"{STEPS[1]}-faces.csv")
    centroids = faces[[f"centroid_{axis}_reference [mm]" for axis in "xyz"]].to_numpy()
    moved = faces[[f"centroid_displacement_{axis} [mm]" for axis in "xyz"]].to_numpy()
    np.testing.assert_allclose(centroids, result.mesh.centroids, atol=1e-6)
    whole = ~(result.faces == LOST).any(axis=1)
    assert np.isnan(moved[~whole]).all()
    stretched = result.mesh.centroids * [1.0, 1.0, 1.1]
    wanted = result.motion(1).apply(stretched) if rigid_motion_removed else stretched
    np.testing.assert_allclose(moved[whole], (wanted - result.mesh.centroids)[whole], atol=1e-6)


def test_ply_has_the_measured_surface_with_its_fields(session: Path, tmp_path: Path) -> None:
    folder = export(session, "ply", tmp_path / "ply")
    solid = trimesh.load(folder / f"{STEPS[1]}.ply", process=False)
    result = bent_sheet()
    whole = ~(result.faces == LOST).any(axis=1)
    np.testing.assert_allclose(solid.triangles, result.vertices[1][result.faces[whole]], atol=1e-5)
    stored = solid.metadata["_ply_raw"]["face"]["data"]["lambda2"]
    np.testing.assert_allclose(np.ravel(stored), 1.1, atol=1e-6)


def test_glb_is_in_metres_with_y_upwards_and_coloured(session: Path, tmp_path: Path) -> None:
    folder = export(session, "glb", tmp_path / "glb")
    scene = trimesh.load(folder / f"{STEPS[1]}.glb", process=False)
    (solid,) = scene.geometry.values()
    result = bent_sheet()
    whole = ~(result.faces == LOST).any(axis=1)
    x, y, z = np.moveaxis(result.vertices[1][result.faces[whole]], -1, 0) / 1000.0
    np.testing.assert_allclose(solid.triangles, np.stack([x, z, -y], axis=-1), atol=1e-7)
    assert (solid.face_normals[:, 0] > 0).all()  # outwards still
    assert len(np.unique(solid.visual.vertex_colors, axis=0)) == 5  # displacement rises with the five levels of z


def test_vtp_carries_points_and_fields_of_each_step(session: Path, tmp_path: Path) -> None:
    folder = export(session, "vtp", tmp_path / "vtp")
    series = ET.parse(folder / "series.pvd").getroot()
    assert [entry.get("file") for entry in series.iter("DataSet")] == [f"{name}.vtp" for name in STEPS]
    root = ET.parse(folder / f"{STEPS[1]}.vtp").getroot()
    arrays = {}
    for element in root.iter("DataArray"):
        raw = base64.b64decode(element.text)
        assert int.from_bytes(raw[:8], "little") == len(raw) - 8
        kind = {"Float32": "<f4", "Float64": "<f8", "Int64": "<i8", "UInt8": "u1", "Int8": "i1"}[element.get("type")]
        arrays[element.get("Name")] = np.frombuffer(raw[8:], kind)
    result = bent_sheet()
    np.testing.assert_array_equal(arrays["connectivity"], result.faces.ravel())
    assert arrays["offsets"].tolist() == list(range(3, 121, 3))
    measured = arrays["measured"].astype(bool)
    np.testing.assert_array_equal(np.flatnonzero(~measured), [LOST])
    points = arrays["Points"].reshape(-1, 3)
    np.testing.assert_array_equal(points[measured], result.vertices[1][measured])
    expected, _ = read_field(session / "results" / "0001" / "results.h5", "E2", 1)
    np.testing.assert_array_equal(arrays["E2"], expected)


def test_vtkhdf_is_the_moving_surface_with_every_field(session: Path, tmp_path: Path) -> None:
    path = export(session, "vtkhdf", tmp_path / "sheet.vtkhdf")
    names = {row["name"] for row in read_summary(session / "results" / "0001" / "results.h5")["fields"]}
    with h5py.File(path) as file:
        assert list(file) == ["VTKHDF"]
        assert file["VTKHDF"].attrs["Type"] == b"PolyData"
        np.testing.assert_array_equal(file["VTKHDF/Points"][:30], bent_sheet().vertices_ref)
        arrays = {*file["VTKHDF/PointData"], *file["VTKHDF/CellData"]}
    vectors = {"displacement", "displacement_without_rigid_motion", "sigma_xyz", "e_tensor", "direction1_current"}
    assert vectors <= arrays
    of_vectors = {name for name in names if name.startswith("displacement")} | {"sigma"}
    assert names - of_vectors <= arrays  # lengths and components are the viewer's to make


@pytest.mark.parametrize("name", ["vtkhdf", "vtp"])
def test_vtk_reads_what_is_exported(session: Path, tmp_path: Path, name: str) -> None:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    out = export(session, name, tmp_path / "sheet.vtkhdf")
    reader = vtkHDFReader() if name == "vtkhdf" else vtkXMLPolyDataReader()
    reader.SetFileName(str(out if name == "vtkhdf" else out / f"{STEPS[1]}.vtp"))
    if name == "vtkhdf":
        reader.SetStep(1)
    reader.Update()
    surface = reader.GetOutputDataObject(0)
    assert (surface.GetNumberOfPoints(), surface.GetNumberOfCells()) == (30, 40)
    expected, _ = read_field(session / "results" / "0001" / "results.h5", "lambda2", 1)
    np.testing.assert_array_equal(vtk_to_numpy(surface.GetCellData().GetArray("lambda2")), expected)


def last_step(session: Path, out: Path, name: str, evaluation: Evaluation) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points and fields of the last step as another program's reader finds them."""
    path = export(session, name, out, evaluation)
    if name == "npz":
        with np.load(path) as arrays:
            fields = {n: arrays[n][1] for n in arrays if n.endswith(("lambda2", "J"))}
            return arrays["vertices"][1], fields
    if name == "mat":
        results = loadmat(path, simplify_cells=True)["DIC3DPPresults"]
        fields = {"lambda2": results["Deform"]["Lamda2"][1], "window_lambda2": results["Deform_window"]["Lamda2"][1]}
        return results["Points3D"][1], fields
    if name == "csv":
        points, faces = (pandas.read_csv(path / f"{STEPS[1]}-{kind}.csv") for kind in ("points", "faces"))
        return points[["x [mm]", "y [mm]", "z [mm]"]].to_numpy(), {n: faces[n].to_numpy() for n in faces}
    if name == "ply":
        solid = trimesh.load(path / f"{STEPS[1]}.ply", process=False)
        stored = solid.metadata["_ply_raw"]["face"]["data"]
        return solid.vertices, {n: np.ravel(stored[n]) for n in ("lambda2", "J", "window_lambda2")}
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkHDFReader() if name == "vtkhdf" else vtkXMLPolyDataReader()
    reader.SetFileName(str(path if name == "vtkhdf" else path / f"{STEPS[1]}.vtp"))
    if name == "vtkhdf":
        reader.SetStep(1)
    reader.Update()
    surface = reader.GetOutputDataObject(0)
    cells = surface.GetCellData()
    fields = {cells.GetArrayName(i): vtk_to_numpy(cells.GetArray(i)) for i in range(cells.GetNumberOfArrays())}
    return vtk_to_numpy(surface.GetPoints().GetData()), fields


@pytest.mark.parametrize("name", ["npz", "mat", "csv", "vtkhdf", "vtp", "ply"])
def test_without_rigid_motion_and_over_a_window_is_carried_through(session: Path, tmp_path: Path, name: str) -> None:
    result = bent_sheet()
    how = Evaluation(rigid_motion_removed=True, window=30.0)
    points, fields = last_step(session, tmp_path / "out", name, how)
    back = result.motion(1).apply(result.vertices[1])
    whole = ~(result.faces == LOST).any(axis=1)
    truth = result.deformation(1, window=strain_window(result.mesh, 30.0))
    if name == "ply":
        np.testing.assert_allclose(points, np.delete(back, LOST, axis=0), atol=1e-5)
        np.testing.assert_allclose(fields["window_lambda2"], truth.lambda2[whole], rtol=1e-6)
        return
    known = np.arange(30) != LOST
    np.testing.assert_allclose(points[known], back[known], atol=1e-6)
    np.testing.assert_allclose(fields["lambda2"], result.deformation(1).lambda2, rtol=1e-6)
    np.testing.assert_allclose(fields["window_lambda2"], truth.lambda2, rtol=1e-6)
    assert np.isfinite(fields["window_lambda2"][whole]).all()


def test_steps_may_be_compared_with_the_one_before(tmp_path: Path) -> None:
    sheet = bent_sheet()
    third = sheet.vertices[1] * [1.0, 1.0, 1.1]
    longer = {n: np.concatenate([v := getattr(sheet, n), v[1:]]) for n in ("correlation", "sigma_xyz", "status")}
    again = replace(
        sheet, steps=(*STEPS, "0005-specimen"), vertices=np.concatenate([sheet.vertices, third[None]]), **longer
    )
    (tmp_path / "results" / "0001").mkdir(parents=True)
    write_results(tmp_path / "results" / "0001" / "results.h5", again)
    whole = ~(sheet.faces == LOST).any(axis=1)
    for previous, last in ((False, 1.21), (True, 1.1)):
        with np.load(export(tmp_path, "npz", evaluation=Evaluation(previous=previous))) as arrays:
            np.testing.assert_allclose(arrays["J"][1][whole], 1.1, atol=1e-12)
            np.testing.assert_allclose(arrays["J"][2][whole], last, atol=1e-12)
        folder = export(tmp_path, "csv", evaluation=Evaluation(previous=previous, exponent=0.25))
        points = pandas.read_csv(folder / "0005-specimen-points.csv")
        before = again.vertices[1 if previous else 0]
        np.testing.assert_allclose(points["z_reference [mm]"], before[:, 2], atol=1e-6)
        np.testing.assert_allclose(points["displacement_z [mm]"], third[:, 2] - before[:, 2], atol=1e-5)
        faces = pandas.read_csv(folder / "0005-specimen-faces.csv")
        np.testing.assert_allclose(faces["seth_hill2:0.25"][whole], (last**0.5 - 1) / 0.5, atol=1e-6)


def test_matlab_reads_what_multidic_would_have_made(shared_data: Path, tmp_path: Path) -> None:
    truth = np.load(shared_data / "multidic_rig" / "reference.npz")
    F, N = truth["points3d"].shape[:2]
    M = len(truth["faces"])
    measured = Results(
        rig="pair", steps=("1", "2", "3"), cameras=(), pairs=(("201", "202"),), vertices_ref=truth["points3d"][0],
        vertices=truth["points3d"], faces=truth["faces"], pair=np.zeros(M, dtype=np.int64),
        vertex_pair=np.zeros(N, dtype=np.int64), correlation=truth["corr_combined"],
        sigma_xyz=np.full((F, N, 3), 0.01), status=np.zeros((F, N), dtype=np.int8),
    )  # fmt: skip
    (tmp_path / "results" / "0001").mkdir(parents=True)
    write_results(tmp_path / "results" / "0001" / "results.h5", measured)
    found = loadmat(export(tmp_path, "mat"), simplify_cells=True)["DIC3DPPresults"]
    np.testing.assert_array_equal(found["Faces"], truth["faces"] + 1)
    np.testing.assert_array_equal(found["pairIndices"], [201, 202])
    same = {"Lamda1": "lambda1", "Lamda2": "lambda2", "J": "J", "Emgn": "E_mgn", "emgn": "almansi_mgn", "Epc1": "E_pc1",
            "Epc2": "E_pc2", "epc1": "almansi_pc1", "epc2": "almansi_pc2", "Eeq": "E_eq", "eeq": "almansi_eq",
            "EShearMax": "E_shear_max", "eShearMax": "almansi_shear_max", "d3": "normal_cur"}  # fmt: skip
    for step in (1, 2):
        for theirs, name in same.items():
            np.testing.assert_allclose(found["Deform"][theirs][step], truth[name][step - 1], atol=2e-7, err_msg=theirs)
        for theirs, name in (("Fmat", "F"), ("Emat", "E_tensor"), ("emat", "almansi_tensor")):
            theirs_first = np.moveaxis(found["Deform"][theirs][step], -1, 0)
            np.testing.assert_allclose(theirs_first, truth[name][step - 1], atol=2e-7)
        np.testing.assert_allclose(found["Deform"]["Area"][step], truth["area_ref_mm2"], rtol=1e-6)
        np.testing.assert_allclose(found["FaceIsoInd"][step], truth["face_isotropy_index"][step], atol=1e-9)
        np.testing.assert_allclose(found["Points3D_ARBM"][step], truth["points3d_rbm_removed"][step], atol=1e-8)
        np.testing.assert_allclose(found["RBM"]["RotMat"][step], truth["rbm_R"][step], atol=1e-9)
        np.testing.assert_allclose(found["corrComb"][step], truth["corr_combined"][step], rtol=1e-6)
        np.testing.assert_allclose(found["FaceCorrComb"][step], truth["face_corr_combined"][step], rtol=1e-6)
        moved = truth["points3d"][step] - truth["points3d"][0]
        np.testing.assert_allclose(found["Disp"]["DispVec"][step], moved, atol=1e-9)
        np.testing.assert_allclose(found["Disp"]["DispMgn"][step], np.linalg.norm(moved, axis=1), atol=1e-9)
        # Without its rigid motion the strain is the same and the turn is gone.
        np.testing.assert_allclose(found["Deform_ARBM"]["Emgn"][step], found["Deform"]["Emgn"][step], atol=2e-7)
        turned = np.abs(found["Deform_ARBM"]["Fmat"][step] - np.eye(3)[:, :, None]).mean()
        assert turned < np.abs(found["Deform"]["Fmat"][step] - np.eye(3)[:, :, None]).mean()


def test_surfaces_are_coloured_by_the_field_that_is_asked_for(session: Path, tmp_path: Path) -> None:
    for name in ("ply", "glb"):
        folder = export(session, name, tmp_path / name, colour="lambda2")
        loaded = trimesh.load(folder / f"{STEPS[1]}.{name}", process=False)
        solid = loaded if name == "ply" else next(iter(loaded.geometry.values()))
        rgb = np.unique(solid.visual.vertex_colors[:, :3], axis=0)
        assert len(rgb) == 1  # the stretch is 1.1 everywhere: the upper end of a scale about 1
        assert rgb[0, 0] > 150 > rgb[0, 2]  # red
    with pytest.raises(InputError, match="no field 'stress'"):
        export(session, "ply", tmp_path / "none", colour="stress")
    assert not (tmp_path / "none").exists()
    with pytest.raises(InputError, match="'npz' has no colours; ply and glb have"):
        export(session, "npz", tmp_path / "x.npz", colour="lambda2")


def test_bad_requests_are_refused_and_leave_nothing(session: Path, tmp_path: Path) -> None:
    assert FORMATS == ("npz", "vtkhdf", "vtp", "mat", "csv", "ply", "glb")
    with pytest.raises(InputError, match="no export format 'stl'; there are npz"):
        export(session, "stl", tmp_path / "x.stl")
    with pytest.raises(InputError, match="no such folder"):
        export(session, "npz", tmp_path / "none" / "x.npz")
    with pytest.raises(InputError, match="not a session"):
        export(tmp_path, "npz")
    with pytest.raises(InputError, match="writes one file"):
        export(session, "npz", tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="writes a folder"):
        export(session, "ply", tmp_path / "file")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_step_in_which_everything_was_lost_is_lost_and_no_error(tmp_path: Path) -> None:
    sheet = bent_sheet()
    vertices = sheet.vertices.copy()
    vertices[1] = np.nan
    run = tmp_path / "results" / "0001"
    run.mkdir(parents=True)
    write_results(run / "results.h5", replace(sheet, vertices=vertices))
    for name in FORMATS:
        assert export(tmp_path, name).exists()
    with np.load(run / "results.npz") as arrays:
        assert np.isnan(arrays["J"][1]).all()
        np.testing.assert_allclose(arrays["J"][0], 1.0)
    row = next(row for row in read_summary(run / "results.h5")["fields"] if row["name"] == "lambda2")
    assert row["range"] is None
    assert row["steps"][1] is None


def test_the_load_at_the_steps_is_exported(session: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(session, tmp_path / "session"))
    folder = copy / "captures" / STEPS[1]
    folder.mkdir(parents=True)
    channels = [{"name": "force", "unit": "N", "values": 12.5}, {"name": "cycle", "unit": "", "values": 3}]
    (folder / "load.json").write_text(json.dumps({"schema": 1, "channels": channels}), encoding="utf-8")
    expected = [[np.nan, np.nan], [12.5, 3.0]]
    with np.load(export(copy, "npz")) as arrays:
        np.testing.assert_array_equal(arrays["load"], expected)
        assert list(arrays["load_channels"]) == ["force [N]", "cycle"]
    read = loadmat(export(copy, "mat"), simplify_cells=True)
    np.testing.assert_array_equal(read["load"], expected)
    assert list(read["load_channels"]) == ["force [N]", "cycle"]
    table = pandas.read_csv(export(copy, "csv") / "load.csv")
    assert list(table["capture"]) == list(STEPS)
    np.testing.assert_array_equal(table[["force [N]", "cycle"]], expected)
