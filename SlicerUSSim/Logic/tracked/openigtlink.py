"""TrackerLink: poses and commands come, and images go, over OpenIGTLink, with reconnection; uses pyigtl's messages.

pyigtl's server has one client, and its client detects a lost peer only when sending to it fails, so TrackerLink has
connections of its own.
"""

from __future__ import annotations

import importlib.util
import logging
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import check_rigid, nearest_rotation
from SlicerUSSim.Logic.base.volume import Volume

_log = logging.getLogger(__name__)

#: The default port of OpenIGTLink.
DEFAULT_PORT = 18944
#: Seconds between attempts to connect; seconds until a peer that stops within a message is disconnected; seconds
#: without a pose after which another client may move the probe
_RETRY_S, _STALLED_S, _SILENT_S = 0.25, 5.0, 2.0
#: Limit of the message size; a larger size in a header means that the data are not OpenIGTLink.
_LARGEST_BYTES = 1 << 28
#: Bytes that the system keeps for a peer, of which an image is a part: the next one is newer
_SEND_BUFFER = 1 << 17
#: Code, subcode, name and text of STATUS
_STATUS_OK = struct.pack(">Hq20sx", 1, 0, b"")
#: Kinds of messages in CAPABILITY, 12 bytes each
_KINDS = b"IMAGE", b"TRANSFORM", b"STATUS", b"GET_STATUS", b"CAPABILITY", b"GET_CAPABIL", b"COMMAND", b"RTS_COMMAND"
_CAPABILITIES = b"".join(kind.ljust(12, b"\0") for kind in _KINDS)
#: Messages with poses that are not read
_OTHER_POSES = ("TDATA", "QTDATA", "POSITION")
#: In metadata, whether a pose is valid: 1 or 0, and OK or else what is wrong (Plus)
_VALID = ("1", "TRUE", "OK", "VALID")

#: A name or IPv4 address, or an IPv6 address in brackets.
_HOST = r"\[[^\[\]]*:[^\[\]]*\]|[^\[\]:]+"
_ADDRESS = re.compile(rf"(?:listen:(?P<ours>{_HOST})|(?!listen:)(?P<theirs>{_HOST})|):(?P<port>[0-9]{{1,5}})")


class Address(NamedTuple):
    """One end of a connection."""

    host: str
    port: int
    #: Whether this is the local end, which waits for the peer to connect
    listen: bool

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def parse_address(text: str) -> Address:
    """Parse --igtl: HOST:PORT to connect to, :PORT to wait on loopback, listen:HOST:PORT to wait at an address.

    IPv6 hosts are in brackets: [::1]:18944. Raises SimulationError for an invalid address.
    """
    match = _ADDRESS.fullmatch(text)
    require(
        match is not None and 0 < int(match["port"]) < 65536,
        f"--igtl is {text!r}, expected HOST:PORT to connect to (such as 127.0.0.1:{DEFAULT_PORT}), :PORT to wait for a "
        "connection from this computer, or listen:HOST:PORT to wait at another address; IPv6 hosts in brackets",
    )
    assert match is not None
    host = (match["ours"] or match["theirs"] or "127.0.0.1").strip("[]")
    return Address(host, int(match["port"]), listen=match["theirs"] is None)


def require_usable(address: Address) -> None:
    """Raise SimulationError if pyigtl is missing, or if it is not possible to listen at the address."""
    _require_pyigtl()
    if address.listen:
        _listening(address).close()


#: Content of a COMMAND -> content and metadata of its reply
Answer = Callable[[bytes], tuple[bytes, Mapping[str, str]] | None]
#: Of an image: the matrix ImageToProbe, its message, and those of other transforms and the image
_Outgoing = tuple[bytes, bytes, bytes]


class _Peer(NamedTuple):
    """Who is connected."""

    socket: socket.socket
    #: Held while a message is sent
    sending: threading.Lock

    def send(self, packed: bytes) -> None:
        """Send a message, for as long as it takes: a robot may move the probe without reading anything."""
        rest = memoryview(packed)
        with self.sending:
            while rest:
                with suppress(TimeoutError):
                    rest = rest[self.socket.send(rest) :]

    def close(self) -> None:
        """Let threads that read or send find that the connection has ended."""
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)


