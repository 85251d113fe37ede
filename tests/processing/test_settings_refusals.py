"""Settings: defaults, files, overrides, and a clear refusal of everything else."""

from dataclasses import fields
from pathlib import Path

import pytest
from ringdic.correlation.settings import CorrelationSettings
from ringdic.errors import InputError
from ringdic.settings import CorrelationGroup, Settings, load_settings, settings_of_run


def test_the_defaults_are_the_best_method() -> None:
    settings = load_settings()
    assert (settings.method, settings.calibration.method) == ("best", "bundle")
    assert (settings.correlation.radius_px, settings.correlation.step_px) == (20, 10)
    assert (settings.correlation.order, settings.correlation.subset) == (1, "circle")
    assert (settings.calibration.distortion, settings.strain.window_mm) == (True, 0.0)


@pytest.mark.parametrize(
    ("overrides", "calibration"),
    [
        (["method=paper"], "dlt"),
        (["method=paper", "calibration.distortion=false"], "dlt"),
        (["calibration.method=bundle", "method=paper"], "bundle"),
        (["calibration.method=dlt"], "dlt"),
        (["method=best"], "bundle"),
    ],
)
def test_the_method_decides_how_cameras_are_calibrated_unless_that_is_said(
    overrides: list[str], calibration: str
) -> None:
    settings = load_settings(None, overrides)
    assert settings.calibration.method == calibration
    assert settings_of_run(settings.to_toml()) == settings


def test_a_file_states_the_method_above_its_groups(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text('method = "paper"\n[calibration]\nskew = false\n')
    settings = load_settings(path)
    assert (settings.method, settings.calibration.method, settings.calibration.skew) == ("paper", "dlt", False)
    assert load_settings(path, ["method=best"]).calibration.method == "bundle"


def test_a_file_is_read_and_an_override_wins_over_it(tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text('[correlation]\nradius_px = 12\nstep_px = 6\nsubset = "square"\n')
    settings = load_settings(path, ["correlation.radius_px=14", "calibration.distortion=false"])
    assert settings.correlation.radius_px == 14
    assert settings.correlation.step_px == 6
    assert settings.correlation.subset == "square"
    assert settings.calibration.distortion is False


def test_what_is_written_reads_back_the_same(tmp_path: Path) -> None:
    settings = load_settings(
        None, ["correlation.tolerance=1e-7", "correlation.radius_px=33", "surface.incidence_deg=50.5"]
    )
    path = tmp_path / "settings.toml"
    path.write_text(settings.to_toml())
    assert load_settings(path) == settings
    assert load_settings(path) != Settings()


def test_the_correlation_has_the_names_and_defaults_of_its_group() -> None:
    own = {field.name: field.default for field in fields(CorrelationSettings)}
    assert {name: own[name] for name in CorrelationGroup().keywords} == CorrelationGroup().keywords
    assert set(own) - set(CorrelationGroup().keywords) == {"texture_min", "noise"}


def test_the_command_has_the_bounds_of_the_group() -> None:
    assert CorrelationGroup.limits("radius_px") == {"min": 2, "max": 500}
    assert CorrelationGroup.limits("step_px") == {"min": 1}
    assert CorrelationGroup.limits("order") == {"min": 1, "max": 2}


def test_the_correlation_understands_its_group() -> None:
    engine = CorrelationSettings(**load_settings(None, ["correlation.radius_px=12"]).correlation.keywords)
    assert engine == CorrelationSettings(radius=12)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("correlation.radius=20", ["correlation.radius", "radius_px"]),
        ("correlaton.radius_px=20", ["correlaton", "correlation"]),
        ("radius_px=20", ["group.name=value"]),
        ("correlation.radius_px", ["group.name=value"]),
        ("correlation.radius_px=many", ["correlation.radius_px", "many"]),
        ("correlation.radius_px=0", ["correlation.radius_px", "0"]),
        ("correlation.tolerance=nan", ["correlation.tolerance"]),
        ("correlation.order=3", ["correlation.order", "1 or 2"]),
        ("correlation.subset=hexagon", ["correlation.subset", "'circle' or 'square'", "hexagon"]),
        ("calibration.method=guess", ["calibration.method", "'dlt' or 'bundle'", "guess"]),
        ("calibration.radial_terms=4", ["calibration.radial_terms", "2 or 3"]),
        ("calibration.terms=best", ["calibration.terms", "'largest' or 'criterion'", "best"]),
        ("calibration.skew=perhaps", ["calibration.skew", "true or false"]),
        ("calibration.print_error_mm=-0.1", ["calibration.print_error_mm", "-0.1"]),
        ("method=magic", ["method", "'best' or 'paper'", "magic"]),
        ("surface.method=global", ["surface.method is no longer a setting", "method=best", "method=paper"]),
        ("surface.curvature=none", ["surface.curvature is no longer a setting", "method=best"]),
        ("tracking.two_pass=false", ["tracking is no longer a setting", "method=best"]),
        ("surface.merge=guess", ["surface.merge", "'combined'", "guess"]),
        ("strain.window_mm=-1", ["strain.window_mm", "greater than or equal to 0", "-1"]),
        ("strain=5", ["group.name=value"]),
    ],
)
def test_what_cannot_be_done_is_refused_with_its_name(override: str, words: list[str]) -> None:
    with pytest.raises(InputError) as refusal:
        load_settings(None, [override])
    for word in words:
        assert word in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_bad_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: no such"):
        load_settings(tmp_path / "none.toml")
    path = tmp_path / "bad.toml"
    path.write_text("[correlation\n")
    with pytest.raises(InputError, match=r"bad\.toml: not readable as TOML"):
        load_settings(path)
    path.write_text("[correlation]\nradius = 3\n")
    with pytest.raises(InputError, match=r"bad\.toml: unknown setting 'correlation\.radius'"):
        load_settings(path)
    path.write_text("strain = 3\n")
    with pytest.raises(InputError, match="strain"):
        load_settings(path)


def test_the_settings_of_a_run_of_another_version_can_be_read() -> None:
    settings = settings_of_run("[correlation]\nradius_px = 17\nmesh_px = 3\n[clouds]\nheight = 2\n")
    assert settings.correlation.radius_px == 17
    assert settings.surface == Settings().surface
    assert settings_of_run(settings.to_toml()) == settings
    with pytest.raises(InputError, match="the run's settings"):
        settings_of_run("[correlation\n")


def test_the_nearest_name_is_offered() -> None:
    with pytest.raises(InputError, match=r"did you mean 'correlation\.radius_px'"):
        load_settings(None, ["correlation.radius=20"])
