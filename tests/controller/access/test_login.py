"""Who gets in at the page: logins, cookies, roles, tokens, limits, and what is noted of all that."""

from __future__ import annotations

import json
import os
from typing import Any

import pytest
from fastapi.testclient import TestClient
from itsdangerous import URLSafeTimedSerializer
from ringdic_controller.access.attempts import AttemptLimit, network_of
from ringdic_controller.access.logins import ATTEMPTS_FOR_NAME, ATTEMPTS_OF_ADDRESS, LOGIN_LASTS
from ringdic_controller.service.app import create_app
from ringdic_controller.service.desk import Desk
from starlette.websockets import WebSocketDisconnect

PASSWORD = "four words are better"  # of all users
Guests = Any  # the fixture's class

API = "/api/v1"
OPEN = {"/login", "/login.css"}


def routes(client: TestClient) -> list[tuple[str, str]]:
    """Every method and path of the interface and the page, with something for each parameter."""
    found = [("GET", "/"), ("GET", "/openapi.json"), ("GET", "/assets/main.js"), ("POST", "/logout")]
    for path, methods in client.app.openapi()["paths"].items():  # type: ignore[attr-defined]
        found += [(method.upper(), path.replace("{", "").replace("}", "")) for method in methods]
    return found


def audited(guests: Guests) -> list[dict[str, Any]]:
    path = guests.access.audit.path
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def test_a_stranger_gets_the_login_and_nothing_else(guests: Guests) -> None:
    client = guests.client()
    asked = routes(client)
    assert len(asked) > 25
    for method, path in asked:
        answer = client.request(method, path)
        assert answer.status_code == (303 if path == "/" else 401), path
    assert client.get("/").headers["location"] == "/login"
    assert "Bearer" in client.get(f"{API}/rig").headers["www-authenticate"]
    for path in ("/login/", "/.//login", "/login.css/../api/v1/rig", "/login%2f..%2fapi/v1/rig", "/nothing"):
        assert client.get(path).status_code in (401, 404), path
    with pytest.raises(WebSocketDisconnect), client.websocket_connect("/api/v1/live"):
        pass


def test_the_login_page_runs_nothing_and_loads_only_its_style(guests: Guests) -> None:
    answer = guests.client().get("/login")
    assert answer.status_code == 200
    assert "script" not in answer.text
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "frame-ancestors 'none'" in policy
    assert guests.client().get("/login.css").headers["content-type"].startswith("text/css")


def test_a_login_gives_a_cookie_that_scripts_and_other_pages_cannot_use(guests: Guests) -> None:
    for scheme, name in (("http", "ringdic"), ("https", "__Host-ringdic")):
        client = guests.client(scheme)
        answer = client.post("/login", data={"name": "anna", "password": PASSWORD})
        assert (answer.status_code, answer.headers["location"]) == (303, "/")
        cookie = answer.headers["set-cookie"]
        assert cookie.startswith(f"{name}=")
        parts = {part.strip().lower() for part in cookie.split(";")[1:]}
        assert {"httponly", "samesite=strict", "path=/"} <= parts
        assert ("secure" in parts) == (scheme == "https")
        assert "domain" not in cookie.lower()
        assert client.get(f"{API}/account").json() == {"name": "anna", "role": "operator", "login": True}
        assert client.post(f"{API}/sessions", json={"name": f"limb-{scheme}"}).status_code == 201


@pytest.mark.parametrize(
    "form",
    [
        {"name": "anna", "password": "wrong"},
        {"name": "Anna", "password": PASSWORD},
        {"name": "nobody", "password": PASSWORD},
        {"name": "script", "password": PASSWORD},
        {"name": "anna", "password": ""},
        {"name": "", "password": PASSWORD},
        {},
        {"name": "anna", "password": PASSWORD + "x" * 5000},
        {"name": "\x00\ud800".encode("utf-8", "surrogatepass"), "password": b"\xff\xfe"},
    ],
)
def test_a_wrong_login_is_refused_in_words(guests: Guests, form: dict[str, Any]) -> None:
    client = guests.client()
    answer = client.post("/login", data=form)
    assert answer.status_code in (401, 422)
    assert 'role="alert" >' in answer.text
    assert "set-cookie" not in answer.headers
    assert client.get(f"{API}/rig").status_code == 401


def test_a_name_with_a_script_in_it_is_text(guests: Guests) -> None:
    answer = guests.client().post("/login", data={"name": '"><script>alert(1)</script>$name', "password": "x"})
    assert "<script" not in answer.text
    assert "&lt;script&gt;" in answer.text


def test_a_viewer_reads_everything_and_changes_nothing(guests: Guests) -> None:
    operator, viewer = guests.logged_in("anna"), guests.logged_in("vito")
    operator.post(f"{API}/sessions", json={"name": "limb"})
    for method, path in routes(viewer):
        if path in (f"{API}/live", "/logout"):
            continue
        answer = viewer.request(method, path)
        if method == "GET":
            assert answer.status_code not in (401, 403), path
        else:
            assert answer.status_code == 403, path
            assert "'vito' is a viewer" in answer.json()["detail"]
    assert viewer.get(f"{API}/sessions").json()["current"] == "limb"


