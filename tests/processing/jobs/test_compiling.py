"""All kernels are compiled once: not again while the mark is there, and again after a part has failed."""

from pathlib import Path

import pytest
from ringdic.jobs import compiling


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """What was told of parts that are compiled in an empty cache; the parts take no time."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiling, "_parts", lambda: {"one": int, "other": int})
    return []


def compile_them(told: list[tuple[int, int]]) -> None:
    compiling.compile_once(lambda done, count, _: told.append((done, count)))


def test_what_is_compiled_is_not_compiled_again(told, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling.subprocess, "Popen", Ended)
    compile_them(told)
    assert told == [(0, 2), (1, 2), (2, 2)]
    compile_them(told)
    assert len(told) == 3


def test_after_a_failure_the_next_process_tries_again(told, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling.subprocess, "Popen", Failed)
    compile_them(told)
    monkeypatch.setattr(compiling.subprocess, "Popen", Ended)
    compile_them(told)
    assert told == 2 * [(0, 2), (1, 2), (2, 2)]


def test_a_part_runs_in_the_process_that_is_asked_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []
    monkeypatch.setattr(compiling, "_parts", lambda: {"one": lambda: ran.append("one"), "other": int})
    monkeypatch.setattr(compiling.os, "nice", lambda by: 0, raising=False)
    assert compiling.main(["one"]) == 0
    assert ran == ["one"]


class Ended:
    """A process that has ended well."""

    returncode = 0

    def __init__(self, *given: object, **named: object) -> None: ...

    def poll(self) -> int:
        return self.returncode


class Failed(Ended):
    """A process that has ended badly."""

    returncode = 1
