"""Requests made from the OpenAPI document, and others that no client would send: never a 5xx, never no answer."""

from __future__ import annotations

import importlib.util
import json
import random
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest
import requests
import schemathesis
import uvicorn
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as hypothesis_seed
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from ringdic.results.writer import write_results
from ringdic.session.writer import Archive
from ringdic_controller.service.app import create_app
from ringdic_controller.service.desk import Desk
from schemathesis import GenerationMode
from schemathesis.schemas import APIOperation

STAND_IN = Path(__file__).parents[1] / "controller" / "stand_in_processing.py"
EXAMPLES = 3  # of each operation, in each mode
RAW = 60  # requests as bytes
IMAGE = b"P5\n40 30\n255\n" + bytes(1200)
# Names that exist, for parameters in paths: else all requests would end with 404.
REAL = {
    "session": ["limb"], "name": ["limb", "lambda1", "J"], "capture_id": ["0001-board", "0003-specimen"],
    "camera": ["01"], "run": ["0001"], "job_id": ["0001"], "round_id": ["r1"],
}  # fmt: skip


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, rig_toml: Callable[[str, Sequence[str]], str]) -> Iterator[str]:
    """Address of a controller with a session that has captures, a run, a live step and a job."""
    root = tmp_path_factory.mktemp("archive")
    writer = Archive(root).create_session("limb", rig_toml("ring", ("01", "02")))
    (root / "image.pgm").write_bytes(IMAGE)
    for kind in ("board", "target", "specimen", "specimen"):
        capture = writer.begin_capture(kind, ["01"])
        capture.store_file("01", root / "image.pgm", 40, 30)
        capture.close()
    spec = importlib.util.spec_from_file_location("stand_in", STAND_IN)
    assert spec is not None
    assert spec.loader is not None
    stand_in = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(stand_in)
    for folder in ("results/0001", "live/0004-specimen"):
        (writer.path / folder).mkdir(parents=True)
        write_results(writer.path / folder / "results.h5", stand_in.tube(("0003-specimen", "0004-specimen")))
    (writer.path / "results" / "0001" / "report.html").write_text("<p>written before: it takes too long")
    desk = Desk(root, lambda _: ["/no/such/program"], rig_toml("ring", ("01", "02")))
    desk.connect(Archive(root), None)
    desk.jobs.submit("limb", writer.path, reason="asked for")
    server = uvicorn.Server(uvicorn.Config(create_app(desk), log_level="critical", timeout_graceful_shutdown=1))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        server.should_exit = True
        thread.join(10)
    desk.close()


def operations(address: str) -> list[APIOperation]:
    """The operations of the interface, without those whose answer has no end."""
    document = requests.get(f"{address}/openapi.json", timeout=20).json()
    del document["paths"]["/api/v1/live"]
    schema = schemathesis.openapi.from_dict(document)
    return [result.ok() for result in schema.get_all_operations()]


def test_no_request_of_the_described_form_or_near_it_fails(
    served: str, scale: int, seed: int, figures: Callable[[str, str, str], None]
) -> None:
    statuses: Counter[int] = Counter()
    faults: list[str] = []
    with requests.Session() as session:
        for operation in operations(served):
            _try(operation, GenerationMode.POSITIVE, served, session, EXAMPLES * scale, seed, statuses, faults)
            if operation.body or operation.query:  # any text is a name in a path: there is nothing else to negate
                _try(operation, GenerationMode.NEGATIVE, served, session, EXAMPLES * scale, seed, statuses, faults)
    assert faults == []
    assert statuses[200] > 0.1 * statuses.total(), "not everything ends with 404"
    figures("requests made from the OpenAPI document", str(statuses.total()), f"5xx: 0; {dict(statuses)}")


