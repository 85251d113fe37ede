"""Dependency that hands the operator's desk to a route (`TheDesk`)."""

from typing import Annotated

from fastapi import Depends, Request

from ringdic_controller.service.desk import Desk


def _desk(request: Request) -> Desk:
    desk: Desk = request.app.state.desk
    return desk


TheDesk = Annotated[Desk, Depends(_desk)]
