"""Points of the true surface of a body that cameras see, and how much of them a measured mesh covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ringdic.arrays import Indices, Mask, Points, Vectors
from ringdic.mesh.mesh import Mesh
from ringdic.mesh.projection import Projector
from ringdic_node.virtual_rig.lens import VirtualCamera
from ringdic_node.virtual_rig.scenes import SolidSpecimen

COUNT = 20_000  # points of the whole surface
_WITHIN = 1.0  # mm along the normal


@dataclass(frozen=True)
class SurfaceSample:
    """Random points of the true surface at the reference, as many on each area, that two cameras or more see.

    points : (n, 3) mm. normals : (n, 3) outward unit vectors. later : (n,) bool, whether two cameras or more see the
    point both at the reference and after the motion. area : mm², for which a point stands.
    """

    points: Points
    normals: Vectors
    later: Mask
    area: float

    @classmethod
    def of(
        cls, before: SolidSpecimen, after: SolidSpecimen, cameras: Sequence[VirtualCamera], count: int = COUNT
    ) -> SurfaceSample:
        """Sample the surface of a body.

        before, after : the body at the reference and after its motion. count : of points on the whole surface.
        """
        points, normals, area = before.solid.sample(count)
        seen = before.visible(cameras, points, normals)
        later = (seen & after.visible(cameras, points, normals)).sum(axis=0) >= 2
        two = seen.sum(axis=0) >= 2
        return cls(points[two], normals[two], later[two], area)

    def covered(self, vertices: Points, faces: Indices) -> Mask:
        """Which points have a triangle within 1 mm along the normal, (n,) bool.

        vertices : (N, 3) mm at the reference. faces : (M, 3) indices of the triangles that count.
        """
        covered = np.zeros(len(self.points), dtype=bool)
        if len(faces):
            used, renumbered = np.unique(faces, return_inverse=True)
            mesh = Mesh(vertices[used], renumbered.reshape(-1, 3))
            covered[Projector(mesh, _WITHIN).hits(self.points, self.normals).point] = True
        return covered
