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
from ringdic.charts.patches import depths, focal_length
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
_HOLE_STEPS = 2  # places across, even, of the widest hole of a map with depths on both sides
_FINE = 10  # px, radius of subsets from twice of which on every second pixel tells where the pattern is
_OVERLAP = 1  # steps of the lattice by which a chart exceeds the part that its camera faces most squarely
_RIM = 3.0  # steps of the lattice by which matches may reach beyond the last place with a depth


@dataclass(frozen=True)
class ChartPlan:
    """What one camera measures: n places of its depth map, and the cameras in which the surface about each is matched.

    inside : (n,) bool, places of the chart. sees : by index of the camera, for each of the others, (n,) bool, whether
    it sees the place.
    """

    inside: Mask
    sees: dict[int, Mask]


def plan_chart(
    k: int, surfaces: Mapping[int, MappedSurface], incidence_deg: float, partners: Sequence[int], *, whole: bool = False
) -> ChartPlan:
    """Determine the part of the surface that a camera faces most squarely, with a margin round it.

    Parameters
    ----------
    k : index of the camera.
    surfaces : as the depth maps of the camera and of these others show it, by index.
    incidence_deg : degrees, largest angle of incidence of a view that is used.
    partners : indices of the cameras that it may be matched with.
    whole : whether the chart is all that the camera shares with a partner, instead of what it faces most squarely.
    """
    own = surfaces[k]
    limit = math.cos(math.radians(incidence_deg))
    squarest, seen = np.full(len(own.xyz), -1.0), np.zeros(len(own.xyz), bool)
    sees = {}
    for c in partners:
        camera = surfaces[c].camera
        cosine = camera.incidence_cosine(own.xyz, own.normals)
        same, hidden = surfaces[c].compare(own.xyz, own.step_mm)
        same &= ~(own.inner & surfaces[c].in_hole(own.xyz))
        squarest = np.maximum(squarest, np.where(same, cosine, -1.0))
        sees[c] = np.asarray((cosine > limit) & ~hidden & _inside(camera, own.xyz))
        seen |= sees[c]
    usable = (own.squareness > limit) & seen
    if whole:
        return ChartPlan(usable, sees)
    return ChartPlan(_dilated(own.map, usable & (own.squareness >= squarest)) & usable, sees)


def facing_pairs(
    cameras: Sequence[Camera], pairs: Sequence[tuple[str, str]], squarely: Floats
) -> tuple[tuple[tuple[str, str], ...], Indices]:
    """Pair of cameras that face each point most squarely.

    cameras : the C cameras. pairs : ids of neighbouring cameras. squarely : (C, n), no unit, cosine of the angle of
    incidence; -1 or less where a camera did not measure the point.
    Returns the pairs of camera ids, with pairs that are not among those given appended, and the index (n,) of each
    point's pair among them.
    """
    n = squarely.shape[1]
    others, best = squarely.copy(), squarely.argmax(axis=0)
    others[best, np.arange(n)] = -np.inf
    second = others.argmax(axis=0)
    number = np.minimum(best, second) * len(cameras) + np.maximum(best, second)
    listed = [(one, other) for one, other in pairs]
    index = {frozenset(pair): k for k, pair in enumerate(listed)}
    of_number = np.full(len(cameras) ** 2, -1)
    for each in np.flatnonzero(np.bincount(number)).tolist():
        a, b = divmod(each, len(cameras))
        pair = (cameras[a].id, cameras[b].id)
        if frozenset(pair) not in index:
            index[frozenset(pair)] = len(listed)
            listed.append(pair)
        of_number[each] = index[frozenset(pair)]
    return tuple(listed), of_number[number]


