"""The playbooks install on the canary first, and in check mode change nothing."""

import os
import re
import subprocess
import sys
from pathlib import Path

import yaml

PLAYBOOKS = Path(__file__).resolve().parents[2] / "deploy" / "ansible"
NODES = ("first", "second")


def play(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run playbooks against two nodes that are both this machine."""
    host = {"ansible_connection": "local", "ansible_become": False, "ansible_python_interpreter": sys.executable}
    (folder / "inventory.yml").write_text(yaml.safe_dump({"nodes": {"hosts": {node: dict(host) for node in NODES}}}))
    command = [str(Path(sys.executable).with_name("ansible-playbook")), "-i", str(folder / "inventory.yml")]
    return subprocess.run(
        [*command, *arguments],
        cwd=PLAYBOOKS,
        env={**os.environ, "LC_ALL": "C.UTF-8", "HOME": str(folder), "ANSIBLE_NOCOLOR": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_playbooks_are_well_formed(tmp_path: Path) -> None:
    played = play(tmp_path, "back.yml", "status.yml", "--syntax-check")
    assert played.returncode == 0, played.stdout + played.stderr


def test_a_release_goes_to_the_canary_before_the_others(tmp_path: Path) -> None:
    wheel = tmp_path / "ringdic-0.2.0-py3-none-any.whl"
    wheel.touch()
    played = play(tmp_path, "install.yml", "--check", "-e", f"wheel={wheel}")
    assert played.returncode == 0, played.stdout + played.stderr
    copied = re.findall(r"^changed: \[(\w+)\]", played.stdout, flags=re.M)
    assert copied == ["first"] * 3 + ["second"] * 3
    assert not Path("/opt/ringdic/staging").exists()


def test_a_file_that_is_no_release_is_refused_before_anything_is_copied(tmp_path: Path) -> None:
    played = play(tmp_path, "install.yml", "--check", "-e", "wheel=numpy-2.0-py3-none-any.whl")
    assert played.returncode != 0
    assert "say which release" in played.stdout
    assert "changed: [" not in played.stdout


def test_the_example_inventory_names_the_group_that_the_playbooks_use() -> None:
    inventory = yaml.safe_load((PLAYBOOKS / "inventory.example.yml").read_text())
    playbooks = [path for path in PLAYBOOKS.glob("*.yml") if not path.name.startswith("inventory")]
    groups = {each["hosts"] for path in playbooks for each in yaml.safe_load(path.read_text())}
    assert groups == set(inventory)
