"""``import ringdic``: quick, complete, and true to its examples; nothing in the working directory stands in its way."""

import doctest
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import ringdic
import ringdic.api
import ringdic.jobs.run
from matplotlib import pyplot
from ringdic_controller.jobs.children import serving_command
from scipy.ndimage import gaussian_filter, shift

SHIFT = np.array([1.5, -0.6])  # px, to the right and upwards


@pytest.fixture(scope="module")
def speckle() -> np.ndarray:
    return gaussian_filter(np.random.default_rng(0).random((120, 140)), 1.5)


@pytest.fixture(scope="module")
def matches(speckle: np.ndarray) -> ringdic.Correlation:
    return ringdic.correlate(speckle, shift(speckle, SHIFT[::-1]), radius=12, step=8, progress=False)


@pytest.fixture(scope="module")
def run(two_cameras: Path, tmp_path_factory: pytest.TempPathFactory) -> ringdic.Run:
    """A run of two cameras."""
    session = tmp_path_factory.mktemp("door") / "session"
    shutil.copytree(two_cameras, session, ignore=shutil.ignore_patterns("results", "work"))
    return ringdic.process(session, set=["correlation.step_px=12"], progress=False)


@pytest.fixture(autouse=True)
def no_figures_left() -> Iterator[None]:
    yield
    pyplot.close("all")


def test_every_public_name_is_there_and_says_what_it_is() -> None:
    for name in set(ringdic.__all__) - {"__version__"}:
        assert getattr(ringdic, name).__doc__
    assert set(ringdic.__all__) <= set(dir(ringdic))
    with pytest.raises(AttributeError, match="no attribute 'correlation_of'"):
        ringdic.correlation_of  # noqa: B018


def test_without_a_package_the_extra_is_named() -> None:
    for package, use in (("pydantic", "ringdic.Settings"), ("numba", "ringdic.correlate('a', 'b', progress=False)")):
        code = f"import sys, ringdic; sys.modules[{package!r}] = None\ntry: {use}\n"
        done = python(code + "except ringdic.InputError as error: print(error)")
        assert "pip install 'ringdic[processing]'" in done.stdout, done.stderr


def test_examples_are_true(run: ringdic.Run, tmp_path: Path) -> None:
    names = {"ringdic": ringdic, "session": run.session.path, "run": run, "folder": tmp_path}
    for module in (ringdic.api, ringdic.jobs.run):
        for example in doctest.DocTestFinder().find(module, extraglobs=names):
            if example.name != "ringdic.api.process":  # the fixture is that
                assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example).failed == 0, example.name


def test_a_shift_is_measured(matches: ringdic.Correlation) -> None:
    error = matches.displacement[matches.good] - SHIFT
    assert matches.good.mean() > 0.9
    assert abs(error).max() < 0.05
    assert abs(matches.strain(50.0).E[matches.good]).max() < 0.002
    assert matches.status.shape == matches.zncc.shape == (len(matches.xy),)
    assert matches.faces.max() < len(matches.xy)


def test_a_field_of_an_image_pair_is_drawn_over_the_image(matches: ringdic.Correlation) -> None:
    axes = matches.plot("u")
    drawn = axes.collections[0].get_array().compressed()
    assert np.median(drawn) == pytest.approx(SHIFT[0], abs=0.01)
    assert axes.figure.axes[-1].get_ylabel() == "Displacement u, to the right, px"
    assert matches.plot("E1", window=40.0, axes=axes) is axes
    with pytest.raises(ringdic.InputError, match="no field 'w'; there are u, v"):
        matches.plot("w")


def test_saved_points_are_those_of_the_command(matches: ringdic.Correlation, tmp_path: Path) -> None:
    with np.load(matches.save(tmp_path / "points.npz")) as file:
        assert set(file) == {"xy", "uv", "gradient", "zncc", "iterations", "status", "sigma", "faces"}
        np.testing.assert_array_equal(file["uv"], matches.displacement)
    with pytest.raises(ringdic.InputError, match=r"points\.npz"):
        matches.save(tmp_path)


def test_images_that_cannot_be_correlated_are_refused(speckle: np.ndarray) -> None:
    for reference, current, mask, words in (
        (speckle, speckle[:-1], None, "same size"),
        (speckle[None], speckle, None, "height, width"),
        (np.where(speckle > 0.5, np.nan, speckle), speckle, None, "not finite"),
        (speckle, speckle, np.zeros_like(speckle, bool), "region of interest"),
        ("nowhere.png", speckle, None, "nowhere.png"),
    ):
        with pytest.raises(ringdic.InputError, match=words):
            ringdic.correlate(reference, current, mask=mask, progress=False)
    with pytest.raises(ringdic.ComputationError, match="the current image"):
        ringdic.correlate(speckle, np.random.default_rng(5).random(speckle.shape), progress=False)


def test_progress_goes_to_a_function(speckle: np.ndarray) -> None:
    reports: list[ringdic.progress.Progress] = []
    ringdic.correlate(speckle, speckle, progress=reports.append)
    assert reports[-1].stage == "correlate"
    assert reports[-1].done > 0.9


