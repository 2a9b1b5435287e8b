"""TrackerLink: receives probe poses and sends images over OpenIGTLink, with reconnection; uses pyigtl's messages.

pyigtl's client and server detect a lost peer only when sending to it fails, so TrackerLink has a loop of its own.
"""

from __future__ import annotations

import importlib.util
import logging
import re
import select
import socket
import threading
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import check_rigid, nearest_rotation
from SlicerUSSim.Logic.base.volume import Volume

_log = logging.getLogger(__name__)

#: The default port of OpenIGTLink.
DEFAULT_PORT = 18944
#: Seconds between attempts to connect; seconds until a peer that stops within a message is disconnected.
_RETRY_S, _STALLED_S = 0.25, 5.0
#: Limit of the message size; a larger size in a header means that the data are not OpenIGTLink.
_LARGEST_BYTES = 1 << 28
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


class TrackerLink:
    """An OpenIGTLink connection that is maintained until stop().

    Parameters
    ----------
    host, port : of the peer, or with `listen` the local address.
    moved : called with every pose, (4, 4) probe_to_ras in mm, in the thread of the link.
    device : name of the TRANSFORM to follow (default: the first received).
    listen : wait for the peer to connect, instead of connecting to it.
    image_name : device name of the IMAGE messages.

    Raises SimulationError without pyigtl, and with `listen` for a port that is in use.
    """

    def __init__(
        self,
        host: str,
        port: int,
        moved: Callable[[np.ndarray], None],
        *,
        device: str | None = None,
        listen: bool = False,
        image_name: str = "SlicerUSSim",
    ) -> None:
        self._address, self._moved = Address(host, port, listen), moved
        _require_pyigtl()
        self._device, self._image_name = device, image_name
        #: State of the connection, for display
        self.status = ""
        #: Numbers of poses used, of poses dropped because they are damaged, not valid or not rigid, and of images sent
        self.received = self.dropped = self.sent = 0
        self._refused = 0  # poses since the last that was used
        self._passed_over: set[str] = set()
        self._outgoing: bytes | None = None
        self._lock = threading.Lock()
        # Wakes the loop to send an image or to stop.
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_in.setblocking(False)
        self._stopping = False
        self._listener = _listening(self._address) if listen else None
        self._thread = threading.Thread(target=self._run, name="OpenIGTLink", daemon=True)
        self._thread.start()

    def send(self, image: Volume) -> None:
        """Send an image with its position (RAS); an image that is still waiting to be sent is replaced."""
        from pyigtl import ImageMessage

        message = ImageMessage(
            image.array, image.ijk_to_ras, world_coordinate_system="ras", device_name=self._image_name
        )
        with self._lock:
            self._outgoing = message.pack()
        self._wake()

    def stop(self) -> None:
        """Close the connection and wait for its thread to end; further calls have no effect."""
        if self._stopping:
            return
        self._stopping = True
        self._wake()
        self._thread.join()
        for end in (self._listener, self._wake_in, self._wake_out):
            if end is not None:
                end.close()

    # ---- the loop, in a separate thread ------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopping:
            try:
                peer = self._connected()
                if peer is None:
                    continue
                with peer:
                    self._serve(peer)
            except Exception as error:  # pyigtl raises various exceptions for a message that it cannot parse
                self._say(f"connection to {self._peer_name} lost ({error}), reconnecting", logging.WARNING)
                select.select([self._wake_in], [], [], _RETRY_S)
                self._awake()

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

    def _serve(self, peer: socket.socket) -> None:
        self._say(f"connected to {self._peer_name}")
        peer.settimeout(_STALLED_S)
        while not self._stopping:
            readable, _, _ = select.select([peer, self._wake_in], [], [])
            if self._wake_in in readable:
                self._awake()
            if peer in readable:
                self._receive(peer)
            with self._lock:
                outgoing, self._outgoing = self._outgoing, None
            if outgoing is not None:
                peer.sendall(outgoing)
                self.sent += 1

    def _receive(self, peer: socket.socket) -> None:
        from pyigtl.messages import CRC64, MessageBase, TransformMessage

        packed = _exactly(peer, MessageBase.IGTL_HEADER_SIZE)
        header = MessageBase.parse_header(packed)
        size, kind, device = header["body_size"], header["message_type"], header["device_name"]
        require(size <= _LARGEST_BYTES, f"message size is {size} bytes, expected at most {_LARGEST_BYTES}")
        body = _exactly(peer, size)
        if kind != "TRANSFORM":
            self._notice(f"messages of type {kind} are passed over")
            if kind in _OTHER_POSES and not self.received:
                remedy = "expected TRANSFORM: configure it to send TRANSFORM messages of the probe's pose"
                self._say(f"{self._peer_name} sends {kind} messages, {remedy}", logging.WARNING)
            return
        if self._device is None and packed[-8:].hex() == f"{CRC64(body):016x}":
            self._device = device
            _log.info("OpenIGTLink: no transform was chosen, the first that came is followed: %r", device)
        if self._device not in (None, device):
            self._notice(f"transform {device!r} is passed over, {self._device!r} is followed")
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
        self._refused = 0
        self._say(f"connected to {self._peer_name}, following {self._device}")
        self.received += 1
        self._moved(pose)

    def _connected(self) -> socket.socket | None:
        if self._listener is None:
            self._say(self.status or f"connecting to {self._peer_name}")
            return socket.create_connection((self._address.host, self._address.port), timeout=_STALLED_S)
        self._say(f"waiting for a connection at {self._address}")
        readable, _, _ = select.select([self._listener, self._wake_in], [], [])
        if self._wake_in in readable:
            self._awake()
        return self._listener.accept()[0] if self._listener in readable else None

    @property
    def _peer_name(self) -> str:
        return "the client" if self._listener is not None else str(self._address)

    def _wake(self) -> None:
        self._wake_out.send(b"!")

    def _awake(self) -> None:
        try:
            while self._wake_in.recv(1024):
                pass
        except BlockingIOError:
            pass


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


def _exactly(peer: socket.socket, count: int) -> bytes:
    """Read exactly `count` bytes. Raises ConnectionError if the peer closes the connection before."""
    parts, missing = [], count
    while missing:
        part = peer.recv(min(missing, 1 << 20))
        if not part:
            raise ConnectionError("closed by the peer")
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)


def _require_valid(name: str, device: str, metadata: dict[str, str]) -> None:
    """Raise SimulationError for a pose that the tracker itself calls invalid, as of a tool that it does not see."""
    keys = {first + last for first in ("Transform", device, f"{device}Transform") for last in ("Valid", "Status")}
    for key, value in metadata.items():
        if key in keys:
            require(value.upper() in _VALID, f"{name} has {key} {value}, expected OK: the last valid pose stays")
