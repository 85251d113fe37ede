"""Which camera faces a part of the surface most squarely, and which others see it.

Both are told from the depth maps of all cameras: a point of one map is seen by another camera where that camera's own
map shows the same depth, or none; where it shows a smaller depth, something stands before the point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels, Points, Vectors
from ringdic.charts.contrast import contrast
from ringdic.charts.depth_map import DepthMap
from ringdic.charts.patches import depths
from ringdic.correlation import grid
from ringdic.geometry.camera import Camera

_REACH = 1.5  # steps of a map's lattice within which its nearest place tells the depth of a pixel
_SAME = 0.5  # steps of the lattice, in mm on the surface, within which two depths agree
_STRONG = 0.5  # slope of a textured pixel, in units of the usual contrast of the chart
_GAP = 0.6  # subset radii, half the largest gap between speckles
_EDGE = 0.45  # subset radii, width of the strip along the border of the pattern that no subset contains
_HOLE = 0.7  # subset radii, of a circle as large as the largest gap between speckles, with pattern all round, is
_LEAST_CONTRAST = 0.3  # close to a point, of the usual one: a subset beyond the last speckles is ill determined
_BRIGHTER = 0.15  # of the range of its grey levels, by which a surface's pixels exceed the brightest of its places
_LAMP = 0.4  # subset radii, least width of a spot that is brighter than that and no part of the surface
_OVERLAP = 1  # steps of the lattice by which a chart exceeds the part that its camera faces most squarely
_RIM = 3.0  # steps of the lattice by which matches may reach beyond the last place with a depth


@dataclass(frozen=True)
class ChartPlan:
    """What one camera measures: n places of its depth map, and the cameras in which the surface about each is matched.

    inside : (n,) bool, places of the chart. sees : (n, C) bool, cameras that see the place, without the camera itself.
    """

    inside: Mask
    sees: Mask


def plan_chart(
    k: int, cameras: Sequence[Camera], maps: Sequence[DepthMap] | Mapping[int, DepthMap], incidence_deg: float,
    partners: Sequence[int],
    *, whole: bool = False,
) -> ChartPlan:  # fmt: skip
    """Determine the part of the surface that a camera faces most squarely, with a margin round it.

    Parameters
    ----------
    k : index of the camera.
    cameras : the C cameras.
    maps : their depth maps, or at least those of the camera and of these others, by index.
    incidence_deg : degrees, largest angle of incidence of a view that is used.
    partners : indices of the cameras that it may be matched with.
    whole : whether the chart is all that the camera shares with a partner, instead of what it faces most squarely.
    """
    view = _MapViews(cameras[k], maps[k])
    limit = math.cos(math.radians(incidence_deg))
    own = cameras[k].incidence_cosine(view.xyz, view.normals)
    squarest = np.full(len(view.xyz), -1.0)
    sees = np.zeros((len(view.xyz), len(cameras)), bool)
    for c in partners:
        cosine = cameras[c].incidence_cosine(view.xyz, view.normals)
        same, hidden = _MapViews(cameras[c], maps[c]).compare(view.xyz, view.step_mm)
        squarest = np.maximum(squarest, np.where(same, cosine, -1.0))
        sees[:, c] = (cosine > limit) & ~hidden & _inside(cameras[c], view.xyz)
    usable = (own > limit) & sees.any(axis=1)
    if whole:
        return ChartPlan(usable, sees)
    return ChartPlan(_dilated(maps[k], usable & (own >= squarest)) & usable, sees)


def facing_pairs(
    cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], squarely: Floats
) -> tuple[tuple[tuple[str, str], ...], Indices]:
    """Pair of cameras that face each point most squarely.

    cameras : the C cameras. pairs : ids of neighbouring cameras. squarely : (C, n), no unit, cosine of the angle of
    incidence; -1 or less where a camera did not measure the point.
    Returns the pairs of camera ids, with pairs that are not among those given appended, and the index (n,) of each
    point's pair among them.
    """
    best = np.sort(np.argsort(-squarely, axis=0)[:2], axis=0)
    listed = [(first, second) for first, second in pairs]
    index = {frozenset(pair): k for k, pair in enumerate(listed)}
    pair_of_point = np.empty(squarely.shape[1], np.int64)
    for a, b in np.unique(best, axis=1).T:
        pair = (cameras[a].id, cameras[b].id)
        if frozenset(pair) not in index:
            index[frozenset(pair)] = len(listed)
            listed.append(pair)
        pair_of_point[(best[0] == a) & (best[1] == b)] = index[frozenset(pair)]
    return tuple(listed), pair_of_point


class _MapViews:
    """Points and normals of a depth map, and a comparison of other points with it."""

    def __init__(self, camera: Camera, depth_map: DepthMap) -> None:
        self.camera, self.map = camera, depth_map
        patches = depth_map.patches
        self.xyz: Points = patches.points(camera, np.zeros((1, 2)))[:, 0]
        self.normals: Vectors = patches.normals(camera)
        self._tree = cKDTree(patches.px) if len(patches.px) else None

    @property
    def step_mm(self) -> float:
        """Spacing of the lattice on a surface that faces the camera, mm."""
        if not len(self.xyz):
            return 0.0
        px = self.map.patches.px[:1]
        angle = np.linalg.norm(self.camera.ray(px + np.array([self.map.spacing, 0.0])) - self.camera.ray(px))
        return float(np.median(np.linalg.norm(self.xyz - self.camera.centre, axis=1)) * angle)

    def compare(self, xyz: Points, step_mm: float) -> tuple[Mask, Mask]:
        """Which points (n, 3) mm the map shows at the same depth, and before which it shows something nearer."""
        same, hidden = np.zeros(len(xyz), bool), np.zeros(len(xyz), bool)
        if self._tree is None or not len(xyz):
            return same, hidden
        px = self.camera.project(xyz)
        distance, index = self._tree.query(px, distance_upper_bound=_REACH * self.map.spacing)
        near = np.flatnonzero(np.isfinite(distance))
        index = index[near]
        patches = self.map.patches
        offset = px[near] - patches.px[index]
        inverse = patches.inverse_depth[index] + np.sum(patches.gradient[index] * offset, axis=1)
        depth = depths(self.camera, xyz[near])
        with np.errstate(divide="ignore"):
            nearer = depth - 1.0 / inverse
        slant = np.maximum(self.camera.incidence_cosine(self.xyz[index], self.normals[index]), 0.2)
        tolerance = _SAME * step_mm / slant
        same[near] = np.abs(nearer) < tolerance
        hidden[near] = nearer > 3.0 * tolerance
        return same, hidden


def _inside(camera: Camera, xyz: Points) -> Mask:
    """Points (n, 3) mm that project into a camera's image, (n,)."""
    px = camera.project(xyz)
    return np.asarray(((px >= 0) & (px <= np.array(camera.size) - 1)).all(axis=1))


