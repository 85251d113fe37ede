"""Results in the forms that other programs read.

=======  ===========================================  ==================================================
format   what is written                              for
=======  ===========================================  ==================================================
npz      one file, arrays of all steps                Python
mat      one file, the same arrays, faces from 1      MATLAB, Octave
vtkhdf   one file, all steps and fields               ParaView
vtp      a folder, one file a step and series.pvd     ParaView and other VTK readers
csv      a folder, points and faces of each step      spreadsheets, R
ply      a folder, one surface a step, with fields    MeshLab, CloudCompare
glb      a folder, one coloured surface a step        viewers, Blender (metres, y upwards)
=======  ===========================================  ==================================================

Lengths are mm in the target's frame except in glb, whose standard is metres.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from processing.errors import InputError
from processing.export.arrays import export_mat, export_npz
from processing.export.surfaces import export_glb, export_ply
from processing.export.tables import export_csv
from processing.export.vtk import export_vtkhdf, export_vtp
from processing.session import newest_results

_WRITERS: dict[str, Callable[[Path, Path], None]] = {
    "npz": export_npz,
    "vtkhdf": export_vtkhdf,
    "vtp": export_vtp,
    "mat": export_mat,
    "csv": export_csv,
    "ply": export_ply,
    "glb": export_glb,
}
_FOLDERS = ("vtp", "csv", "ply", "glb")
FORMATS = tuple(_WRITERS)

__all__ = ["FORMATS", "export", "export_npz"]


def export(session_path: Path, format: str, out: Path | None = None) -> Path:
    """Write the newest results of a session in another form; the file or folder written.

    ``out`` : where to; without it, beside the results. Formats of one file a step write a folder.
    Raises InputError : unknown format, no results, or no folder to write into.
    """
    if format not in _WRITERS:
        raise InputError(f"no export format '{format}'; there are {', '.join(FORMATS)}")
    results_path = newest_results(Path(session_path))
    if out is None:
        out = results_path.with_name(format if format in _FOLDERS else f"results.{format}")
    out = Path(out)
    if not out.parent.is_dir():
        raise InputError(f"{out.parent}: no such folder to export into")
    if format in _FOLDERS:
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is a file; format '{format}' writes a folder with one file a step")
        out.mkdir(exist_ok=True)
        _WRITERS[format](results_path, out)
        return out
    if out.is_dir():
        raise InputError(f"{out}: is a folder; format '{format}' writes one file")
    partial = out.with_name(f".{out.name}.partial")  # a reader never sees half a file
    try:
        _WRITERS[format](results_path, partial)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    return out
