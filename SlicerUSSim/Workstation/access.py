"""Access to the workstation: only from pages of this server, and from other computers only with the token."""

from __future__ import annotations

import hmac
from html import escape
from urllib.parse import urlsplit

from aiohttp import web

_LOOPBACK = {"127.0.0.1", "localhost", "::1"}
#: Of every answer. Vue compiles the page's templates in the browser, which needs eval; images are data and blobs
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; media-src 'self' blob:; "
    "connect-src 'self' ws: wss: data: blob:; worker-src 'self' blob:; object-src 'none'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_REFUSED = """<!doctype html><meta charset="utf-8"><title>SlicerUSSim</title>
<body style="font-family: sans-serif; background: #111; color: #ddd; margin: 4em">
<h1>Not allowed</h1><p id="reason">{reason}</p>"""


def is_loopback(host: str) -> bool:
    """Whether a server at this host is reached from this computer only."""
    return host in _LOOPBACK


def guard(app: web.Application, token: str) -> None:
    """Refuse requests from pages of other sites and, if there is a `token`, requests without it.

    The token is first part of the URL and then a cookie, so that requests for the page's files and its web socket carry
    it too, and the address without it is shown. Without a token the server is on loopback; requests by another host
    name are then refused as well, since another site can make a name of its own resolve to this computer (DNS
    rebinding).
    """
    app.middlewares.append(_checker(token))


def _checker(token: str):
    @web.middleware
    async def check(request: web.Request, handler):
        reason = _objection(request, token)
        if reason:
            text = _REFUSED.format(reason=reason)
            return web.Response(status=403, text=text, content_type="text/html", headers=_HEADERS)
        if token and "token" in request.query and request.path in ("/", "/index.html"):
            # Out of the address bar, the history and what is shown of the screen
            plain = request.rel_url.with_query([pair for pair in request.query.items() if pair[0] != "token"])
            answer = web.HTTPSeeOther(str(plain), headers=_HEADERS)
            answer.set_cookie(_cookie(request), token, httponly=True, samesite="Strict")
            return answer
        response = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    return check


def _cookie(request: web.Request) -> str:
    """Name of the cookie, by port: browsers share cookies between ports, but each workstation has its own token."""
    return f"ussim_token_{request.url.port}"


def _objection(request: web.Request, token: str) -> str:
    host = urlsplit(f"//{request.host}")
    origin = request.headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc != host.netloc:
        return "The request came from a page of another site."
    if not token:
        if not is_loopback(host.hostname or ""):
            return f"The host is {escape(request.host[:80])}, expected 127.0.0.1."
        return ""
    given = request.query.get("token", request.cookies.get(_cookie(request), ""))
    if not hmac.compare_digest(given.encode(), token.encode()):
        return "The token is missing or wrong. Use the URL that <code>ussim serve</code> printed."
    return ""
