"""A job on a cluster: real scheduler and worker processes on loopback, one killed in the middle, a driver killed.

Three neighbouring cameras of the simulated ring, so two pairs, at a fifth of the images' size.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.jobs.pipeline import process_session
from ringdic.results.reader import read_results
from ringdic.results.results import Results
from ringdic.settings import load_settings
from ringdic.tasks import Executor, LocalExecutor, OnTaskEnd, Task, TaskReport, work_folder
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import VirtualRig, paper_rig
from ringdic_node.virtual_rig.scenes import scene

distributed = pytest.importorskip("distributed", reason="SKIPPED FOR WANT OF A LIBRARY: install the extra 'cluster'")
from ringdic.errors import ComputationError, InputError  # noqa: E402
from ringdic.jobs.cluster import ClusterExecutor  # noqa: E402 - after the check above

SCALE = 0.2
STEPS = 4  # with the reference
TASKS = 8 + 3 * (STEPS - 1)  # depth map and chart of each of three cameras, poses, surface, and each later step of each
SETTINGS = ["correlation.radius_px=10", "correlation.step_px=5"]
Workers = Callable[..., "Worker"]


class Worker:
    """A worker process."""

    def __init__(self, address: str, name: str, folder: Path, path: Path | None = None) -> None:
        environment = os.environ if path is None else {**os.environ, "PYTHONPATH": str(path)}
        command = [
            sys.executable,
            "-P",
            "-m",
            "dask",
            "worker",
            address,
            "--no-nanny",
            "--nthreads",
            "1",
            "--name",
            name,
        ]
        local = ["--no-dashboard", "--local-directory", str(folder), "--death-timeout", "60"]
        self.name = name
        with open(folder / f"{name}.log", "ab") as log:
            self.process = subprocess.Popen([*command, *local], stderr=log, stdout=log, env=environment, cwd=folder)


def end(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(15)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(15)


def until(condition: Callable[[], object], timeout: float, why: str) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, why
        time.sleep(0.02)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a running scheduler."""
    folder = tmp_path_factory.mktemp("scheduler")
    file = folder / "scheduler.json"
    command = [sys.executable, "-P", "-m", "dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    with open(folder / "log", "wb") as log:
        process = subprocess.Popen([*command, "--scheduler-file", str(file)], stderr=log, stdout=log, cwd=folder)
    try:
        until(file.is_file, 60, "the scheduler did not start")
        yield json.loads(file.read_text())["address"]
    finally:
        end(process)


@contextmanager
def started(scheduler: str, folder: Path) -> Iterator[Workers]:
    """Call it to start a worker and wait until the scheduler knows it; all end with the block."""
    running: list[Worker] = []
    with distributed.Client(scheduler, set_as_default=False) as client:
        before = len(client.nthreads())

        def start(path: Path | None = None) -> Worker:
            worker = Worker(scheduler, f"{folder.name}-{len(running)}", folder, path)
            running.append(worker)
            until(lambda: len(client.nthreads()) >= before + len(running), 60, "a worker did not start")
            return worker

        yield start
        for worker in running:
            end(worker.process)
        until(lambda: len(client.nthreads()) <= before, 60, "a worker did not end")


@pytest.fixture(scope="module")
def crew(scheduler: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The scheduler's address, with two workers that stay."""
    with started(scheduler, tmp_path_factory.mktemp("crew")) as start:
        start(), start()
        yield scheduler


@pytest.fixture(scope="module")
def source(ringdic: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session, calibrated but not matched: one camera in the middle, two pairs."""
    folder = tmp_path_factory.mktemp("source")
    rig = VirtualRig(paper_rig(12, SCALE).cameras[:3])
    (folder / "src").mkdir()
    pairs = '[pairs]\npairs = [["cam_01", "cam_02"], ["cam_02", "cam_03"]]\n'
    (folder / "src" / "rig.toml").write_text(rig.rig_toml() + pairs, encoding="utf-8")

    def write(path: Path, image: np.ndarray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), image)

    for camera in rig.cameras:
        for pose in range(4):
            write(folder / "src" / "board" / camera.id / f"{pose}.png", render(camera, scene("board", pose), pose))
        write(folder / "src" / "target" / f"{camera.id}.png", render(camera, scene("target", 0), 1))
        for step in range(STEPS):
            write(folder / "src" / "specimen" / camera.id / f"{step}.png", render(camera, scene("specimen", step), 2))
    ringdic("import", folder / "src", folder / "session")
    return folder / "session"


def settings(*more: str):
    return load_settings(None, [*SETTINGS, *more])


@pytest.fixture(scope="module")
def local(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Results:
    """What this machine alone finds. The calibration that it leaves in the session serves all."""
    results = read_results(process_session(source, settings()) / "results.h5")
    shutil.rmtree(source / "work")
    shutil.rmtree(source / "results")
    return results


@pytest.fixture
def session(source: Path, local: Results, tmp_path: Path) -> Path:
    return Path(shutil.copytree(source, tmp_path / "session"))


class Counted:
    """An executor that counts which tasks were made and which were found done."""

    def __init__(self, executor: Executor, watch: Callable[[int], None] = lambda done: None) -> None:
        self._executor = executor
        self._watch = watch
        self.made = 0
        self.found = 0

    def run(self, tasks: Sequence[Task], on_end: OnTaskEnd) -> None:
        def count(task: Task, report: TaskReport, done: int, total: int) -> None:
            self.made += report.computed
            self.found += not report.computed
            self._watch(done)
            on_end(task, report, done, total)

        self._executor.run(tasks, count)


def same(found: Path, expected: Results) -> None:
    """Every number of a run is the other's, to the last bit."""
    results = read_results(found / "results.h5")
    assert results.steps == expected.steps
    for name in ("vertices_ref", "vertices", "faces", "pair", "correlation", "sigma_xyz", "status"):
        assert np.array_equal(getattr(results, name), getattr(expected, name), equal_nan=name != "status"), name
    assert np.isfinite(results.vertices).mean() > 0.5
    for one, other in zip(results.matches, expected.matches, strict=True):
        assert np.array_equal(one.px, other.px, equal_nan=True)


@pytest.fixture
def refused_address() -> str:
    """Where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp://127.0.0.1:{probe.getsockname()[1]}"


def test_a_cluster_that_cannot_be_used_is_refused_with_a_sentence(
    session: Path, scheduler: str, refused_address: str, ringdic: Callable
) -> None:  # first: while the scheduler has no worker yet
    for address, told in (
        (scheduler, "has no worker; start one on each machine with 'dask worker"),
        (refused_address, "no scheduler answers at"),
        ("nonsense://x", "no address of a scheduler"),
    ):
        done = ringdic("process", session, "--cluster", address, "--json", code=2)
        sentences = [line for line in done.stderr.splitlines() if "%" not in line]
        assert len(sentences) == 1, done.stderr
        assert told in sentences[0]
    with pytest.raises(ComputationError, match="has had no worker for 0 s"):
        process_session(session, settings(), executor=ClusterExecutor(scheduler, idle_s=0.5))


def test_a_cluster_finds_what_one_machine_finds(session: Path, local: Results, crew: str, ringdic: Callable) -> None:
    options = [each for name in SETTINGS for each in ("--set", name)]
    done = ringdic("process", session, *options, "--cluster", crew, "--json", timeout_s=300)
    same(Path(json.loads(done.stdout)["run"]), local)
    assert re.search(rf"correlate  camera .* of {TASKS}\)", done.stderr), "the progress tells of the tasks"
    assert [path.name for path in (session / "work").iterdir() if path.suffix != ".npz"] == [], (
        "no file of the handshake is left"
    )


def test_a_worker_killed_in_the_middle_costs_only_its_tasks(
    session: Path, local: Results, crew: str, tmp_path: Path
) -> None:
    with distributed.Client(crew, set_as_default=False) as client, started(crew, tmp_path) as start:
        crew_members = set(client.nthreads())
        victim = start()
        (address,) = set(client.nthreads()) - crew_members

        def kill(done: int) -> None:
            if done < TASKS - 1 and victim.process.poll() is None and client.processing()[address]:
                victim.process.send_signal(signal.SIGKILL)
                victim.process.wait(10)

        executor = Counted(ClusterExecutor(crew), kill)
        run = process_session(session, settings(), executor=executor)
        assert victim.process.returncode == -signal.SIGKILL, "it had a task and was killed at it"
        assert set(client.nthreads()) == crew_members
    same(run, local)
    assert executor.made + executor.found == TASKS


def test_a_job_whose_driver_was_killed_makes_only_what_is_missing(session: Path, local: Results, crew: str) -> None:
    options = [each for name in SETTINGS for each in ("--set", name)]
    command = [sys.executable, "-P", "-m", "ringdic", "process", str(session), *options, "--cluster", crew]
    driver = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    outputs = work_folder(session)
    try:
        until(lambda: len(list(outputs.glob("*.npz"))) >= 3, 200, "nothing was made")
    finally:
        driver.kill()
        driver.wait(10)
    with distributed.Client(crew, set_as_default=False) as client:  # what a worker was at, it ends
        until(lambda: not any(client.processing().values()), 60, "the tasks of the dead driver go on")
        until(lambda: not any(client.run(lambda dask_worker: len(dask_worker.state.executing)).values()), 60, "busy")
    kept = len(list(outputs.glob("*.npz")))
    assert 3 <= kept < TASKS
    again = Counted(ClusterExecutor(crew))
    same(process_session(session, settings(), executor=again), local)
    assert (again.made, again.found) == (TASKS - kept, kept)
    nothing = Counted(LocalExecutor())
    same(process_session(session, settings(), executor=nothing), local)
    assert (nothing.made, nothing.found) == (0, TASKS), "another executor knows the same tasks"


def test_a_worker_with_another_version_is_refused_by_name_and_left_out(
    session: Path, local: Results, crew: str, tmp_path: Path, caplog
) -> None:
    other = tmp_path / "other"
    shutil.copytree(Path.cwd() / "processing" / "ringdic", other / "ringdic")
    with open(other / "ringdic" / "errors.py", "a", encoding="utf-8") as file:
        file.write("\n# another version\n")
    executor = ClusterExecutor(crew)
    executor.check(session)
    with started(crew, tmp_path) as start:
        start(other)
        with pytest.raises(InputError, match=r"worker tcp://\S+ cannot be used: it runs another version of ringdic"):
            executor.check(session)
        # As if it had joined later: the job ends without it.
        same(process_session(session, settings(), executor=executor), local)
    assert "is left out: it runs another version" in caplog.text
