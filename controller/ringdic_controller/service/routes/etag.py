"""Answers that never change: their tag, and whether the asker has them already."""

from fastapi import Request


def forever(tag: str, *, revalidate: bool = True) -> dict[str, str]:
    """Headers of an answer with this tag. With ``revalidate`` the browser asks each time, and gets a short 304."""
    cache = "private, no-cache" if revalidate else "private, max-age=31536000, immutable"
    return {"ETag": f'"{tag}"', "Cache-Control": cache}


def unchanged(request: Request, headers: dict[str, str]) -> bool:
    """Whether the request names the tag in these headers."""
    asked = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return headers["ETag"] in asked or "*" in asked
