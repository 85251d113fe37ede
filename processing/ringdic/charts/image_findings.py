"""Findings about the images of a run: blurred, clipped, dark, repeated or missing ones, and what was lost for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ringdic.arrays import Floats
from ringdic.charts.image_state import ImageState
from ringdic.charts.reference_state import ReferenceState
from ringdic.findings import Finding

_BLUR = 0.8  # px, that a calm image never has more than its reference: stretch, JPEG and noise make 0.3, where both
# images are out of focus 0.65
_BLUR_OF_REFERENCE = 0.9  # px, beside later images: a stretch of 50 % alone makes 0.8
_BLUR_APART = 1.2  # px, where hardly a point was matched, so that the squares show other material
_BLUR_OF_CAMERA = 1.0  # px, beside other cameras, which may stand nearer or show the pattern more squarely
_WIDTH = 16.0 * np.log(2.0)  # square of the full width of an autocorrelation, in that of the blur's standard deviation
_FOLLOWED = 0.5  # share of the points lost, below which an image's squares show the same material
_CLIPPED = 0.25  # of the pixels of the pattern: white paper or black ink alone may be at the end of the grey levels
_CLIPPED_REFERENCE = 0.45  # of the pixels of the pattern at the reference
_MORE_CLIPPED = 0.1  # than in the reference
_FAINT = 0.25  # of the reference's contrast
_LOST = 0.15  # of a camera's points, that are worth a finding
_TIMES = 3.0  # times as much as the lower quartile of all cameras
_HARDLY = 0.1  # of the points of a step
_COARSE = 0.42  # of a subset's width, from which on speckles are too large for it: it holds hardly two
_SOFT = 1.55  # px, edges of a pattern that is out of focus by a pixel and more; in focus they are 1.2 to 1.4
_SOFTER = 1.25  # times as wide as those of the target
_SOFTER_THAN_OTHERS = 1.15  # times as wide as those of the other cameras: by a blur of 0.7 px
_FINE = 1.7  # px, below which pixels do not resolve speckles


@dataclass(frozen=True)
class RunImages:
    """States of the images of a run.

    cameras : ids of the C cameras. steps : ids of the F captures, the reference first. references : (C,). states :
    images of the later steps by camera and step, None where there is none; digests : of their pixels. measured : (F,)
    share of the surface's points that each step measured. radius : px, of the subsets. target_edge : function that
    returns the width, px, of the sharpest edges in the images of the target.
    """

    cameras: tuple[str, ...]
    steps: tuple[str, ...]
    references: tuple[ReferenceState, ...]
    states: Mapping[tuple[int, int], ImageState]
    digests: Mapping[tuple[int, int], str]
    measured: Floats
    radius: int
    target_edge: Callable[[], float]

    def findings(self) -> list[Finding]:
        """All findings about the images."""
        repeating = [one for reference in self.references for one in reference.repetition]
        return [
            *([_joint(repeating)] if repeating else []),
            *self._speckle(),
            *self._focus(),
            *self._clipped_references(),
            *(one for c in range(len(self.cameras)) for one in self._reference(c)),
            *self._repeated(),
            *(one for step in range(1, len(self.steps)) for one in self._step(step)),
        ]

    def _speckle(self) -> Iterator[Finding]:
        """Speckles that are too large for the subsets, or too small for the pixels, in the median of the cameras."""
        sizes = [one.speckle for one in self.references if one.sized]  # those of the others may be the background's
        if not sizes:
            return
        size, width = float(np.median(sizes)), 2 * self.radius + 1
        for sentence in coarse_speckle(sizes, self.radius):
            yield Finding("coarse-speckle", sentence, value=round(size, 2), limit=_COARSE * width, unit="px")
        if size < _FINE:
            sentence = (
                f"the speckles are {size:.1f} px wide (median of the cameras; limit {_FINE} px): pixels do not resolve "
                "them, which biases the matches; apply a coarser pattern, or move the cameras closer"
            )
            yield Finding("fine-speckle", sentence, value=round(size, 2), limit=_FINE, unit="px")

    def _focus(self) -> Iterator[Finding]:
        """Cameras that are out of focus, most of them, so that none can be held against the others."""
        edges = [one.edge for one in self.references if one.sized]  # a background may well be out of focus
        edge = float(np.nanmedian(edges)) if np.isfinite(edges).any() else 0.0
        if edge < _SOFT:
            return
        target = self.target_edge()
        if edge < _SOFTER * target:  # the lenses, or the images, are no sharper
            return
        known = zip(self.cameras, self.references, strict=True)
        cameras = tuple(id_ for id_, one in known if one.sized and one.edge > _SOFT)
        sentence = (
            f"{self.steps[0]}: the edges of the pattern are {edge:.1f} px wide (median of the cameras; limit {_SOFT} "
            f"px), those of the target {target:.1f} px: the cameras are out of focus, or the pattern has soft edges. "
            "Focus them on the specimen, and calibrate and capture again"
        )
        yield Finding("image-blurred", sentence, cameras, self.steps[0], round(edge, 3), _SOFT, "px")

    def _clipped_references(self) -> Iterator[Finding]:
        """Cameras whose reference image is mostly white or black."""
        for what, shares, remedy in (
            ("white", [one.state.bright for one in self.references], "expose shorter"),
            ("black", [one.state.dark for one in self.references], "expose longer, or light the specimen"),
        ):
            cameras = tuple(self.cameras[c] for c, share in enumerate(shares) if share > _CLIPPED_REFERENCE)
            if cameras:
                sentence = (
                    f"{self.steps[0]}, camera {', '.join(cameras)}: up to {100 * max(shares):.0f} % of the pattern's "
                    f"pixels are {what}, without any grey level (limit {100 * _CLIPPED_REFERENCE:.0f} %); {remedy}"
                )
                limit = 100 * _CLIPPED_REFERENCE
                yield Finding("image-clipped", sentence, cameras, self.steps[0], 100 * max(shares), limit, "%")

    def _reference(self, c: int) -> Iterator[Finding]:
        """Whether a camera's reference image is more blurred than its later ones, or than those of other cameras."""
        camera, name = self.cameras[c], self.steps[0]
        later = [state.across for (of, _), state in self.states.items() if of == c and state.lost < _FOLLOWED]
        # A stretch of the surface widens the reference's own blur too: the least stretched step counts.
        blur, limit, beside = -max(later, default=0.0), _BLUR_OF_REFERENCE, "its later images"
        if not blur > limit:
            known, own = [one for one in self.references if one.certain], self.references[c]
            excess = own.speckle**2 - float(np.median([one.speckle for one in known])) ** 2 if own.certain else 0.0
            # Speckles may be larger, or an edge of the body among them: a blur makes their edges wider too.
            if known and own.edge < _SOFTER_THAN_OTHERS * float(np.median([one.edge for one in known])):
                excess = 0.0
            blur, limit = float(np.sqrt(max(excess, 0.0) / _WIDTH)), _BLUR_OF_CAMERA
            beside = "those of the other cameras"
        if blur > limit:
            sentence = (
                f"{name}, camera {camera}: the image is blurred by {blur:.1f} px beside {beside} (limit {limit} px); "
                "focus the camera, and capture the reference again"
            )
            yield Finding("image-blurred", sentence, (camera,), name, round(blur, 3), limit, "px")

    def _repeated(self) -> Iterator[Finding]:
        """Images whose pixels are those of another camera or step."""
        first: dict[str, tuple[int, int]] = {one.digest: (c, 0) for c, one in enumerate(self.references)}
        for c, one in enumerate(self.references):
            if first[one.digest] != (c, 0):
                yield self._same((c, 0), first[one.digest])
        for (c, step), digest in sorted(self.digests.items(), key=lambda each: each[0][::-1]):
            known = first.setdefault(digest, (c, step))
            if known != (c, step):
                yield self._same((c, step), known)

    def _same(self, image: tuple[int, int], other: tuple[int, int]) -> Finding:
        (c, step), (d, before) = image, other
        cameras = tuple(dict.fromkeys((self.cameras[c], self.cameras[d])))
        sentence = (
            f"{self.steps[step]}: the image of camera {self.cameras[c]} is the same, pixel for pixel, as that of "
            f"camera {self.cameras[d]} in {self.steps[before]}; replace it by the one that was taken, or leave the "
            "step out"
        )
        return Finding("image-repeated", sentence, cameras, self.steps[step])

    def _step(self, step: int) -> Iterator[Finding]:
        """Findings about the images of a step: missing ones, each camera's own, and the step itself where it failed."""
        known = {c: self.states[c, step] for c in range(len(self.cameras)) if (c, step) in self.states}
        missing = [self.cameras[c] for c in range(len(self.cameras)) if c not in known]
        if missing:
            sentence = f"{self.steps[step]}: camera {' and '.join(missing)} has no image; capture the step again"
            yield Finding("image-missing", sentence, tuple(missing), self.steps[step], len(missing), 0, "images")
        if self.measured[step] < _HARDLY:
            yield self._unmeasured(step, known)
            return
        usual = float(np.percentile([state.lost for state in known.values()], 25)) if known else 0.0
        single = [
            finding for c, state in known.items() if state.points for finding in self._image(c, step, state, usual)
        ]
        for code in dict.fromkeys(each.code for each in single):
            yield _joint([each for each in single if each.code == code])

    def _image(self, c: int, step: int, state: ImageState, usual: float) -> Iterator[Finding]:
        """What is wrong with one image. usual : share of the points that the better cameras lose at this step."""
        camera, name = self.cameras[c], self.steps[step]
        causes = self._causes(c, state)
        lost = state.lost > max(_LOST, _TIMES * usual)
        losing = f"; {100 * state.lost:.0f} % of its points were lost" if lost else ""
        for code, sentence, value, limit, unit in causes:
            yield Finding(code, f"{name}, camera {camera}: {sentence}{losing}", (camera,), name, value, limit, unit)
        if lost and not causes:
            sentence = (
                f"{name}, camera {camera}: {100 * state.lost:.0f} % of its points were lost (limit {100 * _LOST:.0f} "
                f"%), {100 * usual:.0f} % in the better ones; look whether something hides the specimen there, or "
                "whether the image is of another step"
            )
            yield Finding("camera-lost-points", sentence, (camera,), name, 100 * state.lost, 100 * _LOST, "%")

    def _causes(self, c: int, state: ImageState) -> list[tuple[str, str, float, float, str]]:
        """Code, sentence, figure, limit and unit of all that is wrong with an image of camera c."""
        before, causes = self.references[c].state, []
        limit = _BLUR if state.lost < _FOLLOWED else _BLUR_APART
        if state.blur > limit and state.contrast > _FAINT / 2:
            causes.append(("image-blurred", _blur_sentence(state, limit), state.blur, limit, "px"))
        for what, share, then, remedy in (
            ("white", state.bright, before.bright, "expose shorter, or remove what reflects"),
            ("black", state.dark, before.dark, "expose longer, or light the specimen"),
        ):
            if share > _CLIPPED and share > then + _MORE_CLIPPED:
                sentence = (
                    f"{100 * share:.0f} % of the pattern's pixels are {what}, without any grey level (reference "
                    f"{100 * then:.0f} %, limit {100 * _CLIPPED:.0f} %); {remedy}"
                )
                causes.append(("image-clipped", sentence, 100 * share, 100 * _CLIPPED, "%"))
        if state.contrast < _FAINT and not causes:
            sentence = (
                f"its contrast is {100 * state.contrast:.0f} % of the reference's (limit {100 * _FAINT:.0f} %); light "
                "the specimen as at the reference"
            )
            causes.append(("image-faint", sentence, 100 * state.contrast, 100 * _FAINT, "%"))
        return causes

    def _unmeasured(self, step: int, known: Mapping[int, ImageState]) -> Finding:
        """The finding of a step at which hardly a point was measured: its cause, where most of the images show one."""
        name, share = self.steps[step], float(self.measured[step])
        causes = {c: self._causes(c, state) for c, state in known.items()}
        codes = [each[0][0] for each in causes.values() if each]
        common = max(set(codes), key=codes.count) if codes else ""
        affected = [c for c, each in causes.items() if each and each[0][0] == common]
        measured = f"{name}: {100 * share:.0f} % of the points were measured (limit {100 * _HARDLY:.0f} %)"
        if common and 2 * len(affected) >= len(known):
            worst = max(affected, key=lambda c: causes[c][0][2])
            cameras = tuple(self.cameras[c] for c in affected)
            code, sentence, value, limit, unit = causes[worst][0]
            return Finding(
                code, f"{measured}; camera {' and '.join(cameras)}: {sentence}", cameras, name, value, limit, unit
            )
        lost = ", ".join(f"{self.cameras[c]} {100 * state.lost:.0f} %" for c, state in known.items())
        why = (
            "the images are as sharp and as bright as the reference, but its points were not found in them (lost: "
            f"{lost}); check that the step shows the same specimen, and that it moved by less than 160 px"
        )
        return Finding("step-unmeasured", f"{measured}; {why}", (), name, 100 * share, 100 * _HARDLY, "%")


