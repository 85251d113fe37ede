"""``ringdic measure``, ``ringdic strain`` and the options of ``ringdic export`` on results whose truth is known."""

import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from ringdic.cli.app import application
from ringdic.errors import InputError, RingdicError
from ringdic.results.results import Results
from ringdic.results.writer import write_results
from typer.testing import CliRunner, Result

STRETCH = 1.2


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plate of 20 × 20 mm in the plane x = 57, drawn along z; two runs, the first of them shorter."""
    y, z = np.meshgrid(np.arange(-10.0, 11.0), np.arange(90.0, 111.0), indexing="ij")
    reference = np.column_stack([np.full(y.size, 57.0), y.ravel(), z.ravel()])
    i = np.arange(441).reshape(21, 21)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    path = tmp_path_factory.mktemp("measuring") / "session"
    for run, steps in (("0001", 1), ("0002", 3)):
        vertices = np.stack([reference * [1.0, 1.0, STRETCH**k] for k in range(steps)])
        (path / "results" / run).mkdir(parents=True)
        results = Results(
            rig="plate", steps=tuple("abc"[:steps]), cameras=(), pairs=(("1", "2"),), vertices_ref=reference,
            vertices=vertices, faces=faces, pair=np.zeros(len(faces), dtype=np.int64),
            vertex_pair=np.zeros(441, dtype=np.int64), correlation=np.zeros((steps, 441)),
            sigma_xyz=np.zeros((steps, 441, 3)), status=np.zeros((steps, 441), dtype=np.int8),
        )  # fmt: skip
        write_results(path / "results" / run / "results.h5", results)
    (path / "session.json").write_text("{}", encoding="utf-8")
    return path


def ringdic(*words: object) -> Result:
    return CliRunner().invoke(application(), [str(word) for word in words])


def table(*words: object) -> list[dict[str, str]]:
    result = ringdic(*words)
    assert result.exit_code == 0, result.output
    return list(csv.DictReader(io.StringIO(result.stdout)))


def test_a_place_through_time(session: Path) -> None:
    rows = table("measure", "point", session, "--at", "57,-3.2,101", "--field", "displacement_z", "--field", "lambda2")
    assert [row["capture"] for row in rows] == ["a", "b", "c"]
    for k, row in enumerate(rows):
        assert float(row["displacement_z [mm]"]) == pytest.approx((STRETCH**k - 1) * 101)
        assert float(row["lambda2"]) == pytest.approx(STRETCH**k)
    steps = table(
        "measure", "point", session, "--vertex", 7, "--face", 3, "--reference", "previous", "--seth-hill", 0.25,
        "--field", "seth_hill2:0.25",
    )  # fmt: skip
    assert [float(row["seth_hill2:0.25"]) for row in steps] == pytest.approx(
        [0.0, (STRETCH**0.5 - 1) * 2, (STRETCH**0.5 - 1) * 2] * 2
    )


def test_an_extensometer_and_its_json(session: Path, tmp_path: Path) -> None:
    words = ("measure", "extensometer", session, "--from", "57,-5,95", "--to", "57,7,100")
    result = ringdic(*words, "--json", "--out", tmp_path / "length.csv")
    found = json.loads(result.stdout)
    lengths = [np.hypot(12.0, 5.0 * STRETCH**k) for k in range(3)]
    assert [row["along_surface"] for row in found["rows"]] == pytest.approx(lengths)
    assert found["units"] == {"along_surface": "mm", "straight": "mm"}
    with (tmp_path / "length.csv").open(encoding="utf-8") as file:
        assert [float(row["straight [mm]"]) for row in csv.DictReader(file)] == pytest.approx(lengths)


def test_a_section_and_a_region(session: Path) -> None:
    for cut, length in ((("--z", 100.3), 20.0), (("--theta", 4.0), 20.0), (("--plane", "57,0,100,0,1,1"), 20 * 2**0.5)):
        rows = table("measure", "section", session, *cut, "--field", "E2")
        s = sorted(float(row["s [mm]"]) for row in rows if row["step"] == "2")
        assert s[-1] + s[0] == pytest.approx(length, abs=0.8)  # from middle to middle of the outer crossings
    for region in (
        ("--sphere", "57,0,100,6"),
        ("--box", "50,-5,95,60,5,105"),
        ("--patch", "-5,5,92,108"),
        ("--faces", "1,2"),
    ):
        (row,) = (r for r in table("measure", "region", session, *region, "--field", "J") if r["step"] == "1")
        assert float(row["mean"]) == pytest.approx(STRETCH)
        assert row["lost"] == "0"
    everywhere = ringdic("measure", "region", session, "--run", 1, "--field", "J", "--json")
    assert json.loads(everywhere.stdout)["rows"][0]["measured"] == 800


def test_a_study_of_windows(session: Path) -> None:
    rows = table("strain", session, "--window", 0, "--window", 5)
    assert [(row["window [mm]"], row["step"]) for row in rows] == [(w, k) for w in "05" for k in "012"]
    assert float(rows[5]["lambda2_median"]) == pytest.approx(STRETCH**2)


def test_export_takes_the_same_options(session: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.npz"
    done = ringdic(
        "export", session, "--out", out, "--reference", "previous", "--window", 5, "--without-rigid-motion", "--json"
    )
    assert json.loads(done.stdout) == {"written": str(out)}
    with np.load(out) as arrays:
        np.testing.assert_allclose(arrays["lambda2"][2], STRETCH, atol=1e-12)
        np.testing.assert_allclose(arrays["window_lambda2"][2], STRETCH, atol=1e-10)
    done = ringdic("export", session, "--format", "glb", "--colour", "E2", "--out", tmp_path / "glb", "--run", 1)
    assert [path.name for path in (tmp_path / "glb").iterdir()] == ["a.glb"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("measure", "point"), "name a place: --at"),
        (("measure", "point", "--at", "57,0"), "--at 57,0: wanted 3 numbers"),
        (("measure", "point", "--at", "57,0,nan"), "wanted 3 numbers"),
        (("measure", "point", "--at", "90,0,100"), "33.0 mm away from the surface"),
        (("measure", "point", "--vertex", "441"), "no point 441; there are 441, from 0"),
        (("measure", "point", "--vertex", "1", "--field", "stress"), "no field 'stress'"),
        (("measure", "point", "--vertex", "1", "--reference", "next"), "'first' or the 'previous'"),
        (("measure", "point", "--vertex", "1", "--window", "-2"), "0 (none) to 1000 mm wide, not -2"),
        (("measure", "extensometer", "--from", "1;2;3", "--to", "57,0,100"), "--from 1;2;3: wanted 3 numbers"),
        (("measure", "section"), "name one section"),
        (("measure", "section", "--z", "1", "--theta", "2"), "name one section"),
        (("measure", "section", "--theta", "180"), "misses the surface"),
        (("measure", "region", "--box", "1,2,3,4,5"), "--box 1,2,3,4,5: wanted 6 numbers"),
        (("measure", "region", "--faces", "a"), "--faces a: wanted indices"),
        (("measure", "region", "--box", "0,0,0,1,1,1", "--faces", "1"), "name one region"),
        (("measure", "region", "--out", "/nowhere/at/all.csv"), "no such folder"),
        (("strain", "--window", "-1"), "0 or more"),
        (("strain", "--run", "3"), "no run 3; there are 0001, 0002"),
        (("export", "--colour", "E2"), "'npz' has no colours"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_a_sentence(session: Path, words: tuple[str, ...], said: str) -> None:
    place = 2 if words[0] == "measure" else 1
    result = ringdic(*words[:place], session, *words[place:])
    assert isinstance(result.exception, RingdicError)
    assert result.exception.exit_code == InputError.exit_code
    assert said in str(result.exception)
    assert result.stdout == ""


def test_each_load_channel_is_a_column_of_the_tables(session: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(session, tmp_path / "session"))
    for name, force in (("a", 0.0), ("c", 30.5)):
        (copy / "captures" / name).mkdir(parents=True)
        channel = {"name": "force", "unit": "N", "values": force}
        (copy / "captures" / name / "load.json").write_text(json.dumps({"schema": 1, "channels": [channel]}))
    words = ("measure", "point", copy, "--vertex", 7, "--vertex", 9, "--field", "lambda2")
    assert [row["load_force [N]"] for row in table(*words)] == ["0", "", "30.5"] * 2
    assert "load channel 'force' is not known at b" in ringdic(*words).stderr
    length = table("measure", "extensometer", copy, "--from", "57,-5,95", "--to", "57,7,100")
    assert [row["load_force [N]"] for row in length] == ["0", "", "30.5"]
