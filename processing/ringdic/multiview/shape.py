"""The reference shape: all cameras' reference images to one set of points and the triangles between them.

Sweeps of the camera pairs find the surface roughly. Then the nodes of a lattice over it, or where it is close every
second either way, are matched from the camera that faces them to two others, with second-order subsets; the radius so
measured is fitted with smooth pieces, which give every subset its start value and the curvature of its warp and reach a
little beyond the rim. With that curvature held, all cameras that see a node are matched to first order, which is free
of the bias of flat subsets and of the noise of curved ones.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Indices, Mask
from ringdic.correlation import CorrelationSettings, Status
from ringdic.errors import ComputationError
from ringdic.geometry.camera import Camera
from ringdic.geometry.outliers import LostPoint
from ringdic.multiview.agreement import triangulate_agreeing
from ringdic.multiview.depth import lay_lattice, px_per_mm, rough_surface
from ringdic.multiview.lattice import Pieces, SurfaceLattice, evaluate, robust_pieces
from ringdic.multiview.matching import Image, NodeMatches, ReferenceImages, match_nodes
from ringdic.multiview.tube import lattice_faces
from ringdic.multiview.views import seen
from ringdic.multiview.weights import smooth_sigma
from ringdic.sweep.sweep import DepthSearch, search_radii, sweep_depths
from ringdic.uncertainty.texture import Texture, TextureMap

log = logging.getLogger(__name__)

_RETRIES = 3
_EVERY = 2  # of this many columns, and rows, one has the nodes that the pieces are first fitted to
_IN_PIECE = 20  # nodes that a piece is fitted to at the least
_PIECE = 6  # places of a sweep that hang together: an obstacle may part the surface in several
_FEW = 1e-3  # share of the points below which another retry is not worth it
_REFERENCES = 3  # cameras a node is matched from, one after the other, before it is lost

_CELL = 8  # steps of the correlation, side of the squares over which weights are levelled
_NOTHING = TextureMap(np.full((1, 1, 5), np.nan, np.float32), 1, (1, 1))  # of a camera without an image


@dataclass(frozen=True)
class ShapeSettings:
    """How the reference shape is measured. Lengths mm, angles degrees.

    incidence : the steepest view that is used. spacing : of the lattice, 0 for the correlation's step as the cameras
    see it. curvature : "geometry" holds the second derivatives that the measured shape gives each warp; "none" leaves
    flat subsets flat. piece : reach of the smooth pieces. sigma_max : px, the least certain match that is believed.
    floor : px, what a pixel is uncertain by beside noise and what the images' difference shows: the cameras, and a
    shape that bends otherwise than its pieces do.
    """

    incidence: float = 65.0
    spacing: float = 0.0
    curvature: str = "geometry"
    piece: float = 6.0
    sigma_max: float = 0.05
    floor: float = 0.005


@dataclass(frozen=True)
class ReferenceShape:
    """The measured nodes of the surface and the triangles between them. n points, C cameras, M triangles.

    xyz : (n, 3) mm. node : (n, 2) column and row on the lattice. reference : (n,) index of the camera that the point
    was matched from, where it lies on a whole pixel. px, sigma : (C, n, 2), NaN for a camera that was not used; sigma
    with all that is uncertain in it and level over the image, noise : (C, n, 2) px, of each image's noise alone.
    textures, grey_noise : of each camera's image at px, and its variance, NaN where it has none. covariance :
    (n, 3, 3) mm². chi2, degrees : (n,). c_ls : (n,), the largest over the cameras.
    faces : (M, 3), outwards. pieces : the surface as fitted. status : (columns, rows) of all nodes, 0 where measured;
    NOT_REACHED also where there is no surface. made, seconds : matches and the time they took.
    """

    xyz: Floats
    node: Indices
    reference: Indices
    px: Floats
    sigma: Floats
    noise: Floats
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
        """All of it by name."""
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
        """From what ``arrays`` gave."""
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

    image : gives a camera id's grey reference image, None where there is none: that camera takes no part. masks :
    regions drawn by the user, by camera id. pairs : indices of neighbouring cameras, for the sweeps.
    Raises ComputationError where no two cameras share a textured surface.
    """
    settings = settings or ShapeSettings()
    ring = ReferenceImages(cameras, image, masks, correlation)
    samples = _samples(ring, pairs, search)
    lattice = lay_lattice(samples, settings.spacing or _spacing(cameras, samples, correlation))
    surface = _Surface(ring, settings, rough_surface(lattice, samples))
    surface.thin = math.pi * settings.piece**2 >= _IN_PIECE * _EVERY**2 * math.prod(lattice.spacing)
    surface.measure(2, 2)
    surface.fit()
    surface.retry(2, 2)
    surface.thin = False
    surface.measure(correlation.order, len(cameras))
    surface.fit()
    surface.retry(correlation.order, len(cameras))
    return surface.result()


