"""What makes a process fit to work for a cluster's job, without any cluster."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from ringdic.compiled import source_digest
from ringdic.errors import InputError
from ringdic.jobs.cluster import ClusterExecutor, worker
from ringdic.jobs.cluster.worker import Handshake, TaskOutcome, inspect, run_task, visible
from ringdic.tasks import Task, read_output


@pytest.fixture
def handshake(tmp_path: Path) -> Handshake:
    (tmp_path / "sign").write_text("here", encoding="utf-8")
    return Handshake(source_digest(), tmp_path / "sign", "here")


def test_a_process_that_sees_the_folder_and_has_the_version_is_fit(handshake: Handshake):
    assert inspect(handshake) is None


def test_what_makes_a_process_unfit_is_told(handshake: Handshake, tmp_path: Path):
    assert "another version" in str(inspect(replace(handshake, stamp="0" * 32)))
    elsewhere = replace(handshake, file=tmp_path / "not-mounted" / "sign")
    assert f"does not see the folder {tmp_path / 'not-mounted'}" in str(inspect(elsewhere))
    # A folder of the same path on the worker's own disk is not the driver's.
    assert "does not see the folder" in str(inspect(replace(handshake, text="there")))


def test_a_file_that_another_machine_shows_late_is_waited_for(tmp_path: Path):
    late = tmp_path / "late"
    threading.Timer(0.3, late.touch).start()
    assert visible(late.is_file, tmp_path, limit=20.0)
    began = time.monotonic()
    assert not visible((tmp_path / "never").is_file, tmp_path, limit=0.1)
    assert time.monotonic() - began < 10.0


def threads_seen(*, inputs: tuple[Path, ...]) -> dict[str, np.ndarray]:
    del inputs
    return {"threads": np.array(numba.get_num_threads())}


@pytest.mark.parametrize(("share", "threads"), [(8, 1), (1, 2)])
def test_a_tasks_kernels_take_their_share_and_no_more_than_the_worker_has(
    handshake: Handshake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: int, threads: int
):
    monkeypatch.setattr(worker, "_worker", lambda: ("tcp://here", threads))
    task = Task("k", "a task", threads_seen, (), tmp_path)
    outcome: list[TaskOutcome] = []
    thread = threading.Thread(
        target=lambda: outcome.append(run_task(task, handshake, share))
    )  # numba's number is a thread's
    thread.start()
    thread.join(60)
    assert outcome[0].report is not None
    assert read_output(task.output)["threads"] == 1


def test_an_input_that_cannot_be_used_is_no_fault_of_the_worker(
    handshake: Handshake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(worker, "_worker", lambda: ("tcp://here", 1))

    def refuse(*, inputs: tuple[Path, ...]) -> dict[str, np.ndarray]:
        raise InputError("board.png: cut off")

    outcome = run_task(Task("k", "a task", refuse, (), tmp_path), handshake, 1)
    assert (outcome.input_error, outcome.refusal, outcome.report) == ("board.png: cut off", None, None)


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "distributed", None)  # as if it were not installed
    with pytest.raises(InputError, match=r"pip install 'ringdic\[cluster\]'"):
        ClusterExecutor("tcp://127.0.0.1:8786")


def test_who_asks_for_no_cluster_loads_no_dask():
    loaded = """import sys, ringdic.cli.app, ringdic.jobs.pipeline, ringdic.jobs.cluster
ringdic.cli.app.application()
print("dask" in sys.modules)"""
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "False"
