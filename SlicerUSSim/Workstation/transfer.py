"""Receiver and Sender: files from and to pages over HTTP, piece by piece: images, keys and Cancel go on meanwhile.

On the web socket everything else would wait: it answers one request of a page after the other.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeAlias
from urllib.parse import quote

from aiohttp import BodyPartReader, web

from SlicerUSSim.Workstation import uploads
from SlicerUSSim.Workstation.export import DICOM

#: Called with what is wanted; (file name, content, MIME type)
_Export: TypeAlias = Callable[..., Awaitable[tuple[str, bytes, str] | None]]
#: Bytes of a piece
_PIECE = 2**18


class Receiver:
    """The address "upload" of the server, to which pages send files.

    Parameters
    ----------
    opened : called in the event loop with {name: content} of files to open, and what they are meant to be ("": not
        said).
    export : as of Sender, also called with the images from which a page has composed what is wanted.
    refused : called with a line about files that were not taken.
    """

    def __init__(
        self, opened: Callable[[dict[str, bytes], str], None], export: _Export, refused: Callable[[str], None]
    ) -> None:
        self._opened, self._export, self._refused = opened, export, refused

    def serve(self, app: web.Application) -> None:
        """Answer requests to an application, which is about to start."""
        app.router.add_post("/upload", self._receive)

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
            if len(parts) == uploads.MOST_FILES:
                self._refused(f"more than {uploads.MOST_FILES} files are sent at once, of which no more are taken")
                return web.Response(status=413, text="too many")
            content = bytearray()
            while piece := await part.read_chunk(_PIECE):
                size += len(piece)
                if size > uploads.MOST_BYTES:
                    self._refused(f"the files have more than {uploads.MOST_BYTES} bytes, of which no more are taken")
                    return web.Response(status=413, text="too much")
                content += piece
            parts.append((part.filename or "", bytes(content)))
        files = uploads.plain_names(parts)
        if request.query.get("for") == DICOM:
            return await _answer(request, await self._export(DICOM, files))
        if files:
            self._opened(files, request.query.get("as", ""))
        return web.Response(status=204)


class Sender:
    """The address "exported" of the server.

    Parameters
    ----------
    export : called in the event loop with what is wanted; returns (file name, content, MIME type), or None if there is
        nothing, which the page has been told.
    """

    def __init__(self, export: _Export) -> None:
        self._export = export

    def serve(self, app: web.Application) -> None:
        """Answer requests to an application, which is about to start."""
        app.router.add_get("/exported", self._send)

    async def _send(self, request: web.Request) -> web.StreamResponse:
        return await _answer(request, await self._export(request.query.get("kind", "")))


async def _answer(request: web.Request, found: tuple[str, bytes, str] | None) -> web.StreamResponse:
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
