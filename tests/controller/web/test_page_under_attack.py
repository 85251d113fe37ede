"""Attacks on the page in a real browser: scripts in what a session brings, foreign names, foreign pages, frames."""

from __future__ import annotations

import http.server
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest
import uvicorn
from playwright.sync_api import Browser, BrowserContext, Error, Page, expect, sync_playwright
from ringdic.session.writer import Archive
from ringdic_controller.service.app import STATIC, create_app
from ringdic_controller.service.desk import Desk
from starlette.responses import HTMLResponse
from starlette.types import Receive, Scope, Send

pytestmark = pytest.mark.browser

WAIT = 30_000  # ms; a loaded machine is slow
FOREIGN = "evil.example"  # the browser finds this PC under the name, as after DNS rebinding
# Asks for an address that nothing else asks for, where it runs.
SCRIPT = "fetch('/api/v1/hacked')"
MARKUP = f'<img src=x onerror="{SCRIPT}"><script>{SCRIPT}</script>'
NAME = "<img src=x onerror=fetch('hacked')>"  # a folder's name has no slash


@pytest.fixture(scope="module")
def mapped_browser(chromium: dict[str, Any]) -> Iterator[Browser]:
    """Chromium that finds this PC under a foreign name."""
    rules = [*chromium["args"], f"--host-resolver-rules=MAP {FOREIGN} 127.0.0.1"]
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(**chromium | {"args": rules})
        yield launched
        launched.close()


@pytest.fixture
def context(mapped_browser: Browser) -> Iterator[BrowserContext]:
    """A fresh profile."""
    made = mapped_browser.new_context()
    made.set_default_timeout(WAIT)
    yield made
    made.close()


@dataclass
class Watched:
    """A page, and all addresses that it has asked for or that it was refused."""

    page: Page
    asked: list[str]

    def open(self, address: str) -> int:
        """Open an address; the status of the answer."""
        answer = self.page.goto(address)
        assert answer is not None
        return answer.status


@pytest.fixture
def watched(context: BrowserContext) -> Watched:
    """A new page."""
    found = Watched(context.new_page(), [])
    found.page.on("request", lambda request: found.asked.append(request.url))
    return found


@pytest.fixture
def served(desk: Desk, skip_or_fail: Callable[[str], NoReturn]) -> Iterator[str]:
    """Address of the desk's page."""
    if not (STATIC / "index.html").is_file():
        skip_or_fail("the page is not bundled: install again without RINGDIC_SKIP_PAGE")
    page = create_app(desk)

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        """The page, and at one address what an attacker's server served before its name pointed to this PC."""
        attacker = scope["type"] == "http" and scope["path"] == "/start"
        await (HTMLResponse("<p>") if attacker else page)(scope, receive, send)

    server = uvicorn.Server(uvicorn.Config(application, log_level="critical", timeout_graceful_shutdown=1))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        server.should_exit = True
        thread.join(10)


@pytest.fixture
def foreign_page() -> Iterator[Callable[[str], str]]:
    """Call it with HTML: the address of a page of another origin that shows it."""
    content = [b""]

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(content[0])

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()

    def show(html: str) -> str:
        content[0] = html.encode()
        return f"http://127.0.0.1:{server.server_port}/"

    yield show
    server.shutdown()
    thread.join(10)
    server.server_close()


def hostile_session(root: Path) -> Path:
    """A session of a hostile name, with markup in every text that its records can hold, and in its report."""
    capture = Archive(root).create_session("limb", '[rig]\nname = "r"\n').begin_capture("specimen", ["01"])
    capture.close({"01": MARKUP})
    record = json.loads((capture.path / "capture.json").read_text())
    record["cameras"] = {MARKUP: record["cameras"]["01"] | {"metadata": {MARKUP: MARKUP}}}
    (capture.path / "capture.json").write_text(json.dumps(record | {"note": MARKUP, "opened_at": MARKUP}))
    damaged = capture.path.with_name("0002-specimen")
    damaged.mkdir()
    (damaged / "capture.json").write_text(json.dumps({"schema": 1, MARKUP: 1, "capture_id": MARKUP}))
    header = json.loads((root / "limb" / "session.json").read_text())
    (root / "limb" / "session.json").write_text(json.dumps(header | {"session": MARKUP, "rig": MARKUP}))
    run = root / "limb" / "results" / "0001"
    run.mkdir(parents=True)
    (run / "results.h5").write_bytes(b"no HDF5")
    (run / "summary.json").write_text(json.dumps({"points": MARKUP, "table": [{"quantity": MARKUP}]}))
    (run / "report.html").write_text(f"<title>report</title><h1>Report</h1>{MARKUP}<svg onload={SCRIPT}>")
    return (root / "limb").rename(root / NAME)


