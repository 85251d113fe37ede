"""``ringdic rig init`` writes what all machines of a rig accept; ``ringdic rig check`` says what is wrong."""

from __future__ import annotations

import json
import re
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from ringdic.cli.app import application
from ringdic.errors import InputError
from ringdic.session.rig import read_rig
from ringdic_controller.service.config import read_controller_config
from ringdic_controller.setup.rig_files import RigAnswers, check_names, host_name, rig_text
from ringdic_node.config import read_node_config
from ringdic_node.endpoint import endpoint_security
from typer.testing import CliRunner

REPOSITORY = Path(__file__).parents[3]
SSH_KEY = "ssh-ed25519 " + "A" * 68 + " anna@lab"


def run(*arguments: str, code: int = 0) -> str:
    done = CliRunner().invoke(application(), ["rig", *arguments])
    if isinstance(done.exception, InputError):
        raise done.exception
    assert done.exit_code == code, done.output
    return done.output


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of four cameras, as ``init`` writes it."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "key.pub").write_text(SSH_KEY + "\n")
    options = ["--name", "ring-4", "--cameras", "4", "--host", "192.168.1.10", "--ssh-key", str(folder / "key.pub")]
    run("init", str(folder / "ring"), *options)
    return folder


@pytest.fixture
def rig(made: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    shutil.copytree(made / "ring", tmp_path / "ring")
    return tmp_path / "ring"


@pytest.fixture
def again(made: Path, rig: Path) -> Callable[..., str]:
    """Call it to run ``init`` on the copy once more."""
    key = str(made / "key.pub")
    return lambda *more: run("init", str(rig), "--host", "192.168.1.10", "--ssh-key", key, *more)


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


def faults(folder: Path, code: int = 3) -> dict[str, str]:
    """What ``check`` says is wrong."""
    printed = run("check", str(folder), "--json", code=code)
    checks = json.loads(next(line for line in printed.splitlines() if line.startswith("{")))["checks"]
    return {check["what"]: check["fault"] for check in checks if check["fault"]}


def test_a_rig_that_was_just_made_has_nothing_wrong(rig: Path) -> None:
    assert faults(rig, code=0) == {}


def test_the_controller_accepts_what_was_written(rig: Path) -> None:
    config = read_controller_config(rig / "controller.toml")
    described = read_rig(config.rig)
    assert (described.name, [camera.id for camera in described.cameras]) == ("ring-4", ["01", "02", "03", "04"])
    assert [camera.azimuth_deg for camera in described.cameras] == [0.0, 90.0, 180.0, 270.0]
    assert endpoint_security(config.endpoint, config.certificates)
    assert config.host == "127.0.0.1"


def files_of(card: Path) -> dict[str, dict[str, Any]]:
    document = yaml.safe_load(card.read_text())
    return {entry["path"]: entry for entry in document["write_files"]}


def test_each_card_makes_a_node_that_its_program_accepts(rig: Path, tmp_path: Path) -> None:
    names = set()
    for camera in ("01", "02", "03", "04"):
        card = rig / "cards" / camera / "user-data"
        assert stat.S_IMODE(card.stat().st_mode) == 0o600, "it holds a key"
        document = yaml.safe_load(card.read_text())
        assert card.read_text().startswith("#cloud-config\n")
        names.add(document["hostname"])
        assert document["users"][0]["ssh_authorized_keys"] == [SSH_KEY]
        for path, entry in files_of(card).items():
            written = tmp_path / camera / Path(path).relative_to("/etc/ringdic")
            written.parent.mkdir(parents=True, exist_ok=True)
            written.write_text(entry["content"])
            assert entry["permissions"] == ("0600" if path.endswith("key.pem") else "0644")
        config = read_node_config(tmp_path / camera / "node.toml")
        assert (config.rig, config.id, config.controller) == ("ring-4", camera, "tls/192.168.1.10:7447")
        assert endpoint_security(config.controller, tmp_path / camera / "certificates")
    hosts = yaml.safe_load((rig / "inventory.yml").read_text())["nodes"]["hosts"]
    assert set(hosts) == names == {f"ring-cam-0{k}" for k in range(1, 5)}


def test_the_example_in_deploy_and_the_cards_are_alike(rig: Path) -> None:
    example = yaml.safe_load((REPOSITORY / "deploy/node/cloud-init/user-data").read_text())
    card = yaml.safe_load((rig / "cards/01/user-data").read_text())
    for document in (example, card):
        document.pop("hostname")
        document["users"][0].pop("ssh_authorized_keys")
        for entry in document["write_files"]:
            entry.pop("content")
    assert card == example


def test_a_second_run_changes_nothing_and_replaces_only_what_somebody_agrees_to(
    rig: Path, again: Callable[..., str]
) -> None:
    before = contents(rig)
    again()
    assert contents(rig) == before
    (rig / "controller.toml").write_text('rig = "rig.toml"\n# mine\n')
    with pytest.raises(InputError, match="--yes"):
        again()
    assert "# mine" in (rig / "controller.toml").read_text()
    again("--yes")
    assert contents(rig) == before


def test_a_camera_that_is_added_to_the_rig_gets_its_card(rig: Path, again: Callable[..., str]) -> None:
    before = contents(rig)
    with (rig / "rig.toml").open("a") as file:
        file.write('\n[[cameras]]\nid = "extra"\nazimuth_deg = 300.0\n')
    assert "cards/extra/user-data is missing" in faults(rig)["card of extra"]
    with pytest.raises(InputError, match="--yes"):  # the inventory lacks it
        again()
    again("--yes")
    after = contents(rig)
    assert {name for name in before if before[name] != after[name]} == {"rig.toml", "inventory.yml"}
    assert "ring-cam-extra" in after["inventory.yml"]
    assert faults(rig, code=0) == {}


def test_what_is_missing_from_the_answers_is_asked_for_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    given = ["--name", "ring", "--cameras", "2", "--host", "10.0.0.1"]
    for lacking in ("--name", "--cameras", "--host"):
        k = given.index(lacking)
        with pytest.raises(InputError, match=lacking):
            run("init", str(tmp_path / "ring"), *given[:k], *given[k + 2 :])
    with pytest.raises(InputError, match="--ssh-key"):
        run("init", str(tmp_path / "ring"), *given)
    assert not (tmp_path / "ring").exists()


def test_answers_that_would_spoil_a_file_are_refused(tmp_path: Path) -> None:
    for key in ("", "ssh-rsa", SSH_KEY + '"\n  - x', SSH_KEY + "\n" + SSH_KEY, "-----BEGIN OPENSSH PRIVATE KEY-----"):
        with pytest.raises(InputError, match="one line"):
            RigAnswers("10.0.0.1", key)
    with pytest.raises(InputError, match="none of pi, pattern"):
        RigAnswers("10.0.0.1", SSH_KEY, 'pi"')
    for name in ('a"', "a b", ""):
        with pytest.raises(InputError, match="is not a name"):
            rig_text(name, ["01", "02"])
        with pytest.raises(InputError, match="is not a name"):
            rig_text("ring", ["01", name])
    with pytest.raises(InputError, match="more than once"):
        rig_text("ring", ["01", "01"])


def test_host_names_are_such_and_differ(rig: Path) -> None:
    assert host_name("Cam_01.b") == "ring-cam-cam-01-b"
    text = rig_text("ring", ["a_1", "a.1"])
    (rig / "rig.toml").write_text(text)
    with pytest.raises(InputError, match="like that of 'a_1'"):
        check_names(read_rig(rig / "rig.toml"))


WRONGS = [
    ("controller.toml", "tls/0.0.0.0", "tcp/0.0.0.0", "nodes' endpoint", "without certificates"),
    ("controller.toml", ":7447", ":7448", "card of 01", "connects to tls/192.168.1.10:7447"),
    ("controller.toml", 'host = "127.0.0.1"', 'host = "0.0.0.0"', "page", "ringdic users add"),
    ("controller.toml", 'rig = "rig.toml"', 'rig = "ring.toml"', "rig.toml", "no such file"),
    ("rig.toml", "azimuth_deg = 90.0", "azimuth_deg = 0.0", "rig.toml", "azimuth 0°"),
    ("rig.toml", 'name = "ring-4"', 'name = "ring-5"', "certificate of controller", "names ring-4/controller"),
    ("cards/02/user-data", 'id = "02"', 'id = "01"', "card of 02", "id is '01' and not '02'"),
    ("cards/02/user-data", "tls/192.168.1.10", "tls/192.168.1.11", "card of 02", "does not name"),
    ("cards/02/user-data", "/etc/ringdic/node.toml", "/etc/node.toml", "card of 02", "does not write"),
    ("certificates/nodes/03/certificate.pem", "BEGIN CERT", "BEGIN", "certificate of 03", "no certificate"),
]


@pytest.mark.parametrize(("file", "old", "new", "what", "told"), WRONGS)
def test_check_names_what_is_wrong_and_what_to_do(
    rig: Path, file: str, old: str, new: str, what: str, told: str
) -> None:
    text = (rig / file).read_text()
    assert old in text
    (rig / file).write_text(text.replace(old, new))
    found = faults(rig)
    assert told in found[what], found


def test_check_finds_a_renewed_certificate_that_is_not_on_the_card_and_one_that_is_gone(rig: Path) -> None:
    run("certificates", str(rig), "--out", str(rig / "certificates"), "--renew", "--yes")
    shutil.rmtree(rig / "certificates" / "nodes" / "04")
    found = faults(rig)
    assert "not the one of today" in found["card of 01"]
    assert re.search("nodes/04 is missing", found["certificate of 04"])


def test_check_refuses_a_folder_without_a_configuration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such configuration"):
        run("check", str(tmp_path))