@pytest.mark.parametrize("method", ["DELETE", "PATCH", "PUT", "TRACE", "get", "post", "QUERY", ""])
def test_a_method_that_is_not_known_to_read_is_an_action(guests: Guests, method: str) -> None:
    assert guests.logged_in("vito").request(method, f"{API}/sessions").status_code in (403, 405, 200)
    if method != "get":  # clients send GET for it
        assert guests.logged_in("vito").request(method, f"{API}/captures").status_code == 403


def test_a_token_opens_the_interface_for_its_role_until_it_is_removed(guests: Guests) -> None:
    client = guests.client()
    operator = {"Authorization": f"Bearer {guests.operator_token}"}
    viewer = {"Authorization": f"bearer  {guests.viewer_token} "}
    assert client.post(f"{API}/sessions", json={"name": "a"}, headers=operator).status_code == 201
    assert client.get(f"{API}/sessions", headers=viewer).status_code == 200
    assert client.post(f"{API}/sessions", json={"name": "b"}, headers=viewer).status_code == 403
    for wrong in ("", "Bearer", "Bearer x", f"Basic {guests.operator_token}", f"Bearer {guests.operator_token[:-1]}"):
        assert client.get(f"{API}/sessions", headers={"Authorization": wrong}).status_code == 401, wrong
    assert client.get(f"{API}/sessions?token={guests.operator_token}").status_code == 401
    guests.file.remove("script")
    assert client.get(f"{API}/sessions", headers=operator).status_code == 401


def test_a_cookie_ends_with_logout_and_with_the_user(guests: Guests) -> None:
    client = guests.logged_in("anna")
    copy = guests.client()
    copy.cookies.set("ringdic", client.cookies["ringdic"])
    assert copy.get(f"{API}/rig").status_code == 200
    assert client.post("/logout").headers["location"] == "/login"
    assert copy.get(f"{API}/rig").status_code == 401, "a copy of the cookie is worth nothing"

    again = guests.logged_in("anna")
    guests.file.set_user("anna", "operator", "quite another password")
    assert again.get(f"{API}/rig").status_code == 401
    viewer = guests.logged_in("vito")
    guests.file.remove("vito")
    assert viewer.get(f"{API}/rig").status_code == 401


def test_a_role_that_is_taken_away_is_gone_at_once(guests: Guests) -> None:
    client = guests.logged_in("anna")
    text = guests.file.path.read_text().replace('"operator"', '"viewer"')
    guests.file.path.write_text(text)
    assert client.post(f"{API}/sessions", json={"name": "x"}).status_code == 403


