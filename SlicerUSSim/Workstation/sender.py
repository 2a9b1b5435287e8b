"""Sender: gives pages what they export over HTTP, piece by piece: images, keys and Cancel go on meanwhile.

On the web socket everything else would wait: it answers one request of a page after the other.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from urllib.parse import quote

from aiohttp import web

#: Bytes of a piece
_PIECE = 2**18


class Sender:
    """The address "exported" of the server.

    Parameters
    ----------
    export : called in the event loop with what is wanted; returns (file name, content, MIME type), or None if there is
        nothing, which the page has been told.
    """

    def __init__(self, export: Callable[[str], Awaitable[tuple[str, bytes, str] | None]]) -> None:
        self._export = export

    def serve(self, app: web.Application) -> None:
        """Answer requests to an application, which is about to start."""
        app.router.add_get("/exported", self._send)

    async def _send(self, request: web.Request) -> web.StreamResponse:
        found = await self._export(request.query.get("kind", ""))
        if found is None:
            return web.Response(status=204)
        name, content, mime = found
        response = web.StreamResponse()
        response.content_type, response.content_length = mime, len(content)
        response.headers["Content-Disposition"] = f"attachment; filename*=UTF-8''{quote(name)}"
        response.headers["Cache-Control"] = "no-store"
        await response.prepare(request)
        for start in range(0, len(content), _PIECE):
            await response.write(content[start : start + _PIECE])
        await response.write_eof()
        return response
