"""Disturbances of a solid body's images, added to the finished radiance: shadows, reflections of lamps, bars."""

from __future__ import annotations

import numba as nb
import numpy as np

from ringdic_node.virtual_rig.arrays import Radiance
from ringdic_node.virtual_rig.lens import VirtualCamera, ideal_of_pixel
from ringdic_node.virtual_rig.scenes.damage import BAR
from ringdic_node.virtual_rig.scenes.solid import SolidSpecimen

_ROOM = 800.0  # mm from a camera, behind everything that stands in the rig


def with_damage(camera: VirtualCamera, scene: SolidSpecimen, image: Radiance) -> Radiance:
    """The image (height, width) of a solid body, in linear light without unit, with the disturbances of the scene."""
    rays = np.empty((camera.height * camera.width, 3))
    _fill_rays(camera.lens, np.ascontiguousarray(camera.R), camera.width, rays)
    distance = scene.hit_distances(np.tile(camera.centre, (len(rays), 1)), rays)
    hit = distance > 0.0
    xyz = camera.centre + np.where(hit, distance, _ROOM)[:, None] * rays
    material = scene.moved_back(xyz[hit])
    normals = scene.moved_normals(material, scene.solid.nearest(material)[1])
    light = image.ravel().astype(np.float64)
    light[hit] *= scene.damage.lit(xyz[hit])
    light[hit] += scene.damage.reflections(camera.centre, xyz[hit], normals)
    for share in scene.damage.bar_shares(camera.centre, xyz, 1.0 / camera.K[0, 0]):
        light += share * (BAR - light)
    return light.reshape(image.shape).astype(np.float32)


@nb.njit(nogil=True)
def _fill_rays(lens, R, width, out):  # type: ignore[no-untyped-def]
    """Write the unit directions in the world of all pixels' rays, row by row, to out (height * width, 3)."""
    for k in range(len(out)):
        u, v = k % width, k // width
        x, y, _, _, _, _ = ideal_of_pixel(u, v, lens, (u - lens[3]) / lens[0], (v - lens[4]) / lens[1])
        size = (x * x + y * y + 1.0) ** 0.5
        for i in range(3):
            out[k, i] = (R[0, i] * x + R[1, i] * y + R[2, i]) / size
