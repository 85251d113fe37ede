"""Users of a page: an operator, a viewer and a token of each, with hashes that are quick to make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from argon2 import PasswordHasher
from fastapi.testclient import TestClient
from ringdic_controller.access import users
from ringdic_controller.access.audit import AuditLog
from ringdic_controller.access.logins import Logins
from ringdic_controller.access.users import UserFile
from ringdic_controller.service.app import create_app
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.gate import Access

PASSWORD = "four words are better"


@dataclass
class Guests:
    """The users of a page, its audit log, and clients of it."""

    file: UserFile
    access: Access
    desk: Desk
    operator_token: str
    viewer_token: str

    def client(self, scheme: str = "http", address: str = "10.0.0.7") -> TestClient:
        app = create_app(self.desk, access=self.access)
        return TestClient(app, f"{scheme}://127.0.0.1", client=(address, 50000), follow_redirects=False)

    def logged_in(self, name: str, **more: str) -> TestClient:
        client = self.client(**more)
        assert client.post("/login", data={"name": name, "password": PASSWORD}).status_code == 303
        return client


@pytest.fixture
def quick_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(users, "_hasher", PasswordHasher(time_cost=1, memory_cost=8, parallelism=1))


@pytest.fixture
def guests(quick_hashes: None, desk: Desk, tmp_path: Path) -> Guests:
    file = UserFile(tmp_path / "users.json")
    file.set_user("anna", "operator", PASSWORD)
    file.set_user("vito", "viewer", PASSWORD)
    tokens = file.add_token("script", "operator"), file.add_token("screen", "viewer")
    access = Access(AuditLog(desk.catalogue.root / "audit.jsonl"), Logins(file))
    return Guests(file, access, desk, *tokens)
