"""Tables of stated standard deviations: the figures are those of planted errors, and what misses an aim is named."""

import csv
from pathlib import Path

import numpy as np
import pytest
from ringdic_controller.studies.sigma_tables import SigmaRow, write_sigma_tables
from ringdic_controller.studies.solid_errors import Spread, StatedSpreads

NORMAL = np.random.default_rng(3).normal(size=(20_000, 2))


def spreads(factor: float = 1.0, far: int = 0) -> StatedSpreads:
    """Displacements ``factor`` times as far off as stated, and some stretches 50 σ off."""
    sigma, off = np.full(NORMAL.shape, 0.01), 0.01 * NORMAL
    stretch = off.copy()
    stretch[:far] = 0.5
    return StatedSpreads(Spread.of(off, sigma), Spread.of(factor * off, sigma), Spread.of(stretch, sigma))


def test_the_spread_of_errors_is_robust_and_plain_and_counts_what_lies_far_off() -> None:
    found = spreads(2.0, far=100)
    assert found.displacement.robust == pytest.approx(2.0, rel=0.02)
    assert found.displacement.plain == pytest.approx(2.0, rel=0.02)
    assert found.stretch.robust == pytest.approx(1.0, rel=0.03)  # outliers hardly move it
    assert found.stretch.plain > 3.0
    assert found.stretch.beyond == pytest.approx(100 / 20_000, abs=1e-6)
    nothing = Spread.of(np.full((4, 2), np.nan), np.ones((4, 2)))
    assert nothing.count == 0
    assert np.isnan(nothing.robust)


def test_aims_are_strict_where_nothing_disturbs_and_none_where_results_are_not_to_be_used() -> None:
    assert SigmaRow("calm", spreads()).missed == []
    assert SigmaRow("calm", spreads(1.4)).missed == ["displacement"]
    assert SigmaRow("calm", spreads(0.7)).missed == ["displacement"]
    assert SigmaRow("noise", spreads(1.4), calm=False).missed == []
    assert SigmaRow("noise", spreads(0.7), calm=False).missed == []
    assert SigmaRow("bump", spreads(1.6, far=100), calm=False).missed == ["displacement", "stretch"]
    assert SigmaRow("bump", spreads(9.0, far=100), calm=False, usable=False).missed == []


def test_both_files_hold_every_row(tmp_path: Path) -> None:
    rows = [SigmaRow("calm", spreads()), SigmaRow("bump", spreads(9.0), calm=False, usable=False)]
    assert write_sigma_tables(tmp_path, [*rows, SigmaRow("noise", spreads(3.0), calm=False)], "Mishaps") == 2
    page = (tmp_path / "sigma.md").read_text(encoding="utf-8")
    assert "2 of 3 rows reach all aims" in page
    assert "| bump |" in page
    with (tmp_path / "sigma.csv").open(encoding="utf-8", newline="") as file:
        stored = {row["row"]: row for row in csv.DictReader(file)}
    assert float(stored["noise"]["displacement: robust"]) == pytest.approx(3.0, rel=0.02)
    assert stored["noise"]["missed"] == "displacement"
    assert stored["bump"]["missed"] == "not to be used"
    write_sigma_tables(tmp_path, [], "Nothing")
