"""The warm processing: one child carries out order after order; it can be stopped, cancelled, and it may crash."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from ringdic.session.writer import Archive
from ringdic_controller.jobs.children import Order, WarmChild, message_of, serving_command
from ringdic_controller.jobs.jobs import Job, Jobs

# Session's name → what the child does; every child tells its process id as the run.
CHILD = """
import json, os, sys, time, threading, queue
orders, stop = queue.SimpleQueue(), set()
def say(**what): print(json.dumps(what), flush=True)
def read():
    for line in sys.stdin:
        message = json.loads(line)
        stop.add(message["stop"]) if "stop" in message else orders.put(message)
    orders.put(None)
threading.Thread(target=read, daemon=True).start()
say(worker="warming"); say(worker="warming", compiling=True); say(worker="ready", seconds=1.5)
while (order := orders.get()):
    what, number = os.path.basename(order["session"]), order["order"]
    print("log of", what, flush=True)
    say(stage="correlate", done=0.5, message=what + " " + str(order["step"]))
    if what == "crash": os._exit(9)
    until = time.monotonic() + {"slow": 30, "brief": 0.4}.get(what, 0)
    while time.monotonic() < until and number not in stop: time.sleep(0.01)
    if number in stop: say(state="stopped")
    elif what == "bad": say(state="failed", error="camera 203 sees no board")
    else: say(state="done", run=str(os.getpid()))
