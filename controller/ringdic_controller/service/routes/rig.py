"""The rig: the present state of its nodes, and the file that describes it."""

from typing import Any

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse

from ringdic_controller.service.refusals import NotFoundError
from ringdic_controller.service.routes.desk import TheDesk

router = APIRouter(prefix="/rig", tags=["rig"])


@router.get("", summary="The nodes in ring order and whether a capture can be taken")
def read_rig_state(desk: TheDesk) -> dict[str, Any]:
    """Present state of the rig's nodes.

    ``nodes`` holds a dictionary for each camera, ``missing`` the ids of cameras whose node is not alive, ``refusal``
    why no capture can be taken, or null.
    """
    return desk.state.rig()


@router.get("/config", response_class=PlainTextResponse, summary="rig.toml as the controller uses it")
def read_rig_file(desk: TheDesk) -> str:
    """The rig's description as TOML text; 404 if the controller runs without a rig."""
    if desk.roster.rig_toml is None:
        raise NotFoundError("The controller runs without a rig.toml.")
    return desk.roster.rig_toml
