"""Receiver: takes files of pages over HTTP, piece by piece: pages know how far they are, and images go on meanwhile."""

from __future__ import annotations

from collections.abc import Callable

from aiohttp import BodyPartReader, web

from SlicerUSSim.Workstation import uploads

#: Bytes of a piece
_PIECE = 2**18


class Receiver:
    """The address "upload" of the server, to which pages send files.

    Parameters
    ----------
    opened : called in the event loop with {name: content} of files to open, and what they are meant to be ("": not
        said).
    added : called with the name and the content of a mask to add, and the tissue that it is.
    posed : called with the name and the content of a file with a pose of the probe.
    refused : called with a line about files that were not taken.
    """

    def __init__(
        self,
        opened: Callable[[dict[str, bytes], str], None],
        added: Callable[[str, bytes, str], None],
        refused: Callable[[str], None],
        posed: Callable[[str, bytes], None] = lambda name, content: None,
    ) -> None:
        self._opened, self._added, self._refused, self._posed = opened, added, refused, posed

    def serve(self, app: web.Application) -> None:
        """Answer requests to an application, which is about to start."""
        app.router.add_post("/upload", self._receive)

    async def _receive(self, request: web.Request) -> web.Response:
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
        if files and request.query.get("for") == "add":
            self._added(*next(iter(files.items())), request.query.get("as", ""))
        elif files and request.query.get("for") == "pose":
            self._posed(*next(iter(files.items())))
        elif files:
            self._opened(files, request.query.get("as", ""))
        return web.Response(status=204)
