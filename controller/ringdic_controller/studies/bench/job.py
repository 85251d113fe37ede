"""Benchmark of whole jobs: time from the specimen's images to the results, by stage and by number of steps.

The images are those of virtual cameras, rendered once and kept in a folder; those of the specimen are PGM files, as
nodes deliver them and the archive keeps them. Each job runs in a process of its own, so that its peak memory and its
processor time, and that of its checks, are known. It begins without any matches, but with compiled kernels and
calibrated cameras, as in a session that goes on. The calibration is timed by itself.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ringdic.errors import ComputationError, InputError
from ringdic.session.images import read_gray
from ringdic_node.virtual_rig.scenes import Specimen

from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot
from ringdic_controller.studies.validate.scenery import Scenery

Say = Callable[[str], None]

_RENDERED = 5  # steps that are rendered; later ones are copies of these with noise of their own
_BOARDS = 15
_MB = 1e6


@dataclass(frozen=True)
class _NoisyCopy(RenderedShot):
    """A rendered image with a little noise added, which stands for a further step without rendering one."""

    turn: int = 0

    @property
    def key(self) -> str:
        return f"{super().key}-{self.turn}"

    @property
    def first(self) -> RenderedShot:
        """The image without the added noise."""
        return RenderedShot(self.camera, self.scene, self.seed, self.jpeg)


class _SessionImages(ImageCache):
    """Images as they go into sessions: those of the specimen as PGM files, all others as rendered."""

    def path(self, shot: RenderedShot) -> Path:
        """File of an image in the form that goes into a session."""
        rendered = super().path(shot)
        return rendered.with_suffix(".pgm") if isinstance(shot.scene, Specimen) else rendered


def bench_job(
    folder: Path,
    steps: Sequence[int] = (5,),
    *,
    scale: float = 1.0,
    cameras: int = 12,
    settings: Sequence[str] = (),
    say: Say = lambda _: None,
) -> dict[str, Any]:
    """Time whole jobs, one for each number of specimen images a camera (the reference included).

    folder : of the images and sessions, which are kept for the next time. scale : 1 is 2464 x 3280 px. settings :
    ``group.name=value`` to process with. say : called with one line about each job.

    Returns JSON values: the rig, the seconds of its calibration from the images of boards and target, and for each
    number of steps the seconds (``wall``, ``cpu``, by stage), the processor time of the checks and their share of the
    whole (``checks``, ``checks_share``), the peak memory in 1e6 bytes (None where the system does not report it), the
    triangles and the size of the stored matches. Several numbers of steps also give
    ``seconds_per_step``, ``cpu_seconds_per_step`` and ``peak_mb_per_step``, by a straight line.
    """
    if min(steps, default=0) < 2:
        raise InputError("a job needs the reference and at least one step: 2 steps or more")
    scenery = Scenery(scale=scale, cameras=cameras, boards=_BOARDS, limb=_RENDERED)
    cache = _SessionImages(Path(folder) / "images")
    shots = _shots(scenery, cache, max(steps), say)
    runs: list[dict[str, Any]] = []
    warm: Path | None = None
    calibration = 0.0
    for count in sorted(steps):
        name = f"{cameras}-{scale:g}-{count}-delivered"
        captures = [("board", shot) for shot in scenery.shots("boards")]
        captures += [("target", shot) for shot in scenery.shots("target")] + [("specimen", s) for s in shots[:count]]
        path = Path(folder) / "sessions" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        session = make_session(path, scenery.rig.rig_toml(), captures, cache, calibration=warm)
        if warm is None:
            shutil.rmtree(session / "calibration", ignore_errors=True)
            calibration = _process(session, settings)["seconds"]["calibrate"]
            say(f"{_BOARDS} boards a camera and the target: calibrated in {calibration:.1f} s")
            warm = session
        elif not list((session / "calibration").glob("*.json")):
            raise ComputationError(f"{session}: the calibration of {warm} was not taken over")
        shutil.rmtree(session / "work", ignore_errors=True)
        run = {"steps": count, **_process(session, settings)}
        say(_told(run))
        say(_told_checks(run))
        runs.append(run)
    rig = {"cameras": cameras, "scale": scale, "settings": list(settings)}
    return {**rig, "boards": _BOARDS, "calibration_seconds": calibration, "runs": runs, **_lines(runs)}


def job_ratios(new: dict[str, Any], old: dict[str, Any]) -> list[dict[str, Any]]:
    """Speed relative to an earlier result, for each job that both results have: a ratio above 1 is better.

    Raises InputError if they have no job in common.
    """
    alike = [new.get(name) == old.get(name) for name in ("cameras", "scale", "settings")]
    before = {run["steps"]: run for run in old.get("runs", [])} if all(alike) else {}
    rows = [
        {"steps": run["steps"], **{name: before[run["steps"]][name] / run[name] for name in ("wall", "cpu")}}
        for run in new["runs"]
        if run["steps"] in before
    ]
    if not rows:
        raise InputError("the earlier result holds no job of the same rig, settings and number of steps")
    return rows


def _shots(scenery: Scenery, session_images: ImageCache, count: int, say: Say) -> list[Mapping[str, RenderedShot]]:
    """The specimen's images of each step by camera; those that are missing are rendered or copied first."""
    rendered_images, rendered = ImageCache(session_images.folder), scenery.shots("limb")
    every = [shot for scene in ("boards", "target") for shots in scenery.shots(scene) for shot in shots.values()]
    every += [shot for shots in rendered[:count] for shot in shots.values()]
    missing = sum(not rendered_images.path(shot).is_file() for shot in every)
    if missing:
        say(f"rendering {missing} images into {rendered_images.folder}")
    rendered_images.render_missing(every)
    steps: list[Mapping[str, RenderedShot]] = list(rendered[:count])
    for k in range(len(steps), count):
        turn, which = divmod(k - 1, _RENDERED)
        shots = rendered[1 + which].items()
        steps.append({id_: _NoisyCopy(shot.camera, shot.scene, shot.seed, shot.jpeg, turn=turn) for id_, shot in shots})
    for shot in [shot for shots in steps for shot in shots.values()]:
        if not session_images.path(shot).is_file():
            _deliver(shot, rendered_images, session_images.path(shot))
    return steps


