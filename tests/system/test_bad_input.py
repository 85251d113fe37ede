"""What an operator can get wrong: the real commands end with the right exit code and one sentence, and leave nothing.

A sentence names the file or the camera and says what to do. Standard output stays empty, folders stay as they were.
"""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic_node.virtual_rig.render import render
from ringdic_node.virtual_rig.rig import VirtualRig, paper_rig
from ringdic_node.virtual_rig.scenes import scene

BAD_INPUT, NOT_COMPUTABLE = 2, 3
SCALE = 0.2
Command = Callable[..., subprocess.CompletedProcess[str]]
Refusal = Callable[..., str]
STEPS = ("0006-specimen", "0007-specimen")


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, and every folder; calibrations and outputs of tasks that are whole may be kept."""
    may_stay = {"calibration", "work"}
    found = {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in folder.rglob("*")}
    return {name: data for name, data in found.items() if not may_stay & {*Path(name).parts} or "partial" in name}


@pytest.fixture(scope="module")
def refused(ringdic: Command) -> Refusal:
    """Run a command that must be refused; its sentence. `folder` holds all that it could have written to."""

    def run(folder: Path, code: int, *arguments: object) -> str:
        before = tree(folder)
        done = ringdic(*arguments, "--json", code=code)
        assert done.stdout == ""
        assert "Traceback" not in done.stderr
        told = [line for line in done.stderr.splitlines() if not re.match(r" *\d+%  ", line)]  # all but the progress
        assert len(told) == 1, done.stderr
        assert tree(folder) == before
        return told[0]

    return run


def says(sentence: str, *words: str) -> None:
    """What the sentence must name is in it."""
    assert [word for word in words if word not in sentence] == [], sentence


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def crop(path: Path) -> Path:
    return write(path, grey(path)[:-8])


def truncate_jpeg(path: Path) -> Path:
    """The image as a JPEG of which the last third did not arrive."""
    data = cv2.imencode(".jpg", grey(path))[1].tobytes()
    path.unlink()
    jpeg = path.with_suffix(".jpg")
    jpeg.write_bytes(data[: 2 * len(data) // 3])
    return jpeg


@dataclass
class Work:
    """A folder of images to spoil, in a folder of its own."""

    folder: Path

    @property
    def src(self) -> Path:
        return self.folder / "src"

    @property
    def session(self) -> Path:
        return self.folder / "session"


@pytest.fixture(scope="module")
def good(ringdic: Command, tmp_path_factory: pytest.TempPathFactory) -> Work:
    """Two cameras of the virtual ring: a folder of images and the session made of it, processed once."""
    work = Work(tmp_path_factory.mktemp("good"))
    rig = VirtualRig(paper_rig(12, SCALE).cameras[:2])
    for kind in ("board", "target", "specimen"):
        (work.src / kind).mkdir(parents=True)
    (work.src / "rig.toml").write_text(rig.rig_toml(), encoding="utf-8")
    for camera in rig.cameras:
        for pose in range(4):
            write(work.src / "board" / camera.id / f"{pose}.png", render(camera, scene("board", pose), pose))
        write(work.src / "target" / f"{camera.id}.png", render(camera, scene("target", 0), 1))
        for step in range(2):
            write(work.src / "specimen" / camera.id / f"{step}.png", render(camera, scene("specimen", step), 2))
    for command in (("import", work.src, work.session), ("process", work.session)):
        json.loads(ringdic(*command, "--json").stdout)
    return work


@pytest.fixture
def work(good: Work, tmp_path: Path) -> Work:
    """Copies to spoil: the images, and the session with its calibration but without results."""
    shutil.copytree(good.src, tmp_path / "src")
    shutil.copytree(good.session, tmp_path / "session", ignore=shutil.ignore_patterns("results"))
    return Work(tmp_path)


def edited(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def small_mask(path: Path) -> None:
    write(path, np.full((5, 7), 255, np.uint8))


def empty_mask(path: Path) -> None:
    write(path, np.zeros((round(3280 * SCALE), round(2464 * SCALE)), np.uint8))


UNIMPORTABLE: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "unknown key": (
        lambda src: edited(src / "rig.toml", "dot_size_mm", "dot_size"),
        ["rig.toml", "[target]", "unknown key 'dot_size'", "dot_size_mm"],
    ),
    "unknown table": (
        lambda src: edited(src / "rig.toml", "[board]", "[checkerboard]"),
        ["rig.toml", "unknown key 'checkerboard'", "board"],
    ),
    "value of a wrong type": (
        lambda src: edited(src / "rig.toml", "[15, 20]", "15"),
        ["rig.toml", "[board] squares", "2 numbers", "not 15"],
    ),
    "not TOML": (lambda src: edited(src / "rig.toml", "[board]", "[board"), ["rig.toml", "not readable as TOML"]),
    "no rig.toml": (lambda src: (src / "rig.toml").unlink(), ["rig.toml", "no such file"]),
    "no board folder of a camera": (
        lambda src: shutil.rmtree(src / "board" / "cam_02"),
        ["board/cam_02", "board folder of camera 'cam_02' is missing", "every camera of rig.toml needs one"],
    ),
    "no specimen folder of a camera": (
        lambda src: shutil.rmtree(src / "specimen" / "cam_02"),
        ["specimen/cam_02", "camera 'cam_02' is missing"],
    ),
    "no specimen": (lambda src: shutil.rmtree(src / "specimen"), ["specimen", "is missing"]),
    "no target image of a camera": (
        lambda src: (src / "target" / "cam_02.png").unlink(),
        ["target", "camera 'cam_02'", "cam_02.png"],
    ),
    "fewer steps of one camera": (
        lambda src: (src / "specimen" / "cam_02" / "1.png").unlink(),
        ["specimen", "cam_01 2, cam_02 1", "every step needs all cameras"],
    ),
    "sizes within a folder": (
        lambda src: crop(src / "board" / "cam_01" / "2.png"),
        ["board/cam_01/2.png", "493 x 648", "493 x 656", "one size"],
    ),
    "target of another size": (
        lambda src: crop(src / "target" / "cam_02.png"),
        ["target/cam_02.png", "493 x 648", "board/cam_02/0.png", "one size"],
    ),
    "specimen of another size": (
        lambda src: [crop(path) for path in (src / "specimen" / "cam_02").iterdir()],
        ["specimen/cam_02/0.png", "493 x 648", "board/cam_02/0.png", "one size"],
    ),
    "truncated JPEG": (
        lambda src: truncate_jpeg(src / "specimen" / "cam_02" / "1.png"),
        ["specimen/cam_02/1.jpg", "truncated", "copy or capture it again"],
    ),
    "empty file": (
        lambda src: (src / "board" / "cam_01" / "0.png").write_bytes(b""),
        ["board/cam_01/0.png", "empty", "copy or capture it again"],
    ),
    "no image": (
        lambda src: (src / "board" / "cam_01" / "0.png").write_text("a letter"),
        ["board/cam_01/0.png", "not an image", "use JPEG, PNG, PGM or TIFF"],
    ),
    "mask without points": (
        lambda src: empty_mask(src / "mask" / "cam_01.png"),
        ["mask/cam_01.png", "marks no pixel", "paint the region of interest white"],
    ),
    "mask of another size": (
        lambda src: small_mask(src / "mask" / "cam_01.png"),
        ["mask/cam_01.png", "7 x 5 px", "493 x 656"],
    ),
    "mask of no camera": (
        lambda src: empty_mask(src / "mask" / "cam_77.png"),
        ["mask/cam_77.png", "no camera 'cam_77'", "name a mask by its camera's id"],
    ),
}


@pytest.mark.parametrize(("spoil", "words"), UNIMPORTABLE.values(), ids=UNIMPORTABLE.keys())
def test_a_bad_folder_of_images_is_not_imported(
    refused: Refusal, work: Work, spoil: Callable[[Path], object], words: list[str]
) -> None:
    spoil(work.src)
    sentence = refused(work.folder, BAD_INPUT, "import", work.src, work.folder / "made")
    says(sentence, *words)


def test_import_takes_a_folder_and_makes_a_new_session(refused: Refusal, work: Work) -> None:
    sentence = refused(work.folder, BAD_INPUT, "import", work.src, work.session)
    says(sentence, f"{work.session} exists already", "new session folder")
    sentence = refused(work.folder, BAD_INPUT, "import", work.folder / "nowhere", work.folder / "made")
    says(sentence, "nowhere: no such folder", "rig.toml")
    sentence = refused(work.folder, BAD_INPUT, "import", work.src, work.src / "rig.toml" / "made")
    says(sentence, str(work.src / "rig.toml"), "check the path")


def few_dots(session: Path) -> None:
    """One column of dots is left of the target."""
    path = session / "captures" / "0005-target" / "cam_02.png"
    image = grey(path)
    middle = image.shape[1] // 2
    image[:, : middle - 15] = image[:, middle + 15 :] = 128
    write(path, image)


def boards_hidden(session: Path) -> None:
    """The board is in no image of a camera: it saw the target instead."""
    for number in range(1, 5):
        folder = session / "captures"
        shutil.copy(folder / "0005-target" / "cam_02.png", folder / f"000{number}-board" / "cam_02.png")


def in_step(number: int, spoil: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda session: spoil(session / "captures" / STEPS[number] / "cam_02.png")


def truncated_in_place(path: Path) -> None:
    truncate_jpeg(path).rename(path)


def without(kind: str) -> Callable[[Path], object]:
    def spoil(session: Path) -> None:
        for folder in (session / "captures").glob(f"*-{kind}"):
            shutil.rmtree(folder)

    return spoil


def mask_beside_the_specimen(session: Path) -> None:
    mask = np.zeros((round(3280 * SCALE), round(2464 * SCALE)), np.uint8)
    mask[4:60, 4:60] = 255
    write(session / "mask" / "cam_01.png", mask)


def bare_specimen(session: Path) -> None:
    for path in session.glob("captures/*-specimen/*.png"):
        write(path, np.full_like(grey(path), 90))


UNPROCESSABLE: dict[str, tuple[Callable[[Path], object], int, list[str]]] = {
    "board in no image": (
        boards_hidden,
        BAD_INPUT,
        ["camera cam_02", "checkerboard was found in 0 of 4", "at least 3", "whole board"],
    ),
    "too few dots": (
        few_dots,
        BAD_INPUT,
        ["camera cam_02", "20 dots in 1 column of", "are needed", "whole target"],
    ),
    "board of another size": (
        lambda session: crop(session / "captures" / "0002-board" / "cam_02.png"),
        BAD_INPUT,
        ["0002-board/cam_02.png", "493 x 648", "493 x 656", "one size"],
    ),
    "target of another size": (
        lambda session: crop(session / "captures" / "0005-target" / "cam_02.png"),
        BAD_INPUT,
        ["cam_02.png", "0005-target/cam_02.png", "493 x 648", "493 x 656", "one size"],
    ),
    "specimen of another size": (
        in_step(0, crop),
        BAD_INPUT,
        ["0006-specimen/cam_02.png", "493 x 648", "calibrated at 493 x 656", "one size"],
    ),
    "truncated JPEG": (
        in_step(1, truncated_in_place),
        BAD_INPUT,
        ["0007-specimen/cam_02.png", "truncated", "copy or capture it again"],
    ),
    "an image is gone": (in_step(1, Path.unlink), BAD_INPUT, ["0007-specimen/cam_02.png", "not there", "copy it back"]),
    "mask without points": (
        lambda session: empty_mask(session / "mask" / "cam_01.png"),
        BAD_INPUT,
        ["mask/cam_01.png", "marks no pixel", "paint the region of interest white"],
    ),
    "mask beside the specimen": (
        mask_beside_the_specimen,
        NOT_COMPUTABLE,
        ["camera cam_01 does not match", "the contrast inside its mask is", "draw the mask on the specimen"],
    ),
    "no target": (without("target"), BAD_INPUT, ["no capture of the calibration target", "capture or import one"]),
    "no specimen": (without("specimen"), BAD_INPUT, ["no capture of the specimen", "capture or import"]),
    "damaged record": (
        lambda session: (session / "captures" / STEPS[0] / "capture.json").write_text("[1, 2]"),
        BAD_INPUT,
        ["0006-specimen/capture.json", "not a record"],
    ),
    "record without cameras": (
        lambda session: (session / "captures" / STEPS[0] / "capture.json").write_text('{"schema": 1, "cameras": [1]}'),
        BAD_INPUT,
        ["0006-specimen/capture.json", "one record a camera", "copy it back"],
    ),
    "unknown key": (
        lambda session: edited(session / "rig.toml", "rows =", "lines ="),
        BAD_INPUT,
        ["rig.toml", "unknown key 'lines'", "rows"],
    ),
    "specimen without texture": (
        bare_specimen,
        NOT_COMPUTABLE,
        ["no two cameras share a textured surface", "camera cam_01", "0 textured places", "speckle the specimen"],
    ),
}


@pytest.mark.parametrize(("spoil", "code", "words"), UNPROCESSABLE.values(), ids=UNPROCESSABLE.keys())
def test_a_bad_session_is_not_processed(
    refused: Refusal, work: Work, spoil: Callable[[Path], object], code: int, words: list[str]
) -> None:
    spoil(work.session)
    sentence = refused(work.folder, code, "process", work.session)
    says(sentence, *words)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--set", "correlation.radius=5"), ["unknown setting 'correlation.radius'", "radius_px"]),
        (("--set", "correlaton.radius_px=5"), ["unknown group of settings 'correlaton'", "correlation"]),
        (("--set", "calibration.method=clicks"), ["calibration.method", "'dlt' or 'bundle'", "'clicks'"]),
        (("--set", "method=clicks"), ["method", "'best' or 'paper'", "'clicks'"]),
        (("--set", "strain.window_mm=-4"), ["strain.window_mm", "greater than or equal to 0", "-4"]),
        (("--set", "radius"), ["--set radius", "group.name=value", "correlation.radius_px=20"]),
        (("--set", "correlation.radius_px=large"), ["correlation.radius_px must be a whole number", "'large'"]),
        (("--set", "correlation.order=3"), ["correlation.order must be 1 or 2", "3"]),
        (("--settings", "none.toml"), ["none.toml", "no such settings file"]),
        (("--cluster", "tcp://127.0.0.1:1"), ["no scheduler answers at tcp://127.0.0.1:1", "dask scheduler"]),
    ],
)
def test_unusable_settings_are_named(refused: Refusal, good: Work, option: tuple[str, str], words: list[str]) -> None:
    sentence = refused(good.folder, BAD_INPUT, "process", good.session, *option)
    says(sentence, *words)


def test_a_session_processed_twice_keeps_its_first_results(ringdic: Command, good: Work, tmp_path: Path) -> None:
    processed = shutil.copytree(good.session, tmp_path / "session")
    first = tree(processed / "results")
    assert {Path(name).parts[0] for name in first} == {"0001"}
    ringdic("process", processed, "--set", "correlation.step_px=12", "--json")
    after = tree(processed / "results")
    assert {name: data for name, data in after.items() if name.startswith("0001")} == first
    assert {Path(name).parts[0] for name in after} == {"0001", "0002"}
    assert after["0002/settings.toml"] != after["0001/settings.toml"]


def test_a_folder_that_is_no_session_is_named(refused: Refusal, good: Work) -> None:
    for command in ("process", "export"):
        sentence = refused(good.folder, BAD_INPUT, command, good.src)
        says(sentence, f"{good.src}: not a session", "ringdic import")
        sentence = refused(good.folder, BAD_INPUT, command, good.folder / "nowhere")
        assert "nowhere: no such session folder" in sentence


def test_an_export_needs_results_a_format_and_a_place(refused: Refusal, good: Work, work: Work) -> None:
    sentence = refused(work.folder, BAD_INPUT, "export", work.session)
    says(sentence, "no results yet", "ringdic process")
    sentence = refused(good.folder, BAD_INPUT, "export", good.session, "--format", "stl")
    says(sentence, "no export format 'stl'", "npz, vtkhdf, vtp, mat, csv, ply, glb")
    sentence = refused(good.folder, BAD_INPUT, "export", good.session, "--out", good.folder / "none" / "a.npz")
    assert f"{good.folder / 'none'}: no such folder" in sentence


@pytest.fixture
def pair(work: Work) -> tuple[Path, Path]:
    """Two images that can be correlated."""
    return work.src / "specimen" / "cam_01" / "0.png", work.src / "specimen" / "cam_01" / "1.png"


def test_images_that_cannot_be_correlated_are_named(refused: Refusal, work: Work, pair: tuple[Path, Path]) -> None:
    def told(reference: Path, current: Path, *options: object, code: int = BAD_INPUT) -> str:
        out = work.folder / "points.npz"
        return refused(work.folder, code, "correlate", reference, current, "--out", out, *options)

    reference, current = pair
    assert "none.png: cannot be read (No such file" in told(reference, work.src / "none.png")
    small = write(work.src / "small.png", grey(current)[:-8])
    sentence = told(reference, small)
    says(sentence, "small.png is 493 x 648", "same size")
    empty = work.src / "empty.png"
    empty_mask(empty)
    assert "empty.png: the mask marks no pixel; paint" in told(reference, current, "--mask", empty)
    assert "small.png: the mask is 493 x 648 px" in told(reference, current, "--mask", small)
    assert "choose a smaller radius" in told(reference, current, "--radius", 300)
    assert "subset 'star' is not known; use 'circle' or 'square'" in told(reference, current, "--subset", "star")
    flat = write(work.src / "flat.png", np.full_like(grey(current), 90))
    sentence = told(reference, flat, code=NOT_COMPUTABLE)
    says(sentence, "flat.png: none of the", "check that")
    jpeg = truncate_jpeg(current)
    assert f"{jpeg}: the image file is truncated" in told(reference, jpeg)
    assert f"{jpeg}: the image file is truncated" in told(jpeg, reference)


def test_correlated_points_need_a_place(refused: Refusal, work: Work, pair: tuple[Path, Path]) -> None:
    sentence = refused(work.folder, BAD_INPUT, "correlate", *pair, "--out", work.folder / "none" / "points.npz")
    assert "none/points.npz: the folder does not exist" in sentence
    sentence = refused(work.folder, BAD_INPUT, "correlate", *pair, "--out", work.session)
    assert f"{work.session}: is a folder" in sentence


def test_the_controller_names_its_configuration(ringdic: Command, tmp_path: Path) -> None:
    config = tmp_path / "controller.toml"
    for text, words in {
        'archiv = "here"': ["controller.toml", "unknown key 'archiv'", "archive"],
        'rig = "none.toml"': ["none.toml", "no such file"],
        "[http]\nport = 70000": ["controller.toml", "port 70000", "0 … 65535"],
    }.items():
        config.write_text(text, encoding="utf-8")
        done = ringdic("controller", "--config", config, code=BAD_INPUT)
        assert done.stdout == ""
        assert len(done.stderr.splitlines()) == 1
        says(done.stderr, *words)
        assert [path.name for path in tmp_path.iterdir()] == ["controller.toml"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("proces",), "No such command 'proces'"),
        (("process",), "Missing argument"),
        (("process", "session", "--colour"), "No such option: --colour"),
        (("correlate", "a.png", "b.png"), "Missing option '--out'"),
        (("correlate", "a.png", "b.png", "--out", "p.npz", "--radius", "1"), "Invalid value for '--radius'"),
        (("demo", "--cameras", "2"), "Invalid value for '--cameras'"),
    ],
)
def test_a_mistyped_command_is_bad_input(ringdic: Command, arguments: tuple[str, ...], words: str) -> None:
    done = ringdic(*arguments, code=BAD_INPUT)
    assert done.stdout == ""
    assert words in done.stderr
    assert "Traceback" not in done.stderr