def _dilated(depth_map: DepthMap, chosen: Mask) -> Mask:
    """Places (n,) of a map within the overlap of chosen ones."""
    if not chosen.any():
        return chosen
    cell = np.rint(depth_map.patches.px / depth_map.spacing).astype(np.int64)
    picture = np.zeros(cell.max(axis=0, initial=0) + 1, np.uint8)
    picture[tuple(cell[chosen].T)] = 1
    grown = cv2.dilate(picture, np.ones((2 * _OVERLAP + 1,) * 2, np.uint8))
    return np.asarray(grown[tuple(cell.T)] > 0)


def chart_region(grey: Image, depth_map: DepthMap, inside: Mask, radius: int) -> tuple[Mask, Mask]:
    """Region of a chart in its camera's reference image: the textured pixels about its places.

    Beyond the rim of the depth map it exceeds the chart's places by a step or two of the lattice, since matches reach
    farther on the fine grid; texture tells where the surface really ends.

    grey : (height, width) grey levels. depth_map : of the camera. inside : (n,) places that belong to the chart.
    radius : px, of the subsets.
    Returns two masks (height, width): pixels that subsets may contain, and those of them where points may lie, since
    there is texture close by. A point beyond the pixels of its subset would be an extrapolation, which knows nothing of
    an edge of the surface between.
    """
    spacing, px = depth_map.spacing, depth_map.patches.px
    region, of_points = np.zeros(grey.shape, bool), np.zeros(grey.shape, bool)
    if not inside.any():
        return region, of_points
    cells = _cells(depth_map, inside)
    half, reach = spacing // 2 + 1, spacing
    left, top = np.maximum(np.floor(cells.min(axis=0)).astype(int) - half - reach, 0)
    right, bottom = np.ceil(cells.max(axis=0)).astype(int) + half + reach
    part = grey[top:bottom, left:right]
    mask = np.zeros(part.shape, np.uint8)
    column, row = (np.rint(cells).astype(int) - (left, top)).T
    mask[row, column] = 1
    side = 2 * reach + 1
    grown = cv2.dilate(mask, np.ones((side + 2 * half,) * 2, np.uint8))  # of squares about the cells
    closed = np.asarray(cv2.erode(grown, np.ones((side, side), np.uint8))) > 0
    textured, close = _textured_pixels(part, float(np.median(contrast(grey, px[inside], radius))), radius)
    column, row = np.rint(px[inside]).astype(np.int64).T
    lamps = _lamps(part, grey[row, column], radius)
    pattern = (_without_gaps(closed & textured, radius) & ~lamps).astype(np.uint8)
    inner = cv2.erode(pattern, np.ones((2 * round(_EDGE * radius) + 1,) * 2, np.uint8)) > 0
    region[top:bottom, left:right] = inner
    of_points[top:bottom, left:right] = inner & _without_gaps(close, radius)
    return region, of_points


