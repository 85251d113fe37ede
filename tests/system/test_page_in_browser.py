"""The operator's page in a real browser, over a real controller and real node processes on loopback."""

from __future__ import annotations

import base64
import hashlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import cv2
import httpx
import numpy as np
import pytest
import uvicorn
from playwright.sync_api import Browser, Page, expect
from ringdic_controller.jobs.children import Command, Processing, WarmChild
from ringdic_controller.service.app import STATIC, create_app
from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.service import SHUTDOWN_LIMIT, free_endpoint, open_desk

pytestmark = pytest.mark.browser

CAMERAS = ("01", "02", "03", "04")
STAND_IN = Path(__file__).parents[1] / "controller" / "stand_in_processing.py"
PACE = 1.0  # seconds that the stand-in's processing takes
WAIT = 30_000  # ms; a loaded machine is slow


@dataclass
class Station:
    """A running controller with its nodes."""

    address: str
    desk: Desk
    folder: Path
    config: ControllerConfig
    nodes: dict[str, subprocess.Popen[bytes]]

    def start_node(self, camera: str) -> None:
        """Start the node process of a camera."""
        config = self.folder / f"node-{camera}.toml"
        config.write_text(
            f'rig = "page-ring"\nid = "{camera}"\ncontroller = "{self.config.endpoint}"\n'
            f'spool = "spool-{camera}"\ncamera = "pattern"\nstatus_s = 0.5\n[pattern]\nwidth = 120\nheight = 160\n'
        )
        command = [sys.executable, "-P", "-m", "ringdic_node", "run", "--config", str(config)]
        with (self.folder / f"node-{camera}.log").open("ab") as log:
            self.nodes[camera] = subprocess.Popen(command, stdout=log, stderr=log)

    def kill_node(self, camera: str) -> None:
        """Kill the node process of a camera."""
        self.nodes[camera].kill()
        self.nodes[camera].wait(10)

    def post(self, path: str, body: dict[str, Any]) -> Any:
        """Ask the controller by HTTP."""
        answer = httpx.post(f"{self.address}/api/v1/{path}", json=body, timeout=20)
        answer.raise_for_status()
        return answer.json()

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + WAIT / 1000
        while not condition():
            assert time.monotonic() < deadline, f"{what} never came about"
            time.sleep(0.05)

    def capture(self, kind: str) -> None:
        """Capture, and wait for the close."""
        begun = self.post("captures", {"kind": kind})["id"]
        self.until(lambda: self.desk.rounds.get(begun).state == "closed", f"the {kind} capture")

    def processed_session(self, name: str, steps: int = 3) -> None:
        """A session of its own with results, made without the page."""
        self.post("sessions", {"name": name})
        for kind in ("board", "target", *["specimen"] * steps):
            self.capture(kind)
            self.until(lambda: all(job.finished for job in self.desk.jobs.list()), "the end of the jobs")


@contextmanager
def running_station(folder: Path, rig: str, processing: Command | Processing) -> Iterator[Station]:
    """A controller served over HTTP, and its nodes."""
    (folder / "rig.toml").write_text(rig)
    config = free_endpoint(ControllerConfig(archive=folder / "archive", rig=folder / "rig.toml"))
    with open_desk(config, processing) as desk, socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(
            uvicorn.Config(create_app(desk), log_level="warning", timeout_graceful_shutdown=SHUTDOWN_LIMIT)
        )
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        made = Station(f"http://127.0.0.1:{listener.getsockname()[1]}", desk, folder, config, {})
        try:
            for camera in CAMERAS:
                made.start_node(camera)
            made.until(lambda: not desk.roster.missing(), "every node's appearance")
            yield made
        finally:
            server.should_exit = True
            thread.join(10)
            for process in made.nodes.values():
                process.terminate()
            for process in made.nodes.values():
                try:
                    process.wait(10)
                except subprocess.TimeoutExpired:
                    process.kill()


@pytest.fixture(scope="module")
def bundled(skip_or_fail: Callable[[str], NoReturn]) -> None:
    if not (STATIC / "index.html").is_file():
        skip_or_fail("the page is not bundled: install again without RINGDIC_SKIP_PAGE")


