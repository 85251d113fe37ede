"""Steps that come at a steady pace are on the page one after the other, with the truth's strain: real processes."""

from pathlib import Path

import numpy as np
from ringdic.results.reader import read_results
from ringdic.session.folder import live_results
from ringdic_controller.studies.bench.live import bench_live, live_ratios
from ringdic_controller.studies.truth import errors
from ringdic_node.virtual_rig.scenes import Limb

STEPS, INTERVAL = 3, 2.0
LONG = 60.0  # seconds; a loaded machine


def test_steps_at_a_steady_pace_are_shown_and_true(tmp_path: Path, figures) -> None:
    found = bench_live(tmp_path, cameras=6, scale=0.2, steps=STEPS, interval=INTERVAL, boards=4)
    shown = [step["capture_id"] for step in found["steps"]]
    assert len(found["taken"]) == STEPS
    assert shown == sorted(set(shown))
    assert set(shown) <= set(found["taken"])
    assert shown[-1] == found["taken"][-1]  # whatever was skipped, the newest is shown
    assert found["skipped"] == STEPS - len(shown)
    assert all(0 < step["seconds"] < LONG for step in found["steps"])
    assert live_ratios(found, found)[0]["seconds"] == 1
    figures("live: from a step's last image to its map", f"{found['seconds']['median']:.1f} s", "(fifth of the size)")

    (session,) = tmp_path.glob("live-*/archive/bench")
    newest = live_results(session)[-1] / "results.h5"
    assert newest.parent.name == found["taken"][-1]
    found_errors = errors(read_results(newest), Limb(), (0, STEPS))
    distance = np.sqrt(np.nanmean(found_errors.distance**2))
    moved = np.linalg.norm(found_errors.displacement[1], axis=1)
    assert distance < 0.2
    assert np.sqrt(np.nanmean(moved**2)) < 0.1
