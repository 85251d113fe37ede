"""Damaged and hostile messages and files: each is read, or refused with its own error, and soon."""

from __future__ import annotations

import importlib.util
import json
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from ringdic.errors import InputError
from ringdic.results.reader import read_field, read_mesh, read_positions, read_summary, read_unmeasured
from ringdic.results.writer import write_results
from ringdic.session.images import read_gray
from ringdic.session.json_text import read_json
from ringdic.session.records import (
    CameraRecord,
    CaptureRecord,
    SessionRecord,
    read_capture_record,
    read_session_record,
)
from ringdic.session.rig import read_rig
from ringdic.settings import load_settings
from ringdic_controller.jobs.children import message_of
from ringdic_controller.service.config import read_controller_config
from ringdic_controller.service.guard import foreign_host, foreign_page
from ringdic_node.config import ConfigError, read_node_config
from ringdic_node.wire import (
    Ack,
    Arm,
    ArmReply,
    CaptureKey,
    Failure,
    Fetch,
    Inventory,
    Manifest,
    NodeStatus,
    Trigger,
    TriggerReply,
    WireError,
    decode,
    encode,
)
from starlette.datastructures import Headers

STAND_IN = Path(__file__).parents[1] / "controller" / "stand_in_processing.py"
LONGEST = 5.0  # seconds that one input may take on a loaded machine

HASH, KEY = "a" * 64, CaptureKey("limb", "0001-board", 1_700_000_000_000_000_000)
MANIFEST = Manifest("201", KEY, "board", HASH, 9, 3, 3, 1, 5000.0, metadata={"Lux": 7.5, "deep": {"a": [1]}})
MESSAGES = [
    encode(message)
    for message in (
        Arm("limb", "board", {"gain": 1.0}, HASH, ("201", "202")),
        ArmReply("201", True, HASH, locked={"ExposureTime": 5000}),
        Trigger(KEY, "board", 3),
        TriggerReply("201", KEY, "accepted", ""),
        MANIFEST,
        Failure("201", KEY, "the disk is full"),
        Inventory("201", (MANIFEST,), (Failure("201", KEY, "late"),)),
        Fetch(KEY),
        Ack("201", KEY, HASH),
        NodeStatus("201", "idle", False, 1, 2, 3, {"ringdic": "0.2.0"}),
    )
]
CAPTURE = CaptureRecord(
    "0001-board", 1, "board", "limb", "closed", "2026-01-01T00:00:00+00:00", "2026-01-01T00:00:01+00:00", 1, 2, 3, True,
    cameras={"201": CameraRecord("ok", None, "201.pgm", HASH, 9, 3, 3, 5, 5000.0, {"Lux": 7.5})},
)  # fmt: skip
SESSION = SessionRecord("limb", "ring-12", "2026-01-01T00:00:00+00:00", "capture")
JOB = {"id": "0001", "session": "limb", "reason": "asked for", "automatic": False, "created_at": "", "done": 0.5}
CONTROLLER = b"""archive = "a"
live = true
[http]
host = "127.0.0.1"
port = 8000
hosts = ["lab"]
[zenoh]
endpoint = "tcp/a:1"
"""
NODE = b"""rig = "r"
id = "201"
controller = "tcp/127.0.0.1:7447"
spool = "s"
camera = "pattern"
[pattern]
width = 120
"""
SETTINGS = b'method = "best"\n[correlation]\nradius_px = 20\nstep_px = 10\n[strain]\nwindow_mm = 5\n'
NOISE = np.random.default_rng(0).integers(0, 255, (9, 11, 3), dtype=np.uint8)
IMAGES = [
    cv2.imencode(suffix, image)[1].tobytes()
    for suffix, image in [
        *((suffix, NOISE[..., 0]) for suffix in (".png", ".jpg", ".pgm", ".tif", ".bmp")),
        *((suffix, NOISE) for suffix in (".png", ".jpg", ".ppm", ".tif", ".bmp")),
        *((suffix, NOISE[..., 0].astype(np.uint16)) for suffix in (".png", ".pgm", ".tif")),
    ]
]
TOKENS = [
    b"NaN", b"-Infinity", b"1e999", b"9" * 30, b"9" * 5000, b"-1", b"null", b"true", b'""', b"\\ud800", b"\\u0000",
    b"\0", b"\xff\xfe", b"[" * 3000, b'{"a":' * 3000, b"{}", b"[]", b"..", b"../../etc/passwd", b"\r\n\r\n",
    b"<script>", b"%00", "\u202e\U0001f9b5".encode(), b"#", b"'", b'"""', b"=", b"[[x]]\n", b"1979-05-27T07:32:00Z",
]  # fmt: skip


@dataclass(frozen=True)
class Target:
    """What reads inputs. seeds : valid inputs. read : takes one, and raises one of refusals where it is not usable.

    share : of the inputs.
    """

    seeds: list[bytes]
    read: Callable[[Path], object]
    refusals: tuple[type[Exception], ...] = (InputError,)
    share: float = 1.0


