"""Transfer: files from and to pages over HTTP, piece by piece: images, keys and Cancel continue meanwhile.

On the web socket everything else would wait: it answers one request of a page after the other.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from urllib.parse import quote

from aiohttp import BodyPartReader, web

from SlicerUSSim.Workstation import uploads
from SlicerUSSim.Workstation.export import DICOM

#: Bytes of a piece
_PIECE = 2**18


class Transfer:
    """The addresses "upload" and "exported" of the server.

    Parameters
    ----------
    opened : called in the event loop with {name: content} of files to open, and what they are meant to be ("":
        unspecified).
    export : called in the event loop with what is wanted, and the images from which a page has composed it; returns
        (file name, content, MIME type), or None if there is nothing, which the page has been told.
    refused : called with a line about files that were not taken.
    """

    def __init__(
        self,
        opened: Callable[[dict[str, bytes], str], None],
        export: Callable[..., Awaitable[tuple[str, bytes, str] | None]],
        refused: Callable[[str], None],
    ) -> None:
        self._opened, self._export, self._refused = opened, export, refused

    def serve(self, app: web.Application) -> None:
        """Answer requests to an application, which is about to start."""
        app.router.add_post("/upload", self._receive)
        app.router.add_get("/exported", self._send)

    async def _receive(self, request: web.Request) -> web.StreamResponse:
        """A request that a page breaks off, since the user cancels it, opens nothing."""
        if not request.content_type.startswith("multipart/"):
            return web.Response(status=400, text="expected files")
        parts: list[tuple[str, bytes]] = []
        size = 0
        reader = await request.multipart()
        while (part := await reader.next()) is not None:
            if not isinstance(part, BodyPartReader):
                return web.Response(status=400, text="expected files")
            content = bytearray()
            while size <= uploads.MOST_BYTES and (piece := await part.read_chunk(_PIECE)):
                size += len(piece)
                content += piece
            parts.append((part.filename or "", bytes(content)))
            if size > uploads.MOST_BYTES or len(parts) > uploads.MOST_FILES:
                most = f"{uploads.MOST_FILES} files or {uploads.MOST_BYTES} bytes"
                self._refused(f"more than {most} are sent at once; none is opened")
                return web.Response(status=413, text="too much")
        files = uploads.plain_names(parts)
        if request.query.get("for") == DICOM:
            return _answer(await self._export(DICOM, files))
        if files:
            self._opened(files, request.query.get("as", ""))
        return web.Response(status=204)

    async def _send(self, request: web.Request) -> web.StreamResponse:
        return _answer(await self._export(request.query.get("kind", "")))


def _answer(found: tuple[str, bytes, str] | None) -> web.StreamResponse:
    if found is None:
        return web.Response(status=204)
    name, content, mime = found
    disposition = f"attachment; filename*=UTF-8''{quote(name)}"
    headers = {"Content-Disposition": disposition, "Cache-Control": "no-store"}
    return web.Response(body=content, content_type=mime, headers=headers)
