"""HTTP caching by entity tags (ETag), for answers that never change."""

from fastapi import Request


def cache_headers(tag: str, *, revalidate: bool = True) -> dict[str, str]:
    """Headers of an answer that has this entity tag and that the client may keep.

    With ``revalidate`` the client asks before every use, and gets a short 304 if nothing has changed; without, it need
    not ask again.
    """
    cache = "private, no-cache" if revalidate else "private, max-age=31536000, immutable"
    return {"ETag": f'"{tag}"', "Cache-Control": cache}


def client_has(request: Request, headers: dict[str, str]) -> bool:
    """Whether the client already has the answer with the entity tag in these headers; a 304 is then sent."""
    tags = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return headers["ETag"] in tags or "*" in tags
