"""What is deployed is what the programs accept: examples, units, scripts, and the installer in a scratch root."""

import configparser
import contextlib
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.metadata import distribution
from pathlib import Path

import pytest
import typer.main
import zenoh
from ringdic.cli.app import application
from ringdic_controller.service.config import read_controller_config
from ringdic_node.cli import _parser as node_parser
from ringdic_node.config import read_node_config

REPOSITORY = Path(__file__).resolve().parents[2]
NODE = REPOSITORY / "deploy" / "node"
CONTROLLER = REPOSITORY / "deploy" / "controller"
UNITS = (NODE / "ringdic-node.service", CONTROLLER / "ringdic-controller.service")
SCRIPTS = sorted((REPOSITORY / "deploy").rglob("*.sh"))
INSTALLER = NODE / "install.sh"


def unit_of(path: Path) -> configparser.ConfigParser:
    unit = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(path.read_text(encoding="utf-8"))
    return unit


def command_of(path: Path) -> tuple[str, list[str]]:
    program, *arguments = shlex.split(unit_of(path)["Service"]["ExecStart"])
    return program, arguments


# Examples


def test_node_example_is_accepted_and_spools_where_the_unit_may_write() -> None:
    config = read_node_config(NODE / "node.toml.example")
    assert config.camera == "pi"
    assert config.spool == Path("/var/lib/ringdic/spool")
    assert unit_of(UNITS[0])["Service"]["StateDirectory"] == "ringdic"


def test_node_example_shows_the_defaults_of_its_optional_keys() -> None:
    shown = read_node_config(NODE / "node.toml.example")
    bare = type(shown)(shown.rig, shown.id, shown.controller, shown.spool, shown.camera, shown.camera_settings)
    assert shown == bare


def test_controller_example_is_accepted_and_archives_where_the_unit_may_write() -> None:
    config = read_controller_config(CONTROLLER / "controller.toml.example")
    assert config.archive == Path("/var/lib/ringdic/archive")
    assert unit_of(UNITS[1])["Service"]["StateDirectory"] == "ringdic"
    assert config.host == "127.0.0.1"  # without users, the page is not offered to the network


def test_nodes_connect_to_the_port_on_which_the_controller_listens() -> None:
    node = read_node_config(NODE / "node.toml.example")
    controller = read_controller_config(CONTROLLER / "controller.toml.example")
    assert node.controller.rpartition(":")[2] == controller.endpoint.rpartition(":")[2]


def test_first_boot_writes_a_configuration_that_the_node_accepts(tmp_path: Path) -> None:
    text = (NODE / "cloud-init" / "user-data").read_text(encoding="utf-8")
    assert text.startswith("#cloud-config\n")  # else cloud-init ignores the file
    assert "\t" not in text  # YAML forbids tabs
    head = r"- path: /etc/ringdic/node\.toml\n(?: {4}permissions.*\n)? {4}content: \|\n"
    block = re.search(head + r"((?: {6}.*\n)+)", text)
    assert block is not None
    path = tmp_path / "node.toml"
    path.write_text(re.sub(r"^ {6}", "", block[1], flags=re.MULTILINE), encoding="utf-8")
    example = read_node_config(NODE / "node.toml.example")
    written = read_node_config(path)
    assert (written.rig, written.controller, written.spool) == (example.rig, example.controller, example.spool)


# Units


def test_node_unit_starts_a_command_that_exists() -> None:
    program, arguments = command_of(UNITS[0])
    assert Path(program).name in {script.name for script in distribution("ringdic").entry_points}
    options = node_parser().parse_args(arguments)
    assert (options.command, options.config) == ("run", Path("/etc/ringdic/node.toml"))


def test_controller_unit_starts_a_command_that_exists() -> None:
    program, (verb, *arguments) = command_of(UNITS[1])
    assert Path(program).name in {script.name for script in distribution("ringdic").entry_points}
    command = typer.main.get_command(application()).commands[verb]  # type: ignore[attr-defined]
    context = command.make_context(verb, arguments)
    assert context.params == {"config": Path("/etc/ringdic/controller.toml")}


@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_unit_promises_no_readiness_that_the_program_does_not_report(path: Path) -> None:
    service = unit_of(path)["Service"]
    sources = (REPOSITORY / ("node_agent" if "node" in path.name else "controller")).rglob("*.py")
    notifies = any("NOTIFY_SOCKET" in source.read_text(encoding="utf-8") for source in sources)
    assert (service["Type"] == "notify") == notifies
    assert ("WatchdogSec" in service) <= notifies


def test_node_unit_leaves_the_camera_devices_visible() -> None:
    service = unit_of(UNITS[0])["Service"]
    for hides in ("PrivateDevices", "ProtectClock", "DevicePolicy", "DeviceAllow"):
        assert hides not in service
    assert service["SupplementaryGroups"] == "video"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.name)
def test_systemd_accepts_the_unit(path: Path, tmp_path: Path) -> None:
    program, _ = command_of(path)
    copy = tmp_path / path.name  # systemd insists on a program that is there
    copy.write_text(path.read_text(encoding="utf-8").replace(program, sys.executable), encoding="utf-8")
    done = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(shutil.which("chronyd") is None, reason="chronyd is not installed")
@pytest.mark.parametrize("path", [NODE / "chrony.conf", CONTROLLER / "chrony.conf"], ids=["node", "controller"])
def test_chrony_accepts_the_configuration(path: Path, tmp_path: Path) -> None:
    filled = tmp_path / "chrony.conf"
    filled.write_text(path.read_text(encoding="utf-8").replace("@CONTROLLER@", "192.168.1.10"), encoding="utf-8")
    command = [str(shutil.which("chronyd")), "-p", "-f", str(filled)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


# Scripts and the installer


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.name)
def test_script_is_sound(path: Path) -> None:
    assert os.access(path, os.X_OK)
    subprocess.run(["bash", "-n", str(path)], check=True, timeout=60)
    if shutil.which("shellcheck"):
        subprocess.run(["shellcheck", str(path)], check=True, timeout=60)


