"""The results of camera pairs: merged, the arrays of every vertex follow it to its new number."""

from types import SimpleNamespace

import numpy as np
import pytest
from ringdic.geometry.camera import Camera
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import Kind, borders, overlap_area
from ringdic.pairs.reconstruction import PairShape, PairStep
from ringdic.pairs.surfaces import PairsSeries, PairSurface, pairs_surface
from ringdic.results.results import Results
from ringdic.results.series import join_steps
from ringdic.settings import Settings, SurfaceGroup

STEPS, PITCH, LOST = 3, 2.0, 7


def plate(pair: tuple[str, str], first: int, above: float, turned: float) -> PairSurface:
    """A plate of 30 x 20 points at x = first PITCH, moved by (0, 0, step) mm a step; every value tells its vertex."""
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(30), np.arange(20), indexing="ij"))
    n = len(i)
    xy = np.stack([(i + first) * PITCH, j * PITCH], axis=1) @ [
        [np.cos(turned), np.sin(turned)],
        [-np.sin(turned), np.cos(turned)],
    ]
    xyz = np.column_stack([xy, np.full(n, above)])
    vertices = np.stack([xyz + np.array([0.0, 0.0, step]) for step in range(STEPS)])
    index = np.arange(n).reshape(30, 20)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    status = np.zeros((STEPS, n), np.int8)
    status[2, LOST] = 16
    vertices[2, LOST] = np.nan
    c_ls = np.where(status == 0, 0.01 + 1e-4 * np.arange(n), np.nan)
    sigma = np.where(status[..., None] == 0, np.broadcast_to(xyz / 1000, (STEPS, n, 3)), np.nan)
    # One match more than there are vertices: it was lost from the start.
    in_pixels = {name: np.zeros((2, n + 1, 2)) for name in ("px", "sigma")}
    matched = SimpleNamespace(**in_pixels, c_ls=np.zeros(n + 1), seconds={"refine": 1.0})
    steps = [
        PairStep(vertices[k], c_ls[k].astype(np.float32), sigma[k].astype(np.float32), np.append(status[k], 5), 0.0)
        for k in range(STEPS)
    ]
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    cameras = tuple(Camera(id_, np.eye(3, 4), (1, 1)) for id_ in pair)
    grid = np.vstack([xy, [-9, -9]])
    shape = PairShape(
        cameras, grid, np.arange(n), faces, steps[0], np.zeros((0, 4, 2), int), vertices[0], matched.sigma, 1.0
    )
    worst = c_ls.max(axis=0)
    return PairSurface(shape, lambda k: (steps[k], matched), worst, np.zeros(STEPS), np.zeros((STEPS, 2)))


def run(heuristic: str) -> tuple[Results, dict]:
    series, figures = series_of(heuristic)
    return join_steps([series.at(k) for k in range(STEPS)]), figures


def series_of(heuristic: str) -> tuple[PairsSeries, dict]:
    surfaces = [plate(("A", "B"), 0, 0.0, 0.0), plate(("B", "C"), 20, 0.1, 0.03)]
    settings = Settings(surface=SurfaceGroup(merge=heuristic))
    return pairs_surface("plates", [], surfaces, [f"000{k}-specimen" for k in range(STEPS)], settings)


@pytest.mark.parametrize("heuristic", ["combined", "correlation"])
def test_every_vertex_keeps_its_own_values(heuristic: str) -> None:
    whole, _ = run("none")
    results, figures = run(heuristic)
    assert figures["removed"] > 100
    assert len(results.vertices_ref) < len(whole.vertices_ref)
    np.testing.assert_array_equal(np.unique(results.faces), np.arange(len(results.vertices_ref)))
    where = {tuple(xyz): k for k, xyz in enumerate(whole.vertices_ref)}
    old = np.array([where[tuple(xyz)] for xyz in results.vertices_ref])
    for name in ("vertices", "correlation", "sigma_xyz", "status"):
        np.testing.assert_array_equal(getattr(results, name), getattr(whole, name)[:, old])
    np.testing.assert_array_equal(results.vertex_pair, whole.vertex_pair[old])
    for mine, before in zip(results.matches, whole.matches, strict=True):
        has = mine.vertex >= 0
        np.testing.assert_array_equal(results.vertices_ref[mine.vertex[has]], whole.vertices_ref[before.vertex[has]])
        assert before.vertex[-1] == mine.vertex[-1] == -1
    assert [matches.seconds for matches in results.matches] == [{"refine": 1.0}] * 2  # those of the reference alone
    assert sum((matches.vertex >= 0).sum() for matches in results.matches) == len(results.vertices_ref)


def test_the_merged_plate_is_one_sheet_and_tells_which_triangles_join_pairs() -> None:
    results, _ = run("combined")
    mesh = results.mesh
    (rim,) = borders(Mesh(mesh.vertices, mesh.faces))
    assert rim.kind is Kind.RIM
    assert overlap_area(mesh, reach=1.0) == 0.0
    corners = results.vertex_pair[results.faces]
    np.testing.assert_array_equal(results.pair == -1, (corners != corners[:, :1]).any(axis=1))
    assert set(results.pair) == {-1, 0, 1}
    assert results.deformation(1).lambda2 == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("heuristic", ["none", "combined"])
def test_the_distance_between_the_pairs_is_told_either_way(heuristic: str) -> None:
    _, figures = run(heuristic)
    assert figures["heuristic"] == heuristic
    assert figures["mismatch_mm"] == pytest.approx(0.1, abs=1e-9)
    assert figures["mismatch_std_mm"] == pytest.approx(0.0, abs=1e-6)
    (row,) = figures["mismatches"]
    assert row["pairs"] == ["A-B", "B-C"]
    assert row["bias_mm"] == pytest.approx(0.1, abs=1e-9)
