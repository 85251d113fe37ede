"""The controller's configuration: defaults, paths beside the file, and refusals that name the key."""

from pathlib import Path

import pytest
from ringdic.errors import InputError
from ringdic_controller.service.config import ControllerConfig, read_controller_config


def test_without_a_file_the_controller_is_on_loopback() -> None:
    assert read_controller_config(None) == ControllerConfig()
    assert ControllerConfig().host == "127.0.0.1"
    assert "127.0.0.1" in ControllerConfig().endpoint


def test_paths_are_taken_from_the_folder_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "controller.toml"
    file.write_text(
        'archive = "sessions"\nrig = "/etc/rig.toml"\nsettings = "fine.toml"\nlive = false\n'
        '[http]\nhost = "::1"\nport = 0\nhosts = ["Lab-PC"]\n[zenoh]\nendpoint = "tcp/0.0.0.0:7448"\n'
    )
    config = read_controller_config(file)
    assert config == ControllerConfig(
        tmp_path / "sessions", Path("/etc/rig.toml"), tmp_path / "fine.toml", False, "::1", 0, "tcp/0.0.0.0:7448",
        ("lab-pc",),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('archiv = "x"', "archiv"),
        ("[http]\nadress = 1", "adress"),
        ("[http]\nport = 70000", "70000"),
        ('[http]\nport = "80"', "port"),
        ("[http]\nport = true", "port"),
        ("[http]\nhosts = [1]", "hosts"),
        ("http = 3", "http"),
        ("live = 1", "true or false"),
        ('[zenoh]\nendpoint = "localhost"', "endpoint"),
        ("= nothing", "controller.toml"),
    ],
)
def test_a_bad_file_is_refused_with_its_name_and_key(tmp_path: Path, text: str, word: str) -> None:
    file = tmp_path / "controller.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=word) as refusal:
        read_controller_config(file)
    assert str(file) in str(refusal.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such configuration"):
        read_controller_config(tmp_path / "nothing.toml")
