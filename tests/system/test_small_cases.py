"""Small folders of images that were once measured wrongly, each with its right answer."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import newest_results


@pytest.fixture
def measured(ringdic: Callable, shared_cases: Path, tmp_path: Path) -> Callable[[str], Results]:
    """Call it with the path of a case's input: its results at the defaults."""

    def measure(case: str) -> Results:
        session = tmp_path / case.replace("/", "_")
        ringdic("import", shared_cases / case, session)
        ringdic("process", session, timeout_s=300)
        return read_results(newest_results(session))

    return measure


def test_a_flat_plate_is_measured_whole_with_a_mask_and_without(measured: Callable[[str], Results], figures) -> None:
    plate, masked = measured("flat_plate_cut/in"), measured("flat_plate_cut/in_mask")
    areas = [results.summary["area_mm2"] / 100.0 for results in (plate, masked)]
    figures("flat plate of 315 cm²: measured without and with a mask, cm²", f"{areas[0]:.0f}, {areas[1]:.0f}", "≥ 297")
    assert min(areas) >= 297.0  # of 303 that both cameras show
    assert max(areas) <= 315.0
    for results in (plate, masked):
        centred = results.vertices_ref - results.vertices_ref.mean(axis=0)
        off_plane = centred @ np.linalg.svd(centred, full_matrices=False)[2][2]
        assert np.median(np.abs(off_plane)) < 0.03
        moved = np.nanmedian(results.vertices[1] - results.vertices_ref, axis=0)
        np.testing.assert_allclose(moved, [0.5, 0.2, 0.3], atol=0.01)


def test_a_rod_far_from_the_targets_radius_is_measured(measured: Callable[[str], Results], figures) -> None:
    """The rod's axis is the target's."""
    results = measured("rod_r30/in")
    area = results.summary["area_mm2"] / 100.0
    off = np.linalg.norm(results.vertices_ref[:, :2], axis=1) - 30.0
    rms = float(np.sqrt(np.mean(off**2)))
    figures("rod of radius 30 mm, target 57: off, area", f"{rms:.4f} mm RMS, {area:.0f} cm²", "≤ 0.02, ≥ 95")
    assert area >= 95.0
    assert rms < 0.02
    assert np.abs(off).max() < 1.0


def test_a_grid_is_named_as_a_repeating_pattern_unless_that_is_accepted(
    ringdic: Callable, shared_cases: Path, tmp_path: Path
) -> None:
    """It moved by 30 px, but is like itself at every 24 px along an axis, and at 12 px along both, which is 17 px."""
    images = [shared_cases / "periodic_pattern" / f"periodic_{which}.png" for which in ("ref", "cur")]
    options = ("--out", tmp_path / "points.npz", "--step", 20, "--json")
    summary = json.loads(ringdic("correlate", *images, *options, code=4).stdout)
    assert summary["verdict"] == "do not use"
    assert [each["code"] for each in summary["findings"]] == ["repeating-pattern"]
    assert re.search("repeats itself at (17|24) px", summary["warnings"][0])
    off = np.load(tmp_path / "points.npz")["uv"] - (30.0, 0.0)
    assert not (np.linalg.norm(off, axis=1) > 1.0).any()  # nothing wrong is given
    kept = json.loads(ringdic("correlate", *images, *options, "--accept", "repeating-pattern").stdout)
    assert kept["good"] > 200
    assert "no code" in ringdic("correlate", *images, *options, "--accept", "repeating", code=2).stderr
