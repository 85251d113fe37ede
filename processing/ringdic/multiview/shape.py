"""Measurement of the reference shape, one set of points and triangles, from the reference images of all cameras.

Sweeps of the camera pairs give a first rough surface and a lattice over it. The nodes of the lattice (of a dense one,
every second in either direction) are matched from the camera that faces them to two others, with second-order subsets.
Smooth pieces fitted to the radius measured so give every subset its start value and the curvature of its warp, and
reach a little beyond the rim. With that curvature held fixed, all cameras that see a node are matched to first order,
which is free of the bias of flat subsets and of the noise of curved ones.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Indices, Mask, Pixels, Points
from ringdic.charts.agreement import triangulate_agreeing
from ringdic.charts.weights import CELL_STEPS, smooth_sigma
from ringdic.correlation import CorrelationSettings, Status
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint
from ringdic.multiview.depth import lay_lattice, px_per_mm, rough_surface
from ringdic.multiview.lattice import Pieces, SurfaceLattice, evaluate, robust_pieces
from ringdic.multiview.matching import NodeMatches, ReferenceImages, match_nodes
from ringdic.multiview.tube import lattice_faces
from ringdic.multiview.views import visibility
from ringdic.sweep.sweep import DepthSearch, search_radii, sweep_depths
from ringdic.uncertainty.texture import Texture, TextureMap

log = logging.getLogger(__name__)

_RETRIES = 3
_EVERY = 2  # columns, and rows, from one node of the first pass to the next on a dense lattice
_IN_PIECE = 20  # fewest nodes within reach of a piece
_PIECE = 6  # fewest connected positions of a sweep that are accepted: an obstacle may divide the surface
_FEW = 1e-3  # share of the nodes that another retry must gain
_REFERENCES = 3  # cameras that a node is matched from, one after the other, before it is given up

_UNKNOWN_TEXTURE = TextureMap(np.full((1, 1, 5), np.nan, np.float32), 1, (1, 1))  # of a camera without an image


@dataclass(frozen=True)
class ShapeSettings:
    """Settings of the reference shape's measurement. Lengths mm, angles degrees.

    incidence : steepest angle of a view that is used. spacing : of the lattice, 0 for the correlation's step as the
    cameras see it. curvature : "geometry" to hold the second derivatives that the measured shape gives each warp,
    "none" for flat subsets. piece : reach of the smooth pieces. sigma_max : px, greatest standard deviation of an
    accepted match. floor : px, standard deviation of a pixel due to causes other than noise and the difference of the
    images: errors of the cameras, and curvature that the fitted pieces do not represent.
    """

    incidence: float = 65.0
    spacing: float = 0.0
    curvature: str = "geometry"
    piece: float = 6.0
    sigma_max: float = 0.05
    floor: float = 0.005


@dataclass(frozen=True)
class ReferenceShape:
    """Measured points of a surface at the reference and the triangles between them: n points, C cameras, M triangles.

    xyz : (n, 3) mm, world frame. node : (n, 2) int, column and row on the lattice. reference : (n,) int, index of the
    camera that each point was matched from and in which it lies on a whole pixel. px : (C, n, 2) px, NaN for a camera
    that was not used. sigma : (C, n, 2) px, standard deviation due to all causes, smoothed over the image. noise : (C,
    n, 2) px, due to the noise of each image alone. textures : of each camera's image at px. grey_noise : (C,), variance
    of each camera's noise, grey levels², NaN where it has no image. covariance : (n, 3, 3) mm². chi2, degrees : (n,),
    of the triangulation. c_ls : (n,), the largest over the cameras. faces : (M, 3) int, normals outwards. pieces : the
    fitted surface. status : (columns, rows) of all nodes, 0 where measured, NOT_REACHED also where there is no surface.
    match_count : number of matches that were computed.
    """

    xyz: Points
    node: Indices
    reference: Indices
    px: Pixels
    sigma: Pixels
    noise: Pixels
    textures: tuple[Texture, ...]
    grey_noise: Floats
    covariance: Floats
    chi2: Floats
    degrees: Indices
    c_ls: Floats
    faces: Indices
    pieces: Pieces
    status: NDArray[np.int8]
    match_count: int

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of the shape by name, as stored in a task's output.

        Shapes and units are those of the class: (n, ...) mm or px for the points, (M, 3) indices for the faces.
        """
        lattice = self.pieces.lattice
        parts = {
            "lattice": np.array([lattice.radius, lattice.columns, *lattice.z]),
            "coefficients": self.pieces.coefficients,
            "support": self.pieces.support,
        }
        for k, texture in enumerate(self.textures):
            parts |= {f"texture_{k}_{each.name}": getattr(texture, each.name) for each in fields(texture)}
        plain = {each.name for each in fields(self)} - {"pieces", "textures"}
        return {**parts, **{name: np.asarray(getattr(self, name)) for name in plain}}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> ReferenceShape:
        """The shape from its arrays by name, as read from a task's output.

        arrays : as from :meth:`arrays`, (n, ...) mm or px for the points, (M, 3) indices for the faces.
        """
        radius, columns, *z = arrays["lattice"].tolist()
        lattice = SurfaceLattice(radius, int(columns), np.array(z))
        textures = tuple(
            Texture(**{each.name: arrays[f"texture_{k}_{each.name}"] for each in fields(Texture)})
            for k in range(len(arrays["px"]))
        )
        plain: dict[str, Any] = {each.name: arrays[each.name] for each in fields(cls) if each.name in arrays}
        pieces = Pieces(lattice, arrays["coefficients"], arrays["support"])
        plain["match_count"] = int(arrays["match_count"])
        return cls(**plain, pieces=pieces, textures=textures)


