"""Whether an image that does not match its partner's is another camera's, or turned over: features tell, and findings.

By the calibration, lines of sight through features of two images meet, where the surface may be, for the cameras that
took the images and for hardly any others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ringdic.arrays import Image, Pixels
from ringdic.charts.depth_map import DepthImages
from ringdic.charts.plane_sweep import DepthRange
from ringdic.correlation import prepare_current, prepare_reference
from ringdic.correlation.features import matched_features
from ringdic.findings import Finding
from ringdic.geometry.triangulation import reprojection_residuals, triangulate

_MISS = 1.5  # px of the reduced images, by which lines of sight that meet pass a feature
_FEWEST = 20  # features whose lines of sight meet
_TIMES = 3.0  # times as many as with the cameras as they are

#: How an image may be turned over, and the axes along which it is flipped then: 0 from top to bottom, 1 left to right.
_TURNS = {"mirrored": (1,), "upside down": (0, 1)}
_MOTIONS = ("camera-moved", "lens-refocused", "camera-moved-unknown", "camera-contradicts")


@dataclass(frozen=True)
class ConfusedImages:
    """What features show to be wrong with the reference images of two cameras.

    kind : "exchanged", where the image of the first camera shows what the second would, "mirrored" or "upside down".
    cameras : ids.
    """

    kind: str
    cameras: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """What is wrong, and what to do."""
        first, *others = self.cameras
        if self.kind == "exchanged":
            return (
                f"the image of camera {first} shows what camera {others[0]} would; the two may be exchanged: put each "
                "image where it belongs"
            )
        like = f", like that of camera {' and '.join(others)}," if others else ""
        return f"the image of camera {first}{like} is {self.kind}; turn it back"


def confusion_findings(confused: Sequence[ConfusedImages], reference: str) -> list[Finding]:
    """Findings on images that are exchanged, mirrored or upside down.

    confused : what was found with each camera that does not match, of which the most frequent counts where they
    contradict one another. reference : name of the capture.
    """
    findings, told = [], set[str]()
    pairs = Counter(frozenset(each.cameras) for each in confused if each.kind == "exchanged")
    for pair, _ in pairs.most_common():
        if not told & pair:
            told |= pair
            first, second = sorted(pair)
            sentence = (
                f"{reference}: the images of camera {first} and {second} are exchanged, as their features show: each "
                "is what the other camera would see. Put each image where it belongs, and process again"
            )
            findings.append(Finding("images-exchanged", sentence, (first, second), reference))
    for kind in _TURNS:
        turned = sorted({id_ for each in confused if each.kind == kind for id_ in each.cameras} - told)
        if turned:
            told |= {*turned}
            sentence = (
                f"{reference}: the image of camera {', '.join(turned)} is {kind}, as its features show. Turn it "
                "back, and process again"
            )
            findings.append(Finding("image-turned", sentence, tuple(turned), reference))
    return findings


def without_consequences(findings: Sequence[Finding], confused: Sequence[ConfusedImages]) -> list[Finding]:
    """The findings that do not follow from images that are exchanged or turned over.

    Those that do are of cameras that seem to have moved, or do not match.
    """
    if not confused:
        return list(findings)
    sentences = [each.sentence for each in confused]
    return [
        each
        for each in findings
        if each.code not in _MOTIONS
        and not (each.code == "camera-unmatched" and any(one in each.sentence for one in sentences))
    ]


def exchanged_or_mirrored(
    images: DepthImages, k: int, partner: int, space: DepthRange, least: int = 0
) -> ConfusedImages | None:
    """Tell where features show that an image of two cameras is another's, mirrored or upside down; None elsewhere.

    images : of all cameras. k, partner : indices of the two. space : where the surface may be. least :
    number of features that must agree at least.
    """
    ids = [camera.id for camera in images.cameras]
    pictures = images.current(k).image, images.current(partner).image
    first, second = _features(images, *pictures)
    mine, its = ids[k], ids[partner]
    tried: list[tuple[ConfusedImages, tuple[int, int], Pixels, Pixels]] = []
    for kind, axes in _TURNS.items():
        over = [_turned(px, image, axes) for px, image in zip((first, second), pictures, strict=True)]
        tried.append((ConfusedImages(kind, (mine, its)), (k, partner), over[0], over[1]))
        # Features of the turned image lie at the same pixels in an image that was turned before.
        back, there = _features(images, np.ascontiguousarray(np.flip(pictures[0], axes)), pictures[1])
        tried.append((ConfusedImages(kind, (mine,)), (k, partner), back, there))
        at, turned = _turned(back, pictures[0], axes), _turned(there, pictures[1], axes)
        tried.append((ConfusedImages(kind, (its,)), (k, partner), at, turned))
    tried.append((ConfusedImages("exchanged", (mine, its)), (partner, k), first, second))
    for c, other in enumerate(ids):
        if c not in (k, partner):
            tried.append((ConfusedImages("exchanged", (mine, other)), (c, partner), first, second))
            tried.append((ConfusedImages("exchanged", (its, other)), (k, c), first, second))
    counts = [_meeting(images, pair, space, one, other) for _, pair, one, other in tried]
    best = int(np.argmax(counts))
    own = _meeting(images, (k, partner), space, first, second)
    return tried[best][0] if counts[best] >= max(_FEWEST, least, _TIMES * own) else None


def _features(images: DepthImages, first: Image, second: Image) -> tuple[Pixels, Pixels]:
    """Positions (n, 2) px of the features that two images have in common, in each."""
    reference = prepare_reference(first, np.ones(first.shape, bool), images.settings)
    return matched_features(reference, prepare_current(second, settings=images.settings))


def _turned(px: Pixels, image: Image, axes: tuple[int, ...]) -> Pixels:
    """Positions (n, 2) px in the image flipped along some axes: 0 from top to bottom, 1 from left to right."""
    last = np.array(image.shape[::-1]) - 1
    over = np.array([1 in axes, 0 in axes])
    return np.asarray(np.where(over, last - px, px), dtype=np.float64)


def _meeting(images: DepthImages, pair: tuple[int, int], space: DepthRange, first: Pixels, second: Pixels) -> int:
    """Number of features (n, 2) px whose lines of sight from two cameras meet where the surface may be."""
    cameras = [images.cameras[c] for c in pair]
    if not len(first):
        return 0
    px = np.stack([first, second])
    xyz = triangulate(cameras, px)
    miss = np.linalg.norm(reprojection_residuals(cameras, xyz, px), axis=2).max(axis=0)
    with np.errstate(invalid="ignore"):
        return int(((miss < _MISS) & space.holds(cameras[0], xyz) & space.holds(cameras[1], xyz)).sum())
