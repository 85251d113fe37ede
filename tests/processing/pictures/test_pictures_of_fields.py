"""Pictures tell what was measured, where it was: against a tube whose geometry and deformation are known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from ringdic.errors import InputError
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.mesh.mesh import Mesh
from ringdic.pictures.animation import surface_frames, write_animation
from ringdic.pictures.axes import draw_surface
from ringdic.pictures.overlay import camera_of, overlay
from ringdic.pictures.painter import paint
from ringdic.pictures.scale import Scale, scale_of
from ringdic.pictures.views import from_side, mean_azimuth, through_camera, unrolled
from ringdic.results.evaluation import EvaluatedResults
from ringdic.results.results import Results

RADIUS, AROUND, ALONG = 50.0, 60, 21
STRETCH = (1.0, 1.1, 1.2)  # along z


def camera() -> Camera:
    """At azimuth 0, 400 mm from the axis, looking at it level; image of 320 × 240 px."""
    K = np.array([[500.0, 0.0, 159.5], [0.0, 500.0, 119.5], [0.0, 0.0, 1.0]])
    R = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    t = -R @ np.array([400.0, 0.0, 25.0])
    P = K @ np.column_stack([R, t])
    return Camera("one", P / P[2, 3], (320, 240), Intrinsics(K, np.zeros(5), (320, 240)))


def drawn_tube(lost: int | None = None) -> Results:
    angle, z = np.meshgrid(np.arange(AROUND) * 2 * np.pi / AROUND, 2.5 * np.arange(ALONG), indexing="ij")
    reference = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z], -1).reshape(-1, 3)
    n = np.arange(AROUND * ALONG).reshape(AROUND, ALONG)
    m = np.roll(n, -1, axis=0)
    a, b, c, d = (part.ravel() for part in (n[:, :-1], m[:, :-1], m[:, 1:], n[:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([reference * [1.0, 1.0, k] for k in STRETCH])
    if lost is not None:
        vertices[1:, lost] = np.nan
    N = len(reference)
    return Results(
        rig="tube", steps=("a", "b", "c"), cameras=(camera(),), pairs=(("one", "two"),), vertices_ref=reference,
        vertices=vertices, faces=faces, pair=np.zeros(len(faces), dtype=np.int64),
        vertex_pair=np.zeros(N, dtype=np.int64), correlation=np.full((3, N), 0.01),
        sigma_xyz=np.full((3, N, 3), 1e-3), status=np.zeros((3, N), dtype=np.int8),
    )  # fmt: skip


def test_a_pixel_belongs_to_the_triangle_over_its_centre_and_the_nearer_one_hides_the_other() -> None:
    far = [[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]]
    near = [[-3.0, -3.0], [4.0, -3.0], [-3.0, 4.0]]
    lost = [[0.0, 0.0], [np.nan, 9.0], [9.0, 9.0]]
    painted = paint(np.array([near, far, lost]), np.array([1.0, 2.0, 0.5]), (12, 12))
    y, x = np.indices((12, 12))
    wanted = np.where(x + y <= 9, 1, -1)
    wanted[x + y <= 1] = 0
    np.testing.assert_array_equal(painted, wanted)


def test_the_unrolled_tube_shows_every_triangle_at_its_azimuth_and_height() -> None:
    mesh = drawn_tube().mesh
    view = unrolled(mesh, width=720)
    assert view.extent == pytest.approx((0.0, 360.0, 0.0, 50.0))
    assert view.aspect == pytest.approx(2 * np.pi * RADIUS / 50.0)
    assert (view.faces >= 0).all()
    centroids = mesh.centroids
    height, width = view.faces.shape
    x = (np.degrees(np.arctan2(centroids[:, 1], centroids[:, 0])) % 360.0) / 360.0 * width - 0.5
    y = (50.0 - centroids[:, 2]) / 50.0 * height - 0.5
    np.testing.assert_array_equal(
        view.faces[np.rint(y).astype(int), np.rint(x).astype(int)], np.arange(len(mesh.faces))
    )


def test_a_part_of_a_ring_is_cut_where_there_is_none_of_it() -> None:
    mesh = drawn_tube().mesh
    azimuth = np.degrees(np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]))
    part, _ = Mesh(mesh.vertices, mesh.faces[(np.abs(azimuth)[mesh.faces] < 45.0).all(axis=1)]).compact()
    view = unrolled(part)
    assert view.extent == pytest.approx((318.0, 402.0, 0.0, 50.0))
    assert (view.faces >= 0).all()
    assert mean_azimuth(part) == pytest.approx(0.0, abs=1e-9)


def test_the_body_from_a_side_shows_its_near_half_and_the_inside_over_the_rim() -> None:
    mesh = drawn_tube().mesh
    view = from_side(mesh, np.radians(90.0))
    shown = np.unique(view.faces[(view.faces >= 0) & ~view.inside])
    assert (mesh.centroids[shown, 1] > -1.0).all()
    assert view.inside.any()
    assert (mesh.centroids[np.unique(view.faces[view.inside]), 1] < 1.0).all()


def test_an_overlay_colours_what_the_camera_sees_and_leaves_the_rest_of_the_photograph() -> None:
    lost = 10  # a vertex right before the camera
    seen = EvaluatedResults(drawn_tube(lost))
    results, photograph = seen.results, np.full((240, 320), 102, dtype=np.uint8)
    scale = scale_of(seen, "lambda2", (0.7, 1.3))
    drawn = overlay(seen, "one", photograph, scale, 2, opacity=0.5)
    now = Mesh(results.vertices[2], results.faces)
    measured = now.whole_faces()
    cosine = camera().incidence_cosine(now.centroids, now.normals)
    px = np.rint(camera().project(np.nan_to_num(now.centroids))).astype(int)
    wanted = np.rint(255 * (0.5 * 102 / 255 + 0.5 * scale.colours(np.array(1.2))))
    front = np.flatnonzero(measured & (cosine > 0.3))
    assert len(front) > 300
    assert np.abs(drawn[px[front, 1], px[front, 0]] - wanted).max() <= 1
    hole = camera().project(results.vertices_ref[lost] * [1.0, 1.0, 1.2])
    x, y = np.rint(hole).astype(int)
    np.testing.assert_array_equal(drawn[y, x], 102)
    np.testing.assert_array_equal(drawn[:10], 102)
    assert cosine[np.unique(through_camera(now, camera()))[1:]].min() > 0


@pytest.mark.parametrize("form", [(0.2, 0.2, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 0.6)])
def test_a_drawing_of_a_narrow_or_wide_surface_fills_its_figure(form: tuple[float, float, float]) -> None:
    tube = drawn_tube()
    seen = EvaluatedResults(replace(tube, vertices_ref=tube.vertices_ref * form, vertices=tube.vertices * form))
    axes = draw_surface(None, seen, scale_of(seen, "lambda2", (0.7, 1.3)), 0, elevation=0.0)
    figure = axes.figure
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert axes.get_window_extent().height > 0.7 * figure.bbox.height  # the rest are title and labels
    drawn = (np.asarray(canvas.buffer_rgba())[..., :3] < 250).any(axis=2)
    pyplot.close(figure)
    for axis in (0, 1):
        filled = np.concatenate([[True], drawn.any(axis=axis), [True]])
        assert np.diff(np.flatnonzero(filled)).max() < 0.12 * len(filled)  # the widest strip of blank paper


def test_what_cannot_be_laid_over_is_refused_by_name() -> None:
    seen = EvaluatedResults(drawn_tube())
    scale = scale_of(seen, "lambda2")
    with pytest.raises(InputError, match=r"200 x 100 px.*320 x 240"):
        overlay(seen, "one", np.zeros((100, 200), np.uint8), scale, 1)
    with pytest.raises(InputError, match="no camera 'nine'; it has one"):
        camera_of(seen, "nine")
    with pytest.raises(InputError, match="no field 'mood'"):
        scale_of(seen, "mood")
    with pytest.raises(InputError, match="the first one smaller"):
        Scale(scale.field, 1.0, 1.0)


def test_an_animation_has_a_frame_a_step_in_the_colours_of_the_step(tmp_path: Path) -> None:
    seen = EvaluatedResults(drawn_tube())
    scale = scale_of(seen, "lambda2", (0.7, 1.3))
    frames = list(surface_frames(seen, scale, 0.0, side=240))
    assert len({frame.shape for frame in frames}) == 1
    write_animation(tmp_path / "film.gif", frames, seconds=0.5)
    write_animation(tmp_path / "film.mp4", frames, seconds=0.5)
    film = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(2.0)
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.n_frames == 3
        assert gif.info["duration"] == 500
        for step, stretch in enumerate(STRETCH):
            gif.seek(step)
            wanted = 255 * scale.colours(np.array(stretch))
            y, x = 26 + 160, frames[0].shape[1] // 4  # on the body
            assert np.abs(np.asarray(gif.convert("RGB"))[y, x] - wanted).max() < 8
            assert np.abs(film.read()[1][y, x, ::-1] - wanted).max() < 25  # compressed with loss
    with pytest.raises(InputError, match="give its name such an ending"):
        write_animation(tmp_path / "film.avi", frames)
