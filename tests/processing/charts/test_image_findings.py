"""Findings about images name the camera and the step that is wrong, and say nothing about calm ones."""

from dataclasses import replace

import numpy as np
import pytest
from ringdic.charts.image_findings import RunImages, coarse_speckle
from ringdic.charts.image_state import ImageState
from ringdic.charts.reference_state import REFERENCE_STATE, ReferenceState
from ringdic.findings import Finding, Verdict

CALM = ImageState(1000, 980, 0.1, 20.0, -0.1, 0.95, 0.01, 0.0, 120.0)
CAMERAS, STEPS = ("1", "2", "3"), ("0001-specimen", "0002-specimen", "0003-specimen")
REFERENCES = tuple(ReferenceState(CALM, 4.0, True, True, (), f"reference {camera}", 1.3) for camera in CAMERAS)
PLACES = [(c, step) for c in range(3) for step in (1, 2)]


def run_images(**changed: ImageState) -> RunImages:
    """Calm images of three cameras but for some: changed.c1s2 is that of the second camera at the third capture."""
    states = {(c, step): changed.get(f"c{c}s{step}", CALM) for c, step in PLACES}
    digests = {place: f"image {place}" for place in PLACES}
    return RunImages(CAMERAS, STEPS, REFERENCES, states, digests, np.ones(3), 10, lambda: 1.4)


def only(images: RunImages) -> Finding:
    (finding,) = images.findings()
    return finding


def test_calm_images_and_those_of_another_light_say_nothing() -> None:
    assert run_images().findings() == []
    for state in (
        replace(CALM, contrast=0.5, level=60.0), replace(CALM, contrast=1.9, level=230.0, bright=0.08),
        replace(CALM, blur=0.3, across=-0.3), replace(CALM, matched=900),
    ):  # fmt: skip
        assert run_images(c1s1=state).findings() == []


def test_an_image_that_is_blurred_is_named_with_the_direction() -> None:
    smeared = only(run_images(c1s2=replace(CALM, blur=1.7, across=0.1, along=30.0, matched=600)))
    assert (smeared.code, smeared.cameras, smeared.step, smeared.value) == ("image-blurred", ("2",), STEPS[2], 1.7)
    assert "30°" in smeared.sentence
    assert "40 % of its points were lost" in smeared.sentence
    defocused = only(run_images(c0s1=replace(CALM, blur=1.5, across=1.4)))
    assert "focus the camera" in defocused.sentence


def test_what_all_cameras_show_at_a_step_is_one_finding() -> None:
    smeared = replace(CALM, blur=1.4, across=0.1, along=30.0)
    images = run_images(c0s1=smeared, c1s1=replace(smeared, blur=1.9), c2s1=smeared)
    finding = only(images)
    assert (finding.code, finding.cameras, finding.value) == ("image-blurred", CAMERAS, 1.9)


def test_a_reference_that_is_more_blurred_than_all_later_images_is_named_once() -> None:
    sharper = replace(CALM, blur=-0.2, across=-1.2)
    reference = only(run_images(c0s1=sharper, c0s2=sharper))
    assert (reference.code, reference.cameras, reference.step) == ("image-blurred", ("1",), STEPS[0])
    assert reference.value == pytest.approx(1.2)


def test_a_camera_out_of_focus_is_known_by_its_speckles() -> None:
    """A blur of σ px makes the autocorrelation of a normal pattern wider by 16 ln 2 σ² in its square."""
    wide = float(np.sqrt(16.0 + 16.0 * np.log(2.0) * 1.5**2))
    blurred = replace(REFERENCES[1], speckle=wide, edge=2.0)
    finding = only(replace(run_images(), references=(REFERENCES[0], blurred, REFERENCES[2])))
    assert (finding.code, finding.cameras, finding.step) == ("image-blurred", ("2",), STEPS[0])
    assert finding.value == pytest.approx(1.5, abs=0.01)
    further, sharp = replace(REFERENCES[1], speckle=4.4), replace(REFERENCES[1], speckle=wide, edge=1.35)
    for other in (further, sharp):  # larger speckles with edges as sharp as the others' are no blur
        assert replace(run_images(), references=(REFERENCES[0], other, REFERENCES[2])).findings() == []


def test_cameras_that_are_all_out_of_focus_are_named_unless_the_target_is_no_sharper() -> None:
    """Two of three show edges that are twice as wide as those of the target."""
    soft = (*(replace(one, edge=2.6) for one in REFERENCES[:2]), REFERENCES[2])
    finding = only(replace(run_images(), references=soft))
    assert (finding.code, finding.cameras, finding.step, finding.value) == ("image-blurred", ("1", "2"), STEPS[0], 2.6)
    assert "those of the target 1.4 px" in finding.sentence
    assert replace(run_images(), references=soft, target_edge=lambda: 2.5).findings() == []
    background = tuple(replace(one, certain=False, sized=False) for one in soft)
    assert replace(run_images(), references=background).findings() == []


