"""Figures that tell why a camera's reference image does not match that of its nearest partner.

Features are matched between the whole images with no use of the calibration, and compared with it: how far off the
epipolar lines they lie, at which depths, and how many of them inside the mask. How much more one of the two images is
blurred follows from their spectra.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Floats, Image, Mask, Pixels
from ringdic.charts.blur import SQUARE_PX, blur_change
from ringdic.charts.contrast import contrast
from ringdic.charts.depth_map import DepthImages, DepthMap, lattice_places
from ringdic.charts.exchanged import ConfusedImages, exchanged_or_mirrored
from ringdic.charts.patches import depths
from ringdic.charts.plane_sweep import DepthRange
from ringdic.correlation import prepare_reference
from ringdic.correlation.features import matched_features
from ringdic.geometry.camera import Camera
from ringdic.geometry.triangulation import triangulate

_LEAST_SHARE = 0.05  # of the textured places have a depth: with fewer, it is asked why
_FEWEST = 15  # matched features from which their epipolar offset and their depths are known
_WINDOW = 3.0  # px, of the epipolar offsets that agree with one another
_OVER_CHANCE = 3.0  # number of matches in it, in units of those in a window at random
_OFF_LINE = 1.0  # px of the reduced images, largest epipolar offset of a match that is used
_BLUR = 1.5  # px, that stands out
_FAINT = 0.35  # of the partner's contrast, or of that outside the mask
_STRONGEST = 75.0  # percentile of the contrast over an image, of the places at which patterns are compared
_SQUARES = 64  # of an image, whose spectra are taken


@dataclass(frozen=True)
class MatchEvidence:
    """Figures of a camera and its nearest partner; NaN where unknown.

    camera, partner : their ids. textured, depths : numbers of textured places, inside the mask, and of those with a
    depth. masked : whether there is a mask.
    contrast, partner_contrast : of the pattern, grey levels a px; mask_contrast : inside the mask. blur : px, standard
    deviation by which its image is more blurred than the partner's, negative where less. matches : number of features
    matched, of which in_mask lie inside the mask and in_range at a depth that is searched. offset : px, their median
    distance from the epipolar lines; limit : px, that is allowed. near, far : mm, 5th and 95th percentile of their
    depths; low, high : mm, range of depths searched. features : (2, n, 2) px, of the full images of both. confused :
    that an image is another camera's or mirrored, None where nothing shows it.
    """

    camera: str
    partner: str
    textured: int
    depths: int
    masked: bool
    contrast: float
    partner_contrast: float
    mask_contrast: float
    blur: float
    matches: int
    in_mask: int
    in_range: int
    offset: float
    limit: float
    near: float
    far: float
    low: float
    high: float
    features: Pixels = field(repr=False)
    confused: ConfusedImages | None = None

    @property
    def sentence(self) -> str:
        """What stands out, with its number, then the other figures."""
        partner = f"camera {self.partner}"
        inside = " inside its mask" if self.masked else ""
        figures = [f"{self.textured} textured places{inside}, {self.depths} with a depth"]
        figures.append(f"{self.matches} features matched in {partner}")
        if self.matches >= _FEWEST:
            figures.append(f"epipolar offset {abs(self.offset):.1f} px")
            figures.append(f"depths {self.near:.0f} to {self.far:.0f} mm")
        if np.isfinite(self.blur):
            figures.append(f"blur {self.blur:+.1f} px against it")
        return f"camera {self.camera} does not match: {self._verdict(partner)} ({', '.join(figures)})"

    def _verdict(self, partner: str) -> str:
        """The figure that stands against a match, and what to check."""
        known = self.matches >= _FEWEST
        if self.confused is not None:
            return self.confused.sentence
        if not self.masked and not self.textured:
            return f"the strongest contrast of its image is {self.contrast:.1f} grey levels a px; speckle the specimen"
        if self.masked and known and self.in_mask < 0.1 * self.matches:
            return f"its mask holds {self.in_mask} of the {self.matches} features; draw it on the specimen"
        if self.masked and self.mask_contrast < _FAINT * self.contrast:
            return (
                f"the contrast inside its mask is {self.mask_contrast:.1f} grey levels a px, elsewhere "
                f"{self.contrast:.1f}; draw the mask on the specimen"
            )
        if known and abs(self.offset) > self.limit:
            return (
                f"its matches lie {abs(self.offset):.1f} px off the epipolar lines, {self.limit:.0f} px are allowed; "
                "one of the two moved since the calibration: calibrate again"
            )
        if known and self.in_range < 0.5 * self.matches:
            return (
                f"its matches lie at depths of {self.near:.0f} to {self.far:.0f} mm, {self.low:.0f} to "
                f"{self.high:.0f} mm are searched; place the specimen where the cameras' axes meet"
            )
        if abs(self.blur) > _BLUR:
            which, than = ("its image", partner) if self.blur > 0 else (f"the image of {partner}", "its own")
            return f"{which} is blurred by {abs(self.blur):.1f} px against {than}; focus it"
        if self.contrast < _FAINT * self.partner_contrast:
            return (
                f"the contrast of its image is {self.contrast:.1f} grey levels a px, that of {partner} "
                f"{self.partner_contrast:.1f}; check where it looks, and the light"
            )
        return f"{self.matches} features of its image are found in that of {partner}; check where both look"


def match_evidence(
    images: DepthImages, depth_map: DepthMap, k: int, partner: int, space: DepthRange, mask: Mask | None
) -> MatchEvidence | None:
    """Find out why a camera's depth map is all but empty; None where it is not.

    Parameters
    ----------
    images : of all cameras.
    depth_map : of the camera.
    k, partner : indices of the camera and of its nearest partner.
    space : where the surface is searched.
    mask : (height, width) bool, of the full image, drawn for the camera; None without.
    """
    places, known = len(depth_map.textured), len(depth_map.patches.px)
    if known > max(_FEWEST, _LEAST_SHARE * places):
        return None
    cameras, factor = (images.cameras[k], images.cameras[partner]), images.factor
    pictures = (images.current(k).image, images.current(partner).image)
    height, width = pictures[0].shape
    within = np.ones((height, width), bool)
    if mask is not None:
        within = mask[factor // 2 :: factor, factor // 2 :: factor][:height, :width]
    patterns = [_Pattern.of(picture, images.settings.radius) for picture in pictures]
    first, second, offset = _agreeing_features(images, cameras, pictures)
    xyz = triangulate(list(cameras), np.stack([first, second])) if len(first) else np.zeros((0, 3))
    depth = depths(cameras[0], xyz)
    near, far = np.percentile(depth, [5.0, 95.0]) if len(depth) else (np.nan, np.nan)
    low, high = space.limits(cameras[0])
    column, row = np.rint(first).astype(int).T
    return MatchEvidence(
        cameras[0].id, cameras[1].id, places, known, mask is not None, patterns[0].contrast, patterns[1].contrast,
        patterns[0].contrast_inside(within), factor * patterns[0].blur_against(patterns[1]), len(first),
        int(within[row, column].sum()), int((space.holds(cameras[0], xyz) & space.holds(cameras[1], xyz)).sum()),
        factor * offset, factor * _OFF_LINE, float(near), float(far), low, high,
        (np.stack([first, second]) + 0.5) * factor - 0.5,
        exchanged_or_mirrored(images, k, partner, space, len(first) // 2),
    )  # fmt: skip


@dataclass(frozen=True)
class Unmatched:
    """Why a camera has hardly a depth.

    sentence : empty where it has enough. features : (2, n, 2) px, matched in it and its partner without use of the
    calibration. confused : that its image or its partner's is another camera's or mirrored, None where nothing shows
    it.
    """

    sentence: str = ""
    features: Pixels = field(default_factory=lambda: np.zeros((2, 0, 2)), repr=False)
    confused: ConfusedImages | None = None


def why_unmatched(
    images: DepthImages, depth_map: DepthMap, k: int, partner: int | None, space: DepthRange, mask: Mask | None
) -> Unmatched:
    """Find out why a camera has hardly a depth, if so.

    partner : index of its nearest partner, None without. mask : (height, width) bool, of the full image, or None.
    """
    evidence = None if partner is None else match_evidence(images, depth_map, k, partner, space, mask)
    if evidence is not None:
        return Unmatched(evidence.sentence, evidence.features, evidence.confused)
    if len(depth_map.patches.px):
        return Unmatched()
    return Unmatched(f"camera {images.cameras[k].id} does not match: no other camera's view is similar enough")


@dataclass(frozen=True)
class _Pattern:
    """The pattern in an image: contrast about n places of a lattice, and the image about the strongest of them.

    places : (n, 2) px. level : (n,) grey levels a px. squares : (k, 64, 64) grey levels.
    """

    places: Pixels
    level: Floats
    squares: NDArray[np.float32]

    @classmethod
    def of(cls, image: Image, radius: int) -> _Pattern:
        """The pattern of an image. radius : px, of the subsets."""
        places = lattice_places((image.shape[1], image.shape[0]), radius, radius + 2, None)
        level = contrast(image, places, radius)
        return cls(places, level, _squares(image, places[level >= np.percentile(level, _STRONGEST)]))

    @property
    def contrast(self) -> float:
        """Of the textured places: grey levels a px."""
        return float(np.percentile(self.level, 90.0))

    def contrast_inside(self, mask: Mask) -> float:
        """Median contrast of the places inside a mask (height, width), grey levels a px; 0 without any."""
        column, row = self.places.astype(int).T
        inside = self.level[mask[row, column]]
        return float(np.median(inside)) if len(inside) else 0.0

    def blur_against(self, other: _Pattern) -> float:
        """Standard deviation of the blur, px, that this pattern has more than another; negative where less.

        The more blurred of the two tells it: in the other, frequencies stand out that it has lost. NaN where noise
        leaves too few frequencies of either.
        """
        more = blur_change(other.squares, self.squares).mean
        less = -blur_change(self.squares, other.squares).mean
        return more if abs(more) > abs(less) or np.isnan(more) else less


def _squares(image: Image, px: Pixels) -> NDArray[np.float32]:
    """Squares (k, 64, 64) of an image about some of the places (n, 2) px, as far as they lie inside it."""
    half, (height, width) = SQUARE_PX // 2, image.shape
    px = px[((px >= half) & (px < (width - half, height - half))).all(axis=1)].astype(int)
    chosen = px[np.linspace(0, len(px) - 1, min(_SQUARES, len(px))).astype(int)]
    squares = [image[y - half : y + half, x - half : x + half] for x, y in chosen]
    return np.array(squares, np.float32).reshape(-1, SQUARE_PX, SQUARE_PX)


def _agreeing_features(
    images: DepthImages, cameras: tuple[Camera, Camera], pictures: tuple[Image, Image]
) -> tuple[Pixels, Pixels, float]:
    """Features (n, 2) px of both images that lie equally far from their epipolar lines, and this distance, px."""
    reference = prepare_reference(pictures[0], np.ones(pictures[0].shape, bool), images.settings)
    first, second = matched_features(reference, images.current(images.cameras.index(cameras[1])))
    nothing = np.zeros((0, 2)), np.zeros((0, 2)), np.nan
    if len(first) < _FEWEST:
        return nothing
    offset = _epipolar_offsets(cameras, first, second)
    ordered = np.sort(offset[np.isfinite(offset)])
    count = np.searchsorted(ordered, ordered + _WINDOW) - np.arange(len(ordered))
    by_chance = len(first) * _WINDOW / (0.5 * pictures[1].shape[0])
    if count.max(initial=0) < max(_FEWEST, _OVER_CHANCE * by_chance):
        return nothing
    start = int(np.argmax(count))
    middle = float(np.median(ordered[start : start + count[start]]))
    agree = np.abs(offset - middle) < _WINDOW / 2
    return first[agree], second[agree], middle


def _epipolar_offsets(cameras: tuple[Camera, Camera], first: Pixels, second: Pixels) -> Floats:
    """Distances (n,) px of pixels (n, 2) of the second camera from the epipolar lines of those of the first."""
    xyz = triangulate(list(cameras), np.stack([first, second]))
    rays = cameras[0].ray(first)
    along = np.sum((xyz - cameras[0].centre) * rays, axis=1, keepdims=True)
    at = cameras[1].project(cameras[0].centre + along * rays)
    direction = cameras[1].project(cameras[0].centre + 1.001 * along * rays) - at
    with np.errstate(invalid="ignore", divide="ignore"):
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    miss = second - at
    return np.asarray(direction[:, 0] * miss[:, 1] - direction[:, 1] * miss[:, 0])