def reference_shape(
    cameras: Sequence[Camera],
    image: Callable[[str], Image | None],
    masks: Mapping[str, Mask],
    pairs: Sequence[tuple[int, int]],
    search: DepthSearch,
    correlation: CorrelationSettings,
    settings: ShapeSettings | None = None,
) -> ReferenceShape:
    """Measure the surface in the reference images of all cameras.

    Parameters
    ----------
    cameras : the C calibrated cameras.
    image : function that returns the reference image of a camera id, (height, width) grey levels, or None; a camera
        without one is not used.
    masks : (height, width) bool, regions drawn by the user, by camera id.
    pairs : indices of neighbouring cameras, for the sweeps.
    search : where the surface may lie, mm.
    correlation : of the subsets.
    settings : of the shape; None for the defaults.

    Raises ComputationError where no two cameras share a textured surface.
    """
    settings = settings or ShapeSettings()
    images = ReferenceImages(cameras, image, masks, correlation)
    samples = _samples(images, pairs, search)
    lattice = lay_lattice(samples, settings.spacing or _spacing(cameras, samples, correlation))
    surface = _Surface(images, settings, rough_surface(lattice, samples))
    surface.thin = math.pi * settings.piece**2 >= _IN_PIECE * _EVERY**2 * math.prod(lattice.spacing)
    surface.measure(2, 2)
    surface.fit()
    surface.retry(2, 2)
    surface.thin = False
    surface.measure(correlation.order, len(cameras))
    surface.fit()
    surface.retry(correlation.order, len(cameras))
    return surface.result()


def _spacing(cameras: Sequence[Camera], samples: Points, correlation: CorrelationSettings) -> float:
    """Spacing of the lattice, mm, at which its nodes lie one step of the correlation apart in the images."""
    radius = float(np.median(np.hypot(samples[:, 0], samples[:, 1])))
    return correlation.step / px_per_mm(cameras, radius)


def _samples(images: ReferenceImages, pairs: Sequence[tuple[int, int]], search: DepthSearch) -> Points:
    """Positions (n, 3) mm of the surface from depth sweeps of the camera pairs."""
    samples = []
    for a, b in pairs:
        cameras = (images.cameras[a], images.cameras[b])
        mask = images.masks.get(cameras[0].id)
        radii = search_radii(cameras, search)
        depths = sweep_depths(cameras, images.grey(a), images.current(b), mask, radii, search, images.settings, _PIECE)
        samples.append(depths.xyz[depths.good])
        log.debug("cameras %s, %s: %d positions on the surface", cameras[0].id, cameras[1].id, len(samples[-1]))
    samples_of_all = np.concatenate(samples)
    if len(samples_of_all) < 12:
        raise ComputationError(
            "no textured surface that two neighbouring cameras both see was found; check that the specimen is speckled "
            "and stands where the target stood, that masks cover it, and that the images are in focus"
        )
    return samples_of_all


