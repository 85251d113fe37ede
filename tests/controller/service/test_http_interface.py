"""The HTTP interface over a real archive: sessions, captures, jobs, results, and refusals in one sentence."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from ringdic_controller.service.preview import preview_jpeg
from ringdic_controller.service.refusals import NotFoundError

API = "/api/v1"
AROUND, ALONG, STRETCH = 60, 16, 0.1  # the stand-in's tube


def until(condition: Callable[[], Any], timeout: float = 20.0) -> Any:
    """The condition's value once it holds."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.02)
    raise TimeoutError("it never came about")


def capture(client, kind: str, **more: Any) -> dict[str, Any]:
    """Begin a capture and follow its round to the end."""
    answer = client.post(f"{API}/captures", json={"kind": kind, **more})
    assert answer.status_code == 202, answer.text
    address = f"{API}/rounds/{answer.json()['id']}"
    return until(lambda: (r := client.get(address).json())["state"] in ("closed", "refused") and r)


def capture_everything(client, steps: int = 2) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    for kind in ("board", "target", *["specimen"] * steps):
        assert capture(client, kind)["state"] == "closed"


def finished_job(client) -> dict[str, Any]:
    def all_finished() -> list[dict[str, Any]] | None:
        jobs = client.get(f"{API}/jobs").json()
        return jobs if jobs and all(job["finished_at"] for job in jobs) else None

    return until(all_finished)[0]


@pytest.fixture
def processed(client):
    """A session with results of a reference and two steps."""
    capture_everything(client, steps=3)
    assert finished_job(client)["state"] == "done"
    return client


def test_a_capture_is_listed_with_every_camera_and_its_image_has_the_recorded_checksum(client) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    ended = capture(client, "board")
    assert ended["capture_id"] == "0001-board"
    (record,) = client.get(f"{API}/sessions/limb/captures").json()
    assert {entry["status"] for entry in record["cameras"].values()} == {"ok"}
    assert record["skew_ns"] == 30_000  # the stand-in's cameras fire 10 µs after each other
    for camera, entry in record["cameras"].items():
        answer = client.get(f"{API}/sessions/limb/captures/0001-board/images/{camera}")
        assert hashlib.sha256(answer.content).hexdigest() == entry["sha256"]