def test_clipped_and_dark_images_are_named() -> None:
    white = only(run_images(c2s1=replace(CALM, bright=0.5)))
    assert (white.code, white.cameras, white.step) == ("image-clipped", ("3",), STEPS[1])
    assert "50 %" in white.sentence
    black = only(run_images(c2s1=replace(CALM, dark=0.6, contrast=0.05)))
    assert black.code == "image-clipped"
    faint = only(run_images(c2s1=replace(CALM, contrast=0.1)))
    assert faint.code == "image-faint"


def test_a_pattern_that_is_white_by_itself_is_not_clipped() -> None:
    white = replace(CALM, bright=0.4)
    images = run_images(**{f"c{c}s{step}": white for c, step in PLACES})
    assert replace(images, references=tuple(replace(one, state=white) for one in REFERENCES)).findings() == []


def test_a_reference_that_is_mostly_white_is_named() -> None:
    white = replace(CALM, bright=0.6)
    references = (REFERENCES[0], replace(REFERENCES[1], state=white), REFERENCES[2])
    finding = only(replace(run_images(), references=references))
    assert (finding.code, finding.cameras, finding.step, finding.value) == ("image-clipped", ("2",), STEPS[0], 60.0)


def test_a_camera_that_loses_far_more_points_than_the_others_is_named() -> None:
    lost = only(run_images(c1s1=replace(CALM, matched=700)))
    assert (lost.code, lost.cameras, lost.step) == ("camera-lost-points", ("2",), STEPS[1])
    assert lost.value == pytest.approx(30.0)
    all_lose = {f"c{c}s1": replace(CALM, matched=700) for c in range(3)}
    assert run_images(**all_lose).findings() == []


def test_the_same_pixels_twice_are_not_to_be_used() -> None:
    images = run_images()
    for other, where in (((1, 1), STEPS[1]), ((0, 2), STEPS[2])):
        again = replace(images, digests={**images.digests, (1, 2): images.digests.get(other, "")})
        finding = only(again)
        assert finding.code == "image-repeated"
        assert finding.verdict is Verdict.DO_NOT_USE
        assert (finding.step, finding.cameras[0]) == (STEPS[2], "2")
        assert where in finding.sentence
    of_reference = only(replace(images, digests={**images.digests, (1, 2): "reference 2"}))
    assert of_reference.cameras == ("2",)
    assert STEPS[0] in of_reference.sentence


def test_a_missing_image_is_named() -> None:
    images = run_images()
    states = {place: state for place, state in images.states.items() if place != (1, 2)}
    missing = only(replace(images, states=states))
    assert (missing.code, missing.cameras, missing.step) == ("image-missing", ("2",), STEPS[2])


def test_a_step_without_points_has_the_cause_that_most_images_show() -> None:
    smeared = replace(CALM, blur=2.0, across=0.2, along=60.0, matched=3)
    images = run_images(**{f"c{c}s1": smeared for c in range(3)})
    measured = np.array([1.0, 0.02, 1.0])
    step = only(replace(images, measured=measured))
    assert (step.code, step.cameras, step.step) == ("image-blurred", CAMERAS, STEPS[1])
    assert "blurred by 2.0 px" in step.sentence
    assert "60°" in step.sentence
    elsewhere = run_images(**{f"c{c}s1": replace(CALM, matched=3) for c in range(3)})
    unknown = only(replace(elsewhere, measured=measured))
    assert unknown.cameras == ()
    assert "as sharp and as bright as the reference" in unknown.sentence


@pytest.mark.parametrize(("size", "code"), [(1.2, "fine-speckle"), (9.8, "coarse-speckle"), (20.0, "coarse-speckle")])
def test_speckles_that_do_not_suit_the_subset_or_the_pixels_are_named(size: float, code: str) -> None:
    references = tuple(replace(one, speckle=size) for one in REFERENCES)
    finding = only(replace(run_images(), references=references))
    assert (finding.code, finding.value) == (code, size)
    background = tuple(replace(one, certain=False, sized=False) for one in references)
    assert replace(run_images(), references=background).findings() == []


def test_speckles_of_unknown_size_are_not_called_coarse() -> None:
    assert coarse_speckle([np.nan, np.nan], 20) == []
    (sentence,) = coarse_speckle([30.0, np.nan, 30.0], 20)
    assert "30.0 px wide" in sentence


def test_the_state_of_a_reference_survives_its_storage() -> None:
    finding = Finding("repeating-pattern", "camera 1: it repeats", ("1",), None, 0.98, 0.65, "ZNCC")
    state = ReferenceState(CALM, 4.5, False, True, (finding,), "digest", 1.2)
    assert ReferenceState.of_arrays({name: state.arrays()[name] for name in REFERENCE_STATE}) == state
    assert ReferenceState.of_arrays(REFERENCES[0].arrays()) == REFERENCES[0]