def wheel(folder: Path, version: str, *, broken: bool = False) -> Path:
    """A wheel of the node's package alone; a broken one installs, but its command ends with an error."""
    path = folder / f"ringdic-{version}-py3-none-any.whl"
    scripts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
    about = f"ringdic-{version}.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        for source in sorted((REPOSITORY / "node_agent").rglob("*.py")):
            text = source.read_text(encoding="utf-8")
            if broken and source.name == "link.py":
                text = "raise RuntimeError('this release does not work')\n"
            archive.writestr(source.relative_to(REPOSITORY / "node_agent").as_posix(), text)
        archive.writestr(
            f"{about}/METADATA",
            f"Metadata-Version: 2.1\nName: ringdic\nVersion: {version}\n"
            "Requires-Dist: eclipse-zenoh\nRequires-Dist: numpy\n",
        )
        archive.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        entry = f"[console_scripts]\nringdic-node = {scripts['ringdic-node']}\n"
        archive.writestr(f"{about}/entry_points.txt", entry)
        archive.writestr(f"{about}/RECORD", "".join(f"{name},,\n" for name in archive.namelist()))
    return path


@pytest.fixture
def from_apt(tmp_path: Path) -> Path:
    """A folder with what a node has from elsewhere, numpy and Zenoh, and nothing else of this environment."""
    folder = tmp_path / "site"
    folder.mkdir()
    for name in ("numpy", "eclipse-zenoh"):
        files = distribution(name).files or []
        for top in {file.parts[0] for file in files} - {".."}:
            (folder / top).symlink_to(str(distribution(name).locate_file(top)))
    return folder


@contextlib.contextmanager
def router() -> Iterator[str]:
    """A controller as far as `check` asks: a router that answers on loopback."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        yield endpoint


def test_releases_are_installed_checked_and_taken_back(tmp_path: Path, from_apt: Path) -> None:
    root = tmp_path / "root"
    prefix = root / "opt" / "ringdic"
    python = tmp_path / "bin" / "python3"  # a plain interpreter, as the Pi's is, and not this environment's
    python.parent.mkdir()
    python.symlink_to(Path(sys.executable).resolve())
    environment = {**os.environ, "PYTHONPATH": str(from_apt), "PATH": f"{python.parent}:{os.environ['PATH']}"}
    for name in ("VIRTUAL_ENV", "PYTHONHOME"):
        environment.pop(name, None)

    def install(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [str(INSTALLER), *map(str, arguments), "--root", str(root)]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240)

    def current() -> str | None:
        link = prefix / "current"
        return os.readlink(link) if link.is_symlink() else None

    offline = ("--wheels", tmp_path)
    first = wheel(tmp_path, "0.1.0")
    asked = install(first, *offline)
    config = root / "etc" / "ringdic" / "node.toml"
    assert asked.returncode == 2, asked.stderr  # the example is put in place and has to be filled in
    assert config.read_text(encoding="utf-8") == (NODE / "node.toml.example").read_text(encoding="utf-8")
    assert current() is None

    with router() as endpoint:
        spool = root / "var" / "lib" / "ringdic" / "spool"
        config.write_text(
            f'rig = "ring-12"\nid = "cam_01"\ncontroller = "{endpoint}"\nspool = "{spool}"\ncamera = "pattern"\n',
            encoding="utf-8",
        )
        done = install(first, *offline)
        assert done.returncode == 0, done.stderr + done.stdout
        assert current() == "releases/0.1.0"
        unit = root / "etc" / "systemd" / "system" / "ringdic-node.service"
        assert unit.read_bytes() == UNITS[0].read_bytes()
        assert "server 127.0.0.1 iburst" in (root / "etc" / "chrony" / "chrony.conf").read_text(encoding="utf-8")
        program = root / command_of(UNITS[0])[0].lstrip("/")
        assert os.access(program, os.X_OK)  # where the unit will look for it

        assert install(first, *offline).returncode == 2  # a release is never changed afterwards

        refused = install(wheel(tmp_path, "0.2.0", broken=True), *offline)
        assert refused.returncode == 3
        assert "does not pass its check" in refused.stderr
        assert current() == "releases/0.1.0"
        assert not (prefix / "releases" / "0.2.0").exists()

        assert install(first, "--release", "0.1.0-again", *offline).returncode == 0
        assert current() == "releases/0.1.0-again"
    unchecked = install("--back")  # the way back asks nobody, not even a controller
    assert unchecked.returncode == 0, unchecked.stderr
    assert current() == "releases/0.1.0"
    assert set(install("--list").stdout.splitlines()) == {"0.1.0  current", "0.1.0-again  previous"}


def test_a_release_whose_parts_are_missing_is_not_left_behind(tmp_path: Path) -> None:
    root = tmp_path / "root"
    config = root / "etc" / "ringdic" / "node.toml"
    config.parent.mkdir(parents=True)
    shutil.copy(NODE / "node.toml.example", config)
    damaged = tmp_path / "ringdic-0.1.0-py3-none-any.whl"
    damaged.write_bytes(b"not a wheel")
    command = [str(INSTALLER), str(damaged), "--wheels", str(tmp_path), "--root", str(root)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 3
    assert not (root / "opt" / "ringdic" / "current").is_symlink()
    assert not (root / "opt" / "ringdic" / "releases" / "0.1.0").exists()
