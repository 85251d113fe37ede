"""Tasks, their keys, their output files and what a process keeps between them."""

import pickle
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
import pytest
from ringdic.errors import ComputationError, InputError
from ringdic.session.records import CameraRecord
from ringdic.settings import CorrelationGroup
from ringdic.tasks import (
    Arrays,
    LocalExecutor,
    Memory,
    Task,
    TaskReport,
    digest,
    file_digest,
    read_output,
    tidy,
)

CALLS: list[str] = []


def add(name: str, value: float, *, inputs: tuple[Path, ...]) -> Arrays:
    """The value and all that the inputs hold."""
    CALLS.append(name)
    return {"sum": value + sum(read_output(path)["sum"] for path in inputs), "points": np.array(2)}


def impossible(sentence: str, *, inputs: tuple[Path, ...]) -> Arrays:
    CALLS.append(sentence)
    raise ComputationError(sentence)


def damaged(*, inputs: tuple[Path, ...]) -> Arrays:
    raise InputError("image.png: truncated")


@pytest.fixture(autouse=True)
def calls() -> list[str]:
    CALLS.clear()
    return CALLS


def chain(folder: Path, length: int = 4) -> list[Task]:
    """Tasks each of which needs the one before: sums 1, 3, 6, 10 …"""
    tasks: list[Task] = []
    for k in range(1, length + 1):
        needs = (tasks[-1].key,) if tasks else ()
        tasks.append(Task(digest("chain", k, needs), f"{k}", add, (f"{k}", np.array(float(k))), folder, needs))
    return tasks


def run(tasks: list[Task], workers: int = 2) -> list[tuple[str, bool]]:
    told: list[tuple[str, bool]] = []

    def tell(task: Task, report: TaskReport, count: int, total: int) -> None:
        assert (count, total) == (len(told) + 1, len(tasks))
        assert threading.current_thread() is threading.main_thread()
        told.append((task.name, report.computed))

    LocalExecutor(workers).run(tasks, tell)
    return told


def test_each_task_runs_after_what_it_needs_and_once(tmp_path: Path) -> None:
    tasks = chain(tmp_path / "work")
    assert run(tasks) == [(task.name, True) for task in tasks]
    assert read_output(tasks[-1].output)["sum"] == 10.0
    assert run(tasks) == [(task.name, False) for task in tasks]
    assert CALLS == ["1", "2", "3", "4"]


def test_only_what_is_missing_is_made_again(tmp_path: Path) -> None:
    tasks = chain(tmp_path)
    run(tasks)
    tasks[2].output.unlink()
    CALLS.clear()
    assert run(tasks).count(("3", True)) == 1
    assert CALLS == ["3"]


