"""The login in a real browser: the page asks who one is, a viewer finds no buttons that act, and a logout is one."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import pytest
import uvicorn
from playwright.sync_api import Browser, Page, expect
from ringdic_controller.service.app import STATIC, create_app

pytestmark = pytest.mark.browser

PASSWORD = "four words are better"  # of all users
Guests = Any  # the fixture's class


@pytest.fixture
def address(guests: Guests, skip_or_fail: Callable[[str], NoReturn]) -> Iterator[str]:
    """The page of the guests, on a free port of loopback."""
    if not (STATIC / "index.html").is_file():
        skip_or_fail("the page is not built")
    app = create_app(guests.desk, access=guests.access)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        server.should_exit = True
        thread.join(10)


def log_in(page: Page, name: str, password: str = PASSWORD) -> None:
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name="Log in").click()


def test_a_user_logs_in_acts_and_logs_out_and_a_viewer_only_looks(
    browser: Browser, address: str, guests: Guests
) -> None:
    context = browser.new_context()
    context.set_default_timeout(30_000)
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text) if "Content Security" in message.text else None)
    page.goto(address)
    assert page.url == f"{address}/login"
    log_in(page, "anna", "wrong")
    expect(page.get_by_role("alert")).to_have_text("Name or password is wrong.")
    log_in(page, "anna")
    expect(page.locator("#account-name")).to_have_text("anna")
    expect(page.locator("#live")).to_have_text("live")
    assert page.evaluate("document.cookie") == "", "scripts do not see the login"
    page.locator("#session-name").fill("limb")
    page.locator("#session-create").click()
    expect(page.locator("#session-select")).to_have_value("limb")
    expect(page.locator("#capture-board")).to_be_visible()
    page.get_by_role("button", name="Log out").click()
    page.wait_for_url(f"{address}/login")

    log_in(page, "vito")
    expect(page.locator("#account-name")).to_have_text("vito (viewer)")
    expect(page.locator("#session-select")).to_have_value("limb")
    for act in ("#capture-board", "#session-create", "#job-start"):
        expect(page.locator(act)).to_be_hidden()
    guests.file.remove("vito")
    page.reload()
    assert page.url == f"{address}/login"
    assert complaints == []
    context.close()
