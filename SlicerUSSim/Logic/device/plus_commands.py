"""PlusCommands: answers commands of OpenIGTLink clients, such as SlicerOpenIGTLink's, as PlusServer does.

Texts, names of metadata and the order of both are those of PlusLib (src/PlusServer, 2.9). Commands come as COMMAND,
answered by RTS_COMMAND, or in older clients as STRING called CMD_number, answered by STRING called ACK_number.
"""

from __future__ import annotations

import logging
import re
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.device.imaging_parameters import KNOWN, changed_parameter, parameter_text
from SlicerUSSim.Logic.device.recorder import Recorder
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.openigtlink import Answer, Message
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

_log = logging.getLogger(__name__)

#: IDs as in the configuration files of Plus
ULTRASOUND, CAPTURE, CHANNEL = "VideoDevice", "CaptureDevice", "TrackedVideoStream"
#: Types of devices that Plus knows: those that are here, and those that clients ask for
_TYPES = {
    "UsSimulator": ULTRASOUND, "VirtualCapture": CAPTURE, "VirtualDiscCapture": CAPTURE,
    "VirtualBufferedCapture": CAPTURE, "VirtualMixer": "", "VirtualVolumeReconstructor": "", "FakeTracker": "",
}  # fmt: skip
#: Of recordings that are in progress, or not, and the command then fails
_RECORDING_ERRORS = {
    "StartRecording": (True, "Recording to file is already in progress."),
    "SuspendRecording": (False, "Suspend recording failed: recording to file is not in progress."),
    "ResumeRecording": (True, "Resume recording failed: recording to file is already in progress."),
}
_STOP = "StopRecording"
#: {command: its method}; and attributes of which Plus needs one
_METHODS = {
    "GetUsParameter": "_get", "SetUsParameter": "_set", "GetTransform": "_transform", "Version": "_version",
    "RequestChannelIds": "_ids", "RequestDeviceIds": "_ids", **dict.fromkeys((*_RECORDING_ERRORS, _STOP), "_record"),
}  # fmt: skip
_NEEDS = {"_transform": ("TransformName",), "_record": ("CaptureDeviceId", "ChannelId")}
#: Commands of a client that are remembered: one that comes again is ignored
_RECENT = 10
_FAILED, _FAILED_IDS = "Command failed. See error message.", "Command failed, see error message."
#: Id, name, encoding and length of a command before its text
_COMMAND = struct.Struct(">I128sHI")
_ASCII, _UTF8 = 3, 106


@dataclass(frozen=True)
class _Reply:
    """The answer to a command, before it is a message."""

    message: str = ""
    #: Why the command failed; None if it did not
    error: str | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    #: The XML of the reply, instead of one with the message, and what older clients get in place of the message
    content: str | None = None
    old: str | None = None

    @property
    def status(self) -> str:
        return "SUCCESS" if self.error is None else "FAIL"