class MappedSurface:
    """The surface as a camera's depth map shows it, and a comparison of other points with it.

    Attributes
    ----------
    camera, map : the camera and its depth map.
    xyz, normals : (n, 3) mm and (n, 3), of the places of the map.
    squareness : (n,), cosine of the angle of incidence at which the camera sees them.
    inner : (n,) bool, places of the map whose four neighbours on the lattice are places too.
    """

    def __init__(self, camera: Camera, depth_map: DepthMap) -> None:
        self.camera, self.map = camera, depth_map
        patches = depth_map.patches
        self.xyz: Points = patches.points(camera, np.zeros((1, 2)))[:, 0]
        self.normals: Vectors = patches.normals(camera)
        self.squareness: Floats = camera.incidence_cosine(self.xyz, self.normals)
        self._tree = cKDTree(patches.px) if len(patches.px) else None
        cells = self._cells(patches.px)
        known = np.zeros(cells.max(axis=0, initial=0) + 2, np.uint8)
        known[tuple(cells.T)] = 1
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        self.inner: Mask = np.asarray(cv2.erode(known, cross)[tuple(cells.T)] > 0)
        lines = (np.ones(shape, np.uint8) for shape in ((_HOLE_STEPS + 1, 1), (1, _HOLE_STEPS + 1)))
        closed = np.maximum(*(cv2.morphologyEx(known, cv2.MORPH_CLOSE, line) for line in lines))
        self._holes: Mask = np.asarray(closed > known)

    def _cells(self, px: Pixels) -> Indices:
        """Cells (n, 2) of the lattice, with a margin before its first, in which pixels (n, 2) lie."""
        return np.rint(px / self.map.spacing).astype(np.int64) + 1

    @property
    def step_mm(self) -> float:
        """Spacing of the lattice on a surface that faces the camera, mm."""
        away = depths(self.camera, self.xyz)
        return self.map.spacing * float(np.median(away)) / focal_length(self.camera) if len(away) else 0.0

    def compare(self, xyz: Points, step_mm: float) -> tuple[Mask, Mask]:
        """Which points the map shows at the same depth, and before which it shows something nearer, (n,) each.

        xyz : (n, 3) mm. step_mm : mm, of the lattice on the surface.
        """
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
        slant = np.maximum(self.squareness[index], 0.2)
        tolerance = _SAME * step_mm / slant
        same[near] = np.abs(nearer) < tolerance
        hidden[near] = nearer > 3.0 * tolerance
        return same, hidden

    def in_hole(self, xyz: Points) -> Mask:
        """Which points lie in a narrow hole of the map, (n,) bool: there is no depth, but there is on both sides.

        xyz : (n, 3) mm.
        """
        cells = self._cells(self.camera.project(xyz))
        inside = np.all((cells >= 0) & (cells < self._holes.shape), axis=1)
        return inside & self._holes[tuple(np.where(inside[:, None], cells, 0).T)]


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
    region, of_points = np.zeros(grey.shape, bool), np.zeros(grey.shape, bool)
    if not inside.any():
        return region, of_points
    thin = max(1, radius // _FINE)
    cells, reach = _cells(depth_map, inside), depth_map.spacing
    beyond = reach + reach // 2 + 1
    left, top = np.maximum(np.floor(cells.min(axis=0)).astype(int) - beyond, 0) // thin * thin
    right, bottom = np.ceil(cells.max(axis=0)).astype(int) + beyond
    part = _thinned(grey[top:bottom, left:right], thin)

    def place(px: Pixels) -> tuple[Indices, Indices]:
        """Row and column of pixels of the image in its part."""
        column, row = np.floor((np.rint(px) - (left, top)) / thin).astype(np.int64).T
        return np.minimum(row, part.shape[0] - 1), np.minimum(column, part.shape[1] - 1)

    known = np.stack(place(depth_map.patches.px[inside])[::-1], axis=1)
    pattern, close = _pattern_and_texture(part, place(cells), known, reach // thin, round(radius / thin))
    whole = [np.repeat(np.repeat(each, thin, axis=0), thin, axis=1) for each in (pattern, close)]
    margin = round(_EDGE * radius)
    inner = cv2.erode(whole[0].view(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8)) > 0
    there = np.s_[top : top + inner.shape[0], left : left + inner.shape[1]]
    region[there], of_points[there] = inner, inner & whole[1]
    return region, of_points


def _thinned(grey: Image, thin: int) -> Image:
    """Reduce an image by averaging squares of ``thin`` pixels a side; what lies beyond whole squares is cut."""
    if thin == 1:
        return grey
    height, width = (side // thin for side in grey.shape)
    means = np.empty_like(grey, shape=(height, width))
    cv2.resize(grey[: height * thin, : width * thin], (width, height), dst=means, interpolation=cv2.INTER_AREA)
    return means


def _pattern_and_texture(
    grey: Image, cells: tuple[Indices, Indices], known: Indices, spacing: int, radius: int
) -> tuple[Mask, Mask]:
    """Pixels of the pattern about cells of a chart, and those with texture close by, two masks of an image's shape.

    grey : (height, width) grey levels. cells : rows and columns of the cells. known : (n, 2) px, whole, places with a
    depth. spacing : px, of the cells. radius : px, of the subsets.
    """
    mask = np.zeros(grey.shape, np.uint8)
    mask[cells] = 1
    side = 2 * spacing + 1
    grown = cv2.dilate(mask, np.ones((side + 2 * (spacing // 2 + 1),) * 2, np.uint8))  # of squares about the cells
    closed = np.asarray(cv2.erode(grown, np.ones((side, side), np.uint8))) > 0
    textured, close = _textured_pixels(grey, float(np.median(contrast(grey, known.astype(float), radius))), radius)
    lamps = _lamps(grey, grey[known[:, 1], known[:, 0]], radius)
    return _without_gaps(closed & textured, radius) & ~lamps, _without_gaps(close, radius)


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
    return np.asarray(mask | gap.take(label, mode="clip"))


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