def coarse_speckle(sizes: Sequence[float], radius: int) -> list[str]:
    """The sentence about speckles that are too large for the subsets, if they are.

    sizes : px, of the speckles in each camera, NaN where it is not known. radius : px, of the subsets.
    """
    known = [size for size in sizes if math.isfinite(size)]
    size, width = float(np.median(known)) if known else 0.0, 2 * radius + 1
    if size <= _COARSE * width:
        return []
    return [
        f"the speckles are {size:.1f} px wide (median of the cameras; limit {_COARSE * width:.0f} px), a subset is "
        f"{width} px wide and holds too few: set correlation.radius_px to {round(1.5 * size)} or more, or apply a "
        "finer pattern"
    ]


def _joint(findings: list[Finding]) -> Finding:
    """One finding in place of those of one code about several cameras at one step: the gravest, and whom it is of."""
    worst = max(findings, key=lambda each: abs((each.value or 0.0) - (each.limit or 0.0)))
    if len(findings) == 1:
        return worst
    cameras = tuple(camera for each in findings for camera in each.cameras)
    sentence = f"{worst.sentence} (so {len(cameras)} cameras: {', '.join(cameras)})"
    return replace(worst, sentence=sentence, cameras=cameras)


def _blur_sentence(state: ImageState, limit: float) -> str:
    """What a blur is and what helps: one along a direction is a motion's, one in all directions that of a lens."""
    if state.across > 0.5 * state.blur:
        return (
            f"blurred by {state.blur:.1f} px beside its reference (limit {limit} px), in all directions; focus the "
            "camera and capture again"
        )
    return (
        f"blurred by {state.blur:.1f} px beside its reference (limit {limit} px), along {state.along:.0f}° from x "
        "towards y, as by a motion; expose shorter, or capture when the specimen rests"
    )
