"""Bodies of the gallery that a search over cylinders lost or measured wrongly, at the defaults, against truth."""

from collections.abc import Callable

import pytest
from ringdic_controller.studies.gallery import rows as gallery_rows
from ringdic_controller.studies.gallery.run import run_gallery

#: Rows of the gallery, and the least share covered of what two cameras see under 60°.
ROWS = {
    "limb-tilted-arc4": 0.97,
    "bean-arc4": 0.97,
    "box-90-arc4": 0.95,
    "plate-tangent-arc4": 0.95,
    "rod-30-arc4": 0.97,
    "limb-blurred-arc4": 0.94,
    "limb-turned-20-arc4": 0.97,
    "limb-ring6": 0.97,
}


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """The figures of the rows by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gallery_rows, "BOARDS", 5)
        totals = run_gallery(tmp_path_factory.mktemp("gallery"), scale=0.3, only=tuple(ROWS))
    return {entry["name"]: entry for entry in totals["entries"]}


@pytest.mark.parametrize("name", ROWS)
def test_a_body_of_any_shape_is_measured(rows: dict[str, dict], figures: Callable, name: str) -> None:
    row = rows[name]
    assert row["refusal"] == ""
    found, turned = row["figures"], "turned" in name
    shape, displacement, stretches = (
        found["spreads"][what]["robust"] for what in ("position", "displacement", "stretch")
    )
    figures(f"{name}: covered of what two cameras see", f"{found['covered']:.1%}", f"≥ {ROWS[name]:.0%}")
    figures("    shape, displacement, stretches over σ", f"{shape:.2f}, {displacement:.2f}, {stretches:.2f}", "")
    assert found["wrong"] == 0
    assert found["covered"] >= ROWS[name]
    # Blurred images leave a bias of some hundredths of a millimetre; a turn bends the displacement's field at the rim.
    assert shape < (2.2 if "blurred" in name else 1.45)
    assert 0.8 < displacement < 1.25
    assert 0.8 < stretches < (1.6 if turned else 1.3)
