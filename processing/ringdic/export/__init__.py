"""Export of results to the file formats of other programs.

=======  ===========================================  ==================================================
format   what is written                              for
=======  ===========================================  ==================================================
npz      one file, arrays of all steps                Python
mat      one file: DIC3DPPresults as MultiDIC makes   MATLAB, Octave
         it, and the arrays of the npz, from 1
vtkhdf   one file, all steps and fields               ParaView
vtp      a folder, one file a step and series.pvd     ParaView and other VTK readers
csv      a folder, points and faces of each step,     spreadsheets, R
         and load.csv where a load was archived
ply      a folder, one surface a step, with fields    MeshLab, CloudCompare
         and colours
glb      a folder, one coloured surface a step        viewers, Blender (metres, y upwards)
=======  ===========================================  ==================================================

Lengths are mm in the world frame of the target, except in glb, whose standard is metres. Every format is evaluated
from the stored positions, so that a step can be compared with the one before it, freed of its rigid motion, or given
strains over another window than that of the run.

A standard deviation whose name does not say its cause, such as ``sigma_xyz``, ``sigma_displacement`` and
``sigma_lambda``, is in every format that by image noise and calibration together, or by the noise alone where the part
of the calibration is unknown. Endings ``_noise`` and ``_calibration`` name the parts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from ringdic.errors import InputError
from ringdic.export.arrays import export_npz
from ringdic.export.matlab import export_mat
from ringdic.export.surfaces import DEFAULT_COLOUR, export_glb, export_ply
from ringdic.export.tables import export_csv
from ringdic.export.vtk import export_vtkhdf, export_vtp
from ringdic.results.evaluation import EvaluatedResults, Evaluation, evaluate_results
from ringdic.session.folder import newest_results
from ringdic.session.load import LoadSeries, load_series

_WRITERS: dict[str, Callable[[EvaluatedResults, Path], None]] = {
    "npz": export_npz,
    "vtkhdf": export_vtkhdf,
    "vtp": export_vtp,
    "mat": export_mat,
    "csv": export_csv,
    "ply": export_ply,
    "glb": export_glb,
}
#: Formats that carry the load at the steps.
_WITH_LOAD: dict[str, Callable[[EvaluatedResults, Path, Sequence[LoadSeries]], None]] = {
    "npz": export_npz,
    "mat": export_mat,
    "csv": export_csv,
}
FOLDERS = ("vtp", "csv", "ply", "glb")
_COLOURED: dict[str, Callable[[EvaluatedResults, Path, str], None]] = {"ply": export_ply, "glb": export_glb}
FORMATS = tuple(_WRITERS)

__all__ = ["FOLDERS", "FORMATS", "Evaluation", "export"]


def export(
    session_path: Path,
    format: str,
    out: Path | None = None,
    evaluation: Evaluation = Evaluation(),  # noqa: B008 - frozen
    colour: str | None = None,
    run: int | None = None,
) -> Path:
    """Write the results of a session in the format of another program.

    Parameters
    ----------
    session_path : Path
        The session's folder.
    format : str
        One of `FORMATS`.
    out : Path, optional
        File to write, or folder for formats with one file per step; in the run's folder unless given.
    evaluation : Evaluation
        How fields are computed from positions: reference, rigid motion, strain window, strain family.
    colour : str, optional
        Name of the field that colours ply and glb; displacement unless given.
    run : int, optional
        Number of the processing run; the newest unless given.

    Returns the file or folder written. Raises InputError for an unknown format or field, for a session without results,
    and where there is no folder to write into.
    """
    if format not in _WRITERS:
        raise InputError(f"no export format '{format}'; there are {', '.join(FORMATS)}")
    if colour is not None and format not in _COLOURED:
        raise InputError(f"format '{format}' has no colours; {' and '.join(_COLOURED)} have")
    results_path = newest_results(Path(session_path), run)
    if out is None:
        out = results_path.with_name(format if format in FOLDERS else f"results.{format}")
    out = Path(out)
    _check_place(out, format)
    results = evaluate_results(results_path, evaluation)
    load = load_series([Path(session_path) / "captures" / step for step in results.steps])
    if format in _COLOURED:
        results.field(colour or DEFAULT_COLOUR)
    if format in FOLDERS:
        out.mkdir(exist_ok=True)
        if format in _COLOURED:
            _COLOURED[format](results, out, colour or DEFAULT_COLOUR)
        else:
            _write(results, out, format, load)
        return out
    partial = out.with_name(f".{out.name}.partial")  # a reader never sees half a file
    try:
        _write(results, partial, format, load)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return out


def _write(results: EvaluatedResults, out: Path, format: str, load: Sequence[LoadSeries]) -> None:
    if format in _WITH_LOAD:
        _WITH_LOAD[format](results, out, load)
    else:
        _WRITERS[format](results, out)


def _check_place(out: Path, format: str) -> None:
    if not out.parent.is_dir():
        raise InputError(f"{out.parent}: no such folder to export into")
    if format in FOLDERS:
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is a file; format '{format}' writes a folder with one file a step")
    elif out.is_dir():
        raise InputError(f"{out}: is a folder; format '{format}' writes one file")