def _deliver(shot: RenderedShot, rendered_images: ImageCache, path: Path) -> None:
    """Write an image in the form that goes into a session, with its noise if it is a copy."""
    image = read_gray(rendered_images.path(shot.first if isinstance(shot, _NoisyCopy) else shot))
    if isinstance(shot, _NoisyCopy):
        noise = np.random.default_rng([shot.turn, shot.seed]).integers(-1, 2, image.shape)
        image = np.clip(image.astype(np.int64) + noise, 0, 255).astype(np.uint8)
    aside = path.with_name(f".{path.stem}.partial{path.suffix}")
    if not cv2.imwrite(str(aside), image):
        raise ComputationError(f"{path.parent}: the images cannot be written; check the disk")
    aside.replace(path)


def _process(session: Path, settings: Sequence[str]) -> dict[str, Any]:
    """Process a session in a child process: seconds by stage, processor time, that of the checks, and peak memory."""
    chosen = [word for setting in settings for word in ("--set", setting)]
    stages: dict[str, float] = {}
    outcome: dict[str, Any] = {}
    checks: dict[str, float] = {}
    began = time.monotonic()
    # Standard error goes to a file: nobody reads it meanwhile, and a full pipe would block the child.
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "ringdic_controller.studies.bench.checks", str(session), *chosen],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        assert child.stdout is not None
        before, since = "start", began
        for line in child.stdout:
            message = json.loads(line)
            outcome, checks = message if "state" in message else outcome, message.get("checks", checks)
            stage, now = message.get("stage", before), time.monotonic()
            if stage != before:
                stages[before] = stages.get(before, 0.0) + now - since
                before, since = stage, now
        used = _ended(child)
        stages[before] = stages.get(before, 0.0) + time.monotonic() - since
        if outcome.get("state") != "done":
            errors.seek(0)
            raise ComputationError(f"{session}: the job failed: {outcome.get('error') or errors.read()[-500:]}")
    results = session / "results" / outcome["run"]
    matches_size = sum(path.stat().st_size for path in (session / "work").glob("*.npz"))
    size = (results / "results.h5").stat().st_size
    shutil.rmtree(results)
    share = sum(checks.values()) / used["cpu"] if used["cpu"] else None
    return {
        "wall": time.monotonic() - began, **used, "seconds": stages, "checks": checks, "checks_share": share,
        "faces": outcome["summary"].get("faces"), "kept_mb": matches_size / _MB, "results_mb": size / _MB,
    }  # fmt: skip


def _ended(child: subprocess.Popen[str]) -> dict[str, float | None]:
    """Wait for the child; its processor time, s, and peak memory, 1e6 bytes, None where the system reports none."""
    if not hasattr(os, "wait4"):
        child.wait()
        return {"cpu": None, "peak_mb": None}
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 if sys.platform == "darwin" else 1024
    return {"cpu": usage.ru_utime + usage.ru_stime, "peak_mb": usage.ru_maxrss * unit / _MB}


def _lines(runs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Time and memory for each further step: slopes of straight lines over the number of steps."""
    if len(runs) < 2 or any(run["cpu"] is None for run in runs):
        return {}
    steps = [run["steps"] for run in runs]
    slope = {name: float(np.polyfit(steps, [run[name] for run in runs], 1)[0]) for name in ("wall", "cpu", "peak_mb")}
    return {
        "seconds_per_step": slope["wall"],
        "cpu_seconds_per_step": slope["cpu"],
        "peak_mb_per_step": slope["peak_mb"],
    }


def _told(run: Mapping[str, Any]) -> str:
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in run["seconds"].items())
    return (
        f"{run['steps']} images a camera: {run['wall']:.1f} s ({stages})"
        + ("" if run["cpu"] is None else f", {run['cpu']:.1f} CPU-s, peak {run['peak_mb']:,.0f} MB")
        + f", {run['kept_mb']:.0f} MB of matches kept, results {run['results_mb']:.0f} MB"
    )


def _told_checks(run: Mapping[str, Any]) -> str:
    """The processor time of the checks of a job, each with its share of the whole."""
    parts = [
        f"{name} {seconds:.2f}" + (f" ({100 * seconds / run['cpu']:.1f} %)" if run["cpu"] else "")
        for name, seconds in run["checks"].items()
    ]
    share = "" if run["checks_share"] is None else f", {100 * run['checks_share']:.1f} % of the job's"
    return f"its checks: {sum(run['checks'].values()):.2f} CPU-s{share}: {', '.join(parts)}"
