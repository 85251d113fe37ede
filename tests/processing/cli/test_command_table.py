"""``ringdic`` itself: which commands there are, and one sentence where the packages of a command are missing."""

import subprocess
import sys

COMMAND = "import sys; {}\nsys.argv = ['ringdic', *{}]; from ringdic.__main__ import main; main()"


def run(prepare: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, after some preparation."""
    code = COMMAND.format(prepare, list(arguments))
    return subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=120, check=False)


def without(*packages: str) -> str:
    """Python that makes packages look as if they were not installed."""
    return f"sys.modules.update(dict.fromkeys({packages}))"


def test_the_commands_of_the_library_and_of_the_controller_are_one_table() -> None:
    shown = run("pass", "--help").stdout
    for name in (
        "import", "process", "correlate", "export", "report", "measure", "overlay", "animate", "strain",
        "demo", "controller", "validate", "bench",
    ):  # fmt: skip
        assert f" {name} " in shown


def test_help_loads_neither_arrays_nor_settings() -> None:
    loaded = """import sys
from ringdic.cli.app import application
application()
print({"numpy", "numba", "cv2", "scipy", "pydantic", "fastapi", "zenoh"} & set(sys.modules))"""
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.strip() == "set()"


def test_the_command_has_one_thread_for_linear_algebra_before_numpy_is_loaded() -> None:
    prepare = """import atexit, os, ringdic.__main__
assert "numpy" not in sys.modules
os.environ.pop("OPENBLAS_NUM_THREADS", None)
atexit.register(lambda: print("threads", os.environ["OPENBLAS_NUM_THREADS"]))"""
    assert "threads 1" in run(prepare, "--help").stdout


def test_where_only_a_node_is_installed_the_command_names_the_extra() -> None:
    done = run(without("typer"), "--help")
    assert done.returncode == 2
    assert done.stderr == (
        "ringdic: this needs the extra 'processing', which is not installed (typer is missing); "
        "install it with: pip install 'ringdic[processing]'\n"
    )


def test_where_only_the_library_is_installed_the_demo_names_the_extra() -> None:
    for command in ("demo", "controller"):
        done = run(without("fastapi", "uvicorn"), command)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.endswith("pip install 'ringdic[controller]'\n")


def test_a_package_of_no_extra_that_is_missing_is_a_bug() -> None:
    done = run(without("ringdic.measure"), "strain", "nowhere")
    assert done.returncode == 1
    assert "Traceback" in done.stderr


def test_the_version_is_that_of_the_package() -> None:
    import ringdic

    assert run("pass", "--version").stdout == f"ringdic {ringdic.__version__}\n"
