"""The demo step by step: start the rig, capture, process, compare with the truth, serve the page."""

from __future__ import annotations

import json
import signal
import time
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

from ringdic.cli.console import say, show_table
from ringdic.jobs.compiling import compile_once
from ringdic.progress import Progress, Report, progress_bar
from ringdic.session.folder import newest_results
from ringdic.session.rig import parse_rig
from ringdic.settings import Settings
from ringdic_node.virtual_rig.render import load_renderer
from ringdic_node.virtual_rig.rig import VirtualRig, paper_rig, write_truth
from ringdic_node.virtual_rig.scenes import Limb

from ringdic_controller.studies.demo.client import Client
from ringdic_controller.studies.demo.comparison import compare_with_truth
from ringdic_controller.studies.demo.rig import Setting, check_alive, running_controller, running_nodes

BOARDS = 8  # views of the checkerboard a camera
_START = 300.0  # seconds for all nodes to load their renderer on a busy machine
_JOB = 3600.0  # seconds that processing may take


def run_demo(folder: Path, *, cameras: int, scale: float, steps: int, serve: bool) -> dict[str, Any]:
    """Run the demo in ``folder`` and return the table of measured against true as JSON values.

    Every run makes a folder of its own inside. With ``serve`` the page stays up until Ctrl-C.
    """
    began = time.monotonic()
    signal.signal(signal.SIGTERM, _leave)
    setting = Setting(_new_folder(folder), cameras, scale)
    rig = paper_rig(cameras, scale, setting.seed)
    say(f"a simulated ring of {cameras} cameras of {rig.cameras[0].width} x {rig.cameras[0].height} px")
    with progress_bar() as report:  # once here, so that the nodes and the controller load all kernels from the cache
        compile_once(lambda done, count, _: report(Progress("compile", done / count, f"{done} of {count} parts, once")))
    load_renderer()
    write_truth(rig, setting.folder)
    name = parse_rig(rig.rig_toml()).name
    ids = [camera.id for camera in rig.cameras]
    with (
        running_controller(setting.folder, rig.rig_toml(), settings_for(scale)) as running,
        running_nodes(setting.folder, name, setting.node_tables(ids), running.endpoint) as nodes,
    ):
        client, address = Client(running.address), running.address
        client.wait_for_nodes(ids, _START, lambda: check_alive(nodes, setting.folder))
        say(f"{cameras} nodes and the controller are up; the page is at {address}")
        session = client.post("/sessions", {"name": "demo"})["name"]
        with progress_bar() as report:
            _capture_all(client, steps, report)
            _follow(client, session, report)
        comparison = _compare(setting, session, rig, began)
        if serve:
            say(f"the result is on the page: {address}  (Ctrl-C ends)")
            _wait_for_ctrl_c()
    return comparison


def _leave(signum: int, _: FrameType | None) -> None:
    """End in the way of Ctrl-C, so that the ``with`` blocks stop the processes of the rig."""
    raise SystemExit(128 + signum)


def _capture_all(client: Client, steps: int, report: Report) -> None:
    """Capture boards, target, reference and steps; each step is shown on the page while the next are captured."""
    kinds = ["board"] * BOARDS + ["target"] + ["specimen"] * (steps + 1)
    for k, kind in enumerate(kinds):
        report(Progress("capture", k / len(kinds), f"{kind}, capture {k + 1} of {len(kinds)}"))
        record = client.capture(kind)
        failed = {id_: entry["reason"] for id_, entry in record["cameras"].items() if entry["status"] == "failed"}
        if failed:
            say(f"{record['capture_id']}: {', '.join(f'{id_} failed ({reason})' for id_, reason in failed.items())}")
    report(Progress("capture", 1.0, f"{len(kinds)} captures archived"))


def _follow(client: Client, session: str, report: Report) -> None:
    def watch(job: dict[str, Any]) -> None:
        if job["stage"]:
            report(Progress(job["stage"], job["done"], job["message"], job["rate"], job["left_s"]))

    client.follow_job(client.post("/jobs", {"session": session})["id"], watch, _JOB)


def _compare(setting: Setting, session: str, rig: VirtualRig, began: float) -> dict[str, Any]:
    """Print the table of measured against true values and write it to ``comparison.json``."""
    results = newest_results(setting.archive / session)
    figures = compare_with_truth(results, Limb())
    summary = json.loads((results.parent / "summary.json").read_text(encoding="utf-8"))
    show_table(f"session {session}: {setting.archive / session}", summary["table"])
    show_table("the virtual rig knows the truth", [figure.row() for figure in figures])
    seconds = time.monotonic() - began
    say(f"from start to result: {seconds:.0f} s")
    comparison = {
        "session": str(setting.archive / session),
        "cameras": len(rig.cameras),
        "seconds": round(seconds, 1),
        "control_points_rms_mm": summary["control_points"]["rms_mm"],
        "figures": [figure.to_dict() for figure in figures],
    }
    (setting.folder / "comparison.json").write_text(json.dumps(comparison, indent=1, ensure_ascii=False))
    return comparison


def settings_for(scale: float) -> Settings:
    """The default settings for images of another scale; the subsets keep the least size that they need."""
    return Settings().at_scale(scale)


def _new_folder(folder: Path) -> Path:
    """Create a new folder, named by the time, for this run."""
    stamp = datetime.now().strftime("%Y-%m-%d-%H%M%S")
    for k in range(100):
        path = Path(folder) / (stamp if k == 0 else f"{stamp}-{k}")
        try:
            path.mkdir(parents=True)
            return path.resolve()
        except FileExistsError:
            continue
    raise FileExistsError(f"{folder}: no free name for a new run")


def _wait_for_ctrl_c() -> None:
    try:
        while True:
            time.sleep(1.0)
    except KeyboardInterrupt:
        say("ended")
