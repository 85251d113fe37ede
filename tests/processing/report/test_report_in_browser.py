"""The report of a run as its reader has it: in a browser, without a network, with the numbers of the results."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from ringdic.errors import InputError
from ringdic.findings import Finding, verdict_figures
from ringdic.geometry.camera import Camera, Intrinsics
from ringdic.measure.region import Everything, region_statistics
from ringdic.pictures.unmeasured import COLOURS, unmeasured_legend, unmeasured_picture
from ringdic.report import write_report
from ringdic.results.evaluation import evaluate_results
from ringdic.results.results import Results
from ringdic.results.unmeasured import UnmeasuredPlaces, unmeasured_areas
from ringdic.results.writer import write_results

RADIUS, AROUND, ALONG = 50.0, 60, 21
STEPS = ("0001-specimen", "0002-specimen", "0003-specimen")
LOST = (30, 31, 700)
SIZE = (240, 320)
MOVED = Finding("camera-moved-unknown", "camera 3 <b>moved</b> & was named", ("3",), "0002")
BARE = UnmeasuredPlaces(
    "2", np.array([[60.0, 60.0], [75.0, 60.0], [90.0, 60.0]]), 15.0, np.array([3, 16, 33], np.int8),
    np.array([150.0, 320.0, 90.0]),
)  # fmt: skip


def camera(id_: str, azimuth: float) -> Camera:
    """400 mm from the axis, looking at it level."""
    K = np.array([[420.0, 0.0, 119.5], [0.0, 420.0, 159.5], [0.0, 0.0, 1.0]])
    c, s = np.cos(azimuth), np.sin(azimuth)
    R = np.array([[-s, c, 0.0], [0.0, 0.0, -1.0], [-c, -s, 0.0]])
    P = K @ np.column_stack([R, -R @ np.array([400.0 * c, 400.0 * s, 25.0])])
    return Camera(id_, P / P[2, 3], SIZE, Intrinsics(K, np.zeros(5), SIZE))


def twisted_tube() -> Results:
    angle, z = np.meshgrid(np.arange(AROUND) * 2 * np.pi / AROUND, 2.5 * np.arange(ALONG), indexing="ij")
    reference = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), z], -1).reshape(-1, 3)
    n = np.arange(AROUND * ALONG).reshape(AROUND, ALONG)
    m = np.roll(n, -1, axis=0)
    a, b, c, d = (part.ravel() for part in (n[:, :-1], m[:, :-1], m[:, 1:], n[:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([reference * [1.0 - 0.01 * k, 1.0 - 0.01 * k, 1.0 + 0.001 * k * 30] for k in range(3)])
    status = np.zeros((3, len(reference)), dtype=np.int8)
    vertices[2, LOST], status[2, LOST] = np.nan, 3
    known = np.isfinite(vertices).all(axis=2)
    return Results(
        rig="report-ring", steps=STEPS, cameras=tuple(camera(id_, k * np.pi / 2) for k, id_ in enumerate("1234")),
        pairs=(("1", "2"),), vertices_ref=reference, vertices=vertices, faces=faces,
        pair=np.zeros(len(faces), dtype=np.int64), vertex_pair=np.zeros(len(reference), dtype=np.int64),
        correlation=np.where(known, 0.013, np.nan), sigma_xyz=np.where(known[..., None], [0.002, 0.001, 0.002], np.nan),
        status=status, settings='[correlation]\nradius_px = 17\nstep_px = 9\n[surface]\nmethod = "pairs"\n',
        summary={
            **verdict_figures([MOVED]), "table": [{"figure": "points", "value": "1,260"}],
            "unmeasured": unmeasured_areas((BARE,), 14_500.0),
        },
        unmeasured=(BARE,),
    )  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory, rig_toml: Callable[[str, Sequence[str]], str]) -> Path:
    folder = tmp_path_factory.mktemp("report") / "tube"
    rng = np.random.default_rng(1)
    for name in STEPS:
        (folder / "captures" / name).mkdir(parents=True)
        frames = {}
        for id_ in "1234":
            coarse = rng.uniform(20, 235, (SIZE[1] // 8, SIZE[0] // 8)).astype(np.uint8)
            cv2.imwrite(str(folder / "captures" / name / f"{id_}.png"), cv2.resize(coarse, SIZE))
            frames[id_] = {"file": f"{id_}.png", "exposure_us": 4321.0, "metadata": {"AnalogueGain": 1.5}}
        record = {
            "schema": 1, "capture_id": name, "number": int(name[:4]), "kind": "specimen", "session": "tube",
            "state": "closed", "cameras": frames, "opened_at": "2026-05-04T03:02:01.5+00:00", "skew_ns": 123456,
        }  # fmt: skip
        (folder / "captures" / name / "capture.json").write_text(json.dumps(record))
    (folder / "rig.toml").write_text(rig_toml("report-ring", "1234"))
    header = {"schema": 1, "session": "tube", "rig": "report-ring", "created": "2026-05-04", "source": "capture"}
    (folder / "session.json").write_text(json.dumps(header))
    (folder / "results" / "0001").mkdir(parents=True)
    write_results(folder / "results" / "0001" / "results.h5", twisted_tube())
    return folder


@pytest.fixture(scope="module")
def page(browser: Browser, session: Path) -> Page:
    """The report, opened; what the browser complains about or asks for is kept with it."""
    written = write_report(session)
    assert written == session / "results" / "0001" / "report.html"
    assert written.stat().st_size < 8_000_000
    opened = browser.new_context(viewport={"width": 1200, "height": 900}).new_page()
    asked: list[str] = []
    opened.on("console", lambda message: asked.append(message.text))
    opened.on("pageerror", lambda error: asked.append(str(error)))
    opened.on(
        "request", lambda request: None if request.url.startswith(("file:", "data:")) else asked.append(request.url)
    )
    opened.goto(written.as_uri(), timeout=60_000)
    assert asked == []
    return opened


def table(page: Page, key: str) -> list[list[str]]:
    """The cells of a table, its head first."""
    read = "(rows) => rows.map((row) => [...row.cells].map((cell) => cell.textContent))"
    return page.locator(f"#{key} tr").evaluate_all(read)


def number(text: str) -> float:
    return float(text.replace(",", ""))


@pytest.mark.browser
def test_every_picture_is_whole_and_described(page: Page) -> None:
    pictures = page.locator("img").evaluate_all("(all) => all.map((one) => [one.naturalWidth, one.alt.length])")
    assert len(pictures) >= 12
    assert all(width > 300 and described > 10 for width, described in pictures)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


@pytest.mark.browser
def test_the_statistics_are_those_of_the_results(page: Page, session: Path) -> None:
    seen = evaluate_results(session / "results" / "0001" / "results.h5")
    columns = {
        c.name: c.values for c in region_statistics(seen, Everything(), ["displacement", "lambda1", "J"]).columns
    }
    titles = {"displacement": "Displacement, mm", "lambda1": "Smaller stretch λ1", "J": "Area ratio J"}
    head, *rows = table(page, "statistics")
    shown = {(row[0], row[1]): dict(zip(head[2:], row[2:], strict=True)) for row in rows}
    for i, (field, step) in enumerate(zip(columns["field"], columns["step"], strict=True)):
        if step > 0:
            row = shown[titles[field], columns["capture"][i]]
            for title, name in (("mean", "mean"), ("median", "median"), ("5 %", "p5"), ("greatest", "max")):
                assert number(row[title]) == pytest.approx(columns[name][i], rel=6e-4)
    assert number(shown["Smaller stretch λ1", STEPS[2]]["median"]) == pytest.approx(0.98, abs=1e-4)


@pytest.mark.browser
def test_what_was_lost_is_counted_by_its_reason(page: Page) -> None:
    head, *rows = table(page, "lost")
    assert head == ["step", "measured", "the images do not look alike there"]
    assert rows == [[STEPS[0], "1260", "0"], [STEPS[1], "1260", "0"], [STEPS[2], "1257", "3"]]


@pytest.mark.browser
def test_what_was_not_measured_is_told_by_its_reason_and_shown(page: Page) -> None:
    head, *rows = table(page, "unmeasured-areas")
    assert head == ["why", "cm²", "in the total"]
    assert [row[1:] for row in rows] == [["3.2", "yes"], ["1.5", "yes"], ["0.9", "no"]]
    assert rows[0][0] == "the lines of sight miss one another"
    assert page.locator("#unmeasured-picture img").count() == 1


def test_unmeasured_places_are_drawn_in_the_colours_of_their_reasons() -> None:
    grey = np.full((SIZE[1], SIZE[0]), 100, np.uint8)
    drawn = unmeasured_picture(grey, BARE)
    assert (drawn[200] == 100).all()
    colours = [drawn[60, int(x)] for x in BARE.px[:, 0]]
    assert len({tuple(colour) for colour in colours}) == 3
    assert np.ptp(colours[2]) == 0  # what is not counted is grey
    legend = {row.colour for row in unmeasured_legend(unmeasured_areas((BARE,), 0.0))}
    assert legend == {COLOURS[code] for code in BARE.status.tolist()}


@pytest.mark.browser
def test_the_reporting_tables_tell_settings_and_what_the_cameras_were(page: Page) -> None:
    analysis = dict(table(page, "analysis-table"))
    assert analysis["Subset size"].startswith("35 px across (circle)")
    assert analysis["Step size"].startswith("9 px")
    assert "no capture at rest" in analysis["Displacement noise floor"]
    hardware = dict(table(page, "hardware-table"))
    assert hardware["Image size"] == "240 × 320 px"
    assert hardware["Aperture"] == "not recorded"
    assert "123 µs" in hardware["Synchronisation"]
    head, first, *_ = table(page, "cameras")
    row = dict(zip(head, first, strict=True))
    # Squarely seen are points up to 37° off: between 350 and 364 mm away, 420 px of focal length.
    assert 350 < number(row["stand-off, mm"]) < 364
    assert 420 / 364 < number(row["px/mm"]) < 420 / 350
    assert (number(row["exposure, µs"]), number(row["gain"])) == (4321.0, 1.5)


@pytest.mark.browser
def test_text_is_shown_as_text(page: Page) -> None:
    assert page.locator("#verdict li").all_text_contents() == ["camera 3 · 0002 camera 3 <b>moved</b> & was named"]


@pytest.mark.browser
def test_the_verdict_stands_at_the_top_with_the_camera_and_the_step(page: Page) -> None:
    verdict = page.locator("#verdict")
    assert verdict.locator("strong").text_content() == "Do not use: camera 3"
    assert verdict.locator("li b").all_text_contents() == ["camera 3 · 0002"]
    first = page.locator("table").first.bounding_box()
    box = verdict.bounding_box()
    assert box is not None
    assert first is not None
    assert box["y"] + box["height"] <= first["y"]
    assert "radius_px = 17" in page.locator("#settings-toml").text_content()


def test_a_report_that_cannot_be_written_is_refused_in_a_sentence(session: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a file in a folder that is there"):
        write_report(session, tmp_path / "none" / "report.html")
    with pytest.raises(InputError, match="no run 7"):
        write_report(session, run=7)
