"""zipped: a .zip of files, made piece by piece, so that it has progress and can be cancelled."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

#: Suffixes of files that are compressed
_COMPRESSED = (".gz", ".zip", ".mgz")
#: Bytes of a piece, which takes some hundredths of a second
_PIECE = 2**20
#: Bytes from which the sizes in a .zip have more digits
_LARGE = 2**31


def zipped(
    files: Mapping[str, Path], progress: Callable[[float], None], texts: Mapping[str, str] | None = None
) -> bytes:
    """A .zip of {name: file}, and of {name: content} of texts.

    `progress` is called with the fraction done after every piece, and may raise errors.Cancelled.
    """
    size, done = sum(file.stat().st_size for file in files.values()), 0
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, text in (texts or {}).items():
            archive.writestr(name, text)
        for name, file in files.items():
            is_compressed = name.lower().endswith(_COMPRESSED)
            archive.compression = zipfile.ZIP_STORED if is_compressed else zipfile.ZIP_DEFLATED
            with (
                file.open("rb") as source,
                archive.open(name, "w", force_zip64=file.stat().st_size > _LARGE) as target,
            ):
                while piece := source.read(_PIECE):
                    target.write(piece)
                    done += len(piece)
                    progress(done / max(size, 1))
    return buffer.getvalue()