def test_cookies_that_the_controller_did_not_sign_or_that_are_old_are_refused(
    guests: Guests, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = guests.logged_in("anna")
    good = client.cookies["ringdic"]
    account = guests.file.account("anna")
    forged = URLSafeTimedSerializer("another secret", salt="ringdic login").dumps(["anna", account.version, "x"])
    other_use = URLSafeTimedSerializer(guests.file.secret, salt="other").dumps(["anna", account.version, "x"])
    for cookie in (forged, other_use, good[:-2], good.replace(".", "", 1), "x", "a" * 100_000, '["anna"]'):
        stranger = guests.client()
        stranger.cookies.set("ringdic", cookie)
        assert stranger.get(f"{API}/rig").status_code == 401, cookie[:40]
    monkeypatch.setattr("itsdangerous.timed.time.time", lambda: __import__("time").monotonic() + 4e9)
    assert client.get(f"{API}/rig").status_code == 401, f"older than {LOGIN_LASTS} s"


def test_guessing_is_slowed_for_an_address_and_for_a_name(guests: Guests) -> None:
    guess = {"name": "anna", "password": "wrong"}
    client = guests.client()
    statuses = [client.post("/login", data=guess).status_code for _ in range(ATTEMPTS_OF_ADDRESS[0] + 1)]
    assert statuses == [401] * ATTEMPTS_OF_ADDRESS[0] + [429]
    right = client.post("/login", data={"name": "anna", "password": PASSWORD})
    assert right.status_code == 429, "the right password does not tell itself either"
    assert 0 < int(right.headers["retry-after"]) <= 301
    # Other addresses: the name is guessed no more than this, whoever asks.
    left = ATTEMPTS_FOR_NAME[0] - ATTEMPTS_OF_ADDRESS[0]
    others = [guests.client(address=f"10.0.1.{k}").post("/login", data=guess).status_code for k in range(left + 1)]
    assert others == [401] * left + [429]
    assert guests.client(address="10.0.2.1").post("/login", data={**guess, "name": "vito"}).status_code == 401


def test_a_right_password_clears_the_count(guests: Guests) -> None:
    client = guests.client()
    for _ in range(3):
        for _ in range(ATTEMPTS_OF_ADDRESS[0] - 1):
            client.post("/login", data={"name": "anna", "password": "wrong"})
        assert client.post("/login", data={"name": "anna", "password": PASSWORD}).status_code == 303


def test_the_limit_counts_in_a_moving_window_and_an_ipv6_network_as_one() -> None:
    limit = AttemptLimit(2, 10.0)
    assert [limit.wait("a", now) for now in (0.0, 4.0, 6.0)] == [0.0, 0.0, 4.0]
    assert limit.wait("a", 10.0) == 0.0
    assert limit.wait("a", 11.0) == 3.0
    assert limit.wait("b", 11.0) == 0.0
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:1") != network_of("2001:db8:0:1::1")
    assert network_of("::ffff:10.0.0.1") == network_of("10.0.0.1")
    assert network_of("fe80::1%eth0") == network_of("fe80::2")
    assert network_of("testclient") == "testclient"


def test_each_action_is_noted_with_who_what_when_where_and_how_it_went(guests: Guests) -> None:
    operator = guests.logged_in("anna")
    operator.post(f"{API}/sessions", json={"name": "limb"})
    operator.post(f"{API}/sessions", json={"name": "limb"})
    operator.get(f"{API}/sessions")
    guests.logged_in("vito", address="10.0.0.8").post(f"{API}/captures", json={"kind": "board"})
    stranger = guests.client(address="10.0.0.9")
    stranger.post(f"{API}/captures", json={"kind": "board"})
    stranger.post("/login", data={"name": "anna\n{", "password": "wrong and secret"})
    bearer = {"Authorization": f"Bearer {guests.operator_token}"}
    stranger.post(f"{API}/jobs", json={"session": "none"}, headers=bearer)
    operator.post("/logout")
    lines = audited(guests)
    told = [(line["who"], line["from"], line["what"], line["outcome"]) for line in lines]
    assert told == [
        ("anna", "10.0.0.7", "login", "logged in"),
        ("anna", "10.0.0.7", "POST /api/v1/sessions", "201 Created"),
        ("anna", "10.0.0.7", "POST /api/v1/sessions", "409 Conflict"),
        ("vito", "10.0.0.8", "login", "logged in"),
        ("vito", "10.0.0.8", "POST /api/v1/captures", "403 Forbidden"),
        ("a stranger", "10.0.0.9", "POST /api/v1/captures", "401 Unauthorized"),
        ("anna\n{", "10.0.0.9", "login", "wrong name or password"),
        ("token script", "10.0.0.9", "POST /api/v1/jobs", "404 Not Found"),
        ("anna", "10.0.0.7", "POST /logout", "303 See Other"),
    ]
    assert lines[1]["sent"] == '{"name":"limb"}'
    assert all(line["when"].endswith("+00:00") for line in lines)
    text = guests.access.audit.path.read_text()
    assert PASSWORD not in text
    assert "secret" not in text
    assert guests.operator_token not in text
    assert os.stat(guests.access.audit.path).st_mode & 0o007 == 0


def test_a_flood_of_strangers_does_not_fill_the_log(guests: Guests) -> None:
    client = guests.client()
    for _ in range(70):
        client.post(f"{API}/captures", json={"kind": "board"})
    assert len(audited(guests)) == 60


def test_a_log_that_cannot_be_written_stops_nobody(guests: Guests, caplog: pytest.LogCaptureFixture) -> None:
    guests.access.audit.path.mkdir()
    assert guests.logged_in("anna").post(f"{API}/sessions", json={"name": "limb"}).status_code == 201
    assert "cannot be written" in caplog.text


def test_a_damaged_file_of_users_lets_nobody_in(guests: Guests) -> None:
    client = guests.logged_in("anna")
    guests.file.path.write_text("{")
    for method, path in (("GET", "/"), ("GET", f"{API}/rig"), ("POST", f"{API}/captures"), ("POST", "/logout")):
        assert client.request(method, path).status_code == 503
    assert "damaged" in client.post("/login", data={"name": "anna", "password": PASSWORD}).text
    assert "damaged" in client.get(f"{API}/rig").json()["detail"]


def test_without_users_everybody_may_and_is_noted(desk: Desk) -> None:
    client = TestClient(create_app(desk), "http://127.0.0.1", follow_redirects=False)
    assert client.get(f"{API}/account").json() == {"name": "everybody", "role": "operator", "login": False}
    assert client.post(f"{API}/sessions", json={"name": "limb"}).status_code == 201
    assert client.get("/login").headers["location"] == "/"
    line = json.loads((desk.catalogue.root / "audit.jsonl").read_text())
    assert (line["who"], line["what"]) == ("everybody", "POST /api/v1/sessions")
