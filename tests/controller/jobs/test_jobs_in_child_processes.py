"""Jobs run one at a time in child processes; they can be cancelled, superseded, and they tell how they went."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Thread

import pytest
from ringdic_controller.jobs.jobs import Job, Jobs

TALK = """
import json, sys, time
print(json.dumps({"stage": "calibrate", "done": 0.25, "rate": "3 views/s", "left_s": 9.0, "message": "camera 201"}))
print("a line of log with ångström")
print("{not json", file=sys.stderr)
"""
DONE = 'print(json.dumps({"state": "done", "run": "0004", "summary": {}}))'

DONE_AT_ONCE = "import json\n" + DONE


class Recorder:
    """List of all changes that are reported; complete once the jobs are closed."""

    def __init__(self) -> None:
        self.changes: list[Job] = []

    def __call__(self, job: Job) -> None:
        self.changes.append(job)

    def states(self, job_id: str) -> list[str]:
        """States of one job in order, each once."""
        return list(dict.fromkeys(job.state for job in self.changes if job.id == job_id))


def jobs_of(folder: Path, script: str, recorder: Recorder | None = None) -> Jobs:
    return Jobs(folder, lambda session: [sys.executable, "-c", script, str(session)], recorder or Recorder())


def test_a_job_reports_its_stage_and_keeps_the_rest_as_log(tmp_path: Path) -> None:
    recorder = Recorder()
    jobs = jobs_of(tmp_path, TALK + DONE, recorder)
    job = jobs.wait(jobs.submit("limb", tmp_path, reason="asked for").id, 20)
    jobs.close()
    assert (job.state, job.run, job.done, job.error) == ("done", "0004", 1.0, None)
    assert recorder.states(job.id) == ["queued", "running", "done"]
    progress = next(change for change in recorder.changes if change.stage == "calibrate")
    assert (progress.done, progress.rate, progress.left_s, progress.message) == (0.25, "3 views/s", 9.0, "camera 201")
    stage, *rest = jobs.log(job.id).splitlines()
    assert stage.split(" ", 1)[1] == "calibrate camera 201"
    assert rest == ["a line of log with ångström", "{not json"]


@pytest.mark.parametrize(
    ("end", "sentence"),
    [
        (
            'print(json.dumps({"state": "failed", "error": "camera 203 sees no board"})); sys.exit(2)',
            "203 sees no board",
        ),
        ("sys.exit(7)", "exit code 7"),
        ("pass", "exit code 0"),  # ended well without saying what it made
    ],
)
def test_a_job_that_fails_says_why(tmp_path: Path, end: str, sentence: str) -> None:
    jobs = jobs_of(tmp_path, TALK + end)
    job = jobs.wait(jobs.submit("limb", tmp_path, reason="asked for").id, 20)
    assert job.state == "failed"
    assert sentence in (job.error or "")
    jobs.close()


def test_a_program_that_is_not_there_fails_its_job_and_the_next_is_run(tmp_path: Path) -> None:
    commands = iter([["/no/such/program"], [sys.executable, "-c", DONE_AT_ONCE]])
    jobs = Jobs(tmp_path, lambda _: next(commands))
    first, second = (jobs.submit("limb", tmp_path, reason="asked for") for _ in range(2))
    assert jobs.wait(second.id, 20).state == "done"
    assert "could not be started" in (jobs.get(first.id).error or "")
    jobs.close()


def test_a_running_job_is_cancelled_with_everything_it_started(tmp_path: Path) -> None:
    script = """