@pytest.fixture(scope="module")
def station(
    bundled: None, tmp_path_factory: pytest.TempPathFactory, rig_toml: Callable[[str, Sequence[str]], str]
) -> Iterator[Station]:
    def command(session: Path) -> list[str]:
        return [sys.executable, str(STAND_IN), str(session), "--seconds", str(PACE)]

    with running_station(tmp_path_factory.mktemp("station"), rig_toml("page-ring", CAMERAS), command) as made:
        yield made


@pytest.fixture(scope="module")
def live_station(
    bundled: None, tmp_path_factory: pytest.TempPathFactory, rig_toml: Callable[[str, Sequence[str]], str]
) -> Iterator[Station]:
    """A controller that processes every step at once."""
    processing = WarmChild([sys.executable, str(STAND_IN), "--serve", "--seconds", "0.2"])
    with running_station(tmp_path_factory.mktemp("live"), rig_toml("page-ring", CAMERAS), processing) as made:
        made.desk.processing.quiet = 600.0  # the whole session follows when a test wants it
        yield made


@contextmanager
def opened_page(browser: Browser, station: Station) -> Iterator[Page]:
    """The page, opened; whatever the browser complains about fails the test."""
    complaints: list[str] = []
    context = browser.new_context(viewport={"width": 1440, "height": 900})
    context.set_default_timeout(WAIT)
    opened = context.new_page()
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    asked: list[str] = []
    opened.on("request", lambda request: asked.append(request.url))
    opened.goto(station.address)
    expect(opened.locator("#live")).to_have_text("live", timeout=WAIT)
    yield opened
    context.close()
    unexpected = [text for text in complaints if "409" not in text and "422" not in text]
    assert not unexpected, unexpected
    strangers = [address for address in asked if not address.startswith((station.address, "data:"))]
    assert not strangers, strangers  # the page needs nobody but its controller


@pytest.fixture
def page(browser: Browser, station: Station) -> Iterator[Page]:
    with opened_page(browser, station) as opened:
        yield opened


@pytest.fixture
def live_page(browser: Browser, live_station: Station) -> Iterator[Page]:
    with opened_page(browser, live_station) as opened:
        yield opened


def drawn(page: Page) -> np.ndarray:
    """The pixels of the surface, (h, w, 4) blue, green, red, opacity."""
    address = page.evaluate("document.getElementById('surface').toDataURL('image/png')")
    png = np.frombuffer(base64.b64decode(address.split(",")[1]), np.uint8)
    return cv2.imdecode(png, cv2.IMREAD_UNCHANGED)


def opaque(pixels: np.ndarray) -> np.ndarray:
    """(n, 3) blue, green, red of the pixels where something is drawn."""
    return pixels[pixels[..., 3] > 0][:, :3].astype(int)


def shown(page: Page, what: str) -> np.ndarray:
    """The pixels once the page shows ``field/step/removed``."""
    expect(page.locator("#surface")).to_have_attribute("data-shown", what, timeout=WAIT)
    return drawn(page)


def ticks(page: Page) -> list[float]:
    return [float(text) for text in page.locator("#legend .tick").all_text_contents()]


