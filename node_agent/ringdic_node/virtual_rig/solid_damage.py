"""Disturbances of a solid body's images, added to the finished radiance: hairs, shadows, reflections of lamps, bars."""

from __future__ import annotations

import numba as nb
import numpy as np

from ringdic_node.virtual_rig.arrays import Floats, Radiance
from ringdic_node.virtual_rig.lens import VirtualCamera, ideal_of_pixel
from ringdic_node.virtual_rig.scenes.damage import BAR, HAIR, Hair
from ringdic_node.virtual_rig.scenes.solid import Solid, SolidSpecimen
from ringdic_node.virtual_rig.sensor import blurred

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
    if scene.damage.hairs:
        share = np.zeros(len(rays))
        share[hit] = _hair_shares(scene.damage.hairs, material, distance[hit] / camera.K[0, 0])
        light += blurred(share.reshape(image.shape).astype(np.float32)).ravel() * (HAIR - light)
    light[hit] *= scene.damage.lit(xyz[hit])
    light[hit] += scene.damage.reflections(camera.centre, xyz[hit], normals)
    for share in scene.damage.bar_shares(camera.centre, xyz, 1.0 / camera.K[0, 0]):
        light += share * (BAR - light)
    return light.reshape(image.shape).astype(np.float32)


def grown_hairs(solid: Solid, count: int, seed: int) -> tuple[Hair, ...]:
    """About ``count`` hairs, 10 to 25 mm long and 0.12 mm thick, at random places of a body and in random directions.

    seed : of places and directions.
    """
    points, normals, _ = solid.sample(count, seed)
    rng = np.random.default_rng([seed, 77])
    hairs = []
    for root, normal in zip(points[:count], normals[:count], strict=True):
        along = np.cross(normal, rng.normal(size=3))
        along /= np.linalg.norm(along)
        (a, b, c), (d, e, f), (g, h, i) = np.round([root, along, np.cross(normal, along)], 4).tolist()
        hairs.append(Hair((a, b, c), (d, e, f), (g, h, i), round(float(rng.uniform(10.0, 25.0)), 2), 0.06))
    return tuple(hairs)


def _hair_shares(hairs: tuple[Hair, ...], material: Floats, wide: Floats) -> Floats:
    """Share (n,), without unit, that hairs cover of the pixels that show material points (n, 3) mm.

    wide : (n,) mm, width of each pixel on the body.
    """
    rows = np.array([(*each.root, *each.along, *each.across, each.length, each.radius) for each in hairs])
    out = np.zeros(len(material))
    _fill_hair_shares(rows, np.ascontiguousarray(material), np.ascontiguousarray(wide), out)
    return out


@nb.njit(nogil=True)
def _fill_hair_shares(hairs, material, wide, out):  # type: ignore[no-untyped-def]
    """Write the shares of `_hair_shares` to out (n,). hairs : (k, 11), root, along, across, length, radius, mm."""
    for k in range(len(out)):
        half = 0.5 * wide[k]
        for h in hairs:
            x, y, z = material[k, 0] - h[0], material[k, 1] - h[1], material[k, 2] - h[2]
            aside = x * h[6] + y * h[7] + z * h[8]
            if abs(aside) > h[10] + half:
                continue
            along = x * h[3] + y * h[4] + z * h[5]
            if not 0.0 < along < h[9] or x * x + y * y + z * z > 2.0 * h[9] ** 2:  # the back of the body is no part
                continue
            share = (min(aside + half, h[10]) - max(aside - half, -h[10])) / wide[k]
            out[k] = 1.0 - (1.0 - out[k]) * (1.0 - share)


@nb.njit(nogil=True)
def _fill_rays(lens, R, width, out):  # type: ignore[no-untyped-def]
    """Write the unit directions in the world of all pixels' rays, row by row, to out (height * width, 3)."""
    for k in range(len(out)):
        u, v = k % width, k // width
        x, y, _, _, _, _ = ideal_of_pixel(u, v, lens, (u - lens[3]) / lens[0], (v - lens[4]) / lens[1])
        size = (x * x + y * y + 1.0) ** 0.5
        for i in range(3):
            out[k, i] = (R[0, i] * x + R[1, i] * y + R[2, i]) / size
