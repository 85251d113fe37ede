"""``ringdic rig certificates``: what is made, kept, asked for, and who may read it."""

from __future__ import annotations

import stat
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from ringdic.cli.app import application
from ringdic.errors import InputError
from ringdic_controller.access.certificates import (
    MACHINE_LIFE,
    Authority,
    common_name_of,
    hosts_of,
    machine_fault,
    machines_of,
    open_authority,
)
from ringdic_controller.cli.rig import issue_certificates
from typer.testing import CliRunner

NOW = datetime(2026, 11, 30, 12, tzinfo=UTC)
HOSTS = ["192.168.1.10", "rig-pc.lab"]


@pytest.fixture
def command(tmp_path: Path, rig_toml: Callable[..., str]) -> Callable[..., str]:
    """Call it with options: the command on a rig of two cameras, in a folder of its own; what it printed."""
    (tmp_path / "rig.toml").write_text(rig_toml("ring", ["01", "02"]))

    def run(*options: str) -> str:
        arguments = ["rig", "certificates", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "c"), *options]
        done = CliRunner().invoke(application(), arguments)
        if isinstance(done.exception, InputError):
            raise done.exception
        assert done.exit_code == 0, done.output
        return done.output

    return run


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_one_command_makes_all_and_a_second_changes_nothing(command: Callable[..., str], tmp_path: Path) -> None:
    command("--host", "192.168.1.10", "--host", "Rig-PC.lab")
    folder = tmp_path / "c"
    three = ["authority.pem", "certificate.pem", "key.pem"]
    machines = ("controller", "nodes/01", "nodes/02")
    made = contents(folder)
    assert sorted(made) == sorted(["authority.key", "authority.pem", *(f"{m}/{f}" for m in machines for f in three)])
    private = {name for name in made if stat.S_IMODE((folder / name).stat().st_mode) == 0o600}
    assert private == {name for name in made if name.endswith("key.pem") or name == "authority.key"}
    command()
    assert contents(folder) == made

    now = datetime.now(UTC)
    authority = open_authority(folder, "ring", now)
    controller, first, second = machines_of("ring", ["01", "02"], [], folder)
    names = [common_name_of(machine.certificate()) for machine in (controller, first, second)]
    assert names == ["ring/controller", "ring/node/01", "ring/node/02"]
    assert set(hosts_of(controller.certificate())) == {*HOSTS, "localhost", "127.0.0.1", "::1"}
    assert hosts_of(first.certificate()) == []
    assert [machine_fault(machine, now, authority.certificate) for machine in (controller, first, second)] == [None] * 3
    valid = controller.certificate().not_valid_after_utc - controller.certificate().not_valid_before_utc
    assert valid <= timedelta(days=825), "browsers refuse longer ones"


def test_a_camera_that_is_added_gets_its_certificate_and_the_others_keep_theirs(
    command: Callable[..., str], tmp_path: Path, rig_toml: Callable[..., str]
) -> None:
    command("--host", "10.0.0.1")
    before = contents(tmp_path / "c")
    (tmp_path / "rig.toml").write_text(rig_toml("ring", ["01", "02", "03"]))
    command()
    after = contents(tmp_path / "c")
    assert {name: after[name] for name in before} == before
    assert {name.split("/")[1] for name in after.keys() - before.keys()} == {"03"}


def test_nothing_is_replaced_unless_somebody_agrees(command: Callable[..., str], tmp_path: Path) -> None:
    command("--host", "10.0.0.1")
    before = contents(tmp_path / "c")
    for options in (["--renew"], ["--host", "10.0.0.2"]):
        with pytest.raises(InputError, match="--yes"):
            command(*options)
        assert contents(tmp_path / "c") == before
    command("--host", "10.0.0.2", "--yes")
    changed = {name for name, content in contents(tmp_path / "c").items() if content != before[name]}
    assert changed == {"controller/certificate.pem", "controller/key.pem"}
    command("--renew", "--yes")
    kept = {name for name, content in contents(tmp_path / "c").items() if content == before[name]}
    assert kept == {name for name in before if "authority" in name}


def test_without_an_address_the_command_asks_for_one_and_makes_nothing(
    command: Callable[..., str], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="--host"):
        command()
    for wrong in ("tls/10.0.0.1:7447", "10.0.0.1:80", "a b", "-", "höst"):
        with pytest.raises(InputError, match="neither an address"):
            command("--host", wrong)
    assert not (tmp_path / "c").exists()


def test_what_is_wrong_with_a_certificate_is_said(tmp_path: Path) -> None:
    authority = open_authority(tmp_path, "ring", NOW)
    controller, node = machines_of("ring", ["01"], ["10.0.0.1"], tmp_path)
    for machine in (controller, node):
        authority.issue(machine, NOW)

    def fault(later: timedelta = timedelta(0), **changes: object) -> str | None:
        return machine_fault(replace(node, **changes), NOW + later, authority.certificate)

    assert fault() is None
    assert fault(MACHINE_LIFE - timedelta(days=12)) == "expires in 12 days"
    assert fault(MACHINE_LIFE) == "has expired on 2028-11-29"
    assert fault(folder=tmp_path / "nodes" / "02") == "is missing"
    assert fault(common_name="ring/node/02") == "names ring/node/01"
    assert machine_fault(replace(controller, hosts=(*controller.hosts, "b")), NOW) == "does not name b"
    assert machine_fault(node, NOW, Authority.create("ring", NOW).certificate) == "is signed by another authority"
    (node.folder / "key.pem").write_bytes((controller.folder / "key.pem").read_bytes())
    assert fault() == "does not belong to the key beside it"
    assert issue_certificates(authority, [controller, node], NOW, yes=True) == {"controller": "kept", "01": "renewed"}
    assert fault() is None


def test_an_authority_that_is_not_the_rigs_or_not_whole_is_refused(tmp_path: Path) -> None:
    open_authority(tmp_path, "ring", NOW)
    with pytest.raises(InputError, match="not that of the rig 'other'"):
        open_authority(tmp_path, "other", NOW)
    with pytest.raises(InputError, match="has expired"):
        open_authority(tmp_path, "ring", NOW + timedelta(days=3660))
    key = tmp_path / "authority.key"
    key.write_bytes(b"nothing")
    with pytest.raises(InputError, match="no private key"):
        open_authority(tmp_path, "ring", NOW)
    key.unlink()
    with pytest.raises(InputError, match="put it back"):
        open_authority(tmp_path, "ring", NOW)


def test_names_that_do_not_fit_into_a_certificate_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="shorten"):
        machines_of("r" * 40, ["c" * 40], HOSTS, tmp_path / "c")
    assert not (tmp_path / "c").exists()