def test_an_operator_presses_the_buttons_and_sees_the_strain(page: Page, station: Station) -> None:
    """From no session to the surface in colour, by buttons alone."""
    expect(page.locator("#capture-board")).to_be_disabled()
    expect(page.locator("#capture-status")).to_contain_text("no session yet")
    page.fill("#session-name", "by-hand")
    page.click("#session-create")
    expect(page.locator("#session-select")).to_have_value("by-hand", timeout=WAIT)
    expect(page.locator("#nodes .node.gone")).to_have_count(0)
    expect(page.locator("#nodes .node")).to_have_count(len(CAMERAS))
    for name in ("0001-board", "0002-target", "0003-specimen", "0004-specimen"):
        button = page.locator(f"#capture-{name[5:]}")
        expect(button).to_be_enabled(timeout=WAIT)
        button.click()
        listed = page.locator(f"[data-capture='{name}'][data-state='closed']")
        expect(listed).to_contain_text(f"{len(CAMERAS)} ok", timeout=WAIT)
        expect(listed).to_contain_text("skew")
    expect(page.locator("#job .job-state")).to_have_text("running", timeout=WAIT)
    expect(page.locator("#job .job-pace")).to_contain_text("1000 points/s")
    expect(page.locator("#job .job-state")).to_have_text("done", timeout=WAIT)
    pixels = opaque(shown(page, "lambda2/1/false"))
    assert len(pixels) > 10_000
    blue, _, red = np.median(pixels, axis=0)
    assert red > 2 * blue  # the tube is stretched by 10 %, and red is more than 1
    expect(page.locator("#legend .legend-title")).to_contain_text("λ2")
    assert min(ticks(page)) == pytest.approx(0.9)
    assert max(ticks(page)) == pytest.approx(1.1)
    expect(page.locator("#table")).to_contain_text("larger stretch")
    expect(page.locator("#verdict strong")).to_have_text("! Look at this: camera 02")
    expect(page.locator("#verdict li b")).to_have_text("camera 02 · 0004-specimen")
    expect(page.locator("#verdict li")).to_contain_text("moved since the reference, by 1.20 px")
    expect(page.locator("#session-select option:checked")).to_have_text("by-hand (4 captures, 1 run)")


def test_the_images_of_a_capture_can_be_looked_at_and_had(page: Page, station: Station) -> None:
    station.post("sessions", {"name": "pictures"})
    expect(page.locator("#session-select")).to_have_value("pictures", timeout=WAIT)
    page.locator("#capture-board").click()
    capture = page.locator("[data-capture='0001-board'][data-state='closed']")
    expect(capture).to_be_visible(timeout=WAIT)
    capture.locator("summary").click()
    images = capture.locator(".thumb img")
    expect(images).to_have_count(len(CAMERAS))
    loaded = "[...document.querySelectorAll('.thumb img')].every((image) => image.naturalWidth > 0)"
    station.until(lambda: page.evaluate(loaded), "the pictures")  # what waits inside the page needs its eval
    capture.get_by_role("button", name="Show camera 02").click()
    expect(page.locator("#picture")).to_be_visible()
    expect(page.locator("#picture-title")).to_have_text("0001-board, camera 02")
    with page.expect_download() as download:
        page.click("#picture-original")
    record = station.desk.catalogue.capture("pictures", "0001-board")["cameras"]["02"]
    assert hashlib.sha256(Path(download.value.path()).read_bytes()).hexdigest() == record["sha256"]
    page.click("#picture-close")
    expect(page.locator("#picture")).to_be_hidden()


