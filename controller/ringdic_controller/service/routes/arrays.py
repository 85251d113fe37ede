"""Routes to the arrays of a results file, sent as little-endian numbers: triangles, positions, fields."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response
from numpy.typing import NDArray
from ringdic.results.reader import read_field, read_mesh, read_positions

from ringdic_controller.service.routes.etag import cache_headers, client_has

_BINARY: dict[int | str, dict[str, Any]] = {200: {"content": {"application/octet-stream": {}}}}
Version = Annotated[
    str | None, Query(description="The header's version; with it the client may keep the answer for ever")
]
Removed = Annotated[bool, Query(description="With the rigid motion of the whole surface removed")]


def add_arrays(router: APIRouter, prefix: str, locate: Callable[..., Path]) -> None:
    """Add to a router the routes to faces, positions and fields of a results file.

    Parameters
    ----------
    prefix
        Beginning of their paths.
    locate
        Dependency that gives the results file from the parameters in the path.
    """

    def faces(path: Annotated[Path, Depends(locate)], request: Request, v: Version = None) -> Response:
        """Vertex indices of the triangles, whose normals point outwards."""
        headers = _tagged(path, "faces", v)
        if client_has(request, headers):
            return Response(status_code=304, headers=headers)
        return _binary(read_mesh(path).faces.astype("<u4"), headers)

    def positions(
        path: Annotated[Path, Depends(locate)],
        step: int,
        request: Request,
        rigid_motion_removed: Removed = False,
        v: Version = None,
    ) -> Response:
        """Vertex positions in the target's world frame; NaN where not measured. Step 0 is the reference."""
        headers = _tagged(path, f"positions-{step}-{rigid_motion_removed:d}", v)
        if client_has(request, headers):
            return Response(status_code=304, headers=headers)
        return _binary(read_positions(path, step, rigid_motion_removed).astype("<f4"), headers)

    def field(
        path: Annotated[Path, Depends(locate)],
        name: str,
        step: int,
        request: Request,
        rigid_motion_removed: Removed = False,
        v: Version = None,
    ) -> Response:
        """Values of a field, NaN where not measured; the header's table of fields gives unit and location."""
        values, location = read_field(path, name, step, rigid_motion_removed)
        headers = _tagged(path, f"{name}-{step}-{rigid_motion_removed:d}", v) | {"X-Location": location}
        if client_has(request, headers):
            return Response(status_code=304, headers=headers)
        return _binary(values.astype("<f4"), headers)

    for part, endpoint, summary in (
        ("faces", faces, "Triangles: uint32 (faces, 3)"),
        ("positions/{step}", positions, "Vertices at one step: float32 (points, 3) mm"),
        ("fields/{name}/{step}", field, "One field at one step: float32 (points,) or (faces,)"),
    ):
        router.get(f"{prefix}/{part}", response_class=Response, responses=_BINARY, summary=summary)(endpoint)


def version_of(path: Path) -> str:
    """Version of a results file: a text that changes only when the file is replaced."""
    status = path.stat()
    return f"{status.st_mtime_ns:x}-{status.st_size:x}"


def _tagged(path: Path, name: str, requested: str | None) -> dict[str, str]:
    """Headers of an array; the client may keep it for ever if it asked for the version that it gets."""
    version = version_of(path)
    return cache_headers(f"{version}-{name}", revalidate=requested != version)


def _binary(array: NDArray[Any], headers: dict[str, str]) -> Response:
    shape = ",".join(str(n) for n in array.shape)
    content = np.ascontiguousarray(array).tobytes()
    return Response(
        content, media_type="application/octet-stream", headers=headers | {"X-Type": array.dtype.name, "X-Shape": shape}
    )
