"""The running controller: archive, link to the nodes, jobs and web server, opened and closed in order."""

from __future__ import annotations

import logging
import os
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from threading import current_thread, main_thread
from types import FrameType

import uvicorn
from ringdic.errors import InputError
from ringdic.session.rig import parse_rig, read_rig
from ringdic.session.writer import Archive

from ringdic_controller.jobs.children import Command, Processing, WarmChild, serving_command
from ringdic_controller.rig.capture import Timing
from ringdic_controller.rig.link import RigLink
from ringdic_controller.service.app import create_app
from ringdic_controller.service.config import ControllerConfig
from ringdic_controller.service.connections import BoundedConnection
from ringdic_controller.service.desk import Desk
from ringdic_controller.service.guard import GuardRules
from ringdic_controller.service.page_security import page_security

logger = logging.getLogger(__name__)

TOLERANCE_NS = 1_000_000  # skew that is not flagged, unless rig.toml says otherwise
SHUTDOWN_LIMIT = 2  # seconds; an open event stream would keep the server alive for ever


@contextmanager
def open_desk(
    config: ControllerConfig, processing: Command | Processing | None = None, timing: Timing | None = None
) -> Iterator[Desk]:
    """Open the desk with archive, jobs and, if the configuration names a rig, the link to its nodes.

    Parameters
    ----------
    config
        The controller's configuration.
    processing
        Runs the jobs; None for a warm child process.
    timing
        Waits of a capture round; None for the usual ones.

    Raises InputError for a bad rig.toml or a settings file that does not exist.
    """
    text = None
    if config.rig is not None:
        read_rig(config.rig)  # its errors name the file
        text = config.rig.read_text(encoding="utf-8")
    if config.settings is not None and not config.settings.is_file():
        raise InputError(f"{config.settings}: no such settings file")
    desk = Desk(config.archive, processing or WarmChild(serving_command(), config.settings), text, live=config.live)
    try:
        archive = Archive(config.archive)
        if text is None:
            desk.connect(archive, None)
            yield desk
            return
        rig = parse_rig(text)
        tolerance_us = rig.capture.tolerance_us
        tolerance_ns = TOLERANCE_NS if tolerance_us is None else round(tolerance_us * 1000)
        cameras = [camera.id for camera in rig.cameras]
        with RigLink(
            rig.name,
            cameras,
            config.endpoint,
            archive,
            desk.on_event,
            timing=timing,
            tolerance_ns=tolerance_ns,
            certificates=config.certificates,
        ) as link:
            desk.connect(archive, link)
            yield desk
    finally:
        desk.close()


def serve_page(desk: Desk, config: ControllerConfig, on_ready: Callable[[str], None] | None = None) -> None:
    """Serve the page and the HTTP interface until SIGINT or SIGTERM.

    ``on_ready`` is called with the page's address. Raises InputError if the port is taken, and where other machines
    reach the page without certificates and users.
    """
    secured = page_security(config)
    listener = _listen(config)
    host = f"[{config.host}]" if ":" in config.host else config.host
    address = f"{secured.scheme}://{host}:{listener.getsockname()[1]}"
    rules = GuardRules(hosts=frozenset({config.host.lower(), *config.hosts}))
    app = create_app(desk, rules=rules, access=secured.access)
    server = uvicorn.Server(
        uvicorn.Config(
            app,
            http=BoundedConnection,
            log_level="warning",
            timeout_graceful_shutdown=SHUTDOWN_LIMIT,
            **secured.server_settings,
        )
    )
    logger.info("the page is at %s", address)
    with listener, _ended_by_signal(server):
        if on_ready:
            on_ready(address)
        server.run([listener])


def run_controller(config: ControllerConfig, on_ready: Callable[[str], None] | None = None) -> None:
    """Run the controller until SIGINT or SIGTERM; ``on_ready`` is called with the page's address."""
    page_security(config)  # refused before nodes are let in
    with open_desk(config) as desk:
        serve_page(desk, config, on_ready)


def free_endpoint(config: ControllerConfig) -> ControllerConfig:
    """Replace a configuration's Zenoh endpoint by one on loopback whose port is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return replace(config, endpoint=f"tcp/127.0.0.1:{probe.getsockname()[1]}")


@contextmanager
def _ended_by_signal(server: uvicorn.Server) -> Iterator[None]:
    """Let SIGINT and SIGTERM end only the server, so that archive, jobs and link are then closed in order.

    When it has ended, the server raises the signals again that it caught; they must not end the process then.
    """
    if current_thread() is not main_thread():
        yield
        return

    def end(_number: int, _frame: FrameType | None) -> None:
        server.should_exit = True

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _listen(config: ControllerConfig) -> socket.socket:
    family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # elsewhere it would let two servers share the port
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((config.host, config.port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        raise InputError(
            f"http://{config.host}:{config.port} cannot be served ({error.strerror}); "
            "choose another [http] port in the controller's configuration"
        ) from error
    return listener