def test_every_control_of_the_results_does_what_it_says(page: Page, station: Station) -> None:
    station.processed_session("controls")
    page.select_option("#session-select", "controls")
    at_2 = shown(page, "lambda2/2/false")
    assert max(ticks(page)) == pytest.approx(1.2)

    page.locator("#step").fill("0")
    at_0 = opaque(shown(page, "lambda2/0/false"))
    assert (np.ptp(np.median(at_0, axis=0))) < 12  # no stretch: neither red nor blue
    expect(page.locator("#step-name")).to_contain_text("reference")

    page.locator("#step").fill("2")
    page.select_option("#field", "displacement_z")
    height = shown(page, "displacement_z/2/false")
    assert (height != at_2).any()
    expect(page.locator("#legend .legend-title")).to_contain_text("mm")
    rows = np.flatnonzero((height[..., 3] > 0).any(axis=1))
    top, bottom = (opaque(height[rows[k] : rows[k] + 5]) for k in (len(rows) // 6, 5 * len(rows) // 6))
    assert (top[:, 2] - top[:, 0]).mean() > (bottom[:, 2] - bottom[:, 0]).mean() + 40  # redder where it moved more

    page.select_option("#field", "displacement_x")
    turned = shown(page, "displacement_x/2/false")
    page.check("#rigid")
    assert np.ptp(opaque(turned)[:, 2]) > 100  # one side moves towards, the other away
    shown(page, "displacement_x/2/true")
    page.fill("#low", "-10")
    page.fill("#high", "10")
    page.press("#high", "Enter")
    expect(page.locator("#legend .tick").last).to_have_text("10")
    assert np.ptp(np.median(opaque(drawn(page)), axis=0)) < 12  # nothing is left of the turn
    page.fill("#high", "-11")
    page.press("#high", "Enter")
    expect(page.locator("#notice")).to_contain_text("limits")
    page.click("#auto")
    assert max(ticks(page)) < 1
    page.uncheck("#rigid")

    page.click("#reset-view")  # the view was made for the first run
    page.select_option("#field", "correlation")
    before = shown(page, "correlation/2/false")
    box = page.locator("#surface").bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    expect(page.locator("#pick")).to_contain_text("0.02", timeout=WAIT)
    page.mouse.down()
    page.mouse.move(middle[0] + 150, middle[1] + 120, steps=4)
    page.mouse.up()
    page.wait_for_timeout(200)
    assert (drawn(page) != before).any()
    page.click("#reset-view")
    page.wait_for_timeout(200)
    assert (drawn(page) != before).any(axis=-1).mean() < 0.002

    page.click("#play")
    expect(page.locator("#step")).to_have_value("1", timeout=WAIT)
    page.click("#play")
    expect(page.locator("#play")).to_have_attribute("aria-pressed", "false")

    runs = page.locator("#run option")
    last = runs.first.get_attribute("value")
    assert runs.count() == 2  # after the first step and after the second
    page.select_option("#run", "0001")
    expect(page.locator("#step")).to_have_attribute("max", "1", timeout=WAIT)
    page.select_option("#run", last)
    expect(page.locator("#step")).to_have_attribute("max", "2", timeout=WAIT)
    with page.expect_download() as download:
        page.click("#download")
    assert Path(download.value.path()).read_bytes()[1:4] == b"HDF"


def test_what_was_not_measured_is_told_by_reason_and_shown_on_the_photographs(page: Page, station: Station) -> None:
    station.processed_session("bare")
    page.select_option("#session-select", "bare")
    part = page.locator("#unmeasured")
    expect(part.locator("summary")).to_have_text(
        "Not measured: 1.2 cm² of the texture that two cameras see", timeout=WAIT
    )
    part.locator("summary").click()
    expect(part.locator("li")).to_have_text(
        ["the images do not look alike: 0.7 cm²", "the lines of sight miss one another: 0.5 cm²"]
    )
    expect(part.locator("figcaption")).to_have_text(["01"])
    shown = "document.querySelector('#unmeasured-pictures img')?.naturalWidth > 0"
    station.until(lambda: page.evaluate(shown), "the picture")


def test_processing_is_started_watched_and_cancelled(page: Page, station: Station) -> None:
    station.processed_session("again", steps=2)
    expect(page.locator("#session-select")).to_have_value("again", timeout=WAIT)
    expect(page.locator("#job .job-state")).to_have_text("done", timeout=WAIT)
    page.locator("#job-log-box summary").click()
    expect(page.locator("#job-log")).to_contain_text("the tube is computed")
    page.click("#job-start")
    expect(page.locator("#job .job-state")).to_have_text("running", timeout=WAIT)
    expect(page.locator("#job-start")).to_be_disabled()
    page.click("#job-cancel")
    expect(page.locator("#job .job-state")).to_have_text("cancelled", timeout=WAIT)
    expect(page.locator("#job-cancel")).to_be_hidden()
    expect(page.locator("#job-start")).to_be_enabled()


def test_a_dead_node_is_seen_named_and_can_be_left_out(page: Page, station: Station) -> None:
    station.post("sessions", {"name": "without-03"})
    expect(page.locator("#session-select")).to_have_value("without-03", timeout=WAIT)
    station.kill_node("03")
    try:
        expect(page.locator("[data-node='03']")).to_contain_text("not connected", timeout=WAIT)
        expect(page.locator("#capture-board")).to_be_disabled()
        expect(page.locator("#capture-status")).to_contain_text("Camera 03")
        page.check("#override")
        page.locator("#capture-board").click()
        capture = page.locator("[data-capture='0001-board'][data-state='closed']")
        expect(capture).to_contain_text("3 ok", timeout=WAIT)
        expect(capture).to_contain_text("1 failed")
        capture.locator("summary").click()
        expect(capture.locator(".camera.failed small")).not_to_be_empty()
    finally:
        station.start_node("03")
    expect(page.locator("[data-node='03']")).not_to_contain_text("not connected", timeout=WAIT)


def test_a_name_that_is_taken_is_told_and_the_page_fits_a_narrow_window(page: Page, station: Station) -> None:
    station.post("sessions", {"name": "taken"})
    page.fill("#session-name", "taken")
    page.press("#session-name", "Enter")
    expect(page.locator("#notice")).to_contain_text("already")
    page.set_viewport_size({"width": 420, "height": 900})
    assert page.evaluate("document.documentElement.scrollWidth") <= 420


def test_the_live_view_follows_the_newest_step_and_keeps_what_the_operator_chose(
    live_page: Page, live_station: Station
) -> None:
    page, station = live_page, live_station
    surface, axis = page.locator("#surface"), page.locator("#axis-x")
    station.post("sessions", {"name": "tension"})
    for kind in ("board", "target", "specimen"):
        station.capture(kind)
    expect(surface).to_have_attribute("data-of", "live/0003-specimen", timeout=WAIT)  # the reference: its shape
    station.capture("specimen")
    expect(surface).to_have_attribute("data-of", "live/0004-specimen", timeout=WAIT)
    expect(page.locator("#live-step")).to_contain_text("0004-specimen")
    assert 0 < float(page.locator("#live-step").get_attribute("data-seconds") or "nan") < WAIT / 1000
    expect(page.locator("#report")).to_be_hidden()
    assert max(ticks(page)) == pytest.approx(1.1)
    station.capture("specimen")
    expect(surface).to_have_attribute("data-of", "live/0005-specimen", timeout=WAIT)
    assert max(ticks(page)) == pytest.approx(1.2)  # the limits widen

    page.select_option("#field", "displacement_z")
    shown(page, "displacement_z/1/false")
    page.fill("#low", "-7")
    page.fill("#high", "50")
    page.press("#high", "Enter")
    box = surface.bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 150, middle[1] + 60, steps=4)
    page.mouse.up()
    turned = axis.get_attribute("x2")
    before = drawn(page)
    station.capture("specimen")
    expect(surface).to_have_attribute("data-of", "live/0006-specimen", timeout=WAIT)
    assert (drawn(page) != before).any()
    expect(surface).to_have_attribute("data-shown", "displacement_z/1/false")
    assert axis.get_attribute("x2") == turned
    assert (page.input_value("#low"), page.input_value("#high")) == ("-7", "50")

    page.uncheck("#follow")
    station.capture("specimen")
    expect(page.locator("#live-step")).to_contain_text("0007-specimen", timeout=WAIT)
    expect(surface).to_have_attribute("data-of", "live/0006-specimen")
    page.check("#follow")
    expect(surface).to_have_attribute("data-of", "live/0007-specimen", timeout=WAIT)
    page.click("#job-start")
    expect(surface).to_have_attribute("data-of", "results/0001", timeout=WAIT)  # every step of the session
    expect(page.locator("#step")).to_have_attribute("max", "4")
    page.select_option("#run", "live")
    expect(surface).to_have_attribute("data-of", "live/0007-specimen", timeout=WAIT)


def test_a_capture_at_rest_is_a_button_and_the_processing_tells_that_it_is_ready(
    live_page: Page, live_station: Station
) -> None:
    live_station.post("sessions", {"name": "rest"})
    expect(live_page.locator("#session-select")).to_have_value("rest", timeout=WAIT)
    expect(live_page.locator("#warmth")).to_have_text("ready")
    live_page.locator("#capture-static").click()
    listed = live_page.locator("[data-capture='0001-static'][data-state='closed']")
    expect(listed).to_contain_text(f"{len(CAMERAS)} ok", timeout=WAIT)
