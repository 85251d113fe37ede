"""Points of one camera tracked through its images, for the tests of tracking."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from ringdic.charts.tracked_points import tracked_points
from ringdic.charts.tracking import CameraPixels, interpolate_matches, match_in_two_passes, surface_grid
from ringdic.correlation import CorrelationSettings, prepare_reference
from scipy.spatial import Delaunay


@pytest.fixture(scope="session")
def track_camera() -> Callable[..., list[CameraPixels]]:
    """Call it with a camera's images, the reference first, and points of it: their pixels in each later image.

    The points are those of one chart, whose triangles may be given; by default all between the points.
    """

    def track(
        images: Sequence[np.ndarray], x0: np.ndarray, settings: CorrelationSettings,
        *, curved: bool = True, faces: np.ndarray | None = None,
    ) -> list[CameraPixels]:  # fmt: skip
        if faces is None:
            faces = Delaunay(x0).simplices.astype(np.int32)
        grid = surface_grid(images[0].shape[::-1], settings.step, [(x0, faces)])
        reference = prepare_reference(images[0], grid.region, settings)
        points = tracked_points(reference, grid.xy, settings)
        return [
            interpolate_matches(match_in_two_passes(reference, image, points, settings, curved=curved), x0)
            for image in images[1:]
        ]

    return track