def test_no_script_in_what_a_session_brings_is_run(desk: Desk, served: str, watched: Watched) -> None:
    hostile_session(desk.catalogue.root)
    desk.catalogue.sync()
    assert watched.open(served) == 200
    expect(watched.page.locator("#session-select")).to_have_value(NAME)
    expect(watched.page.locator("#damaged")).to_contain_text("0002-specimen")
    expect(watched.page.locator("#captures")).to_contain_text("0001-specimen")
    watched.page.wait_for_timeout(300)
    address = f"{served}/api/v1/sessions/{NAME.replace('/', '%2F')}/results/0001/report"
    assert watched.open(address) == 200
    assert "Report" in watched.page.content()
    watched.page.wait_for_timeout(300)
    assert [url for url in watched.asked if url.endswith("hacked")] == []
    assert [url for url in watched.asked if not url.startswith((served, "data:"))] == []


def test_a_script_of_a_report_would_be_noticed(
    served: str, watched: Watched, foreign_page: Callable[[str], str]
) -> None:
    assert watched.open(foreign_page(MARKUP)) == 200
    watched.page.wait_for_timeout(300)
    assert [url for url in watched.asked if url.endswith("hacked")] != []


def test_a_foreign_name_of_this_pc_shows_and_captures_nothing(desk: Desk, served: str, watched: Watched) -> None:
    desk.create_session("limb")
    rebound = served.replace("127.0.0.1", FOREIGN)
    assert watched.open(rebound) == 403
    watched.open(f"{rebound}/start")
    script = """async (root) => {
        const json = { method: "POST", headers: { "Content-Type": "application/json" }, body: '{"kind": "board"}' };
        return (await fetch(root + "/api/v1/captures", json)).status;
    }"""
    assert watched.page.evaluate(script, rebound) == 403
    assert desk.rounds.newest() is None


def test_a_foreign_page_changes_nothing_and_frames_nothing(
    desk: Desk, served: str, watched: Watched, foreign_page: Callable[[str], str]
) -> None:
    desk.create_session("limb")
    job = desk.jobs.submit("limb", desk.catalogue.path("limb"), reason="asked for", after=600)
    html = f"""
        <iframe src="{served}/" name="framed"></iframe>
        <img src="{served}/api/v1/rig">
        <form method="post" action="{served}/api/v1/jobs/{job.id}/cancel" target="out"></form>
        <iframe name="out"></iframe>
        <script>
            const simple = {{ method: "POST", mode: "no-cors" }};
            const attempts = [
                fetch("{served}/api/v1/jobs/{job.id}/cancel", simple),
                fetch("{served}/api/v1/captures", {{ ...simple, body: '{{"kind": "board"}}' }}),
                fetch("{served}/api/v1/sessions", {{
                    method: "POST", headers: {{ "Content-Type": "application/json" }}, body: "{{}}",
                }}),
            ];
            document.forms[0].submit();
            Promise.allSettled(attempts).then(() => {{ document.title = "tried"; }});
        </script>"""
    watched.open(foreign_page(html))
    expect(watched.page).to_have_title("tried")
    watched.page.wait_for_timeout(500)
    assert desk.jobs.get(job.id).state == "queued"
    assert desk.rounds.newest() is None
    assert [session["name"] for session in desk.catalogue.sessions()] == ["limb"]
    assert len([url for url in watched.asked if url.startswith(served)]) >= 5, "all of it was tried"
    frame = watched.page.frame("framed")
    assert frame is not None
    with suppress(Error):  # where the browser shows its own page, which is nobody's to read
        assert "RingDIC" not in frame.content()


def test_the_page_works_under_its_own_policy(desk: Desk, served: str, watched: Watched) -> None:
    faults: list[str] = []
    watched.page.on("console", lambda line: faults.append(line.text) if line.type == "error" else None)
    watched.page.on("pageerror", lambda error: faults.append(str(error)))
    desk.create_session("limb")
    assert watched.open(served) == 200
    watched.page.click("#capture-board")
    expect(watched.page.locator("#captures")).to_contain_text("0001-board")
    deadline = time.monotonic() + WAIT / 1000
    while desk.rounds.running() is not None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    watched.page.click("#captures summary")
    watched.page.fill("#captures input", "a note & <b>more</b>")
    watched.page.press("#captures input", "Enter")
    expect(watched.page.locator("#captures summary")).to_contain_text("a note & <b>more</b>")
    watched.page.fill("#session-name", "second")
    watched.page.click("#session-create")
    expect(watched.page.locator("#session-select")).to_have_value("second")
    assert faults == []
