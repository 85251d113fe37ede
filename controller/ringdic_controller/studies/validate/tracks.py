"""Pixels from which the points of a run were triangulated, camera by camera, in one form for all ways."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from ringdic.arrays import Floats
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import triangulate
from ringdic.results.results import Results
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class Tracks:
    """Pixels of all points of a run's surface.

    cameras : C ids. px : (F, C, N, 2), NaN where a camera did not measure a point; at step 0 where all views together
    place the point. reference : (C, N, 2), as matched between the cameras.
    """

    cameras: tuple[str, ...]
    px: Floats
    reference: Floats

    @classmethod
    def of(cls, results: Results) -> Tracks:
        """The pixels of the matches that are stored with the results."""
        ids = tuple(camera.id for camera in results.cameras)
        count = len(results.vertices_ref)
        px = np.full((len(results.steps), len(ids), count, 2), np.nan)
        reference = np.full((len(ids), count, 2), np.nan)
        for matches in results.matches:
            camera = ids.index(matches.cameras[0])
            good = np.where(matches.status[..., None] == 0, 1.0, np.nan)
            px[:, camera, matches.vertex] = matches.px[:, 0] * good
            reference[camera, matches.vertex] = matches.xy
        return cls(ids, px, reference)

    def reconstruct(self, cameras: Mapping[str, Camera]) -> Floats:
        """Reference points triangulated with other cameras, all views weighted alike, (N, 3) mm."""
        return triangulate([cameras[id_] for id_ in self.cameras], self.reference)

    def of_pair(self, cameras: Mapping[str, Camera], pair: tuple[str, str], step: int | None = None) -> Floats:
        """Points triangulated by one camera pair alone, (N, 3) mm, NaN where one of its cameras has no match.

        step : of the tracking in time; None for the reference as matched between the cameras.
        """
        chosen = [self.cameras.index(id_) for id_ in pair]
        px = self.reference[chosen] if step is None else self.px[step, chosen]
        return triangulate([cameras[id_] for id_ in pair], px)

    def neighbours(self, pairs: tuple[tuple[str, str], ...]) -> Iterator[tuple[tuple[str, str], tuple[str, str]]]:
        """Camera pairs that share a camera: each pair with the next one round the ring."""
        following = {first: (first, second) for first, second in pairs}
        for pair in pairs:
            if pair[1] in following:
                yield pair, following[pair[1]]


def mismatch(tracks: Tracks, cameras: Mapping[str, Camera], pairs: tuple[tuple[str, str], ...]) -> Floats:
    """Distances (n,) mm between the surfaces that two camera pairs with a common camera measure (Fig. 7a).

    Points that both pairs see are compared. Where there are none, as where each pair has points of its own, one pair's
    surface is interpolated at the other's points in the image of the common camera, by cubic interpolation.
    """
    distances = []
    for one, other in tracks.neighbours(pairs):
        X, Y = tracks.of_pair(cameras, one), tracks.of_pair(cameras, other)
        both = np.isfinite(X).all(axis=1) & np.isfinite(Y).all(axis=1)
        if both.sum() > 10:
            distances.append(np.linalg.norm(X[both] - Y[both], axis=1))
            continue
        shared = tracks.reference[tracks.cameras.index(one[1])]
        source, wanted = (np.flatnonzero(np.isfinite(each).all(axis=1)) for each in (X, Y))
        if len(source) < 10 or not len(wanted):
            continue
        carried = CloughTocher2DInterpolator(shared[source], X[source])(shared[wanted])
        known = np.isfinite(carried).all(axis=1) & (_gap(shared[source], shared[wanted]) < 1.5)
        distances.append(np.linalg.norm(carried[known] - Y[wanted[known]], axis=1))
    return np.concatenate(distances) if distances else np.zeros(0)


def _gap(source: Floats, wanted: Floats) -> Floats:
    """Distance of each point of ``wanted`` from the nearest of ``source``, in units of the median spacing of these."""
    tree = cKDTree(source)
    spacing = float(np.median(tree.query(source[:2000], k=2)[0][:, 1]))
    return np.asarray(tree.query(wanted)[0]) / spacing
