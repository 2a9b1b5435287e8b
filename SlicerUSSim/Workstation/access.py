"""Access to the workstation: only from pages of this server, and only with the token; see docs/security.md."""

from __future__ import annotations

import hmac
import logging
import ssl
from html import escape
from pathlib import Path
from urllib.parse import urlsplit

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from SlicerUSSim.Logic.base.errors import SimulationError, require

_log = logging.getLogger(__name__)

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


def tls_context(certificate: str, key: str) -> ssl.SSLContext:
    """The TLS of a server. Raises SimulationError for files other than a certificate and its key (both PEM)."""
    for path in (certificate, key):
        require(Path(path).is_file(), f"{path}: no such file")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key, password="")  # rather an error than a question in the terminal
    except (OSError, ValueError) as error:  # of which SSLError is one
        raise SimulationError(
            f"{certificate}, {key}: expected a certificate and its key without a password, both PEM ({error})"
        ) from None
    return context


def guard(app: web.Application, token: str, host: str) -> None:
    """Refuse requests from pages of other sites, and those without the token.

    The token is first part of the URL and then a cookie, so that requests for the page's files and its web socket carry
    it too, and the address without it is shown. It is asked on loopback, too, where other users of the computer can
    connect. There, requests by another host name are refused as well, since another site can make its own name
    resolve to this computer (DNS rebinding).

    Parameters
    ----------
    host : at which the server listens.
    """
    app.middlewares.append(_checker(token, is_loopback(host)))
    logging.getLogger("aiohttp.server").addFilter(_in_one_line)


def _in_one_line(record: logging.LogRecord) -> bool:
    """Let a request that HTTP does not allow, as one with a long line, leave one line and no traceback in the log."""
    error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
    if isinstance(error, HttpProcessingError):
        record.msg, record.args = "a request was refused: %.100s", (" ".join(str(error.message).split()),)
        record.levelno, record.levelname = logging.WARNING, "WARNING"
        record.exc_info = record.exc_text = None
    return True


def _checker(token: str, is_local: bool):
    @web.middleware
    async def check(request: web.Request, handler):
        reason = _objection(request, token, is_local)
        if reason:
            text = _REFUSED.format(reason=reason)
            return web.Response(status=403, text=text, content_type="text/html", headers=_HEADERS)
        if "token" in request.query and request.path in ("/", "/index.html"):
            # Out of the address bar, the history and what is shown of the screen
            plain = request.rel_url.with_query([pair for pair in request.query.items() if pair[0] != "token"])
            answer = web.HTTPSeeOther(str(plain), headers=_HEADERS)
            answer.set_cookie(_cookie(request), token, httponly=True, samesite="Strict", secure=request.secure)
            return answer
        is_socket = request.path.rstrip("/").endswith("/ws")
        if is_socket and not web.WebSocketResponse().can_prepare(request):
            return web.Response(status=400, text="expected a web socket", headers=_HEADERS)
        try:
            response = await handler(request)
        except web.HTTPException as answer:
            answer.headers.update(_HEADERS)
            raise
        except Exception as error:  # wslink's, of a client that did not keep to its protocol or has gone
            _log.info("a request for %s failed: %s: %s", request.path[:80], type(error).__name__, error)
            return web.Response(status=400, text="the request was not understood", headers=_HEADERS)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    return check


def _cookie(request: web.Request) -> str:
    """Name of the cookie, by port: browsers share cookies between ports, but each workstation has its own token."""
    return f"ussim_token_{request.url.port}"


def _objection(request: web.Request, token: str, is_local: bool) -> str:
    origin = request.headers.get("Origin")
    try:
        host = urlsplit(f"//{request.host}")
        from_where = None if origin is None else urlsplit(origin).netloc
        name, _ = host.hostname or "", host.port  # of which neither is known of "[" and of a port above 65535
    except ValueError:
        return "The request was not understood."
    if from_where is not None and from_where != host.netloc:
        return "The request came from a page of another site."
    if is_local and not is_loopback(name):
        return f"The host is {escape(request.host[:80])}, expected 127.0.0.1."
    given = request.query.get("token", request.cookies.get(_cookie(request), ""))
    if not hmac.compare_digest(given.encode(), token.encode()):
        return "The token is missing or wrong. Use the URL that <code>ussim serve</code> printed."
    return ""