def test_a_file_that_was_not_finished_is_not_read(tmp_path: Path) -> None:
    tasks = chain(tmp_path)
    run(tasks)
    whole = tasks[1].output.read_bytes()
    tasks[1].output.write_bytes(whole[: len(whole) // 2])
    (tmp_path / f".{tasks[3].key}-1-1.partial").write_bytes(whole[:10])
    tasks[3].output.unlink()
    CALLS.clear()
    run(tasks)
    assert sorted(CALLS) == ["2", "4"]
    assert tasks[1].output.read_bytes() == whole
    assert read_output(tasks[3].output)["sum"] == 10.0


def test_some_arrays_of_an_output_can_be_read_alone_and_a_missing_one_is_a_sentence(tmp_path: Path) -> None:
    (task,) = chain(tmp_path, 1)
    run([task])
    assert set(read_output(task.output)) == {"sum", "points"}
    assert set(read_output(task.output, ["points"])) == {"points"}
    with pytest.raises(InputError, match="remove it and process again"):
        read_output(task.output, ["points", "of another version"])
    failed = Task(digest("no texture"), "pair", impossible, ("no texture",), tmp_path)
    run([failed])
    with pytest.raises(ComputationError, match="no texture"):
        read_output(failed.output, ["points"])


def test_what_cannot_be_computed_is_an_outcome_and_is_not_tried_again(tmp_path: Path) -> None:
    task = Task(digest("no texture"), "pair", impossible, ("cameras 1 and 2 share no texture",), tmp_path)
    after = Task(digest("after"), "after", add, ("after", np.array(1.0)), tmp_path, (task.key,))
    for _ in range(2):
        run([task, after])
        for each in (task, after):
            with pytest.raises(ComputationError, match="cameras 1 and 2 share no texture"):
                read_output(each.output)
    assert sorted(CALLS) == ["after", "cameras 1 and 2 share no texture"]


def test_a_bad_image_ends_the_run_and_leaves_what_was_made(tmp_path: Path) -> None:
    tasks = [*chain(tmp_path, 2), Task(digest("bad"), "bad", damaged, (), tmp_path)]
    with pytest.raises(InputError, match="truncated"):
        run(tasks, workers=1)
    assert all(task.done for task in tasks[:2])
    assert not tasks[2].done
    assert not list(tmp_path.glob(".*"))


def test_a_task_travels(tmp_path: Path) -> None:
    task = chain(tmp_path, 1)[0]
    travelled = pickle.loads(pickle.dumps(task))
    assert travelled.run().computed
    assert task.done
    assert travelled.run() == TaskReport(computed=False)


@dataclass(frozen=True)
class _Lens:
    focal: float
    terms: np.ndarray


def test_a_key_tells_values_apart_and_is_the_same_for_the_same() -> None:
    values = [
        None, 0, 0.0, "0", b"0", (), [0], [[0]], [0, 0], {"a": 1}, {"a": 2}, {"b": 1}, np.zeros(2), np.zeros((2, 1)),
        np.zeros(2, np.float32), np.array([0.0, 1e-12]), ("ab", "c"), ("a", "bc"), CorrelationGroup(),
        CorrelationGroup(radius_px=21), _Lens(1.0, np.zeros(2)), _Lens(1.0, np.ones(2)), True,
    ]  # fmt: skip
    keys = [digest(value) for value in values]
    assert len(set(keys)) == len(keys)
    assert digest(_Lens(1.0, np.ones(2)), {"b": 1, "a": 2}) == digest(_Lens(1.0, np.ones(2)), {"a": 2, "b": 1})
    with pytest.raises(TypeError):
        digest(Path("image.png"))


def test_a_record_of_a_file_is_believed_while_the_size_agrees(tmp_path: Path) -> None:
    path = tmp_path / "image.pgm"
    path.write_bytes(b"1234")
    assert file_digest(path, CameraRecord(sha256="told", bytes=4)) == "told"
    read = file_digest(path)
    assert file_digest(path, CameraRecord(sha256="told", bytes=5)) == read != "told"
    path.write_bytes(b"1235")
    assert file_digest(path) != read


def test_memory_stays_within_its_bytes_and_makes_each_value_once() -> None:
    memory = Memory(limit=1000)
    made: list[int] = []

    def value(k: int) -> Callable[[], np.ndarray]:
        def make() -> np.ndarray:
            made.append(k)
            return np.zeros(300, np.uint8)

        return make

    def get(k: int) -> None:
        memory.get(k, value(k), lambda array: array.nbytes)

    for k in range(3):
        get(k)
    get(0)  # used again: 1 is now the one not used for longest
    get(3)
    assert memory.bytes == 900
    get(0)
    assert made == [0, 1, 2, 3]
    get(1)
    assert made == [0, 1, 2, 3, 1]
    threads = [threading.Thread(target=get, args=(9,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made.count(9) == 1
    assert memory.bytes <= 1000


def test_the_folder_of_outputs_stays_within_its_size_and_keeps_the_jobs_own(tmp_path: Path) -> None:
    old, new = chain(tmp_path, 4), Task(digest("new"), "new", add, ("new", np.array(1.0)), tmp_path)
    run([*old, new])
    size = new.output.stat().st_size
    tidy(tmp_path, [new], limit=3 * size)
    assert new.done
    assert len(list(tmp_path.glob("*.npz"))) <= 3
    tidy(tmp_path, [new], limit=0)
    assert [path.name for path in tmp_path.glob("*.npz")] == [new.output.name]


def _threads(*, inputs: tuple[Path, ...]) -> dict[str, np.ndarray]:
    del inputs
    return {"threads": np.array(numba.get_num_threads())}


def test_a_task_that_all_others_wait_for_has_all_cores(tmp_path: Path) -> None:
    first = Task("first", "first", _threads, (), tmp_path)
    later = [Task(f"later{k}", f"later {k}", _threads, (), tmp_path, ("first",)) for k in range(4)]
    LocalExecutor(workers=2).run([first, *later], lambda *told: None)
    cores = numba.config.NUMBA_NUM_THREADS
    assert read_output(first.output)["threads"] == cores
    assert read_output(later[0].output)["threads"] == max(1, cores // 2)
