"""The page on other addresses than loopback: refused without protection, served with certificates and login."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from ringdic.errors import InputError
from ringdic_controller.access.certificates import machines_of, open_authority
from ringdic_controller.service import gate
from ringdic_controller.service.app import create_app
from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.page_security import page_security
from ringdic_controller.service.service import run_controller

Guests = Any  # the class of the fixture

NOW = datetime.now(UTC)


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    authority = open_authority(tmp_path / "c", "ring", NOW)
    for machine in machines_of("ring", [], ["10.0.0.1"], tmp_path / "c"):
        authority.issue(machine, NOW)
    return tmp_path / "c"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.10", "10.0.0.1", "localhost.example.org", "rig-pc"])
def test_another_address_is_refused_without_certificates_or_users(
    guests: Guests, certificates: Path, tmp_path: Path, host: str
) -> None:
    config = ControllerConfig(archive=tmp_path / "archive", host=host, port=0)
    folder, users = certificates / "controller", guests.file.path
    for missing in ({}, {"certificates": folder}, {"users": users}):
        with pytest.raises(InputError, match="ringdic rig certificates") as refusal:
            run_controller(ControllerConfig(**{**vars(config), **missing}))
        assert "ringdic users add" in str(refusal.value)
    secured = page_security(ControllerConfig(**{**vars(config), "certificates": folder, "users": users}))
    assert secured.scheme == "https"
    assert secured.server_settings["ssl_certfile"] == str(folder / "certificate.pem")


def test_files_of_the_configuration_that_protect_nothing_are_refused(
    guests: Guests, certificates: Path, tmp_path: Path
) -> None:
    def config(certificates: Path, users: Path) -> ControllerConfig:
        return ControllerConfig(tmp_path / "archive", host="0.0.0.0", certificates=certificates, users=users)

    with pytest.raises(InputError, match=r"authority\.pem cannot be read"):
        page_security(config(tmp_path / "nothing", guests.file.path))
    with pytest.raises(InputError, match="no such file"):
        page_security(config(certificates / "controller", tmp_path / "nothing.json"))
    for name in ("anna", "vito", "script", "screen"):
        guests.file.remove(name)
    with pytest.raises(InputError, match="names nobody"):
        page_security(config(certificates / "controller", guests.file.path))


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_on_loopback_neither_is_needed_and_users_count_where_they_are_named(
    guests: Guests, tmp_path: Path, host: str
) -> None:
    bare = page_security(ControllerConfig(archive=tmp_path, host=host))
    assert (bare.scheme, bare.access.logins) == ("http", None)
    assert bare.server_settings == {"proxy_headers": False}
    assert page_security(ControllerConfig(archive=tmp_path, host=host, users=guests.file.path)).access.logins


@pytest.fixture
def served(guests: Guests, certificates: Path, tmp_path: Path) -> Iterator[str]:
    """The page under TLS, on a free port of loopback."""
    config = ControllerConfig(
        tmp_path / "archive", host="0.0.0.0", certificates=certificates / "controller", users=guests.file.path
    )
    secured = page_security(config)
    settings = uvicorn.Config(
        create_app(guests.desk, access=secured.access), log_level="warning", timeout_graceful_shutdown=1,
        **secured.server_settings,
    )  # fmt: skip
    server = uvicorn.Server(settings)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        yield f"https://127.0.0.1:{listener.getsockname()[1]}"
        server.should_exit = True
        thread.join(10)


def test_the_rigs_authority_vouches_for_the_page_and_a_stream_ends_with_the_right_to_it(
    served: str, guests: Guests, certificates: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate, "LOOK_AGAIN", 0.0)
    trusted = ssl.create_default_context(cafile=str(certificates / "authority.pem"))
    bearer = {"Authorization": f"Bearer {guests.viewer_token}", "X-Forwarded-For": "127.0.0.1"}
    with pytest.raises(httpx.ConnectError, match="certificate"):
        httpx.get(served)
    with pytest.raises(httpx.HTTPError):
        httpx.get(served.replace("https", "http"))
    with httpx.Client(verify=trusted, base_url=served, timeout=30) as client:
        assert client.get("/api/v1/live").status_code == 401
        with client.stream("GET", "/api/v1/live", headers=bearer) as stream:
            lines = stream.iter_lines()
            assert next(lines) == "event: snapshot"
            guests.file.remove("screen")
            told = threading.Event()

            def tell() -> None:
                while not told.wait(0.05):
                    guests.desk.state.publish_rig()

            teller = threading.Thread(target=tell)
            teller.start()
            began = time.monotonic()
            rest = list(lines)
            told.set()
            teller.join()
        assert time.monotonic() - began < 30
        assert not any(line.startswith("event: rig") for line in rest[3:])
        assert client.get("/api/v1/rig", headers=bearer).status_code == 401
