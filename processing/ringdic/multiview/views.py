"""Visibility of the surface's nodes in the cameras, and the angles of incidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ringdic.arrays import Floats, Mask, Points
from ringdic.geometry.camera import Camera
from ringdic.multiview.lattice import TURN, Pieces

_CLEARANCE = 0.7  # mm that a line of sight must keep above the surface it passes
_LOOK_ALONG = np.array([2.0, 4.0, 6.0, 9.0, 13.0, 18.0, 25.0, 34.0, 46.0, 60.0])  # mm from the node


def incidence(pieces: Pieces, cameras: Sequence[Camera]) -> Floats:
    """Cosine of the angle between surface normal and line of sight at every node and camera.

    pieces : the surface. Returns (C, columns, rows) without unit, NaN where there is no surface.
    """
    xyz, normals = pieces.xyz, pieces.normals
    return np.stack([camera.incidence_cosine(xyz, normals) for camera in cameras])


def visibility(
    pieces: Pieces, cameras: Sequence[Camera], masks: Mapping[str, Mask], incidence_deg: float, margin: float
) -> tuple[Mask, Floats]:
    """Which cameras see which nodes of the surface.

    A node is visible in a camera where it is seen under less than ``incidence_deg`` degrees, lies ``margin`` px
    inside the image and inside the camera's mask, and is not behind another part of the surface.

    Parameters
    ----------
    pieces : the surface.
    masks : (height, width) bool, by camera id; a camera without one sees all of its image.
    incidence_deg : degrees, steepest angle between normal and line of sight.
    margin : px.

    Returns
    -------
    Visibility (C, columns, rows) bool and cosine of incidence (C, columns, rows).
    """
    cosine = incidence(pieces, cameras)
    with np.errstate(invalid="ignore"):
        visible = cosine > math.cos(math.radians(incidence_deg))
    xyz = pieces.xyz
    for k, camera in enumerate(cameras):
        at = np.nonzero(visible[k])
        if not len(at[0]):
            continue
        px = camera.project(xyz[at])
        width, height = camera.size
        fits = (px >= margin).all(axis=1) & (px[:, 0] < width - 1 - margin) & (px[:, 1] < height - 1 - margin)
        mask = masks.get(camera.id)
        if mask is not None:
            column, row = np.rint(np.where(fits[:, None], px, 0)).astype(int).T
            fits &= mask[row, column]
        fits[fits] = ~_hidden(pieces, camera, xyz[at][fits])
        visible[k][at] = fits
    return visible, cosine


def _hidden(pieces: Pieces, camera: Camera, xyz: Points) -> Mask:
    """Points (n, 3) mm whose line of sight passes below the surface on its way to the camera, (n,) bool."""
    towards = camera.centre - xyz
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    hidden = np.zeros(len(xyz), bool)
    for distance in _LOOK_ALONG:
        x, y, z = (xyz + distance * towards).T
        column, row, inside = pieces.lattice.nearest(np.arctan2(y, x) % TURN, z)
        with np.errstate(invalid="ignore"):
            hidden |= inside & (np.hypot(x, y) < pieces.radius[column, row] - _CLEARANCE)
    return hidden
