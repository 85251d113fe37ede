"""The command ``ringdic-node``: run the node's service, check the installation, or capture one still.

Exit codes: 0 done, 2 bad input, 3 the machine cannot do it, 1 a bug.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from ringdic_node.cameras.camera import CameraError, Shot
from ringdic_node.clock import SystemClock, clock_offset
from ringdic_node.config import ConfigError, NodeConfig, make_camera, read_node_config
from ringdic_node.endpoint import EndpointError, endpoint_security, handshake_fault
from ringdic_node.room import SpoolRoom
from ringdic_node.spool import Spool

DEFAULT_CONFIG = Path("/etc/ringdic/node.toml")
SECOND = 1_000_000_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``ringdic-node`` with its command-line arguments; return the exit code."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(
        level=logging.DEBUG if options.verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )
    try:
        config = read_node_config(options.config)
        if options.command == "shoot":
            return _shoot(config, options.out)
        endpoint_security(config.controller, config.certificates)  # refused before anything is opened
        return _run(config) if options.command == "run" else _check(config)
    except (ConfigError, EndpointError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except (CameraError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 3


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="ringdic-node", description="The agent of one camera node.")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--config", type=Path, default=DEFAULT_CONFIG, help=f"the node's configuration (default {DEFAULT_CONFIG})"
    )
    shared.add_argument("--verbose", action="store_true", help="log every detail")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("run", parents=[shared], help="serve until SIGTERM")
    commands.add_parser("check", parents=[shared], help="check camera, clock, spool and controller")
    shoot = commands.add_parser("shoot", parents=[shared], help="capture one still into a file, without a controller")
    shoot.add_argument("--out", type=Path, required=True, help="the PGM file to write; it must not exist")
    return parser


def _run(config: NodeConfig) -> int:
    from ringdic_node.service import NodeService, ServiceError

    clock = SystemClock()
    spool = _spool_of(config)
    spool.claim()
    service = NodeService(config, make_camera(config, clock), spool, clock)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: service.stop())
    try:
        service.run()
    except ServiceError as error:
        sys.stderr.write(f"{error}\n")
        sys.stderr.flush()
        os._exit(error.exit_code)  # a thread that hangs in a driver must not keep the process
    return 0


def _spool_of(config: NodeConfig) -> Spool:
    mib = 1 << 20
    return Spool(config.spool, reserve=round(config.spool_reserve_mb * mib), keep=round(config.spool_keep_mb * mib))


def _check(config: NodeConfig) -> int:
    sound = True
    for name, probe in (
        ("camera", _probe_camera),
        ("clock", _probe_clock),
        ("spool", _probe_spool),
        ("controller", _probe_controller),
    ):
        passed, text = probe(config)
        sound = sound and passed
        sys.stdout.write(f"{'ok  ' if passed else 'FAIL'} {name:<11} {text}\n")
    return 0 if sound else 3


def _probe_camera(config: NodeConfig) -> tuple[bool, str]:
    try:
        camera = make_camera(config, SystemClock())
        try:
            lock = camera.lock({})
            return True, f"{config.camera}, {camera.versions()}, sync {lock.sync}"
        finally:
            camera.close()
    except CameraError as error:
        return False, str(error)


def _probe_clock(_: NodeConfig) -> tuple[bool, str]:
    offset = clock_offset()
    if offset is None:
        return True, "not disciplined by chrony; good enough for a simulated rig only"
    return True, f"offset {offset[0]:.3f} ms, error at most {offset[1]:.3f} ms"


def _probe_spool(config: NodeConfig) -> tuple[bool, str]:
    try:
        spool = _spool_of(config)
    except OSError as error:
        return False, f"{config.spool} cannot be used: {error}"
    room = SpoolRoom(spool, config.id, config.arm_captures)
    text = f"{config.spool}, {spool.free >> 20} MiB free, {len(room.waiting)} images wait"
    return not room.obstacle(), "; ".join(part for part in (text, room.detail(0)) if part)


def _probe_controller(config: NodeConfig) -> tuple[bool, str]:
    from ringdic_node.link import NodeLink
    from ringdic_node.wire import Keys

    def ignore(*_: object) -> None:
        pass

    if fault := handshake_fault(config.controller, config.certificates):
        return False, f"{config.controller} and this node do not accept each other's certificates: {fault}"
    # With an id of its own, since the controller would take it for the running service.
    with NodeLink(
        Keys(config.rig), "check", config.controller, ignore, ignore, certificates=config.certificates
    ) as link:
        deadline = time.monotonic() + 3.0
        while time.monotonic() < deadline:
            if link.connected:
                return True, f"{config.controller} answers"
            time.sleep(0.1)
    return False, f"{config.controller} does not answer within 3 s; is the controller running?"


def _shoot(config: NodeConfig, out: Path) -> int:
    clock = SystemClock()
    if out.exists():
        raise ConfigError(f"{out} exists already; choose another --out")
    camera = make_camera(config, clock)
    try:
        camera.lock({})
        frame = camera.capture(Shot(clock.now().wall_ns + SECOND // 2, "static", 0))
    finally:
        camera.close()
    header, pixels = frame.pgm()
    with open(out, "xb") as file:
        file.write(header + pixels)
    sys.stdout.write(f"{out}: {frame.width} x {frame.height}, exposure {frame.exposure_us} us\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