import json, os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
open(sys.argv[1] + "/pid", "w").write(str(child.pid))
print(json.dumps({"stage": "correlate", "done": 0.5}))
time.sleep(60)
"""
    recorder = Recorder()
    jobs = jobs_of(tmp_path, script, recorder)
    job = jobs.submit("limb", tmp_path, reason="asked for")
    _until(lambda: jobs.get(job.id).stage == "correlate")
    grandchild = int((tmp_path / "pid").read_text())
    assert jobs.cancel(job.id).state == "cancelled"
    _until(lambda: _gone(grandchild))
    assert jobs.cancel(job.id).state == "cancelled"
    jobs.close()
    assert recorder.states(job.id) == ["queued", "running", "cancelled"]


def test_a_newer_capture_takes_the_place_of_a_waiting_job_but_not_of_others(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    script = f"import json, os, time\nwhile not os.path.exists({str(gate)!r}): time.sleep(0.02)\n{DONE}"
    jobs = jobs_of(tmp_path / "jobs", script)
    running = jobs.submit("limb", tmp_path, reason="0004-specimen", automatic=True)
    _until(lambda: jobs.get(running.id).state == "running")
    waiting = jobs.submit("limb", tmp_path, reason="0005-specimen", automatic=True)
    other = jobs.submit("plate", tmp_path, reason="0004-specimen", automatic=True)
    asked = jobs.submit("limb", tmp_path, reason="asked for")
    newest = jobs.submit("limb", tmp_path, reason="0006-specimen", automatic=True)
    gate.touch()
    assert jobs.wait(newest.id, 30).state == "done"
    states = {job.id: job.state for job in jobs.list()}
    expected = {running.id: "done", waiting.id: "superseded", other.id: "done", asked.id: "done", newest.id: "done"}
    assert states == expected
    jobs.close()


def test_a_waiting_job_can_be_cancelled_and_never_starts(tmp_path: Path) -> None:
    script = "import json, sys, time\ntime.sleep(0.5)\nopen(sys.argv[1], 'w').close()\n" + DONE
    jobs = jobs_of(tmp_path / "jobs", script)
    first = jobs.submit("a", tmp_path / "a", reason="asked for")
    second = jobs.submit("b", tmp_path / "b", reason="asked for")
    assert jobs.cancel(second.id).state == "cancelled"
    jobs.wait(first.id, 20)
    third = jobs.submit("c", tmp_path / "c", reason="asked for")
    jobs.wait(third.id, 20)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "c", "jobs"]
    jobs.close()


def test_changes_are_reported_in_their_order_with_the_queue_free(tmp_path: Path) -> None:
    changes: list[Job] = []
    listings: list[int] = []

    def ask_from_elsewhere(job: Job) -> None:
        changes.append(job)
        other = Thread(target=lambda: listings.append(len(jobs.list())))
        other.start()
        other.join(20)  # would last as long if the queue were locked

    jobs = Jobs(tmp_path, lambda session: [sys.executable, "-c", DONE_AT_ONCE], ask_from_elsewhere)
    ids = [jobs.submit("limb", tmp_path, reason="asked for").id for _ in range(3)]
    jobs.wait(ids[-1], 20)
    jobs.close()
    assert len(listings) == len(changes)
    for job_id in ids:
        assert [job.state for job in changes if job.id == job_id] == ["queued", "running", "done"]


def test_jobs_outlive_the_controller_and_an_unfinished_one_has_failed(tmp_path: Path) -> None:
    jobs = jobs_of(tmp_path, TALK + DONE)
    done = jobs.wait(jobs.submit("limb", tmp_path, reason="asked for").id, 20)
    jobs.close()
    record = (tmp_path / done.id / "job.json").read_text()
    (tmp_path / "0002").mkdir()
    interrupted = record.replace('"0001"', '"0002"').replace('"state": "done"', '"state": "running"')
    (tmp_path / "0002" / "job.json").write_text(interrupted)
    again = jobs_of(tmp_path, TALK + DONE)
    assert again.get(done.id) == done
    assert again.get("0002").state == "failed"
    assert again.submit("limb", tmp_path, reason="asked for").id == "0003"
    again.close()


def _until(condition) -> None:
    import time

    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline, "it never came about"
        time.sleep(0.02)


def _gone(pid: int) -> bool:
    """Whether a process has ended (a zombie that nobody waits for has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True