def test_a_preview_shows_the_image_and_comes_once(client) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    capture(client, "board")
    address = f"{API}/sessions/limb/captures/0001-board/images/02/preview?width=20"
    answer = client.get(address)
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (15, 20)
    ramp = ((np.arange(1200) + 2) % 256).astype(np.uint8).reshape(30, 40)
    assert abs(picture.mean() - ramp.mean()) < 3
    again = client.get(address, headers={"If-None-Match": answer.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_a_preview_of_a_very_high_image_is_a_picture(tmp_path) -> None:
    path = tmp_path / "01.pgm"
    path.write_bytes(b"P5\n1 70000\n255\n" + bytes(70_000))
    picture = cv2.imdecode(np.frombuffer(preview_jpeg(path), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (16_384, 1)


def test_a_missing_node_is_named_and_an_override_captures_without_it(client, nodes) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    nodes.absent = {"03"}
    refused = client.post(f"{API}/captures", json={"kind": "target"})
    assert refused.status_code == 409
    assert "03" in refused.json()["detail"]
    assert client.get(f"{API}/sessions/limb/captures").json() == []
    assert capture(client, "target", override=True)["state"] == "closed"
    (record,) = client.get(f"{API}/sessions/limb/captures").json()
    assert record["cameras"]["03"] | {"status": "failed", "file": None} == record["cameras"]["03"]
    assert [camera for camera, entry in record["cameras"].items() if entry["status"] == "ok"] == ["01", "02", "04"]
    assert client.get(f"{API}/sessions/limb/captures/0001-target/images/03").status_code == 404


def test_a_second_capture_at_once_is_refused_and_the_first_goes_on(client, nodes) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    nodes.gate.clear()
    first = client.post(f"{API}/captures", json={"kind": "board"}).json()
    address = f"{API}/rounds/{first['id']}"
    until(lambda: client.get(address).json()["state"] == "open")
    second = client.post(f"{API}/captures", json={"kind": "board"})
    assert second.status_code == 409
    assert "under way" in second.json()["detail"]
    assert "under way" in client.get(f"{API}/rig").json()["refusal"]
    nodes.gate.set()
    until(lambda: client.get(address).json()["state"] == "closed")
    assert len(client.get(f"{API}/sessions/limb/captures").json()) == 1
    assert client.get(f"{API}/rig").json()["refusal"] is None


def test_while_a_capture_is_under_way_no_other_session_is_made_or_selected(client, nodes) -> None:
    for name in ("other", "limb"):
        client.post(f"{API}/sessions", json={"name": name})
    nodes.gate.clear()
    first = client.post(f"{API}/captures", json={"kind": "board"}).json()
    assert client.post(f"{API}/sessions", json={"name": "third"}).status_code == 409
    assert client.put(f"{API}/sessions/current", json={"name": "other"}).status_code == 409
    assert client.put(f"{API}/sessions/current", json={"name": "nobody"}).status_code == 404
    assert client.put(f"{API}/sessions/current", json={"name": "limb"}).status_code == 200
    listing = client.get(f"{API}/sessions").json()
    assert (listing["current"], len(listing["sessions"])) == ("limb", 2), "a refusal has changed nothing"
    nodes.gate.set()
    until(lambda: client.get(f"{API}/rounds/{first['id']}").json()["state"] == "closed")


def test_a_capture_closes_even_if_its_processing_cannot_be_queued(client, desk, monkeypatch) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})

    def fail(*_: object) -> None:
        raise NotFoundError("the session's folder has been moved")

    monkeypatch.setattr(desk.processing, "submit_step", fail)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    assert capture(client, "specimen")["state"] == "closed"
    assert client.get(f"{API}/rig").json()["refusal"] is None


def test_how_a_round_ended_can_be_read_until_the_next_begins(client, desk) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    assert desk.state.snapshot()["round"] is None
    for number, kind in enumerate(("board", "target"), start=1):
        assert capture(client, kind)["state"] == "closed"
        newest = desk.state.snapshot()["round"]
        assert (newest["capture_id"], newest["state"]) == (f"{number:04d}-{kind}", "closed")


def test_a_round_that_the_nodes_refuse_tells_why_and_leaves_no_capture(client, nodes) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    nodes.unarmed = "02"
    ended = capture(client, "board")
    assert ended["state"] == "refused"
    assert "camera 02 is not armed" in ended["error"]
    assert client.get(f"{API}/sessions/limb/captures").json() == []
    assert capture(client, "board", override=True)["state"] == "closed"


def test_processing_starts_by_itself_after_the_first_step_and_not_before(client) -> None:
    capture_everything(client, steps=1)
    assert client.get(f"{API}/jobs").json() == []
    refused = client.post(f"{API}/jobs", json={"session": "limb"})
    assert refused.status_code == 409
    assert "only the reference" in refused.json()["detail"]
    capture(client, "specimen")
    job = finished_job(client)
    assert (job["state"], job["automatic"], job["reason"], job["run"]) == ("done", True, "0004-specimen", "0001")
    assert "the tube is computed" in client.get(f"{API}/jobs/{job['id']}/log").text


def test_the_surface_has_the_stretch_that_was_put_in(processed) -> None:
    results = f"{API}/sessions/limb/results"
    runs = [run["run"] for run in processed.get(results).json()]
    assert runs[0] == "0001"
    run = runs[-1]
    header = processed.get(f"{results}/{run}").json()
    assert header["points"] == AROUND * ALONG
    assert header["steps"] == ["0003-specimen", "0004-specimen", "0005-specimen"]

    def array(path: str, kind: str) -> np.ndarray:
        answer = processed.get(f"{results}/{run}/{path}")
        shape = [int(n) for n in answer.headers["X-Shape"].split(",")]
        return np.frombuffer(answer.content, kind).reshape(shape)

    faces = array("faces", "<u4")
    assert faces.shape == (header["faces"], 3)
    reference, last = array("positions/0", "<f4"), array("positions/2", "<f4")
    good = np.isfinite(last[:, 0])
    assert (~good).sum() == 3
    np.testing.assert_allclose(last[good, 2], reference[good, 2] * (1 + 2 * STRETCH), atol=1e-4)
    stretch = array("fields/lambda2/2", "<f4")
    measured = good[faces].all(axis=1)
    np.testing.assert_allclose(stretch[measured], 1 + 2 * STRETCH, atol=1e-5)
    assert np.isnan(stretch[~measured]).all()
    # Without the rigid motion the tube does not turn: what is left is along the radius and the axis.
    turned = array("fields/displacement_x/1", "<f4")
    unturned = array("fields/displacement_x/1?rigid_motion_removed=true", "<f4")
    assert np.abs(turned).max() > 4
    assert np.abs(unturned).max() < 1e-4


def test_arrays_are_tagged_and_may_be_kept_for_ever_by_version(processed) -> None:
    header = processed.get(f"{API}/sessions/limb/results/0001").json()
    address = f"{API}/sessions/limb/results/0001/fields/J/1"
    plain = processed.get(address)
    assert "no-cache" in plain.headers["Cache-Control"]
    assert processed.get(address, headers={"If-None-Match": plain.headers["ETag"]}).status_code == 304
    versioned = processed.get(address, params={"v": header["version"]})
    assert "immutable" in versioned.headers["Cache-Control"]
    other = processed.get(f"{API}/sessions/limb/results/0001/fields/J/2")
    assert other.headers["ETag"] != plain.headers["ETag"]


@pytest.mark.parametrize(
    ("method", "path", "body", "status", "word"),
    [
        ("get", "/sessions/nobody", None, 404, "nobody"),
        ("get", "/sessions/limb/captures/0009-board", None, 404, "0009-board"),
        ("get", "/sessions/limb/results/0001", None, 404, "0001"),
        ("get", "/sessions/limb/results/..%2F..", None, 404, ""),
        ("get", "/jobs/0007", None, 404, "0007"),
        ("post", "/jobs/0007/cancel", None, 404, "0007"),
        ("get", "/rounds/r9", None, 404, "r9"),
        ("post", "/jobs", {"session": "limb"}, 409, "no board capture"),
        ("post", "/sessions", {"name": "limb"}, 409, "limb"),
        ("post", "/sessions", {"name": "../outside"}, 422, "outside"),
        ("post", "/captures", {"kind": "portrait"}, 422, "kind"),
        ("put", "/sessions/current", {"name": "nobody"}, 404, "nobody"),
    ],
)
def test_a_bad_request_is_answered_with_a_sentence(client, method, path, body, status, word) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    answer = client.request(method, f"{API}{path}", json=body)
    assert answer.status_code == status
    assert isinstance(answer.json()["detail"], str)
    assert word in answer.json()["detail"]


def test_without_a_session_nothing_is_captured(client) -> None:
    refused = client.post(f"{API}/captures", json={"kind": "board"})
    assert refused.status_code == 409
    assert "create one" in refused.json()["detail"]


def test_captures_go_to_the_selected_session(client) -> None:
    for name in ("first", "second"):
        client.post(f"{API}/sessions", json={"name": name})
    assert client.get(f"{API}/sessions").json()["current"] == "second"
    assert client.put(f"{API}/sessions/current", json={"name": "first"}).status_code == 200
    capture(client, "board")
    assert len(client.get(f"{API}/sessions/first/captures").json()) == 1
    assert client.get(f"{API}/sessions/second/captures").json() == []


def test_the_openapi_document_names_every_resource(client) -> None:
    document = client.get("/openapi.json").json()
    paths = {path.removeprefix(API) for path in document["paths"]}
    assert {"/rig", "/sessions", "/captures", "/jobs", "/sessions/{session}/results", "/live"} <= paths
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    names = [operation["operationId"] for operation in operations]
    assert len(names) == len(set(names))
    assert all(operation["summary"] for operation in operations)


def test_without_a_bundled_page_the_reason_is_told(desk, tmp_path) -> None:
    from fastapi.testclient import TestClient
    from ringdic_controller.service.app import create_app

    with TestClient(create_app(desk, static=tmp_path / "nothing"), base_url="http://127.0.0.1") as client:
        answer = client.get("/")
        assert answer.status_code == 503
        assert "RINGDIC_SKIP_PAGE" in answer.text


def test_nothing_is_fetched_from_another_host(client) -> None:
    assert client.get("/openapi.json").json()["info"]["title"] == "RingDIC controller"
    for viewer in ("/docs", "/redoc"):  # their pages would load scripts from elsewhere
        assert client.get(viewer).status_code == 404


def test_a_run_has_a_report_that_is_made_once_and_kept_beside_the_results(processed) -> None:
    run = processed.get(f"{API}/sessions/limb/results").json()[-1]["run"]
    address = f"{API}/sessions/limb/results/{run}/report"
    first, second = processed.get(address), processed.get(address)
    assert first.status_code == 200, first.text
    assert first.headers["content-type"].startswith("text/html")
    assert f"report of run {run}" in first.text
    assert "Larger stretch λ2" in first.text
    assert second.headers["last-modified"] == first.headers["last-modified"]
    assert processed.get(f"{API}/sessions/limb/results/0099/report").status_code == 404


def test_what_a_run_did_not_measure_is_told_by_reason_and_drawn_on_the_photograph(processed) -> None:
    run = processed.get(f"{API}/sessions/limb/results").json()[-1]["run"]
    address = f"{API}/sessions/limb/results/{run}/unmeasured"
    found = processed.get(address).json()
    assert [(row["reason"], row["cm2"], row["counted"]) for row in found["reasons"]] == [
        ("the images do not look alike", 0.7, True),
        ("the lines of sight miss one another", 0.5, True),
    ]
    assert found["cameras"] == ["01"]
    picture = processed.get(f"{address}/01")
    assert picture.headers["content-type"] == "image/jpeg"
    drawn = cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR)
    assert np.ptp(drawn[20, 30].astype(int)) > 40
    assert np.ptp(drawn[5, 5].astype(int)) < 12
    assert processed.get(f"{address}/02").status_code == 404


def test_a_note_of_a_capture_is_archived_told_to_who_follows_and_survives_the_close(client, desk, nodes) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    told: list[tuple[str, Any]] = []
    desk.state.events.publish = lambda name, payload: told.append((name, payload))
    nodes.gate.clear()
    round_id = client.post(f"{API}/captures", json={"kind": "board"}).json()["id"]
    address = f"{API}/sessions/limb/captures/0001-board"
    until(lambda: client.get(address).status_code == 200)
    told.clear()
    answer = client.patch(address, json={"note": "the lamp flickers"})
    assert (answer.status_code, answer.json()["note"]) == (200, "the lamp flickers")
    assert ("capture", "the lamp flickers") in [(name, each["record"]["note"]) for name, each in told]
    nodes.gate.set()
    until(lambda: client.get(f"{API}/rounds/{round_id}").json()["state"] == "closed")
    record = client.get(address).json()
    assert (record["state"], record["note"]) == ("closed", "the lamp flickers")
    assert "note" not in client.patch(address, json={"note": ""}).json()


@pytest.mark.parametrize(
    ("capture_id", "body", "status"),
    [
        ("0001-board", {"note": "x" * 2001}, 422),
        ("0001-board", {"note": 5}, 422),
        ("0001-board", {}, 422),
        ("0002-board", {"note": "x"}, 404),
    ],
)
def test_a_note_that_cannot_be_kept_is_refused(client, capture_id: str, body: Any, status: int) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    capture(client, "board")
    assert client.patch(f"{API}/sessions/limb/captures/{capture_id}", json=body).status_code == status
    assert "note" not in client.get(f"{API}/sessions/limb/captures/0001-board").json()


def test_a_load_channel_is_archived_and_other_values_need_a_word(client) -> None:
    client.post(f"{API}/sessions", json={"name": "limb"})
    capture(client, "specimen")
    address = f"{API}/sessions/limb/captures/0001-specimen/load"
    assert client.get(address).json() == []
    force = {"name": "force", "unit": "N", "values": 12.5}
    travel = {"name": "travel", "unit": "mm", "values": [[10**18, 1], [10**18 + 5, 2.5]]}
    assert client.put(address, json=force).json() == [force]
    assert client.put(address, json=travel).json() == client.put(address, json=force).json() == [force, travel]
    refused = client.put(address, json={**force, "values": 13})
    assert (refused.status_code, "force" in refused.json()["detail"]) == (409, True)
    assert client.get(address).json() == [force, travel]
    assert client.put(address, json={**force, "values": 13, "replace": True}).json()[0]["values"] == 13
    for wrong in ("12", [[1.5, 2]], [[2, 1], [1, 1]], [], [[1]], True, None):
        assert client.put(address, json={**force, "values": wrong}).status_code == 422, wrong
    assert client.put(address.replace("0001", "0002"), json=force).status_code == 404
