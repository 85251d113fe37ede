"""The rig: its nodes as they are now, and the file that describes it."""

from typing import Any

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse

from ringdic_controller.service.desk import NotFoundError
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/rig", tags=["rig"])


@router.get("", summary="The nodes in ring order and whether a capture can be taken")
def rig(desk: TheDesk) -> dict[str, Any]:
    """``nodes``: a dictionary a camera; ``missing``: ids of cameras that are not there; ``refusal``: why no capture."""
    return desk.rig_state()


@router.get("/config", response_class=PlainTextResponse, summary="rig.toml as the controller uses it")
def config(desk: TheDesk) -> str:
    """TOML text; 404 if the controller runs without a rig."""
    if desk.rig_toml is None:
        raise NotFoundError("The controller runs without a rig.toml.")
    return desk.rig_toml