"""


class Station:
    """Jobs over a warm child."""

    def __init__(self, folder: Path) -> None:
        self.child = WarmChild([sys.executable, "-c", CHILD])
        self.changes: list[Job] = []
        self.folder = folder
        self.jobs = Jobs(folder / "jobs", self.child, self.changes.append)

    def submit(self, what: str, **more) -> str:
        return self.jobs.submit(what, self.folder / what, reason="asked for", **more).id

    def wait(self, job: str) -> Job:
        return self.jobs.wait(job, 20)

    def until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < deadline, "it never came about"
            time.sleep(0.01)

    def states(self, job: str) -> list[str]:
        """States of one job in order, repeats left out."""
        states = [change.state for change in self.changes if change.id == job]
        return [state for k, state in enumerate(states) if k == 0 or state != states[k - 1]]


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    station = Station(tmp_path)
    yield station
    station.jobs.close()


def test_it_warms_before_there_is_work_and_tells_how_long_that_took(station: Station) -> None:
    warmths: list[tuple[str, bool, float | None]] = []
    station.child.on_change = lambda: warmths.append(
        (station.child.warmth.state, station.child.warmth.compiling, station.child.warmth.seconds)
    )
    assert station.child.warmth.state == "cold"
    station.child.warm()
    station.until(lambda: station.child.warmth.state == "ready")
    assert warmths[-2:] == [("warming", True, None), ("ready", False, 1.5)]


def test_one_child_carries_out_job_after_job_and_keeps_their_logs_apart(station: Station) -> None:
    first, bad, last = (station.submit(what) for what in ("a", "bad", "c"))
    assert station.wait(last).run == station.wait(first).run
    assert station.wait(bad).error == "camera 203 sees no board"
    assert "log of a" in station.jobs.log(first)
    assert "log of a" not in station.jobs.log(last)


def test_a_crash_fails_its_job_alone_and_a_new_child_is_warmed(station: Station) -> None:
    before = station.wait(station.submit("a"))
    crashed = station.wait(station.submit("crash"))
    assert crashed.state == "failed"
    assert "exit code 9" in (crashed.error or "")
    station.until(lambda: station.child.warmth.state == "ready")  # without being asked for anything
    after = station.wait(station.submit("a"))
    assert after.state == "done"
    assert after.run != before.run


def test_an_order_that_comes_as_its_child_ends_fails_and_does_not_wait_for_ever(tmp_path: Path) -> None:
    child = WarmChild([sys.executable, "-c", "pass"])
    child.warm()
    serving = child._child
    assert serving is not None
    assert serving.wait() == 0
    deadline = time.monotonic() + 20
    while serving.warmth.state != "ended":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    work = serving.take({"session": str(tmp_path), "step": None, "settings": None})
    assert list(work.lines()) == []
    child.close()


def test_cancelling_ends_the_child_and_the_next_job_gets_a_new_one(station: Station) -> None:
    before = station.wait(station.submit("a"))
    slow, waiting = station.submit("slow"), station.submit("b")
    station.until(lambda: station.jobs.get(slow).stage == "correlate")
    station.jobs.cancel(slow)
    done = station.wait(waiting)
    assert (station.jobs.get(slow).state, done.state) == ("cancelled", "done")
    assert done.run != before.run
    with pytest.raises(ProcessLookupError):
        os.kill(int(before.run or 0), 0)


def test_a_whole_session_gives_way_to_a_step_and_goes_on_afterwards(station: Station, tmp_path: Path) -> None:
    before = station.wait(station.submit("a"))
    whole = station.submit("slow", automatic=True)
    station.until(lambda: station.jobs.get(whole).stage == "correlate")
    step = station.submit("limb", automatic=True, step="0005-specimen")
    assert station.wait(step).run == before.run  # the same child: nothing had to be warmed again
    station.until(lambda: station.states(whole) == ["queued", "running", "queued", "running"])
    station.jobs.cancel(whole)


def test_a_step_goes_before_what_waits_and_only_the_newest_is_processed(station: Station) -> None:
    station.submit("brief", step="0002-specimen")
    whole = station.submit("limb", automatic=True)
    older = station.submit("limb", automatic=True, step="0004-specimen")
    newer = station.submit("limb", automatic=True, step="0005-specimen")
    station.wait(whole)
    assert station.jobs.get(older).state == "superseded"
    station.until(lambda: [job.id for job in station.changes if job.state == "done"][-2:] == [newer, whole])
    another = station.submit("limb", automatic=True, step="0006-specimen")
    station.wait(another)
    assert {job.id for job in station.jobs.list()} >= {whole, another}
    assert newer not in {job.id for job in station.jobs.list()}  # a step's job is kept until the next step's
    assert not (station.folder / "jobs" / newer).exists()


def test_a_job_that_gave_way_is_left_out_if_a_newer_capture_waits_for_the_same(station: Station) -> None:
    whole = station.submit("slow", automatic=True)
    station.until(lambda: station.jobs.get(whole).stage == "correlate")
    station.submit("slow", automatic=True, step="0005-specimen")
    newer = station.submit("slow", automatic=True, after=0.5)
    station.until(lambda: station.jobs.get(whole).state == "superseded")
    assert station.jobs.get(newer).state == "queued"
    for job in station.jobs.list():
        station.jobs.cancel(job.id)


def test_a_job_waits_until_it_is_due(station: Station) -> None:
    began = time.monotonic()
    late, soon = station.submit("a", after=0.6), station.submit("b")
    station.wait(soon)
    assert station.jobs.get(late).state == "queued"
    station.wait(late)
    assert time.monotonic() - began >= 0.6


def test_the_real_processing_serves_failures_without_ending_and_ends_with_its_orders(
    tmp_path: Path, rig_toml: Callable[..., str]
) -> None:
    Archive(tmp_path).create_session("empty", rig_toml("ring", ("01", "02")))
    child = WarmChild(serving_command())
    watchdog = threading.Timer(300, child.close)
    watchdog.start()
    try:
        sentences = []
        for name in ("absent", "empty"):
            work = child.begin(Order(tmp_path / name))
            messages = [message_of(line) for line in work.lines()]
            outcome = [message for message in messages if message and "state" in message][-1]
            assert (work.wait(), outcome["state"]) == (0, "failed")
            sentences.append(outcome["error"])
        assert "no such session folder" in sentences[0]
        assert "no capture of the specimen" in sentences[1]
        serving = child._child
        assert serving is not None
        assert serving._process.stdin is not None
        serving._process.stdin.close()  # as when the controller is killed
        assert serving._process.wait(20) == 0
    finally:
        watchdog.cancel()
        child.close()


CONTROLLER = """
import sys, time
from pathlib import Path
from ringdic_controller.jobs.children import ChildPerJob, Order, WarmChild

folder, child, stubborn = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
warm = WarmChild([sys.executable, "-c", stubborn])
work = [each.begin(Order(folder)) for each in (warm, ChildPerJob(lambda _: [sys.executable, "-c", child]))]
for each in work: print(next(each.lines()), end="", flush=True)
time.sleep(60)
"""
# Starts a process of its own, tells both numbers, and sleeps; the stubborn one does not even notice signals.
SLEEPER = """
import subprocess, sys, os, time
other = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
print(os.getpid(), other.pid, flush=True)
time.sleep(60)
"""
STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)" + SLEEPER


@pytest.mark.skipif(os.name != "posix", reason="kill of POSIX")
def test_no_child_and_nothing_that_it_started_outlives_a_controller_that_is_killed(tmp_path: Path) -> None:
    command = [sys.executable, "-c", CONTROLLER, str(tmp_path), SLEEPER, STUBBORN]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as controller:
        assert controller.stdout is not None
        children = [int(number) for _ in range(2) for number in controller.stdout.readline().split()]
        assert len(children) == 4
        controller.kill()
    deadline = time.monotonic() + 20
    while any(is_running(number) for number in children):
        assert time.monotonic() < deadline, [number for number in children if is_running(number)]
        time.sleep(0.05)


def is_running(number: int) -> bool:
    """Whether a process runs (one that has ended and that nobody waits for does not)."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
