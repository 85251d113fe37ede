"""rig.toml: what is accepted, what is derived, and what the operator reads when something is wrong."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from ringdic.errors import InputError
from ringdic.session.rig import parse_rig, read_rig

RIG = (Path(__file__).parents[2] / "rigs" / "multidic_pair" / "rig.toml").read_text(encoding="utf-8")
Ring = Callable[[int], str]


@pytest.fixture
def ring(rig_toml: Callable[[str, Sequence[str]], str]) -> Ring:
    """Call it with a number of cameras: a rig.toml of a ring of c0, c1, …"""
    return lambda count: rig_toml("ring", [f"c{i}" for i in range(count)])


def test_adjacent_pairs_close_when_the_ring_does(ring: Ring) -> None:
    assert parse_rig(ring(12)).pairs[-1] == ("c11", "c0")
    assert len(parse_rig(ring(12)).pairs) == 12


@pytest.mark.parametrize(("azimuths", "count"), [((0, 30, 60, 90), 3), ((0, 90, 180, 270), 4), ((90, 60, 30), 2)])
def test_an_arc_is_not_closed_however_near_its_ends_are(ring: Ring, azimuths: Sequence[int], count: int) -> None:
    text = ring(len(azimuths))
    for i, azimuth in enumerate(azimuths):
        text = re.sub(rf'(id = "c{i}"\nazimuth_deg = )[\d.]+', rf"\g<1>{azimuth}.0", text)
    assert len(parse_rig(text).pairs) == count


def test_two_cameras_are_one_pair() -> None:
    rig = parse_rig(RIG)
    assert rig.pairs == (("201", "202"),)
    assert rig.board.inner_corners == (14, 19)
    assert rig.target.column_angle == pytest.approx(12.0 / 57.0)


def test_given_pairs_replace_the_adjacent_ones(ring: Ring) -> None:
    assert parse_rig(ring(6) + '[pairs]\npairs = [["c0", "c2"]]\n').pairs == (("c0", "c2"),)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("radius_mm", "radius_inch"), r"\[target\] unknown key 'radius_inch'"),
        (("rows = 20\n", ""), r"\[target\] rows is missing"),
        (("radius_mm = 57.0", 'radius_mm = "57"'), r"\[target\] radius_mm must be a number"),
        (('id = "201"', "id = 201"), r"number 1 id must be text in quotes"),
        (('id = "202"', 'id = "201"'), "'201' occurs more than once"),
        (("columns = 14", "columns = 31"), "do not fit round the radius"),
        (('"dot-cylinder"', '"cube"'), "'cube' is not known"),
        (("[board]", "[bord]"), "unknown key 'bord'"),
        (("[rig]", "[rig"), "line"),
    ],
)
def test_a_fault_is_named(tmp_path: Path, change: tuple[str, str], sentence: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace(*change, 1), encoding="utf-8")
    with pytest.raises(InputError, match=sentence) as raised:
        read_rig(path)
    assert str(path) in str(raised.value)


def test_a_missing_file_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must describe the target"):
        read_rig(tmp_path / "rig.toml")