def test_settings_come_from_objects_files_and_single_values(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("[correlation]\nradius_px = 14\n", encoding="utf-8")
    own = ringdic.api._settings(file, {"calibration.distortion": False, "method": "paper"})
    assert (own.correlation.radius_px, own.calibration.distortion, own.method) == (14, False, "paper")
    assert ringdic.api._settings(own, ()) == own
    assert ringdic.api._settings(own, "strain.window_mm=3").strain.window_mm == 3.0
    assert ringdic.api._settings(own, "method=best").calibration.method == "bundle"
    with pytest.raises(ringdic.InputError, match="unknown setting"):
        ringdic.process(tmp_path, set={"correlation.radius": 1}, progress=False)


def test_a_run_has_its_steps_fields_and_summary(run: ringdic.Run) -> None:
    assert run.steps[run._step(-1)] == run.steps[-1]
    assert "displacement" in run.fields
    assert run.summary == json.loads((run.path / "summary.json").read_text(encoding="utf-8"))
    assert len(run.cameras) == 2
    step = run.field("displacement_z", -1, reference="previous")
    whole = run.field("displacement_z", run.steps[-1])
    before = run.field("displacement_z", -2)
    np.testing.assert_allclose(step, whole - before, atol=1e-9)
    assert np.nanmax(run.field("displacement", without_rigid_motion=True)) < np.nanmax(run.field("displacement"))
    assert ringdic.read_run(run.session).path == run.path
    for wrong in (lambda: run.field("nothing"), lambda: run.field("J", 9), lambda: run.mesh("0001-board")):
        with pytest.raises(ringdic.InputError, match="there are"):
            wrong()


def test_a_run_is_drawn_as_it_stood(run: ringdic.Run) -> None:
    axes = run.plot("lambda2", limits=(0.9, 1.1), azimuth=75.0)
    picture = axes.images[0].get_array()
    assert (picture[..., 3] > 0).mean() > 0.2
    left, right, low, high = axes.images[0].get_extent()
    z = run.mesh(-1).vertices[:, 2]
    assert high - low == pytest.approx(np.nanmax(z) - np.nanmin(z), rel=0.3)
    assert left < right
    assert axes.figure.axes[-1].get_ylabel() == "Larger stretch λ2"


def test_the_viewer_says_what_to_install(run: ringdic.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ringdic.InputError, match=r"pip install 'ringdic\[viewer\]'"):
        run.view()


def test_measurements_are_those_of_the_commands(run: ringdic.Run) -> None:
    start, end = run.mesh().centroids[[0, -1]]
    lengths = run.measure_distance(start, end)
    assert lengths["straight"][0] == pytest.approx(np.linalg.norm(end - start))
    assert lengths["along_surface"][0] >= lengths["straight"][0] - 1e-9
    low, high = run.mesh().vertices.min(axis=0), run.mesh().vertices.max(axis=0)
    whole, boxed = run.measure_region(["J"]), run.measure_region(["J"], box=(low - 1, high + 1))
    assert whole["mean"] == boxed["mean"]
    assert len(run.measure_section(["J"], z=float(0.5 * (low + high)[2]))["J"])
    assert set(run.strain([0.0, 5.0])["window"]) == {0.0, 5.0}
    for wrong in (lambda: run.measure_section(), lambda: run.measure_region(box=(low, high), faces=[0])):
        with pytest.raises(ringdic.InputError, match="name one"):
            wrong()


def test_the_form_of_an_export_follows_from_the_name(run: ringdic.Run, tmp_path: Path) -> None:
    assert run.export(tmp_path / "a.VTKHDF", format="vtkhdf") == tmp_path / "a.VTKHDF"
    assert run.export(tmp_path / "points.csv") == tmp_path / "points"
    assert len(list((tmp_path / "points").iterdir())) >= len(run.steps)
    assert run.report(tmp_path / "report.html").stat().st_size > 10_000
    for name, words in (("a.txt", "no export format 'txt'"), ("a", "end the name")):
        with pytest.raises(ringdic.InputError, match=words):
            run.export(tmp_path / name)


def python(code: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A program of its own, with the working directory first on its path as a notebook or a prompt has it."""
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture
def crowded(tmp_path: Path) -> Path:
    """A working directory with packages of names that are none of ours, and that cannot be imported."""
    for name in ("processing", "controller", "node_agent", "ringdic_data"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('the wrong package')\n", encoding="utf-8")
    return tmp_path


def test_folders_of_the_working_directory_are_not_taken_for_ours(crowded: Path) -> None:
    done = python("import ringdic, ringdic.api, ringdic.jobs.pipeline; print(ringdic.__version__)", crowded)
    assert (done.stdout.strip(), done.stderr) == (ringdic.__version__, "")
    command = [sys.executable, "-P", "-m", "ringdic", "process", "ringdic_data", "--set", "strain.window_mm=3"]
    done = subprocess.run(command, cwd=crowded, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2
    assert "ringdic_data: not a session" in done.stderr


def test_the_warm_processing_starts_among_them(crowded: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}
    child = subprocess.Popen(
        serving_command(), cwd=crowded, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert child.stdout is not None
        for line in child.stdout:
            if json.loads(line) == {"worker": "warming"} or "compiling" in line:
                continue
            assert json.loads(line)["worker"] == "ready"
            break
        else:
            pytest.fail("it ended without being ready")
    finally:
        child.communicate(timeout=60)
    assert child.returncode == 0


def test_the_names_of_the_source_folders_are_not_importable() -> None:
    names = ("processing", "controller", "node_agent")
    code = f"from importlib.util import find_spec; print([find_spec(name) for name in {names}])"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[None, None, None]"
    assert find_spec("ringdic_node") is not None
