"""The tutorial, followed literally, ends in the picture that it shows."""

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ringdic.session.images import read_gray

MOST_BYTES = 200_000


def test_it_ends_in_the_picture_that_the_page_shows(tutorial: Any, pages: Path) -> None:
    shown = pages / "images" / "first_session.png"
    assert "images/first_session.png" in (pages / "first_session.md").read_text(encoding="utf-8")
    assert shown.stat().st_size < MOST_BYTES
    found = read_gray(tutorial.folder / "first_session.png")
    wanted = read_gray(shown)
    np.testing.assert_allclose(found.shape, wanted.shape, rtol=0.05)  # fonts may differ
    small = [cv2.resize(each, (60, 80), interpolation=cv2.INTER_AREA).astype(float) for each in (found, wanted)]
    assert np.abs(small[0] - small[1]).mean() < 4.0  # grey levels


def test_the_figures_are_as_good_as_the_page_says(tutorial: Any) -> None:
    rms = re.search(r"control points: ([\d.]+) mm RMS", tutorial.printed)
    assert rms is not None
    assert float(rms[1]) < 0.03
    stretch = re.search(r"larger stretch: median ([\d.]+), largest ([\d.]+); (\d+) lost", tutorial.printed)
    assert stretch is not None
    assert 1.0 < float(stretch[1]) < float(stretch[2])


def test_it_leaves_what_it_names(tutorial: Any) -> None:
    for name in ("images/cameras_truth.json", "session/session.json", "session.vtkhdf", "report.html"):
        assert (tutorial.folder / name).is_file(), name


def test_pictures_of_the_pages_are_small(pages: Path) -> None:
    for picture in (pages / "images").iterdir():
        assert picture.stat().st_size < MOST_BYTES, picture.name
