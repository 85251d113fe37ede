"""A stand-in for the processing: the same lines of JSON, and a results file whose truth is known.

A tube of radius 50 mm that is stretched along z by 10 % a step and turned by 5° a step about z; a few points
are lost in the last step. Run as a program: SESSION [--seconds S] [--fail SENTENCE], or --serve [--seconds S] for
orders on standard input.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from ringdic.findings import Finding, verdict_figures
from ringdic.geometry.camera import Camera
from ringdic.results.results import Results
from ringdic.results.series import select_steps
from ringdic.results.unmeasured import UnmeasuredPlaces, unmeasured_areas
from ringdic.results.writer import write_results
from ringdic.session.folder import new_live, new_run, open_session

AROUND, ALONG = 60, 16
LOST = (400, 401, 402)
STRETCH = 0.1
BARE = (
    UnmeasuredPlaces(
        "01", np.array([[30.0, 20.0], [40.0, 20.0]]), 10.0, np.array([3, 16], np.int8), np.array([70.0, 50])
    ),
)
MOVED = Finding(
    "camera-moved",
    "camera 02 moved since the reference, by 1.20 px in its image",
    ("02",),
    "0004-specimen",
    1.2,
    0.06,
    "px",
)


def tube(steps: tuple[str, ...]) -> Results:
    """The results of the tube at these steps."""
    angle = np.arange(AROUND) * 2 * np.pi / AROUND
    z = np.linspace(0.0, 120.0, ALONG)
    grid_angle, grid_z = np.meshgrid(angle, z, indexing="ij")
    reference = np.stack([50 * np.cos(grid_angle), 50 * np.sin(grid_angle), grid_z], -1).reshape(-1, 3)
    vertices = np.stack([_moved(reference, k) for k in range(len(steps))])
    vertices[-1, LOST] = np.nan
    number = np.arange(AROUND * ALONG).reshape(AROUND, ALONG)
    after = np.roll(number, -1, axis=0)
    a, b, c, d = (corner.ravel() for corner in (number[:, :-1], after[:, :-1], after[:, 1:], number[:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    shape = (len(steps), len(reference))
    lost = ~np.isfinite(vertices[..., 0])
    return Results(
        rig="test-ring",
        steps=steps,
        cameras=tuple(Camera(name, np.eye(3, 4) + 1.0, (640, 480)) for name in ("01", "02")),
        pairs=(("01", "02"),),
        vertices_ref=reference,
        vertices=vertices,
        faces=faces,
        pair=np.zeros(len(faces), dtype=np.int64),
        vertex_pair=np.zeros(len(reference), dtype=np.int64),
        correlation=np.where(lost, np.nan, 0.02),
        sigma_xyz=np.where(lost[..., None], np.nan, np.full((*shape, 3), 0.01)),
        status=lost.astype(np.int8),
        summary={
            **verdict_figures([MOVED]),
            "table": [{"quantity": "larger stretch", "measured": "1.1", "true": "1.1"}],
            "unmeasured": unmeasured_areas(BARE, 37_000.0),
        },
        unmeasured=BARE,
    )


def _moved(reference: np.ndarray, step: int) -> np.ndarray:
    turn = np.radians(5.0 * step)
    R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    return (reference * [1.0, 1.0, 1.0 + STRETCH * step]) @ R.T


def process(session: Path, step: str | None, seconds: float) -> dict:
    """Tell of progress, write the run or the step's results; the outcome."""
    sys.stderr.write("INFO the tube is computed\n")
    for k in range(10):
        line = {"stage": "correlate", "done": k / 10, "rate": "1000 points/s", "left_s": 1.0, "message": f"part {k}"}
        _say(line)
        time.sleep(seconds / 10)
    steps = tuple(capture.id for capture in open_session(session).of_kind("specimen"))
    if step is not None:
        with new_live(session, step) as folder:
            whole, at = tube(steps), sorted({0, steps.index(step)})
            write_results(folder / "results.h5", select_steps(whole, at))
        return {"state": "done", "live": step}
    results = tube(steps)
    with new_run(session) as run:
        write_results(run.folder / "results.h5", results)
        (run.folder / "summary.json").write_text(json.dumps(results.summary))
    assert run.final is not None
    return {"state": "done", "run": run.final.name, "summary": results.summary}


def main() -> int:
    """Process the session, or one order after the other."""
    parser = argparse.ArgumentParser()
    parser.add_argument("session", type=Path, nargs="?")
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--fail", default="")
    arguments = parser.parse_args()
    if arguments.serve:
        _say({"worker": "ready", "seconds": 0.1})
        for line in sys.stdin:
            order = json.loads(line)
            if "stop" not in order:
                _say(process(Path(order["session"]), order["step"], arguments.seconds))
        return 0
    if arguments.fail:
        _say({"state": "failed", "error": arguments.fail})
        return 2
    _say(process(arguments.session, None, arguments.seconds))
    return 0


def _say(line: dict) -> None:
    print(json.dumps(line), flush=True)


if __name__ == "__main__":
    sys.exit(main())
