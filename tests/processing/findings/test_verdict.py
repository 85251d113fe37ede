"""The verdict of a run is that of its worst finding; what was accepted is still shown but no longer forbids use."""

import pytest
from ringdic.errors import InputError
from ringdic.findings import CODES, Finding, Verdict, overall_verdict, verdict_figures, verdict_headline
from ringdic.settings import load_settings

LOOK = Finding("area-unmeasured", "4 of 80 cm² were not measured")
STOP = Finding("camera-moved-unknown", "camera 3 moved", ("3",), "0002-specimen", 1.5, 0.1, "px")


def test_the_worst_finding_decides() -> None:
    assert overall_verdict([]) is Verdict.SOUND
    assert overall_verdict([LOOK]) is Verdict.LOOK
    assert overall_verdict([LOOK, STOP, LOOK]) is Verdict.DO_NOT_USE


def test_the_headline_names_the_cameras_of_the_gravest_findings_or_what_they_mean() -> None:
    assert verdict_headline([]) == "sound"
    assert verdict_headline([LOOK, STOP]) == "do not use: camera 3"
    assert verdict_headline([LOOK]) == "look at this: textured area that two cameras see was not measured"
    moved = [Finding("camera-moved", "", (camera,)) for camera in ("2", "4", "2")]
    assert verdict_headline([LOOK, *moved]) == "look at this: camera 2, 4"
    blurred = [Finding("image-blurred", "", (str(k),)) for k in range(5)]
    assert verdict_headline(blurred) == "look at this: an image is more blurred than its reference"
    assert verdict_figures([LOOK, STOP], ["camera-moved-unknown"])["headline"] == "look at this: camera 3"


def test_an_accepted_code_is_marked_and_no_longer_forbids_the_use() -> None:
    figures = verdict_figures([LOOK, STOP], ["camera-moved-unknown"])
    assert figures["verdict"] == "look at this"
    assert [each["accepted"] for each in figures["findings"]] == [False, True]
    assert verdict_figures([LOOK, STOP], ["area-unmeasured"])["verdict"] == "do not use"


def test_the_gravest_comes_first_and_comes_back_from_json() -> None:
    first, second = map(Finding.from_json, verdict_figures([LOOK, STOP])["findings"])
    assert (first, second) == (STOP, LOOK)


def test_only_codes_that_exist_can_be_used_and_accepted() -> None:
    with pytest.raises(ValueError, match="no code"):
        Finding("camera-fell-over", "")
    with pytest.raises(InputError, match=r"'camera-moved-unknow' \(did you mean 'camera-moved-unknown'\?\)"):
        load_settings(None, ['accept=["camera-moved-unknow"]'])


def test_what_is_accepted_is_kept_with_the_settings(tmp_path) -> None:
    settings = load_settings(None, [f"accept={list(CODES)[:2]}"])
    path = tmp_path / "settings.toml"
    path.write_text(settings.to_toml(), encoding="utf-8")
    assert load_settings(path).accept == tuple(list(CODES)[:2])
