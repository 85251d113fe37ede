"""Sheets that overlap become one surface: sound, once covered, over the vertices that were there."""

from collections.abc import Sequence

import numpy as np
import pytest
from ringdic.merging import HEURISTICS, MergedSurface, SurfacePart, merge
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.topology import (
    Kind,
    borders,
    inconsistent_edges,
    is_closed_tube,
    non_manifold_edges,
    overlap_area,
    pieces,
    without_pinches,
)

RADIUS = 40.0


def strip(
    middle: float, width: float, height: float = 60.0, spacing: float = 2.5, seed: int = 0, noise: float = 0.0
) -> SurfacePart:
    """A patch of a tube, its grid turned by a few degrees as one camera's is against another's; angles in degrees."""
    random = np.random.default_rng(seed)
    tilt = random.uniform(-0.15, 0.15)
    n = int(2 * (np.radians(width) * RADIUS + height) / spacing)
    s, z = (np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij")) - n / 2) * spacing + random.uniform(0, 1)
    s, z = s * np.cos(tilt) - z * np.sin(tilt), s * np.sin(tilt) + z * np.cos(tilt)
    inside = (np.abs(s) < 0.5 * np.radians(width) * RADIUS) & (np.abs(z) < height / 2)
    index = np.full((n, n), -1)
    index[inside] = np.arange(inside.sum())
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    theta = np.radians(middle) + s[inside] / RADIUS
    r = RADIUS + noise * random.standard_normal(theta.size)
    # Seen at a steeper angle towards its edges, as by a camera pair.
    correlation = 0.01 + 0.02 * (s[inside] / RADIUS) ** 2 + 0.002 * random.random(theta.size)
    vertices = np.stack([r * np.cos(theta), r * np.sin(theta), z[inside]], axis=1)
    used, faces = np.unique(faces[(faces >= 0).all(axis=1)], return_inverse=True)
    return SurfacePart(vertices[used], faces.reshape(-1, 3), correlation[used])


def strips(count: int = 6, width: float = 100.0, noise: float = 0.02) -> list[SurfacePart]:
    return [strip(360 / count * k, width, seed=k, noise=noise) for k in range(count)]


def joined(parts: Sequence[SurfacePart], merged: MergedSurface) -> Mesh:
    return Mesh(np.concatenate([part.vertices for part in parts]), merged.faces)


def assert_sound(mesh: Mesh) -> None:
    assert len(non_manifold_edges(mesh)) == 0
    assert len(inconsistent_edges(mesh)) == 0
    assert without_pinches(mesh).all()
    assert overlap_area(mesh, reach=1.5) == 0.0
    radial = mesh.centroids * [1, 1, 0] / np.linalg.norm(mesh.centroids[:, :2], axis=1, keepdims=True)
    assert np.einsum("mi,mi->m", mesh.normals, radial).min() > 0.5


@pytest.mark.parametrize("heuristic", list(HEURISTICS))
def test_a_ring_of_overlapping_strips_becomes_a_closed_tube(heuristic: str) -> None:
    """100° strips every 60°: each place is measured once to twice; whatever decides, all of it is covered once."""
    parts = strips()
    merged = merge(parts, heuristic)
    mesh = joined(parts, merged)
    assert_sound(mesh)
    assert is_closed_tube(mesh)
    assert set(merged.pair) == {-1, *range(6)}
    inner = np.abs(mesh.centroids[:, 2]) < 22  # clear of the ragged ends
    assert mesh.areas[inner].sum() == pytest.approx(2 * np.pi * RADIUS * 44, rel=0.02)


def test_three_layers_are_no_harder_than_two() -> None:
    parts = strips(count=9, width=110.0)
    mesh = joined(parts, merge(parts))
    assert_sound(mesh)
    assert is_closed_tube(mesh)


def test_two_sheets_become_one_sheet_with_one_rim() -> None:
    parts = [strip(0, 80, seed=1), strip(50, 80, seed=2)]
    mesh = joined(parts, merge(parts))
    assert_sound(mesh)
    (rim,) = borders(mesh)
    assert rim.kind is Kind.RIM
    assert pieces(mesh).max() == 0


def test_sheets_side_by_side_are_stitched_and_far_ones_are_not() -> None:
    """Beside one another with a gap of 1.5 edges nothing is removed; five edges away they stay two sheets."""
    edge = np.degrees(2.5 / RADIUS)
    for gap, pieces_left in ((1.5, 1), (8.0, 2)):
        parts = [strip(0, 40, seed=3), strip(40 + gap * edge, 40, seed=3)]
        merged = merge(parts)
        assert len(merged.removed) == 0
        mesh = joined(parts, merged)
        assert_sound(mesh)
        assert pieces(mesh).max() + 1 == pieces_left
        assert (merged.added > 0) == (pieces_left == 1)
        assert (merged.pair[merged.pair < 0].size > 0) == (pieces_left == 1)


def test_no_vertex_is_moved_or_made_and_old_triangles_keep_their_sheet() -> None:
    parts = strips()
    merged = merge(parts)
    counts = [len(part.vertices) for part in parts]
    owner = np.repeat(np.arange(len(parts)), counts)
    np.testing.assert_array_equal(np.unique(merged.faces), merged.vertex)
    assert merged.vertex.max() < sum(counts)
    offsets = np.cumsum([0, *counts[:-1]])
    old = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    kept = np.delete(old, merged.removed, axis=0)
    there = {tuple(np.sort(face)) for face in kept}
    first = merged.faces[: len(merged.faces) - merged.added]
    assert {tuple(np.sort(face)) for face in first} <= there
    corners = owner[merged.faces]
    same = (corners == corners[:, :1]).all(axis=1)
    np.testing.assert_array_equal(merged.pair, np.where(same, corners[:, 0], -1))


def test_the_correlation_heuristic_keeps_the_better_surface() -> None:
    """Of two sheets over the same place, the one with the smaller C_LS stays whole and the other goes where covered."""
    good, bad = strip(0, 80, seed=5), strip(0, 50, height=40, seed=6)
    good = SurfacePart(good.vertices, good.faces, np.full(len(good.vertices), 0.01))
    bad = SurfacePart(bad.vertices, bad.faces, np.full(len(bad.vertices), 0.3))
    merged = merge([good, bad], "correlation")
    assert (merged.removed >= len(good.faces)).all()
    assert len(merged.removed) == len(bad.faces)
    assert set(merged.pair) == {0}


@pytest.mark.parametrize("heuristic", list(HEURISTICS))
def test_what_was_lost_later_gives_way_to_what_was_not(heuristic: str) -> None:
    """A patch in the middle of one sheet loses its points at a later step; the other sheet saw it at every step."""
    first, second = strip(0, 80, seed=7, noise=0.02), strip(10, 80, seed=8, noise=0.02)
    hidden = np.linalg.norm(first.vertices - [RADIUS, 0, 0], axis=1) < 8
    first = SurfacePart(first.vertices, first.faces, np.where(hidden, np.nan, first.correlation))
    merged = merge([first, second], heuristic)
    assert_sound(joined([first, second], merged))
    used = merged.vertex[merged.vertex < len(hidden)]
    assert not hidden[used].any()
    (rim,) = borders(joined([first, second], merged))
    assert rim.kind is Kind.RIM


def test_small_holes_are_closed_and_large_ones_are_not() -> None:
    """One missing vertex leaves four cells open, a missing disk of 5 edges radius some 80."""
    whole = strip(0, 100, seed=9)
    for radius, closed in ((1.0, True), (12.0, False)):
        middle = np.argmin(np.linalg.norm(whole.vertices - [RADIUS, 0, 0], axis=1))
        gone = np.linalg.norm(whole.vertices - whole.vertices[middle], axis=1) < radius
        part = SurfacePart(whole.vertices, whole.faces[~gone[whole.faces].any(axis=1)], whole.correlation)
        merged = merge([part])
        mesh = joined([part], merged)
        assert_sound(mesh)
        holes = [border for border in borders(mesh) if border.kind is Kind.HOLE]
        assert len(holes) == (0 if closed else 1)
        if closed:
            assert mesh.areas.sum() == pytest.approx(Mesh(whole.vertices, whole.faces).areas.sum(), rel=1e-3)
        assert set(merged.pair) == {0}


def test_the_two_sides_of_a_plate_are_not_taken_for_an_overlap() -> None:
    front = strip(0, 60, seed=10)
    back = SurfacePart(front.vertices * 0.99, front.faces[:, ::-1], front.correlation)
    merged = merge([front, back])
    assert len(merged.removed) == 0
    assert len(merged.mismatch) == 0


def test_nothing_and_a_single_sheet_stay_as_they_are() -> None:
    empty = SurfacePart(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0))
    assert len(merge([]).faces) == len(merge([empty]).faces) == 0
    part = strip(0, 60, seed=11)
    merged = merge([empty, part])
    np.testing.assert_array_equal(merged.faces, part.faces)
    assert set(merged.pair) == {1}


def test_what_cannot_be_merged_is_refused() -> None:
    part = strip(0, 60)
    with pytest.raises(ValueError, match="no heuristic 'best'"):
        merge([part], "best")
    with pytest.raises(ValueError, match="finite"):
        SurfacePart(np.full((4, 3), np.nan), np.zeros((0, 3), np.int64), np.zeros(4))
    with pytest.raises(ValueError, match="as many correlations"):
        SurfacePart(np.zeros((4, 3)), np.zeros((0, 3), np.int64), np.zeros(3))