class _Surface:
    """State of the measurement of the surface: positions, pixels and uncertainty at each node of the lattice so far."""

    def __init__(self, images: ReferenceImages, settings: ShapeSettings, pieces: Pieces) -> None:
        count, (columns, rows) = len(images.cameras), pieces.lattice.shape
        self.images, self.settings, self.pieces = images, settings, pieces
        self.xyz = np.full((columns, rows, 3), np.nan)
        self.px = np.full((count, columns, rows, 2), np.nan)
        self.sigma = np.full((count, columns, rows, 2), np.nan)
        self.noise = np.full((count, columns, rows, 2), np.nan)
        self.covariance = np.full((columns, rows, 3, 3), np.nan)
        self.chi2 = np.full((columns, rows), np.nan)
        self.degrees = np.zeros((columns, rows), np.int64)
        self.c_ls = np.full((columns, rows), np.nan)
        self.reference = np.full((columns, rows), -1, np.int64)
        self.status = np.full((columns, rows), Status.NOT_REACHED, np.int8)
        self.failures, self.attempted = np.zeros((columns, rows), np.int64), np.zeros((columns, rows), bool)
        self.match_count = 0
        self.thin = False  # measure only every _EVERYth node either way

    @property
    def known(self) -> Mask:
        """Measured nodes, (columns, rows)."""
        return self.status == Status.GOOD

    def measure(self, order: int, views: int, only_lost: bool = False) -> int:
        """Match the nodes that have a smooth piece and triangulate them; the number of nodes that were gained.

        A node is matched from the camera that faces it, or, where that failed, from the next: what hides it or
        glares in one camera spares the others. order : of the subsets. views : most cameras besides the reference
        camera that a node is matched to.
        """
        images, settings = self.images, self.settings
        visible, cosine = visibility(self.pieces, images.cameras, images.masks, settings.incidence, 2.0)
        for k, camera in enumerate(images.cameras):
            if images.image(camera.id) is None:
                visible[k] = False
            elif visible[k].any():
                images.look_at(k, camera.project(self.pieces.xyz[visible[k]]))
        chosen = (visible.sum(axis=0) >= 2) & np.isfinite(self.pieces.radius)
        if self.thin:
            chosen &= _some(self.pieces.lattice.shape)
        if only_lost:
            chosen &= ~self.known
            self.failures[chosen & self.attempted] += 1
            chosen &= self.failures < _REFERENCES
        self.attempted |= chosen
        nodes = _indices(chosen)
        if not len(nodes[0]):
            return 0
        rank = np.where(visible, cosine, -1.0)[:, chosen]
        best_first = np.argsort(-rank, axis=0)
        choice = self.failures[chosen] % np.minimum((rank > 0).sum(axis=0), _REFERENCES)
        reference = best_first[choice, np.arange(len(choice))]
        rank_of = np.argsort(best_first, axis=0)
        partners = (rank > 0) & (rank_of <= views) & (np.arange(len(rank))[:, None] != reference)
        curved = settings.curvature == "geometry" or order == 2
        matches = match_nodes(images, self.pieces, nodes, reference, partners, order=order, curved=curved)
        before = int(self.known.sum())
        self._store(nodes, reference, matches)
        self.match_count += matches.count
        log.debug("order %d: %d of %d nodes measured", order, int(self.known[nodes].sum()), len(nodes[0]))
        return int(self.known.sum()) - before

    def retry(self, order: int, views: int) -> None:
        """Match the lost nodes, and those a little beyond the rim, again until few are gained."""
        for _ in range(_RETRIES):
            gained = self.measure(order, views, only_lost=True)
            if self.fit() == 0 and gained < _FEW * self.known.sum():
                return

    def fit(self) -> int:
        """Fit smooth pieces to the measured nodes and mark nodes off them as lost; the number of these."""
        lattice = self.pieces.lattice
        radius = self._node_radius()
        density = 1.0 / _EVERY**2 if self.thin else 1.0
        self.pieces, agreeing = robust_pieces(lattice, radius, self.settings.piece, density=density)
        off = self.known & ~agreeing
        self.status[off] = LostPoint.SURFACE
        self.xyz[off] = np.nan
        return int(off.sum())

    def _node_radius(self) -> Floats:
        """Radius at the nodes, (columns, rows) mm, from points measured near them.

        A point is less than a pixel away from its node; the radius changes between the two as the smooth piece does.
        """
        lattice, coefficients = self.pieces.lattice, self.pieces.coefficients
        theta, z = lattice.coordinates
        x, y, height = np.moveaxis(self.xyz, -1, 0)
        predicted, _, _ = evaluate(coefficients, lattice.arc(np.arctan2(y, x), theta), height - z)
        return np.hypot(x, y) - predicted + coefficients[..., 0]

    def _store(self, nodes: tuple[Indices, Indices], reference: Indices, matches: NodeMatches) -> None:
        """Triangulate the matches of some nodes and store the result."""
        settings, cameras = self.settings, self.images.cameras
        sigma = np.sqrt(matches.noise**2 + matches.systematic**2 + settings.floor**2)
        with np.errstate(invalid="ignore"):
            uncertain: Mask = np.asarray((sigma > settings.sigma_max).any(axis=2))
        uncertain[reference, np.arange(len(reference))] = False  # its pixel defines the point
        px = np.where(uncertain[..., None], np.nan, matches.px)
        cell = CELL_STEPS * self.images.settings.step
        sigma = np.stack([smooth_sigma(at, own, cell) for at, own in zip(px, sigma, strict=True)])
        points, used = triangulate_agreeing(cameras, px, sigma, reference)
        status = np.where(matches.status != 0, matches.status, 0)
        status = np.where((status == 0) & ~np.isfinite(points.xyz).all(axis=1), LostPoint.RESIDUAL, status)
        few = (np.isfinite(matches.px[..., 0]) & ~uncertain).sum(axis=0) < 2
        status = np.where((status == LostPoint.RESIDUAL) & few & uncertain.any(axis=0), LostPoint.UNCERTAIN, status)
        good = status == 0
        used &= good
        self.status[nodes] = status
        self.reference[nodes] = reference
        self.xyz[nodes] = np.where(good[:, None], points.xyz, np.nan)
        self.px[:, nodes[0], nodes[1]] = np.where(used[..., None], px, np.nan)
        self.sigma[:, nodes[0], nodes[1]] = np.where(used[..., None], sigma, np.nan)
        self.noise[:, nodes[0], nodes[1]] = np.where(used[..., None], matches.noise, np.nan)
        self.covariance[nodes] = points.covariance
        self.chi2[nodes], self.degrees[nodes] = points.chi2, points.degrees
        self.c_ls[nodes] = np.nanmax(np.where(used, matches.c_ls, -np.inf), axis=0)

    def result(self) -> ReferenceShape:
        """The measured shape, without points off the surface and without points in no triangle."""
        if not self.known.any():
            raise ComputationError("no point of the surface could be measured in two cameras; check focus and speckle")
        faces, used = lattice_faces(self.xyz)
        node = np.stack(used, axis=1)
        px, images = self.px[:, used[0], used[1]], self.images
        sees = np.isfinite(px).any(axis=(1, 2))
        return ReferenceShape(
            xyz=self.xyz[used],
            node=node,
            reference=self.reference[used],
            px=px,
            sigma=self.sigma[:, used[0], used[1]],
            noise=self.noise[:, used[0], used[1]],
            textures=tuple(images.texture(k, one) if sees[k] else _UNKNOWN_TEXTURE.at(one) for k, one in enumerate(px)),
            grey_noise=np.array([images.noise(k) if sees[k] else np.nan for k in range(len(px))]),
            covariance=self.covariance[used],
            chi2=self.chi2[used],
            degrees=self.degrees[used],
            c_ls=self.c_ls[used],
            faces=faces,
            pieces=self.pieces,
            status=self.status,
            match_count=self.match_count,
        )


def _some(shape: tuple[int, int]) -> Mask:
    """Nodes (columns, rows) of a dense lattice that are measured first."""
    out = np.zeros(shape, bool)
    out[::_EVERY, ::_EVERY] = True
    return out


def _indices(which: Mask) -> tuple[Indices, Indices]:
    """Columns and rows of the nodes in a mask (columns, rows)."""
    columns, rows = np.nonzero(which)
    return columns, rows
