"""A strict client of OpenIGTLink that shares nothing with the package or pyigtl: header, lengths, CRC, metadata.

From the protocol's pages (openigtlink.org, versions 2 and 3) and igtlutil. It refuses what the protocol does not allow.
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass, field
from xml.etree import ElementTree

import numpy as np

_HEADER = struct.Struct(">H12s20sQQQ")


def _table() -> list[int]:
    found = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = ((value << 1) ^ 0x42F0E1EBA9EA3693 if value >> 63 else value << 1) & (1 << 64) - 1
        found.append(value)
    return found


_CRC_TABLE = _table()


def crc64(data: bytes) -> int:
    """Of ECMA-182, from 0."""
    crc = 0
    for byte in data:
        crc = _CRC_TABLE[(crc >> 56) ^ byte] ^ (crc << 8) & (1 << 64) - 1
    return crc


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
        matrix = np.eye(4)
        matrix[:3] = np.array(struct.unpack(">12f", self.content)).reshape(4, 3).T
        return matrix

    @property
    def image(self) -> tuple[np.ndarray, np.ndarray]:
        """((rows, columns) uint8, (4, 4) from indices to RAS) of IMAGE: of one slice, whose matrix is at its middle."""
        head = struct.Struct(">HBBBB3H12f3H3H")
        version, components, scalar, endian, frame, *rest = head.unpack_from(self.content)
        size, numbers, offset, part = np.array(rest[:3]), rest[3:15], rest[15:18], rest[18:]
        assert (version, components, scalar, frame, size[2]) == (1, 1, 3, 1, 1) and endian in (1, 2)
        assert tuple(offset) == (0, 0, 0) and tuple(part) == tuple(size)
        assert len(self.content) == head.size + size.prod()
        matrix = np.eye(4)
        matrix[:3] = np.array(numbers).reshape(4, 3).T
        matrix[:3, 3] -= matrix[:3, :3] @ (0.5 * (size - 1))
        return np.frombuffer(self.content[head.size :], np.uint8).reshape(size[1], size[0]), matrix

    @property
    def command(self) -> tuple[int, str, ElementTree.Element]:
        """(id, name, XML) of RTS_COMMAND."""
        uid, name, encoding, length = struct.unpack_from(">I128sHI", self.content)
        assert encoding in (3, 106) and len(self.content) == 138 + length
        return uid, _text(name), ElementTree.fromstring(self.content[138:].decode())

    @property
    def string(self) -> str:
        """Of STRING."""
        encoding, length = struct.unpack_from(">HH", self.content)
        assert encoding in (3, 106) and len(self.content) == 4 + length
        return self.content[4:].decode()


class StrictClient:
    """One connection. `receive_buffer` limits what the system keeps for it, as for a slow client."""

    def __init__(self, port: int, receive_buffer: int | None = None) -> None:
        self.socket = socket.socket()
        if receive_buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(120.0)
        self.socket.connect(("127.0.0.1", port))
        self._stream = self.socket.makefile("rb")
        self._number = 0
        #: Whether CRCs are computed, which is slow in Python
        self.checks_crc = True

    def __enter__(self) -> StrictClient:
        return self

    def __exit__(self, *_) -> None:
        self._stream.close()
        self.socket.close()

    def send(self, kind: str, device: str, content: bytes, version: int = 2, metadata: dict | None = None) -> None:
        self.socket.sendall(packed(kind, device, content, version, metadata))

    def command(self, text: str, name: str | None = None, uid: int | None = None) -> Received:
        """The reply to a COMMAND."""
        self.send_command(text, name, uid)
        return self.next("RTS_COMMAND")

    def send_command(self, text: str, name: str | None = None, uid: int | None = None) -> None:
        self._number = self._number + 1 if uid is None else uid
        name = ElementTree.fromstring(text).get("Name", "") if name is None else name
        content = struct.pack(">I128sHI", self._number, name.encode(), 3, len(text)) + text.encode()
        self.send("COMMAND", "", content)

    def string_command(self, text: str, device: str) -> Received:
        """The reply to a command of version 1 of the protocol."""
        self.send("STRING", device, struct.pack(">HH", 3, len(text)) + text.encode(), version=1)
        return self.next("STRING")

    def move(self, matrix: np.ndarray, name: str = "ProbeToReference") -> None:
        self.send("TRANSFORM", name, struct.pack(">12f", *matrix[:3].T.ravel()))

    def receive(self) -> Received:
        version, kind, device, stamp, size, crc = _HEADER.unpack(self._read(_HEADER.size))
        assert version in (1, 2) and size < 1 << 24
        body = self._read(size)
        assert not self.checks_crc or crc64(body) == crc
        metadata = {}
        if version == 2:
            extended, index, values, _ = struct.unpack_from(">HHII", body)
            assert extended == 12
            content = body[12 : size - index - values]
            metadata = _metadata(body[size - index - values :], index)
        else:
            content = body
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


def packed(kind: str, device: str, content: bytes, version: int = 2, metadata: dict | None = None) -> bytes:
    """A message."""
    body = content
    if version == 2:
        entries = [(key.encode(), value.encode()) for key, value in (metadata or {}).items()]
        index = struct.pack(">H", len(entries))
        index += b"".join(struct.pack(">HHI", len(key), 3, len(value)) for key, value in entries)
        values = b"".join(key + value for key, value in entries)
        body = struct.pack(">HHII", 12, len(index), len(values), 0) + content + index + values
    return _HEADER.pack(version, kind.encode(), device.encode(), 0, len(body), crc64(body)) + body


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
