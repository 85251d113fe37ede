"""Figures of a camera's reference image that tell whether it can be matched: speckles, their repetition, light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ringdic.arrays import Image, Mask, Pixels
from ringdic.charts.depth_map import DepthMap
from ringdic.charts.image_state import ImageState, image_state, pixel_digest
from ringdic.charts.sharpness import edge_width
from ringdic.correlation.repetition import find_repetition
from ringdic.findings import Finding

#: Names of the arrays that a reference state is stored as.
REFERENCE_STATE = ("image_state", "speckle", "edge", "certain", "sized", "digest", "repetition")
_KNOWN = 0.3  # of the textured places have a depth: with fewer, all textured places are looked at, background too
_FEWEST = 12  # places with a depth, from which the size of the speckles is known
_MOST = 0.6  # of these that must repeat: lamps in the background do


@dataclass(frozen=True)
class ReferenceState:
    """State of a camera's reference image.

    state : the image beside itself: how it is lit. speckle : px, size of the speckles. certain : whether the surface is
    known well enough to tell the pattern from the background. sized : whether the speckles are the surface's, as they
    are where it is certain, and where they were measured at the places with a depth alone. repetition : findings of a
    repeating pattern. digest : of its pixels. edge : px, width of the pattern's sharpest edges.
    """

    state: ImageState
    speckle: float
    certain: bool
    sized: bool
    repetition: tuple[Finding, ...]
    digest: str
    edge: float

    @classmethod
    def of(cls, camera: str, image: Image, depth_map: DepthMap, radius: int) -> ReferenceState:
        """The state of a camera's image (height, width), at the places of its depth map.

        camera : its id. radius : px, of the subsets.
        """
        known = depth_map.patches.px
        certain = len(known) > _KNOWN * len(depth_map.textured)
        places = known if certain else depth_map.textured
        found = find_repetition(image, places, radius, _about(places, image.shape, depth_map.spacing))
        repeats = found.share >= (0.0 if certain else _MOST)
        sized = certain or len(known) >= _FEWEST
        speckle = found.speckle
        if sized and not certain:
            speckle = find_repetition(image, known, radius, _about(known, image.shape, depth_map.spacing)).speckle
        return cls(
            image_state(image, image, places, np.zeros((len(places), 6))), speckle, certain, sized,
            tuple(found.findings(f"camera {camera}", (camera,))) if repeats else (), pixel_digest(image),
            edge_width(image, known if sized else places),
        )  # fmt: skip

    def arrays(self) -> dict[str, NDArray]:
        """The state as arrays of a task's output, by name.

        "image_state" (9,), "speckle" and "edge" () px, "certain" and "sized" () bool, "digest" () and "repetition"
        (k, 4) of text.
        """
        sentences = [(one.sentence, *one.cameras, one.value, one.limit) for one in self.repetition]
        return {
            "image_state": self.state.array(), "speckle": np.array(self.speckle),
            "certain": np.array(self.certain), "sized": np.array(self.sized), "digest": np.array(self.digest),
            "edge": np.array(self.edge), "repetition": np.array(sentences, dtype=str).reshape(-1, 4),
        }  # fmt: skip

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray]) -> ReferenceState:
        """The state from the arrays (9,), () px, (), () and (k, 4) of :meth:`arrays`, by name."""
        repetition = tuple(
            Finding("repeating-pattern", str(sentence), (str(camera),), None, float(value), float(limit), "ZNCC")
            for sentence, camera, value, limit in arrays["repetition"]
        )
        state = ImageState.of_array(arrays["image_state"])
        certain, sized = (bool(arrays[name]) for name in ("certain", "sized"))
        return cls(
            state, float(arrays["speckle"]), certain, sized, repetition, str(arrays["digest"]), float(arrays["edge"])
        )


def _about(places: Pixels, shape: tuple[int, ...], spacing: int) -> Mask:
    """The pixels of an image of a shape (height, width) about places (n, 2) px of a lattice of some spacing, px."""
    coarse = max(1, spacing // 8)  # px, to which their outline is exact
    height, width = (-(-side // coarse) for side in shape)
    region = np.zeros((height, width), np.uint8)
    column, row = np.rint(places).astype(int).T // coarse
    region[row.clip(0, height - 1), column.clip(0, width - 1)] = 1
    wide = cv2.dilate(region, np.ones((2 * (spacing // coarse) + 1,) * 2, np.uint8))
    whole = cv2.resize(wide, (coarse * width, coarse * height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(whole[: shape[0], : shape[1]]) > 0
