"""HTTP caching of answers that never change: their entity tag, and whether the client has them already."""

from fastapi import Request


def cache_headers(tag: str, *, revalidate: bool = True) -> dict[str, str]:
    """Headers of an answer with this entity tag, which the client may keep.

    With ``revalidate`` it has to ask before every use, and gets a short 304 if nothing has changed; without, it need
    not ask again.
    """
    cache = "private, no-cache" if revalidate else "private, max-age=31536000, immutable"
    return {"ETag": f'"{tag}"', "Cache-Control": cache}


def client_has(request: Request, headers: dict[str, str]) -> bool:
    """Whether the request names the entity tag in these headers: the answer is then a 304 without content."""
    tags = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return headers["ETag"] in tags or "*" in tags