class TrackerLink:
    """An OpenIGTLink connection that is maintained until stop(): to one peer, or with `listen` to several clients.

    Images are never queued: a slow client gets the newest image when it is ready, and skips those in between.

    Parameters
    ----------
    host, port : of the peer, or with `listen` the local address.
    moved : called with every pose, (4, 4) probe_to_ras in mm, in a thread of the link.
    device : TRANSFORM to follow; by default ProbeToReference, or else the first usable. One client at a time leads.
    listen : wait for clients to connect, instead of connecting to a peer.
    image_name : device name of the IMAGE messages.
    answer : called with the content of every COMMAND, in a thread of its client; returns that of the reply, if any.

    Raises SimulationError without pyigtl, and with `listen` for a port that is in use.
    """

    def __init__(
        self, host: str, port: int, moved: Callable[[np.ndarray], None], *, device: str | None = None,
        listen: bool = False, image_name: str = "SlicerUSSim", answer: Answer = lambda content: None,
    ) -> None:  # fmt: skip
        self._address, self._moved = Address(host, port, listen), moved
        _require_pyigtl()
        self._chosen = self._device = device
        self._image_name, self._answer = image_name, answer
        #: State of the connection, for display
        self.status = ""
        #: Numbers of poses used, of poses dropped because they are damaged, not valid or not rigid, and of images sent
        self.received = self.dropped = self.sent = 0
        self._refused = 0  # poses since the last that was used
        self._passed_over: set[str] = set()
        #: Who is connected
        self.peers: list[_Peer] = []
        self._leader: tuple[_Peer, float] | None = None  # who moves the probe, and when it did last
        self._newest: _Outgoing | None = None
        self._changed = threading.Condition()  # another image, or another peer
        self._stopping = threading.Event()
        run = partial(self._listen, _listening(self._address)) if listen else self._connect
        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def send(
        self, image: Volume, transforms: Mapping[str, np.ndarray] = MappingProxyType({}), stamp: float | None = None
    ) -> None:
        """Send an image with its position (RAS) to all; one that is still waiting to be sent is replaced.

        Before it go `transforms` {name: (4, 4)} with the same time, of which ImageToProbe to each client once and when
        it changes. `stamp` are seconds since 1970, by default now.
        """
        from pyigtl import ImageMessage, TransformMessage

        stamp = time.time() if stamp is None else stamp
        packed = {name: TransformMessage(matrix, stamp, name).pack() for name, matrix in transforms.items()}
        packed[""] = ImageMessage(image.array, image.ijk_to_ras, "ras", stamp, self._image_name).pack()
        matrix = transforms["ImageToProbe"].tobytes() if "ImageToProbe" in transforms else b""
        with self._changed:
            self._newest = matrix, packed.pop("ImageToProbe", b""), b"".join(packed.values())
            self._changed.notify_all()

    def stop(self) -> None:
        """Close the connections and wait for the threads to end; further calls have no effect."""
        self._stopping.set()
        with self._changed:
            for peer in self.peers:
                peer.close()
            self._changed.wait_for(lambda: not self.peers, _STALLED_S)
        self._thread.join()

    # ---- connections: a thread that reads for each, and one that sends images ----------------------------------

    def _connect(self) -> None:
        while not self._stopping.is_set():
            self._say(self.status or f"connecting to {self._address}")
            try:
                self._serve(socket.create_connection(self._address[:2], timeout=_STALLED_S))
            except Exception as error:  # pyigtl raises various exceptions for a message that it cannot parse
                if not self._stopping.is_set():
                    self._say(f"connection to {self._address} lost ({error}), reconnecting", logging.WARNING)
                    self._stopping.wait(_RETRY_S)

    def _listen(self, listener: socket.socket) -> None:
        listener.settimeout(_RETRY_S)
        self._tell()
        with listener:
            while not self._stopping.is_set():
                with suppress(TimeoutError):
                    end, _ = listener.accept()
                    threading.Thread(target=self._serve_client, args=(end,), daemon=True).start()

    def _serve_client(self, end: socket.socket) -> None:
        try:
            self._serve(end)
        except Exception as error:
            _log.info("OpenIGTLink: a client has gone (%s)", error)
        self._tell()

    def _serve(self, end: socket.socket) -> None:
        """Take the messages of a peer until the link stops. Raises various errors when the connection ends before."""
        end.settimeout(_STALLED_S)
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        peer = _Peer(end, threading.Lock())
        self.peers.append(peer)
        self._tell()
        threading.Thread(target=self._send_images, args=(peer,), daemon=True).start()
        try:
            while not self._stopping.is_set():
                self._receive(peer)
        finally:
            with self._changed, end:
                self.peers.remove(peer)
                if self._leader is not None and self._leader[0] is peer:
                    self._leader, self._device = None, self._chosen
                self._changed.notify_all()

    def _send_images(self, peer: _Peer) -> None:
        before: _Outgoing | None = None
        try:
            while (newest := self._after(before, peer)) is not None:
                matrix, calibration, others = newest
                is_known = before is not None and before[0] == matrix
                peer.send(others if is_known else calibration + others)
                before = newest
                self.sent += 1
        except OSError:
            peer.close()

    def _after(self, before: _Outgoing | None, peer: _Peer) -> _Outgoing | None:
        """The newest image, when it is another one; None when the connection has ended."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not before or peer not in self.peers)
            return self._newest if peer in self.peers else None

    def _tell(self) -> None:
        """Say who is connected."""
        following = f", following {self._device}" if self._leader is not None else ""
        if self.peers:
            self._say(f"connected to {self._peer_name}{following}")
        else:
            self._say(f"waiting for a connection at {self._address}")

    def _say(self, status: str, level: int = logging.INFO) -> None:
        """Another status, which the log has once."""
        if status != self.status:
            self.status = status
            _log.log(level, "OpenIGTLink: %s", status)

    def _notice(self, what: str) -> None:
        """Something in the stream that is passed over, which the log has once."""
        if what not in self._passed_over:
            self._passed_over.add(what)
            _log.info("OpenIGTLink: %s", what)

    def _refuse(self, reason: str) -> None:
        """A pose that is not used. Trackers send many, so the log has the first as a warning."""
        self.dropped += 1
        self.status = f"{reason} ({self.dropped} pose{'s' * (self.dropped > 1)} dropped)"
        _log.log(logging.DEBUG if self._refused else logging.WARNING, "OpenIGTLink: pose refused: %s", reason)
        self._refused += 1

    @property
    def _peer_name(self) -> str:
        if not self._address.listen:
            return str(self._address)
        return "the client" if len(self.peers) < 2 else f"{len(self.peers)} clients"

    # ---- messages ----------------------------------------------------------------------------------------------

    def _receive(self, peer: _Peer) -> None:
        """Take one message: it may be long until it begins, but not until it ends."""
        from pyigtl.messages import MessageBase

        select.select([peer.socket], [], [])
        packed = _exactly(peer.socket, MessageBase.IGTL_HEADER_SIZE)
        header = MessageBase.parse_header(packed)
        size, kind = header["body_size"], header["message_type"]
        require(size <= _LARGEST_BYTES, f"message size is {size} bytes, expected at most {_LARGEST_BYTES}")
        body = _exactly(peer.socket, size)
        if kind == "TRANSFORM":
            with self._changed:
                self._take_pose(peer, header, packed, body)
        elif kind == "COMMAND":
            try:
                reply = self._answer(_content_of(header, body))
            except Exception as error:  # of pyigtl too, for one that it cannot parse
                _log.warning("OpenIGTLink: a command is not answered: %r", error)
                return
            if reply is not None:
                peer.send(_packed("RTS_COMMAND", header, *reply))
        elif kind == "GET_STATUS":
            peer.send(_packed("STATUS", header, _STATUS_OK))
        elif kind == "GET_CAPABIL":
            peer.send(_packed("CAPABILITY", {**header, "header_version": 1}, _CAPABILITIES))  # no other version has it
        else:
            self._notice(f"messages of type {kind} are passed over")
            if kind in _OTHER_POSES and not self.received:
                remedy = "expected TRANSFORM: configure it to send TRANSFORM messages of the probe's pose"
                self._say(f"{self._peer_name} sends {kind} messages, {remedy}", logging.WARNING)

    def _take_pose(self, peer: _Peer, header: dict[str, Any], packed: bytes, body: bytes) -> None:
        from pyigtl.messages import CRC64, TransformMessage

        device, now = header["device_name"], time.monotonic()
        is_better = self._chosen is None and device == "ProbeToReference" != self._device
        if not is_better and self._device not in (None, device):
            self._notice(f"transform {device!r} is passed over, {self._device!r} is followed")
            return
        leader, last = self._leader or (None, now)
        if not is_better and leader not in (None, peer) and now - last < _SILENT_S:
            self._say(f"connected to {self._peer_name}, of which two send {device}: the first is followed")
            return
        message, name, crc, expected = TransformMessage(), f"transform {device!r}", packed[-8:].hex(), CRC64(body)
        try:
            require(crc == f"{expected:016x}", f"{name} is damaged: its CRC is {crc}, expected {expected:016x}")
            message.unpack(header, body)
            _require_valid(name, device, message.metadata)
            pose = check_rigid(name, message.matrix)
        except SimulationError as error:  # a tracker may send any matrix while it does not see its tool
            self._refuse(str(error))
            return
        pose[:3, :3] = nearest_rotation(pose[:3, :3])  # without the rounding of single precision
        is_new = leader is not peer or device != self._device or self._refused > 0
        self._device, self._leader, self._refused = device, (peer, now), 0
        if is_new:
            self._tell()
        self.received += 1
        self._moved(pose)


def _content_of(header: dict[str, Any], body: bytes) -> bytes:
    """The content of a message, without metadata."""
    from pyigtl.messages import MessageBase

    message, content = cast(Any, MessageBase()), []
    message._unpack_content = content.append
    message.unpack(header, body)
    return content[0]


def _packed(
    kind: str, asked: dict[str, Any], content: bytes, metadata: Mapping[str, str] = MappingProxyType({})
) -> bytes:
    """The answer to a message with the header `asked`; to version 1 it is without metadata."""
    from pyigtl.messages import MessageBase

    message = cast(Any, MessageBase(device_name=asked["device_name"]))
    message._message_type, message._pack_content = kind, lambda: content
    message.header_version = min(asked["header_version"], 2)
    if message.header_version > 1:  # pyigtl writes ASCII alone
        message.metadata = {key: text.encode("ascii", "xmlcharrefreplace").decode() for key, text in metadata.items()}
    return message.pack()


def _require_pyigtl() -> None:
    require(
        importlib.util.find_spec("pyigtl") is not None,
        'OpenIGTLink needs pyigtl; install it with: pip install "SlicerUSSim[serve]"',
    )


def _listening(address: Address) -> socket.socket:
    """A socket that listens at an address. Raises SimulationError if that is not possible."""
    try:
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        return socket.create_server((address.host, address.port), family=family)
    except OSError as error:
        raise SimulationError(f"cannot wait for a tracker at {address} ({error}); choose another address") from None


def _exactly(end: socket.socket, count: int) -> bytes:
    """Read exactly `count` bytes. Raises ConnectionError if the peer closes the connection before, and TimeoutError."""
    parts, missing = [], count
    while missing:
        part = end.recv(min(missing, 1 << 20))
        if not part:
            raise ConnectionError("closed by the peer")
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def _require_valid(name: str, device: str, metadata: dict[str, str]) -> None:
    """Raise SimulationError for a pose that the tracker itself calls invalid, for example of a hidden tool."""
    keys = {first + last for first in ("Transform", device, f"{device}Transform") for last in ("Valid", "Status")}
    for key, value in metadata.items():
        if key in keys:
            require(value.upper() in _VALID, f"{name} has {key} {value}, expected OK: the last valid pose stays")
