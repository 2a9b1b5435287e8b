"""A strict client of OpenIGTLink that shares nothing with the package or pyigtl: header, lengths, CRC, metadata.

From the protocol's pages (openigtlink.org, versions 2 and 3) and igtlutil. It refuses what the protocol does not allow.
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass, field
from xml.etree import ElementTree

import crcmod
import numpy as np

_HEADER = struct.Struct(">H12s20sQQQ")
_IMAGE = struct.Struct(">HBBBB3H12f3H3H")
_crc64 = crcmod.mkCrcFun(0x142F0E1EBA9EA3693, initCrc=0, rev=False)  # ECMA-182


def _text(data: bytes) -> str:
    """A text of a fixed length, with zeros behind it alone."""
    text, _, rest = data.partition(b"\0")
    assert not rest.strip(b"\0"), f"rubbish behind {text!r}"
    return text.decode("ascii")


@dataclass
class Received:
    """A message that came."""

    version: int
    kind: str
    device: str
    #: 32 bits of seconds, 32 of their fraction
    stamp: int
    content: bytes
    metadata: dict[str, str] = field(default_factory=dict)

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) of TRANSFORM."""
        return np.vstack([np.array(struct.unpack(">12f", self.content)).reshape(4, 3).T, [0, 0, 0, 1]])

    @property
    def image(self) -> tuple[np.ndarray, np.ndarray]:
        """((rows, columns) uint8, (4, 4) from indices to RAS) of IMAGE: of one slice, whose matrix is at its middle."""
        version, components, scalar, endian, frame, *rest = _IMAGE.unpack_from(self.content)
        size, numbers, offset, part = np.array(rest[:3]), rest[3:15], rest[15:18], rest[18:]
        assert (version, components, scalar, frame, size[2]) == (1, 1, 3, 1, 1) and endian in (1, 2)
        assert tuple(offset) == (0, 0, 0) and tuple(part) == tuple(size)
        assert len(self.content) == _IMAGE.size + size.prod()
        matrix = np.vstack([np.array(numbers).reshape(4, 3).T, [0, 0, 0, 1]])
        matrix[:3, 3] -= matrix[:3, :3] @ (0.5 * (size - 1))
        return np.frombuffer(self.content[_IMAGE.size :], np.uint8).reshape(size[1], size[0]), matrix

    @property
    def command(self) -> tuple[int, str, ElementTree.Element]:
        """(id, name, XML) of RTS_COMMAND."""
        uid, name, encoding, length = struct.unpack_from(">I128sHI", self.content)
        assert encoding in (3, 106) and len(self.content) == 138 + length
        return uid, _text(name), ElementTree.fromstring(self.content[138:].decode())


class StrictClient:
    """One connection. `receive_buffer` limits what the system keeps for it, as for a slow client."""

    def __init__(self, port: int, receive_buffer: int | None = None) -> None:
        self.socket = socket.socket()
        if receive_buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(60.0)
        self.socket.connect(("127.0.0.1", port))
        self._stream = self.socket.makefile("rb")

    def __enter__(self) -> StrictClient:
        return self

    def __exit__(self, *_) -> None:
        self._stream.close()
        self.socket.close()

    def send(self, kind: str, device: str, content: bytes, version: int = 2) -> None:
        self.socket.sendall(packed(kind, device, content, version))

    def command(self, text: str, name: str | None = None, uid: int = 1) -> Received:
        """The reply to a COMMAND."""
        self.send("COMMAND", "", command_content(text, name, uid))
        return self.next("RTS_COMMAND")

    def move(self, matrix: np.ndarray, name: str = "ProbeToReference") -> None:
        self.send("TRANSFORM", name, struct.pack(">12f", *matrix[:3].T.ravel()))

    def receive(self) -> Received:
        version, kind, device, stamp, size, crc = _HEADER.unpack(self._read(_HEADER.size))
        assert version in (1, 2) and size < 1 << 24
        content, metadata = self._read(size), {}
        assert _crc64(content) == crc
        if version == 2:
            extended, index, values, _ = struct.unpack_from(">HHII", content)
            assert extended == 12
            metadata = _metadata(content[size - index - values :], index)
            content = content[12 : size - index - values]
        return Received(version, _text(kind), _text(device), stamp, content, metadata)

    def next(self, kind: str, device: str | None = None) -> Received:
        """The next message of a kind; others before it are left out."""
        while True:
            message = self.receive()
            if message.kind == kind and device in (None, message.device):
                return message

    def _read(self, count: int) -> bytes:
        data = self._stream.read(count)
        if len(data) < count:
            raise ConnectionError("closed")
        return data


def command_content(text: str, name: str | None = None, uid: int = 1) -> bytes:
    """Of COMMAND; the name as in the XML by default."""
    name = ElementTree.fromstring(text).get("Name", "") if name is None else name
    return struct.pack(">I128sHI", uid, name.encode(), 3, len(text)) + text.encode()


def packed(kind: str, device: str, content: bytes, version: int = 2) -> bytes:
    """A message, in version 2 with an extended header and no metadata."""
    body = content if version == 1 else struct.pack(">HHII", 12, 2, 0, 0) + content + bytes(2)
    return _HEADER.pack(version, kind.encode(), device.encode(), 0, len(body), _crc64(body)) + body


def _metadata(data: bytes, index_size: int) -> dict[str, str]:
    (count,) = struct.unpack_from(">H", data)
    assert index_size == 2 + 8 * count
    found, place = {}, index_size
    for number in range(count):
        key_size, encoding, value_size = struct.unpack_from(">HHI", data, 2 + 8 * number)
        assert encoding in (3, 106)
        key, value = data[place : place + key_size], data[place + key_size : place + key_size + value_size]
        found[key.decode()], place = value.decode(), place + key_size + value_size
    assert place == len(data) and list(found) == sorted(found)  # as std::map has them
    return found
