"""File numbers tell whether frames of several cameras belong together; records, whether they were taken at once."""

import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ringdic.errors import InputError
from ringdic.findings import Verdict
from ringdic.session.folder import Capture
from ringdic.session.importing import import_images
from ringdic.session.moments import moment_findings
from ringdic.session.numbering import frame_numbers, number_conflict
from ringdic.session.records import CameraRecord, CaptureRecord

BASE = 1_700_000_000_000_000_000  # ns


def files(numbers: list[int], text: str = "frame_{:03d}.png") -> list[str]:
    return [text.format(number) for number in numbers]


def capture(
    number: int, times_ms: dict[str, float | None], tolerance_ms: float | None = 1.0, **original: str
) -> Capture:
    record = CaptureRecord(
        f"{number:04d}-specimen", number, "specimen", "s", "closed",
        tolerance_ns=None if tolerance_ms is None else round(1e6 * tolerance_ms),
        cameras={
            id_: CameraRecord("ok", time_ns=None if ms is None else BASE + round(1e6 * ms), original=original.get(id_))
            for id_, ms in times_ms.items()
        },
    )  # fmt: skip
    return Capture(record.capture_id, number, "specimen", Path(), {}, record)


def test_the_number_that_varies_counts_the_frames() -> None:
    assert frame_numbers(["cam2_take7_003.png", "cam2_take7_011.png"]) == [3, 11]
    assert frame_numbers(["1.jpg", "2.tif"]) == [1, 2]


@pytest.mark.parametrize(
    "names",
    [
        ["a.png", "b.png"], ["7.png"], ["rest.png", "step_1.png"],
        ["IMG_20261130_114502.jpg", "IMG_20261130_114507.jpg"], ["t_12.900.png", "t_13.100.png"],
    ],
)  # fmt: skip
def test_names_without_a_count_tell_nothing(names: list[str]) -> None:
    assert frame_numbers(names) is None
    assert number_conflict({"1": names, "2": files(list(range(len(names))))}) is None


@given(st.lists(st.integers(0, 500), min_size=3, max_size=9, unique=True).map(sorted), st.integers(0, 4000), st.data())
def test_equal_counts_agree_wherever_they_begin_and_a_lost_frame_each_never_passes(numbers, start, data) -> None:
    """Each of two cameras has lost another one of the frames."""
    elsewhere = [number + 1000 + start for number in numbers]
    assert number_conflict({"1": files(numbers), "2": files(numbers), "3": files(elsewhere)}) is None
    one, other = data.draw(st.permutations(numbers))[:2]
    left = [[number for number in numbers if number != lost] for lost in (one, other)]
    conflict = number_conflict({"1": files(left[0]), "2": files(left[1])})
    assert conflict is not None
    assert conflict.shift or conflict.only == ((other,), (one,))


def test_the_number_of_lost_frames_is_told_where_the_counters_began_elsewhere() -> None:
    conflict = number_conflict({"a": files([1, 2, 3, 5]), "b": files([101, 102, 104, 105])})
    assert conflict is not None
    assert conflict.only == ((3,), (104,))


def test_a_camera_that_is_one_frame_behind_is_told_of() -> None:
    conflict = number_conflict({"a": files([0, 1, 2, 3]), "b": files([1, 2, 3, 4])})
    assert conflict is not None
    assert conflict.shift == 1
    shifted = [capture(k + 1, {"a": None, "b": None}, a=f"x/{k}.png", b=f"x/{k + 1}.png") for k in range(4)]
    (finding,) = moment_findings(shifted)
    assert (finding.code, finding.cameras, finding.value) == ("file-numbers-shifted", ("a", "b"), 1)
    assert finding.verdict is Verdict.LOOK
    assert not moment_findings([capture(k + 1, {"a": None, "b": None}, a=f"{k}.png", b=f"{k}.png") for k in range(4)])


def test_cameras_that_lack_different_frames_are_refused_with_the_numbers(shared_cases: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(shared_cases / "gap_mispaired/in_horizontal", source)
    (source / "specimen/cam_02/001.png").rename(source / "specimen/cam_02/002.png")
    with pytest.raises(InputError, match=r"'cam_01' has 1, which 'cam_02' lacks, and 'cam_02' has 2"):
        import_images(source, tmp_path / "made")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_times_beyond_the_tolerance_name_the_camera_that_is_off() -> None:
    calm = {"1": 0.0, "2": 0.09, "3": -0.2, "4": None}
    late = {"1": 0.0, "2": 0.09, "3": 30.0, "4": 0.05}
    (finding,) = moment_findings([capture(1, calm), capture(2, late)])
    assert (finding.code, finding.cameras, finding.step) == ("skew-exceeded", ("3",), "0002-specimen")
    assert finding.value == pytest.approx(30.0, abs=0.01)
    assert finding.limit == 1.0
    assert not moment_findings([capture(2, late, tolerance_ms=31.0)])
    assert moment_findings([capture(2, late, tolerance_ms=None)])


def test_of_two_cameras_both_are_named() -> None:
    (finding,) = moment_findings([capture(1, {"1": 0.0, "2": 5.0})])
    assert finding.cameras == ("1", "2")