def _lamps(grey: Image, levels: NDArray, radius: int) -> Mask:
    """Mask (height, width) of spots that are brighter than a surface ever is, such as lamps and light walls behind it.

    Smaller ones may be reflections on it. levels : (n,), grey levels at places of the surface. radius : px, of the
    subsets.
    """
    dark, bright = np.percentile(levels, [5, 95])
    brighter = (grey > bright + _BRIGHTER * (bright - dark)).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(brighter, cv2.MORPH_OPEN, np.ones((round(_LAMP * radius),) * 2, np.uint8)) > 0)


def _without_gaps(mask: Mask, radius: int) -> Mask:
    """A mask (height, width) bool with its small holes filled. radius : px, of the subsets."""
    _, label, figures, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    left, top, wide, high, area = figures.T
    inside = (left > 0) & (top > 0) & (left + wide < mask.shape[1]) & (top + high < mask.shape[0])
    gap = inside & (area < np.pi * (_HOLE * radius) ** 2)
    gap[0] = False  # number 0 is the mask
    return np.asarray(mask | gap[label])


def grid_to_the_border(mask: Mask, step: int) -> tuple[Pixels, NDArray[np.int32]]:
    """Grid of a mask as from `grid`, whose points just outside the mask are moved onto its border.

    So the grid ends where the mask does, and not up to a step before it. mask : (height, width) bool. step : px.
    Returns xy (n, 2) px, whole pixels less than half a step from the multiples of the step, and faces (m, 3).
    """
    half = (step - 1) // 2
    near = cv2.dilate(mask.astype(np.uint8), np.ones((2 * half + 1,) * 2, np.uint8)) > 0
    xy, faces = grid(near, step)
    column, row = xy.astype(np.int64).T
    outside = np.flatnonzero(~mask[row, column])
    side = np.arange(-half, half + 1)
    beside = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    beside = beside[np.argsort((beside**2).sum(axis=1), kind="stable")]
    across, down = np.stack([column, row])[:, outside, None] + half + beside.T[:, None]
    xy[outside] += beside[np.pad(mask, half)[down, across].argmax(axis=1)]
    return xy, faces


def _cells(depth_map: DepthMap, inside: Mask) -> Pixels:
    """Places (k, 2) px of a chart, and textured places without a depth close to them."""
    spacing = depth_map.spacing
    known, textured = depth_map.patches.px, depth_map.textured
    cell, other = (np.rint(px / spacing).astype(np.int64) for px in (known, textured))
    taken = np.zeros(np.maximum(cell.max(axis=0), other.max(axis=0, initial=0)) + 1, bool)
    taken[tuple(cell.T)] = True
    beyond = textured[~taken[tuple(other.T)]]
    if not len(beyond):
        return known[inside]
    distance = cKDTree(known[inside]).query(beyond, distance_upper_bound=_RIM * spacing)[0]
    return np.concatenate([known[inside], beyond[np.isfinite(distance)]])


def _textured_pixels(grey: Image, usual: float, radius: int) -> tuple[Mask, Mask]:
    """Pixels of a textured surface, that is those of steep grey levels and the gaps between them, and pixels with
    texture close by, both as masks of the image's shape.

    usual : contrast of the surface, grey levels a px. radius : px, of the subsets.
    """
    along_x, along_y = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=0.125) for order in ((1, 0), (0, 1)))
    square = cv2.add(cv2.multiply(along_x, along_x), cv2.multiply(along_y, along_y))
    size = 2 * round(_GAP * radius) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    steep = (square > (_STRONG * usual) ** 2).astype(np.uint8)
    textured = np.asarray(cv2.morphologyEx(steep, cv2.MORPH_CLOSE, kernel)) > 0
    mean = np.asarray(cv2.blur(square, (size, size)))
    return textured, mean > (_LEAST_CONTRAST * usual) ** 2