def _spacing(cameras: Sequence[Camera], samples: Floats, correlation: CorrelationSettings) -> float:
    radius = float(np.median(np.hypot(samples[:, 0], samples[:, 1])))
    return correlation.step / px_per_mm(cameras, radius)


def _samples(ring: ReferenceImages, pairs: Sequence[tuple[int, int]], search: DepthSearch) -> Floats:
    """Places (n, 3) mm where the sweeps of the pairs found the surface."""
    found = []
    for a, b in pairs:
        cameras = (ring.cameras[a], ring.cameras[b])
        mask = ring.masks.get(cameras[0].id)
        radii = search_radii(cameras, search)
        seen_at = sweep_depths(cameras, ring.grey(a), ring.current(b), mask, radii, search, ring.settings, _PIECE)
        found.append(seen_at.xyz[seen_at.good])
        log.debug("cameras %s, %s: %d places of the surface", cameras[0].id, cameras[1].id, len(found[-1]))
    samples = np.concatenate(found)
    if len(samples) < 12:
        raise ComputationError(
            "no textured surface that two neighbouring cameras both see was found; check that the specimen is speckled "
            "and stands where the target stood, that masks cover it, and that the images are in focus"
        )
    return samples


class _Surface:
    """The surface while it is being measured: what is known of each node."""

    def __init__(self, ring: ReferenceImages, settings: ShapeSettings, pieces: Pieces) -> None:
        count, (columns, rows) = len(ring.cameras), pieces.lattice.shape
        self.ring, self.settings, self.pieces = ring, settings, pieces
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
        self.tries, self.tried = np.zeros((columns, rows), np.int64), np.zeros((columns, rows), bool)
        self.match_count = 0
        self.thin = False  # some of the nodes alone

    @property
    def known(self) -> Mask:
        """Measured nodes. (columns, rows)."""
        return self.status == Status.GOOD

    def measure(self, order: int, views: int, only_lost: bool = False) -> int:
        """Match the nodes that have a piece in up to so many cameras beside the reference; how many are new.

        A node is matched from the camera that faces it, or, where that failed, from the next: an obstacle or a
        reflection in one camera leaves the others.
        """
        ring, settings = self.ring, self.settings
        sight, cosine = seen(self.pieces, ring.cameras, ring.masks, settings.incidence, 2.0)
        for k, camera in enumerate(ring.cameras):
            if ring.image(camera.id) is None:
                sight[k] = False
            elif sight[k].any():
                ring.look_at(k, camera.project(self.pieces.xyz[sight[k]]))
        wanted = (sight.sum(axis=0) >= 2) & np.isfinite(self.pieces.radius)
        if self.thin:
            wanted &= _some(self.pieces.lattice.shape)
        if only_lost:
            wanted &= ~self.known
            self.tries[wanted & self.tried] += 1
            wanted &= self.tries < _REFERENCES
        self.tried |= wanted
        nodes = _indices(wanted)
        if not len(nodes[0]):
            return 0
        rank = np.where(sight, cosine, -1.0)[:, wanted]
        best_first = np.argsort(-rank, axis=0)
        turn = self.tries[wanted] % np.minimum((rank > 0).sum(axis=0), _REFERENCES)
        reference = best_first[turn, np.arange(len(turn))]
        order_of = np.argsort(best_first, axis=0)
        partners = (rank > 0) & (order_of <= views) & (np.arange(len(rank))[:, None] != reference)
        curved = settings.curvature == "geometry" or order == 2
        found = match_nodes(ring, self.pieces, nodes, reference, partners, order=order, curved=curved)
        before = int(self.known.sum())
        self._keep(nodes, reference, found)
        self.match_count += found.count
        log.debug("order %d: %d of %d nodes measured", order, int(self.known[nodes].sum()), len(nodes[0]))
        return int(self.known.sum()) - before

    def retry(self, order: int, views: int) -> None:
        """Match the lost nodes again, and those a little beyond the rim, until few are gained."""
        for _ in range(_RETRIES):
            gained = self.measure(order, views, only_lost=True)
            if self.fit() == 0 and gained < _FEW * self.known.sum():
                return

    def fit(self) -> int:
        """Smooth pieces through the measured nodes; a node off its piece is lost. How many were."""
        lattice = self.pieces.lattice
        radius = self._node_radius()
        density = 1.0 / _EVERY**2 if self.thin else 1.0
        self.pieces, kept = robust_pieces(lattice, radius, self.settings.piece, density=density)
        off = self.known & ~kept
        self.status[off] = LostPoint.SURFACE
        self.xyz[off] = np.nan
        return int(off.sum())

    def _node_radius(self) -> Floats:
        """Radius at the nodes from points measured near them: what is left to the piece is the same at both."""
        lattice, coefficients = self.pieces.lattice, self.pieces.coefficients
        theta, z = lattice.places
        x, y, height = np.moveaxis(self.xyz, -1, 0)
        there, _, _ = evaluate(coefficients, lattice.arc(np.arctan2(y, x), theta), height - z)
        return np.hypot(x, y) - there + coefficients[..., 0]

    def _keep(self, nodes: tuple[Indices, Indices], reference: Indices, found: NodeMatches) -> None:
        settings, cameras = self.settings, self.ring.cameras
        sigma = np.sqrt(found.noise**2 + found.systematic**2 + settings.floor**2)
        with np.errstate(invalid="ignore"):
            uncertain: Mask = np.asarray((sigma > settings.sigma_max).any(axis=2))
        uncertain[reference, np.arange(len(reference))] = False  # its pixel names the point
        px = np.where(uncertain[..., None], np.nan, found.px)
        cell = _CELL * self.ring.settings.step
        sigma = np.stack([smooth_sigma(at, own, cell) for at, own in zip(px, sigma, strict=True)])
        points, used = triangulate_agreeing(cameras, px, sigma, reference)
        status = np.where(found.status != 0, found.status, 0)
        status = np.where((status == 0) & ~np.isfinite(points.xyz).all(axis=1), LostPoint.RESIDUAL, status)
        few = (np.isfinite(found.px[..., 0]) & ~uncertain).sum(axis=0) < 2
        status = np.where((status == LostPoint.RESIDUAL) & few & uncertain.any(axis=0), LostPoint.UNCERTAIN, status)
        good = status == 0
        used &= good
        self.status[nodes] = status
        self.reference[nodes] = reference
        self.xyz[nodes] = np.where(good[:, None], points.xyz, np.nan)
        self.px[:, nodes[0], nodes[1]] = np.where(used[..., None], px, np.nan)
        self.sigma[:, nodes[0], nodes[1]] = np.where(used[..., None], sigma, np.nan)
        self.noise[:, nodes[0], nodes[1]] = np.where(used[..., None], found.noise, np.nan)
        self.covariance[nodes] = points.covariance
        self.chi2[nodes], self.degrees[nodes] = points.chi2, points.degrees
        self.c_ls[nodes] = np.nanmax(np.where(used, found.c_ls, -np.inf), axis=0)

    def result(self) -> ReferenceShape:
        """What was measured, without points off the surface and without points in no triangle."""
        if not self.known.any():
            raise ComputationError("no point of the surface could be measured in two cameras; check focus and speckle")
        faces, used = lattice_faces(self.xyz)
        node = np.stack(used, axis=1)
        px, ring = self.px[:, used[0], used[1]], self.ring
        sees = np.isfinite(px).any(axis=(1, 2))
        return ReferenceShape(
            xyz=self.xyz[used],
            node=node,
            reference=self.reference[used],
            px=px,
            sigma=self.sigma[:, used[0], used[1]],
            noise=self.noise[:, used[0], used[1]],
            textures=tuple(ring.texture(k, one) if sees[k] else _NOTHING.at(one) for k, one in enumerate(px)),
            grey_noise=np.array([ring.noise(k) if sees[k] else np.nan for k in range(len(px))]),
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
    """The nodes (columns, rows) that are measured first where the lattice is close."""
    out = np.zeros(shape, bool)
    out[::_EVERY, ::_EVERY] = True
    return out


def _indices(which: Mask) -> tuple[Indices, Indices]:
    columns, rows = np.nonzero(which)
    return columns, rows
