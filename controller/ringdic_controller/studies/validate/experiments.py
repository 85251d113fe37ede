"""The paper's experiments in order: images, sessions, both ways of processing, figures."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ringdic.calibration.calibrated_rig import CalibratedRig, calibrate_rig
from ringdic.geometry.camera import Camera
from ringdic.jobs.pipeline import process_session
from ringdic.progress import Progress, Report, silent
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.session.folder import open_session
from ringdic.session.rig import Rig, parse_rig
from ringdic.settings import CalibrationGroup, Settings
from ringdic_node.virtual_rig.scenes import Cylinder, Specimen

from ringdic_controller.studies.validate.calibration import ExactRays, figure_6, table_1, table_2, true_camera
from ringdic_controller.studies.validate.cylinder import (
    CylinderRun,
    diameter,
    diameter_with_print_errors,
    figure_7a,
    figure_7b,
    separate_errors,
)
from ringdic_controller.studies.validate.figures import PAPER, Figure, Findings
from ringdic_controller.studies.validate.folders import make_session
from ringdic_controller.studies.validate.image_cache import ImageCache, RenderedShot
from ringdic_controller.studies.validate.limb import LimbRun, compare_spoilt, figure_9
from ringdic_controller.studies.validate.scenery import Scenery

#: Kinds of capture of the scenes of an experiment.
_KINDS = {"boards": "board", "target": "target", "printed": "target"}
EXPERIMENTS = ("calibration", "cylinder", "printed", "limb", "spoilt")
_SCENES = {
    "calibration": ("boards", "target"),
    "cylinder": ("boards", "target", "cylinder"),
    "printed": ("boards", "printed", "cylinder"),
    "limb": ("boards", "target", "limb"),
    "spoilt": ("boards", "target", "spoilt"),
}


@dataclass
class Validation:
    """The experiments on one simulated rig: renders, calibrates and processes them, and gathers their figures.

    folder : receives images, sessions and results. scenery : scenes and views. ways : settings of the processing by
    name. Existing sessions, and results made with the same settings, are used again, even if the program has changed
    since; remove ``sessions/*/results`` to process again.
    """

    folder: Path
    scenery: Scenery
    ways: Mapping[str, Settings]
    report: Report = silent
    clock: Callable[[], float] = time.monotonic
    seconds: dict[str, float] = field(default_factory=dict)
    rig: Rig = field(init=False)
    true: dict[str, Camera] = field(init=False)

    def __post_init__(self) -> None:
        self.rig = parse_rig(self.scenery.rig.rig_toml())
        self.true = {camera.id: true_camera(camera) for camera in self.scenery.rig.cameras}
        self.image_cache = ImageCache(self.folder / "images")

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Adjacent pairs of the ring."""
        return self.rig.pairs

    def run(self, experiments: Sequence[str] = EXPERIMENTS) -> dict[str, Findings]:
        """Run the experiments; figures and curves by table or figure of the paper."""
        findings: dict[str, Findings] = {}
        rings = self._rings()
        if "calibration" in experiments:
            findings |= self._calibration(rings)
        if "cylinder" in experiments:
            findings |= self._cylinder(rings)
        if "printed" in experiments:
            runs = {way: CylinderRun.of(results) for way, results in self._process("printed", 1).items()}
            findings["printed"] = diameter_with_print_errors(runs)
        if "limb" in experiments or "spoilt" in experiments:
            findings |= self._limb("spoilt" in experiments)
        return findings

    def render(self, experiments: Sequence[str] = EXPERIMENTS) -> None:
        """Render the images of these experiments that are missing."""
        for name in dict.fromkeys(("moved", *(name for each in experiments for name in _SCENES[each]))):
            self._render_missing(name)

    def _calibration(self, rings: Mapping[str, CalibratedRig]) -> dict[str, Findings]:
        self._render_missing("moved")
        images = {id_: self.image_cache.path(shot) for id_, shot in self.scenery.shots("moved")[0].items()}
        uncorrected = {"paper's, no correction": self._uncorrected()} if PAPER in self.ways else {}
        return {
            "table_1": table_1(rings, self.true, self.scenery.scale),
            "table_2": table_2({**rings, **uncorrected}, self.pairs),
            "figure_6": figure_6({**rings, **uncorrected}, self.rig, images, self.pairs),
        }

    def _cylinder(self, rings: Mapping[str, CalibratedRig]) -> dict[str, Findings]:
        results = self._process("cylinder")
        runs = {way: CylinderRun.of(each) for way, each in results.items()}
        uncorrected = {id_: each.camera for id_, each in self._uncorrected().cameras.items()}
        rays = ExactRays.of(self.true, self.pairs)
        return {
            "diameter": diameter(runs, self.pairs),
            "apart": separate_errors(runs, rays, self.true, uncorrected),
            "figure_7a": figure_7a(runs, self.pairs),
            "figure_7b": figure_7b(runs, Cylinder(), self.pairs),
        }

    def _limb(self, with_spoilt: bool) -> dict[str, Findings]:
        cameras = self.scenery.rig.cameras
        scenes = _specimens(self.scenery, "limb")
        clean = {way: LimbRun.of(results, scenes) for way, results in self._process("limb").items()}
        findings = {"figure_9": figure_9(clean, scenes, cameras)}
        if with_spoilt:
            scenes = _specimens(self.scenery, "spoilt")
            runs = {way: LimbRun.of(results, scenes) for way, results in self._process("spoilt").items()}
            findings["spoilt"] = compare_spoilt(runs, clean, scenes, cameras)
        return findings

    def _rings(self) -> dict[str, CalibratedRig]:
        """The cameras as calibrated by each way; all other sessions take the calibrations over from this one."""
        session = open_session(self._session("calibration"))
        rings = {}
        for way, settings in self.ways.items():
            began = self.clock()
            rings[way] = calibrate_rig(session, settings.calibration, self._step(f"calibrate, {way}"))
            self._add_seconds(f"calibration, {way}", began)
        return rings

    def _uncorrected(self) -> CalibratedRig:
        session = open_session(self._session("calibration"))
        return calibrate_rig(session, CalibrationGroup(method="dlt", distortion=False))

    def _process(self, name: str, steps: int | None = None) -> dict[str, Results]:
        """Results of an experiment by every way; a run that exists with the same settings is only read."""
        session = self._session(name, steps)
        findings = {}
        for way, settings in self.ways.items():
            if way == PAPER and name == "cylinder":  # the pairs' surfaces are compared where they overlap
                surface = settings.surface.model_copy(update={"merge": "none"})
                settings = settings.model_copy(update={"surface": surface})
            run = _run_with(session, settings)
            if run is None:
                began = self.clock()
                run = process_session(session, settings, self._renamed(f"{name}, {way}"))
                self._add_seconds(f"{name}, {way}", began)
            findings[way] = read_results(run / "results.h5")
        return findings

    def _session(self, name: str, steps: int | None = None) -> Path:
        captures: list[tuple[str, Mapping[str, RenderedShot]]] = []
        for scenes in _SCENES[name]:
            self._render_missing(scenes)
            kind = _KINDS.get(scenes, "specimen")
            shots = self.scenery.shots(scenes)
            captures += [(kind, each) for each in (shots[:steps] if kind == "specimen" else shots)]
        calibrated = self.folder / "sessions" / "calibration"
        path = self.folder / "sessions" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return make_session(
            path,
            self.scenery.rig.rig_toml(),
            captures,
            self.image_cache,
            calibration=None if path == calibrated else calibrated,
        )

    def _render_missing(self, name: str) -> None:
        shots = [shot for scene in self.scenery.shots(name) for shot in scene.values()]
        began = self.clock()
        rendered = sum(not self.image_cache.path(shot).is_file() for shot in shots)
        self.image_cache.render_missing(shots, lambda done: self.report(Progress("render", done, name)))
        if rendered:
            self._add_seconds(f"render {name}, {rendered} images", began)

    def _step(self, stage: str) -> Callable[[float, str], None]:
        return lambda done, message: self.report(Progress(stage, done, message))

    def _renamed(self, what: str) -> Report:
        def report(progress: Progress) -> None:
            message = f"{progress.stage} {progress.message}".strip()
            self.report(Progress(what, progress.done, message, progress.rate, progress.left_s))

        return report

    def _add_seconds(self, what: str, began: float) -> None:
        self.seconds[what] = round(self.seconds.get(what, 0.0) + self.clock() - began, 1)


def figures(findings: Mapping[str, Findings]) -> list[Figure]:
    """The figures of all experiments in one list."""
    return [figure for each in findings.values() for figure in each.figures]


def _specimens(scenery: Scenery, name: str) -> list[Specimen]:
    return [scene for scene in scenery.scenes(name) if isinstance(scene, Specimen)]


def _run_with(session: Path, settings: Settings) -> Path | None:
    """The newest run of a session that was made with these settings."""
    wanted = settings.to_toml()
    for run in reversed(open_session(session).runs()):
        if (run / "settings.toml").read_text(encoding="utf-8") == wanted:
            return run
    return None