class PlusCommands:
    """The commands of one device.

    Parameters
    ----------
    preset : the preset of now, and the pixels of its images.
    change : called with another preset; raises SimulationError if it cannot be used.
    transforms : {"ProbeToReference": (4, 4), ...} of now.
    recorder : None: nothing can be recorded.
    """

    def __init__(
        self, preset: Callable[[], tuple[Preset, ImageGrid]], change: Callable[[Preset], None],
        transforms: Callable[[], Mapping[str, np.ndarray]], recorder: Recorder | None = None,
    ) -> None:  # fmt: skip
        self._preset, self._change, self._transforms, self._recorder = preset, change, transforms, recorder

    def session(self) -> Answer:
        """What answers the messages of one client."""
        recent: deque[int] = deque(maxlen=_RECENT)
        return lambda message: self._answer(message, recent)

    def _answer(self, message: Message, recent: deque[int]) -> list[Message]:
        if message.kind == "COMMAND":
            uid, name, text = command_of(message.content)
        else:
            number = re.match(r"\s*[-+]?\d+", message.device.partition("_")[2])
            if number is None:
                return [_string("ACK", "FAIL", "Malformed DeviceName. Expected CMD_cmdId (ex: CMD_001)")]
            uid, text = int(number[0]), _string_of(message.content)
            parsed = _parsed(text)
            name = "?" if parsed is None else parsed.get("Name", "")
        if uid in recent:
            _log.warning("command %d was received before, and is ignored", uid)
            return []
        recent.append(uid)
        if not name or not text:
            return []
        reply, xml_name = self._executed(name, text)
        _log.info("command %s: %s %s", name, reply.status, reply.error or reply.message)
        if message.kind != "COMMAND":
            if not xml_name:
                return [_string(message.device.partition("_")[0], "FAIL", "Error attempting to process command.")]
            return [_string(f"ACK_{uid}", reply.status, reply.old or reply.content or reply.message)]
        metadata = {**reply.metadata, "Status": reply.status}
        error = ""
        if reply.error is not None:
            metadata["Error"], error = reply.error, f' Error="{_encoded(reply.error)}"'
        content = reply.content
        if content is None:
            metadata["Message"] = reply.message
            said = f'Status="{reply.status}"{error} Message="{_encoded(reply.message)}"'
            content = f'<CommandReply Name="{_encoded(xml_name)}" {said}></CommandReply>'
        body = command_content(uid, xml_name, content)
        return [Message("RTS_COMMAND", message.device, body, dict(sorted(metadata.items())))]

    def _executed(self, name: str, text: str) -> tuple[_Reply, str]:
        """(reply, name in the XML); without a name for what is no command."""
        element, method = _parsed(text), _METHODS.get(name, "")
        unknown = _Reply("", "Unknown command type requested."), ""
        if element is None or not method or not any(map(element.get, _NEEDS.get(method, ("Name",)))):
            return unknown
        given = element.get("Name", "")
        found = next((known for known in _METHODS if known.lower() == given.lower()), "")
        if _METHODS.get(found) != method:
            return unknown
        device = element.get("UsDeviceId", "")
        if method in ("_get", "_set") and device not in ("", ULTRASOUND):
            return _Reply(_FAILED, f"Device {device} is not found."), given
        return getattr(self, method)(found, element), given

    # ---- imaging parameters ------------------------------------------------------------------------------------

    def _get(self, _: str, element: ElementTree.Element) -> _Reply:
        (preset, grid), found = self._preset(), []
        for name, _value in _parameters(element):
            value = parameter_text(preset, grid, name)
            wrong = f"{name} is not set. " if name in KNOWN else f"Invalid parameter {name}. "
            found.append((name, wrong if value is None else "", value))
        return _parameter_reply(found, True)

    def _set(self, _: str, element: ElementTree.Element) -> _Reply:
        wanted = {name: value for name, value in _parameters(element) if value is not None}
        errors = {name: self._set_one(name, value) for name, value in sorted(wanted.items())}
        return _parameter_reply(
            [(name, error, "FAIL" if error else "SUCCESS") for name, error in errors.items()], False
        )

    def _set_one(self, name: str, value: str) -> str:
        """An error, or ""."""
        if name not in KNOWN:
            return f"Invalid parameter {name}. "
        try:
            self._change(changed_parameter(self._preset()[0], name, value))
        except ValueError:
            return f"Failed to parse {name}.{'' if name == 'TimeGainCompensation' else ' '}"
        except SimulationError as error:
            _log.warning("%s", error)
            return f"Failed to set {name}. "
        return ""

    # ---- what there is -----------------------------------------------------------------------------------------

    def _ids(self, name: str, element: ElementTree.Element) -> _Reply:
        devices = [ULTRASOUND, CAPTURE] if self._recorder is not None else [ULTRASOUND]
        if name == "RequestChannelIds":
            return _Reply(CHANNEL, metadata={CHANNEL: CHANNEL})
        kind = element.get("DeviceType", "")
        if kind and kind not in _TYPES:
            return _Reply(_FAILED_IDS, "Unknown device type requested.")
        found = [device for device in devices if not kind or device == _TYPES[kind]]
        return _Reply(",".join(found), metadata={device: device for device in found})

    def _transform(self, _: str, element: ElementTree.Element) -> _Reply:
        name = element.get("TransformName", "")
        base, known = f"GetTransform ({name})", self._transforms()
        try:
            matrix = TrackedSequence(np.zeros((1, 0, 0), np.uint8), (known,), np.zeros(1)).pose(0, name)
        except SimulationError:
            return _Reply(_FAILED, f"{base} Failed. Transform not found.")
        persistent = "true" if name.startswith("ImageTo") and name in known else "false"
        values = " ".join(f"{value:g}" for value in matrix.ravel())
        metadata = {name: values, "persistent": persistent, "date": "", "error": "-1"}
        old = f'{base}<name="{name}" value="{values}" persistent="{persistent}" date="" error="-1"/>'
        return _Reply(f"{base} Command successful.", metadata=metadata, old=old)

    def _version(self, _: str, element: ElementTree.Element) -> _Reply:
        versions = {"PlusVersion": f"SlicerUSSim {__version__}", "IGTLProtocolVersion": "3", "IGTLHeaderVersion": "2"}
        return _Reply("Success.", metadata=versions)

    # ---- recording ---------------------------------------------------------------------------------------------

    def _record(self, name: str, element: ElementTree.Element) -> _Reply:
        device, channel, file = (element.get(key, "") for key in ("CaptureDeviceId", "ChannelId", "OutputFilename"))
        recorder = self._recorder
        if recorder is None or (device != CAPTURE if device else channel != CHANNEL):
            return _Reply(_FAILED, f"VirtualCapture has not been found ({device or channel}), {name}")
        base = f"VirtualCapture ({CAPTURE}) {name} "
        is_true = {key: element.get(key, "").lower() == "true" for key in ("EnableCompression", "PauseOnStart")}
        try:
            if name == _STOP:
                if recorder.count == 0:
                    return _Reply(_FAILED, f"{base}No frames to record.")
                path, count = recorder.stop(file)
                return _Reply(f"{base}Recording {count} frames successful to file {path}")
            wrong, reason = _RECORDING_ERRORS[name]
            if recorder.is_recording == wrong:
                return _Reply(_FAILED, f"{base}{reason}")
            if name == "StartRecording":
                recorder.start(file, compress=is_true["EnableCompression"], paused=is_true["PauseOnStart"])
            else:
                recorder.pause(name == "SuspendRecording")
        except SimulationError as error:
            _log.warning("%s", error)
            opened = f"Failed to open file {file or '(undefined)'}."
            return _Reply(_FAILED, f"{base}{f'Failed to finalize file: {file}' if name == _STOP else opened}")
        return _Reply(f"{base}successful.")


