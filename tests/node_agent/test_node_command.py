"""The node's configuration and command line: exit codes and sentences."""

from __future__ import annotations

import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from ringdic_node.cameras.camera import CameraError, Frame, Shot, check_settings
from ringdic_node.cameras.pattern import PatternCamera
from ringdic_node.cameras.playback import PlaybackCamera
from ringdic_node.cli import main
from ringdic_node.clock import SystemClock, parse_tracking
from ringdic_node.config import ConfigError, make_camera, read_node_config

SOUND = """
rig = "ring"
id = "201"
controller = "tcp/127.0.0.1:1"
spool = "spool"
camera = "pattern"
[pattern]
width = 8
height = 6
"""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "node.toml"
    path.write_text(SOUND)
    return path


def test_the_spool_lies_beside_the_configuration(config, tmp_path):
    assert read_node_config(config).spool == tmp_path / "spool"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('rig = "ring"', 'rigg = "ring"', "unknown key 'rigg'"),
        ('rig = "ring"', "", "'rig' is missing"),
        ('id = "201"', "id = 201", "'id'"),
        ('id = "201"', 'id = "2/1"', "not a name"),
        ('camera = "pattern"', 'camera = "webcam"', "'webcam'"),
        ("width = 8", "wide = 8", r"\[pattern\] unknown key 'wide'"),
        ("width = 8", 'width = "8"', "width"),
        ('controller = "tcp/127.0.0.1:1"', 'controller = "127.0.0.1"', "endpoint"),
        ("[pattern]", "[pattern", "node.toml"),
    ],
)
def test_a_bad_configuration_is_refused_with_file_and_key(config, old, new, told, capsys):
    config.write_text(SOUND.replace(old, new))
    with pytest.raises(ConfigError, match=told) as caught:
        read_node_config(config)
    assert str(config) in str(caught.value)
    assert main(["check", "--config", str(config)]) == 2
    assert re.search(told, capsys.readouterr().err)


def test_a_missing_configuration_is_bad_input(tmp_path, capsys):
    assert main(["run", "--config", str(tmp_path / "none.toml")]) == 2
    assert "no such file" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize("controller", ["tcp/192.168.1.10:7447", "tls/192.168.1.10:7447"])
def test_a_controller_on_another_machine_needs_certificates(config, tmp_path, controller, command, capsys):
    text = SOUND.replace("tcp/127.0.0.1:1", controller).replace("camera =", f'certificates = "{tmp_path}/c"\ncamera =')
    config.write_text(text)
    assert main([command, "--config", str(config)]) == 2
    assert "ringdic rig certificates" in capsys.readouterr().err
    assert not (tmp_path / "spool").exists(), "refused before anything is opened"


def test_shoot_writes_one_still_and_never_replaces_it(config, tmp_path, capsys):
    out = tmp_path / "still.pgm"
    assert main(["shoot", "--config", str(config), "--out", str(out)]) == 0
    image = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    assert image.shape == (6, 8)
    assert (np.diff(image[0].astype(int)) % 251 == 1).all()
    assert main(["shoot", "--config", str(config), "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_check_names_what_is_missing(config, tmp_path, capsys):
    (tmp_path / "spool").mkdir()
    (tmp_path / "spool/s~0001-board~5.json").write_text('{"schema": 9, "type": "manifest"}')
    assert main(["check", "--config", str(config)]) == 3
    lines = {line.split()[1]: line for line in capsys.readouterr().out.splitlines()}
    assert set(lines) == {"camera", "clock", "spool", "controller"}
    assert lines["camera"].startswith("ok")
    assert lines["controller"].startswith("FAIL")
    assert "1 images stay in the spool because they cannot be used, first s~0001-board~5.json" in lines["spool"]


def test_a_node_needs_none_of_the_pc_packages():
    """Every module that a node loads, with the heavy ones made unloadable."""
    code = (
        "import sys\n"
        "for name in ('numba', 'cv2', 'scipy', 'h5py', 'pydantic', 'typer', 'processing', 'controller', 'picamera2'):\n"
        "    sys.modules[name] = None\n"
        "import ringdic_node.cli, ringdic_node.service, ringdic_node.cameras.pattern, ringdic_node.cameras.pi\n"
        "import ringdic_node.cameras.virtual\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_sixteen_bit_frames_are_big_endian_in_the_file():
    pixels = np.array([[1, 256], [1023, 65535]], np.uint16)
    header, body = Frame(pixels, 0).pgm()
    decoded = cv2.imdecode(np.frombuffer(header + body, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (decoded == pixels).all()


def test_a_frame_that_is_no_plane_cannot_exist():
    with pytest.raises(CameraError, match="plane"):
        Frame(np.zeros((2, 2, 3), np.uint8), 0)
    with pytest.raises(CameraError, match="8 or 16 bit"):
        Frame(np.zeros((2, 2)), 0)


def test_frame_times_scatter_as_stated():
    camera = PatternCamera("201", SystemClock(), width=2, height=2, jitter_us=30.0)
    times = np.array([camera.capture(Shot(0, "board", i)).time_ns for i in range(400)])
    # The standard deviation of 400 normal samples is within 15 % of its parameter at four sigma.
    assert abs(times.std() / 30_000 - 1) < 0.15


def test_settings_are_refused_by_name():
    with pytest.raises(CameraError, match="iso"):
        check_settings({"iso": 100})
    with pytest.raises(CameraError, match="exposure_us"):
        check_settings({"exposure_us": 0})


def test_the_offset_of_the_clock_is_read_from_chrony():
    line = "C0A8010A,192.168.1.10,3,1700000000.1,-0.000012,0.000001,0.00002,-9.1,0.0,0.02,0.0004,0.0001,16.0,Normal\n"
    offset, error = parse_tracking(line)
    assert offset == pytest.approx(-0.012)
    assert error == pytest.approx(0.012 + 0.1 + 0.2)
    assert parse_tracking("00000000,,0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,1.0,1.0,0.0,Not synchronised\n") is None
    assert parse_tracking("506 Cannot talk to daemon\n") is None


@pytest.mark.parametrize("deepest", [255, 65535])
def test_a_played_back_image_is_the_file_byte_for_byte(config, tmp_path, deepest):
    plane = np.random.default_rng(1).integers(0, deepest + 1, (6, 8)).astype(np.uint8 if deepest == 255 else ">u2")
    content = f"P5\n8 6\n{deepest}\n".encode() + plane.tobytes()
    (tmp_path / "plane.pgm").write_bytes(content)
    config.write_text(SOUND.split("camera =")[0] + 'camera = "playback"\n[playback]\nimage = "plane.pgm"\n')
    camera = make_camera(read_node_config(config), SystemClock())
    assert b"".join(camera.capture(Shot(0, "static", 0)).pgm()) == content


@pytest.mark.parametrize(
    ("content", "told"), [(b"P2\n1 1\n255\n0", "not a binary PGM"), (b"P5\n8 6\n255\nabc", "cut off"), (None, "read")]
)
def test_what_cannot_be_played_back_is_refused_with_its_file(tmp_path, content, told):
    path = tmp_path / "plane.pgm"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CameraError, match=f"plane.pgm.*{told}"):
        PlaybackCamera(SystemClock(), image=str(path))