def showable(value: object) -> None:
    """Fails unless a value can be sent as JSON."""
    json.dumps(value, allow_nan=False).encode()


def every_array(path: Path) -> None:
    read_summary(path)
    read_mesh(path)
    read_positions(path, 1, rigid_motion_removed=True)
    read_field(path, "lambda1", 1)
    read_unmeasured(path)


def seeds_of(name: str, folder: Path, rig: str) -> list[bytes]:
    """Valid inputs of a target."""
    if name == "rig.toml":
        return [rig.encode()]
    if name != "results.h5":
        return TARGETS[name].seeds
    spec = importlib.util.spec_from_file_location("stand_in", STAND_IN)
    assert spec is not None
    assert spec.loader is not None
    stand_in = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(stand_in)
    write_results(folder / "results.h5", stand_in.tube(("0003-specimen", "0004-specimen")))
    return [(folder / "results.h5").read_bytes()]


def guarded(path: Path) -> None:
    lines = path.read_bytes().split(b"\n")
    names = (b"host", b"origin", b"referer", b"sec-fetch-site")
    headers = Headers(raw=list(zip(names, lines, strict=False)))
    scope = {"type": "http", "method": "POST", "scheme": "http", "server": ("127.0.0.1", 80)}
    assert foreign_host(headers, scope, ()) is None or "'hosts'" in (foreign_host(headers, scope, ()) or "")
    foreign_page(headers, scope)


TARGETS = {
    "messages of the wire": Target(MESSAGES, lambda path: decode(path.read_bytes()), (WireError,), 3),
    "capture.json": Target(
        [json.dumps(CAPTURE.to_json()).encode()], lambda path: showable(read_capture_record(path).to_json())
    ),
    "session.json": Target(
        [json.dumps(SESSION.to_json()).encode()], lambda path: showable(read_session_record(path).to_json())
    ),
    "other JSON": Target([json.dumps(JOB).encode()], lambda path: showable(read_json(path)), (ValueError,)),
    "lines of the processing": Target(
        [json.dumps({"state": "done"}).encode()],
        lambda path: message_of(path.read_bytes().decode(errors="replace")),
        (),
    ),
    "rig.toml": Target([], read_rig, share=0.3),
    "settings.toml": Target([SETTINGS], load_settings, share=0.3),
    "controller.toml": Target([CONTROLLER], read_controller_config, share=0.3),
    "node.toml": Target([NODE], read_node_config, (ConfigError,)),
    "images": Target(IMAGES, read_gray),
    "results.h5": Target([], every_array, share=0.02),
    "headers of requests": Target([b"127.0.0.1:8000\nhttp://127.0.0.1:8000\nhttp://a/b\nnone"], guarded, ()),
}
INPUTS = 100  # of a target of share 1


def spoilt(random_: random.Random, seeds: list[bytes]) -> bytes:
    """A seed with one change or several: bytes and tokens put in, taken out, exchanged, repeated, joined."""
    content = bytearray(random_.choice(seeds))
    for _ in range(1 + int(random_.expovariate(0.7))):
        at = random_.randrange(len(content) + 1)
        length = 1 + int(random_.expovariate(0.2))
        match random_.randrange(7):
            case 0:
                content[at : at + length] = random_.randbytes(random_.randrange(5))
            case 1:
                content[at:at] = random_.choice(TOKENS)
            case 2:
                content[at : at + length] = random_.choice(TOKENS)
            case 3:
                del content[at : at + length]
            case 4:
                content[at:at] = content[at : at + length] * random_.randrange(1, 4)
            case 5:
                other = random_.choice(seeds)
                content[at:] = other[random_.randrange(len(other) + 1) :]
            case _:
                del content[at:]
        content = content[:1_000_000]
    return bytes(content)


@pytest.mark.parametrize("name", TARGETS)
def test_every_input_is_read_or_refused(
    tmp_path: Path, rig_toml: Callable[..., str], name: str, scale: int, seed: int
) -> None:
    target = TARGETS[name]
    seeds = seeds_of(name, tmp_path, rig_toml("ring", ("01", "02")))
    random_, path = random.Random(f"{seed} {name}"), tmp_path / "input"
    count = round(INPUTS * target.share * scale)
    longest = 0.0
    for k in range(count):
        content = seeds[k] if k < len(seeds) else spoilt(random_, seeds)
        path.write_bytes(content)
        began = time.monotonic()
        try:
            target.read(path)
        except target.refusals:
            assert k >= len(seeds), "what is valid is read"
        except Exception as error:
            kept = Path(tmp_path / "fault")
            kept.write_bytes(content)
            raise AssertionError(f"{name}, input {k}, kept as {kept}: {error!r}") from error
        longest = max(longest, time.monotonic() - began)
    assert longest < LONGEST