def command_content(uid: int, name: str, text: str) -> bytes:
    """The content of COMMAND and RTS_COMMAND."""
    encoding = _ASCII if text.isascii() else _UTF8
    encoded = text.encode()
    return _COMMAND.pack(uid, name.encode()[:127], encoding, len(encoded)) + encoded


def command_of(content: bytes) -> tuple[int, str, str]:
    """(id, name, text) of COMMAND and RTS_COMMAND. Raises struct.error for a content that is too short."""
    uid, name, _, length = _COMMAND.unpack_from(content)
    text = content[_COMMAND.size : _COMMAND.size + length]
    return uid, name.split(b"\0")[0].decode(errors="replace"), text.decode(errors="replace").rstrip("\0")


def _string(device: str, status: str, message: str) -> Message:
    """A reply to an older client."""
    text = f'<CommandReply Status="{status}" Message="{_encoded(message)}" />'
    encoded = text.encode()
    return Message("STRING", device, struct.pack(">HH", _ASCII if text.isascii() else _UTF8, len(encoded)) + encoded)


def _string_of(content: bytes) -> str:
    _, length = struct.unpack_from(">HH", content)
    return content[4 : 4 + length].decode(errors="replace").rstrip("\0")


def _parsed(text: str) -> ElementTree.Element | None:
    """The element of a command; None for another text."""
    if "<!DOCTYPE" in text:  # whose entities can grow without end
        return None
    try:
        element = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError):
        return None
    return element if element.tag.lower() == "command" else None


def _parameters(element: ElementTree.Element) -> list[tuple[str, str | None]]:
    """(name, value) of the parameters in a command."""
    found = [child for child in element if child.tag.lower() == "parameter"]
    return [(child.get("Name", ""), child.get("Value")) for child in found if child.get("Name")]


def _parameter_reply(found: Sequence[tuple[str, str, str | None]], has_values: bool) -> _Reply:
    """The reply of GetUsParameter and SetUsParameter to (name, error or "", value in the metadata)."""
    content = "".join(
        f'<Parameter Name="{_encoded(name)}" Success="{"false" if error else "true"}"'
        + (f' Value="{value}"/>' if has_values and value is not None else "/>")
        for name, error, value in found
    )
    metadata = {name: value for name, _, value in found if value is not None}
    errors = "".join(error for _, error, _ in found)
    return _Reply("", errors or None, metadata, f"<CommandReply>{content}</CommandReply>")


def _encoded(text: str) -> str:
    """A text as the value of an attribute."""
    return escape(text, {'"': "&quot;", "'": "&apos;"})
