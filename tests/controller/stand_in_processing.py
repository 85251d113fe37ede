"""A stand-in for the processing: the same lines of JSON, and a results file whose truth is known.

A tube of radius 50 mm that is stretched along z by 10 % a step and turned by 5° a step about z; a few points
are lost in the last step. Run as a program: SESSION [--seconds S] [--fail SENTENCE].
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from processing.camera import Camera
from processing.results import Results, write_results
from processing.session import new_run, read_session

AROUND, ALONG = 60, 16
LOST = (400, 401, 402)
STRETCH = 0.1


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
    a, b, c, d = (part.ravel() for part in (number[:, :-1], after[:, :-1], after[:, 1:], number[:, 1:]))
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
        summary={"table": [{"quantity": "larger stretch", "measured": "1.1", "true": "1.1"}]},
    )


def _moved(reference: np.ndarray, step: int) -> np.ndarray:
    turn = np.radians(5.0 * step)
    R = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    return (reference * [1.0, 1.0, 1.0 + STRETCH * step]) @ R.T


def main() -> int:
    """Print progress, write the run, print the outcome."""
    parser = argparse.ArgumentParser()
    parser.add_argument("session", type=Path)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--fail", default="")
    arguments = parser.parse_args()
    sys.stderr.write("INFO the tube is computed\n")
    for k in range(10):
        line = {"stage": "correlate", "done": k / 10, "rate": "1000 points/s", "left_s": 1.0, "message": f"part {k}"}
        sys.stdout.write(json.dumps(line) + "\n")
        time.sleep(arguments.seconds / 10)
    if arguments.fail:
        sys.stdout.write(json.dumps({"state": "failed", "error": arguments.fail}) + "\n")
        return 2
    steps = tuple(capture.id for capture in read_session(arguments.session).of_kind("specimen"))
    results = tube(steps)
    with new_run(arguments.session) as run:
        write_results(run.folder / "results.h5", results)
        (run.folder / "summary.json").write_text(json.dumps(results.summary))
    assert run.final is not None
    sys.stdout.write(json.dumps({"state": "done", "run": run.final.name, "summary": results.summary}) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