def _try(
    operation: APIOperation,
    mode: GenerationMode,
    address: str,
    session: requests.Session,
    examples: int,
    seed: int,
    statuses: Counter[int],
    faults: list[str],
) -> None:
    """Send requests of one operation, each as it is and with names that exist in its path."""

    @settings(
        max_examples=examples, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @hypothesis_seed(seed)
    @given(
        case=operation.as_strategy(generation_mode=mode),
        real=st.fixed_dictionaries({name: st.sampled_from(names) for name, names in REAL.items()}),
    )
    def send(case: schemathesis.Case, real: dict[str, str]) -> None:
        for names in (
            case.path_parameters,
            {name: real.get(name, value) for name, value in case.path_parameters.items()},
        ):
            case.path_parameters = names
            answer = case.call(base_url=address, session=session, timeout=30)
            statuses[answer.status_code] += 1
            if answer.status_code >= 500:
                faults.append(f"{answer.status_code} {case.as_curl_command()}: {answer.text[:200]}")
            elif answer.status_code >= 400:
                assert isinstance(json.loads(answer.content)["detail"], str)

    with suppress(Unsatisfiable):  # there is nothing to negate
        send()


LINES = b"""
GET / HTTP/1.1
GET /api/v1/rig HTTP/1.1
POST /api/v1/sessions HTTP/1.1
PUT /api/v1/sessions/current HTTP/1.1
POST /api/v1/captures HTTP/1.1
POST /api/v1/jobs/0001/cancel HTTP/1.1
GET /api/v1/sessions/%00/captures HTTP/1.1
GET /api/v1/jobs/%ff/log HTTP/1.1
GET /api/v1/sessions/limb/captures/0001-board/images/..%2f..%2fsession.json HTTP/1.1
GET /assets/../../config.py HTTP/1.1
GET /assets/%2e%2e/%2e%2e/service/config.py HTTP/1.1
GET http://evil.example/ HTTP/1.1
HEAD / HTTP/1.0
OPTIONS * HTTP/1.1
TRACE / HTTP/1.1
GET /api/v1/sessions/limb/results/LONG/file HTTP/1.1
GET /api/v1/sessions/\xff\xfe HTTP/1.1
""".strip().replace(b"LONG", b"0" * 300).splitlines()  # fmt: skip
HEADERS = b"""
Host: 127.0.0.1
Host: evil.example
Host:
Content-Length: 5
Content-Length: -1
Content-Length: 0
Content-Length: 99999999999999999999
Transfer-Encoding: chunked
Transfer-Encoding: gzip
Expect: 100-continue
Content-Type: application/json
Content-Type: multipart/form-data
Origin: null
Connection: upgrade
Upgrade: websocket
Sec-WebSocket-Key: x
Range: bytes=0-0,0-0,-1
Range: bytes=9-
Accept-Encoding: *;q=0
If-None-Match: "\xff"
Cookie: a=\xff
X: LONG
""".strip().replace(b"LONG", b"0" * 3000).splitlines()  # fmt: skip
BODIES = [b"", b"{}", b"[" * 5000, b'{"name": "\\ud800"}', b"5\r\nhello\r\n0\r\n\r\n", b"fffffff\r\n", b"\0\0", b"NaN"]


def test_no_bytes_on_the_socket_bring_the_server_down(served: str, scale: int, seed: int) -> None:
    random_ = random.Random(seed)
    host, port = served.removeprefix("http://").split(":")
    statuses: Counter[str] = Counter()
    for _ in range(RAW * scale):
        lines = [random_.choice(LINES), *random_.sample(HEADERS, random_.randrange(6))]
        if random_.random() < 0.7:
            lines.insert(1, b"Host: 127.0.0.1")
        content = b"\r\n".join(lines) + b"\r\n\r\n" + random_.choice(BODIES)
        if random_.random() < 0.2:
            at = random_.randrange(len(content))
            content = content[:at] + random_.randbytes(random_.randrange(4)) + content[at + 1 :]
        statuses[_status(host, int(port), content)] += 1
    assert not [status for status in statuses if status.startswith("5")], statuses
    assert requests.get(f"{served}/api/v1/rig", timeout=20).status_code == 200


def _status(host: str, port: int, content: bytes) -> str:
    """The status of the answer to these bytes; empty where there is none, as to an unfinished request."""
    with socket.create_connection((host, port), timeout=20) as connection:
        try:
            connection.sendall(content)
            connection.shutdown(socket.SHUT_WR)
            return connection.recv(15)[9:12].decode("ascii", "replace")
        except ConnectionError:
            return ""
