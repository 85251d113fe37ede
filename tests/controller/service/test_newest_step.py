"""Each step of the specimen is processed at once and served; the whole session follows when the capturing ends."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from ringdic_controller.jobs.children import WarmChild
from ringdic_controller.service.desk import Desk

QUIET = 0.6  # seconds


@pytest.fixture
def desk(desk_of: Callable[..., Desk], warm_stand_in: WarmChild) -> Desk:
    """A desk whose processing is a warm stand-in, with a session."""
    desk = desk_of(warm_stand_in, quiet=QUIET)
    desk.create_session("limb")
    return desk


def until(condition: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + 30
    while not (met := condition()):
        assert time.monotonic() < deadline, "it never came about"
        time.sleep(0.02)
    return met


def capture(desk: Desk, *kinds: str) -> None:
    for kind in kinds:
        round_ = until(lambda: desk.rounds.refusal() is None and desk.rounds.begin(kind)).id  # noqa: B023
        until(lambda: desk.rounds.get(round_).state == "closed")  # noqa: B023


def newest(desk: Desk) -> str:
    return (desk.sessions.newest_step("limb") or {}).get("capture_id", "")


def test_the_newest_step_is_served_and_is_no_run(desk: Desk, client: TestClient) -> None:
    events: list[tuple[str, dict[str, Any]]] = []
    publish = desk.state.events.publish
    desk.state.events.publish = lambda *event: (events.append(event), publish(*event))  # type: ignore
    address = "/api/v1/sessions/limb/live"
    capture(desk, "board", "target")
    assert client.get(address).status_code == 404
    capture(desk, "specimen")
    until(lambda: newest(desk) == "0003-specimen")  # the reference alone: its shape
    assert client.get(address).json()["steps"] == ["0003-specimen"]
    capture(desk, "specimen")
    until(lambda: newest(desk) == "0004-specimen")
    header = client.get(address).json()
    assert header["steps"] == ["0003-specimen", "0004-specimen"]
    assert 0 <= header["seconds"] < 30
    of_step = f"{address}/0004-specimen"
    answer = client.get(f"{of_step}/fields/lambda2/1", params={"v": header["version"]})
    assert "immutable" in answer.headers["Cache-Control"]
    np.testing.assert_allclose(np.nanmedian(np.frombuffer(answer.content, "<f4")), 1.1, atol=1e-6)
    again = client.get(f"{of_step}/fields/lambda2/1", headers={"If-None-Match": answer.headers["ETag"]})
    assert again.status_code == 304
    faces = np.frombuffer(client.get(f"{of_step}/faces").content, "<u4")
    assert len(faces) == 3 * header["faces"]
    until(lambda: ("newest", desk.sessions.newest_step("limb")) in events)
    assert client.get(f"{address}/0009-specimen").status_code == 404
    assert client.get("/api/v1/sessions/absent/live").status_code == 404
    assert client.get("/api/v1/sessions/limb/results").json() == []


def test_the_whole_session_is_processed_once_when_the_capturing_has_ended(desk: Desk) -> None:
    capture(desk, "board", "target", *["specimen"] * 8)
    began = time.monotonic()
    assert desk.catalogue.runs("limb") == []
    until(lambda: desk.catalogue.runs("limb"))
    assert time.monotonic() - began > QUIET / 2
    runs = [job for job in desk.jobs.list() if job.step is None and job.state == "done"]
    assert len(runs) == 1
    assert newest(desk) == "0010-specimen"
    folders = sorted(path.name for path in (desk.catalogue.root / "limb" / "live").iterdir())
    assert folders[-1] == "0010-specimen"
    assert len(folders) <= 5  # newer ones have taken the place of the others


def test_without_live_processing_the_whole_session_is_processed_at_once(
    desk_of: Callable[..., Desk], warm_stand_in: WarmChild
) -> None:
    desk = desk_of(warm_stand_in, live=False)
    desk.create_session("limb")
    capture(desk, "board", "target", "specimen", "specimen")
    until(lambda: desk.catalogue.runs("limb"))
    assert newest(desk) == ""
