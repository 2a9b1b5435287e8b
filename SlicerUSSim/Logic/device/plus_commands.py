"""PlusCommands: answers commands of OpenIGTLink clients, such as SlicerOpenIGTLink's, as PlusServer does.

Texts and names are from PlusLib (src/PlusServer and vtkPlusUsImagingParameters, 2.9), which answers COMMAND by
RTS_COMMAND. FocusDepthMm is this device's own.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable, Mapping
from threading import Lock
from types import MappingProxyType
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.device.recorder import Recorder
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

_log = logging.getLogger(__name__)

#: IDs as in the configuration files of Plus
ULTRASOUND, CAPTURE, CHANNEL = "VideoDevice", "CaptureDevice", "TrackedVideoStream"
#: {type that clients ask for: its device}
_TYPES = {"UsSimulator": ULTRASOUND, "VirtualCapture": CAPTURE, "VirtualVolumeReconstructor": ""}
#: {name: (section, field, the field's value at 0, its change by 1)}; the gain as on the panel's slider
_NUMBERS = {
    "DepthMm": ("probe", "depth_mm", 0.0, 1.0), "FrequencyMhz": ("probe", "frequency_mhz", 0.0, 1.0),
    "FocusDepthMm": ("probe", "focus_mm", 0.0, 1.0), "DynRangeDb": ("display", "dynamic_range_db", 0.0, 1.0),
    "GainPercent": ("display", "gain_db", -40.0, 0.8),
}  # fmt: skip
_FOCUS, _TGC = "FocusDepthPercent", "TimeGainCompensation"
#: Parameters of Plus that this device does not have
_NOT_SET = ["Intensity", "Contrast", "PowerDb", "SectorPercent", "ZoomFactor", "Voltage", "SoundVelocity", "ImageSize"]
#: Id, name, encoding and length of a command before its text
_COMMAND, _ASCII = struct.Struct(">I128sHI"), 3


class _Reply(NamedTuple):
    """The answer to a command, before it is a message."""

    message: str = ""
    #: Why the command failed; "" if it did not
    error: str = ""
    metadata: Mapping[str, str] = MappingProxyType({})
    #: The XML of the reply, instead of one with the message
    content: Element | None = None


class PlusCommands:
    """The commands of one device.

    Parameters
    ----------
    preset : the preset of now.
    change : called with another preset; raises SimulationError if it cannot be used.
    transforms : {"ProbeToReference": (4, 4), ...} of now.
    recorder : None: nothing can be recorded.
    """

    def __init__(
        self, preset: Callable[[], Preset], change: Callable[[Preset], None],
        transforms: Callable[[], Mapping[str, np.ndarray]], recorder: Recorder | None = None,
    ) -> None:  # fmt: skip
        self._preset, self._change, self._transforms, self._recorder = preset, change, transforms, recorder
        self._lock = Lock()
        self._commands: dict[str, Callable[[Element], _Reply]] = {
            "GetUsParameter": self._get, "SetUsParameter": self._set, "GetTransform": self._transform,
            "RequestDeviceIds": self._device_ids, "RequestChannelIds": lambda command: _ids([CHANNEL]),
            "StartRecording": self._record, "StopRecording": self._record,
        }  # fmt: skip

    def answer(self, command: bytes) -> tuple[bytes, Mapping[str, str]] | None:
        """(content, metadata) of the reply to a COMMAND's; None if it is empty. Raises struct.error for half of one."""
        uid, padded, _, length = _COMMAND.unpack_from(command)
        name = padded.split(b"\0")[0].decode(errors="replace")
        text = command[_COMMAND.size : _COMMAND.size + length].decode(errors="replace").rstrip("\0")
        if not name or not text:
            return None
        element, execute = _parsed(text), self._commands.get(name)
        if element is None or execute is None or element.get("Name", "").lower() != name.lower():
            name, reply = "", _Reply(error="Unknown command type requested.")
        else:
            try:
                with self._lock:  # each client has a thread
                    reply = execute(element)
            except SimulationError as error:
                reply = _Reply("Command failed. See error message.", str(error))
        said = {"Status": "FAIL", "Error": reply.error} if reply.error else {"Status": "SUCCESS"}
        _log.info("command %s: %s %s", name, said["Status"], reply.error or reply.message)
        content, metadata = reply.content, {**reply.metadata, **said}
        if content is None:
            content = Element("CommandReply", {"Name": name, **said, "Message": reply.message})
            metadata["Message"] = reply.message
        body = ElementTree.tostring(content, "us-ascii", short_empty_elements=False)
        return _COMMAND.pack(uid, name.encode(), _ASCII, len(body)) + body, dict(sorted(metadata.items()))

    def _get(self, command: Element) -> _Reply:
        asked, known, content, errors = _asked(command), _parameters(self._preset()), Element("CommandReply"), ""
        for name in asked:
            if name in known:
                SubElement(content, "Parameter", Name=name, Success="true", Value=known[name])
            else:
                SubElement(content, "Parameter", Name=name, Success="false")
                errors += f"{name} is not set. " if name in _NOT_SET else f"Invalid parameter {name}. "
        return _Reply(error=errors, metadata={name: known[name] for name in asked if name in known}, content=content)

    def _set(self, command: Element) -> _Reply:
        errors = {name: self._set_one(name, value) for name, value in sorted(_asked(command).items())}
        content = Element("CommandReply")
        for name, error in errors.items():
            SubElement(content, "Parameter", Name=name, Success="false" if error else "true")
        metadata = {name: "FAIL" if error else "SUCCESS" for name, error in errors.items()}
        return _Reply(error="".join(errors.values()), metadata=metadata, content=content)

    def _set_one(self, name: str, text: str) -> str:
        """An error, or ""."""
        try:
            self._change(_changed(self._preset(), name, text))
        except KeyError:
            return f"Invalid parameter {name}. "
        except ValueError:
            return f"Failed to parse {name}.{'' if name == 'TimeGainCompensation' else ' '}"
        except SimulationError as error:
            _log.warning("%s", error)
            return f"Failed to set {name}. "
        return ""

    def _device_ids(self, command: Element) -> _Reply:
        kind = command.get("DeviceType", "")
        if kind and kind not in _TYPES:
            return _Reply("Command failed, see error message.", "Unknown device type requested.")
        here = [ULTRASOUND] if self._recorder is None else [ULTRASOUND, CAPTURE]
        return _ids([device for device in here if not kind or device == _TYPES[kind]])

    def _transform(self, command: Element) -> _Reply:
        name, no_image = command.get("TransformName", ""), np.zeros((1, 0, 0), np.uint8)
        try:
            matrix = TrackedSequence(no_image, (self._transforms(),), np.zeros(1)).pose(0, name)
        except SimulationError:
            raise SimulationError(f"GetTransform ({name}) Failed. Transform not found.") from None
        values, is_constant = " ".join(f"{value:g}" for value in matrix.ravel()), name == "ImageToProbe"
        metadata = {name: values, "persistent": str(is_constant).lower(), "date": "", "error": "-1"}
        return _Reply(f"GetTransform ({name}) Command successful.", metadata=metadata)

    def _record(self, command: Element) -> _Reply:
        keys = "Name", "CaptureDeviceId", "ChannelId", "OutputFilename"
        name, device, channel, file = (command.get(key, "") for key in keys)
        asked, begin = device or channel or "auto-detect", f"VirtualCapture ({CAPTURE}) {name} "
        recorder = self._recorder if asked in (CAPTURE, CHANNEL) else None
        recorder = required(recorder, f"VirtualCapture has not been found ({asked}), {name}")
        if name.lower() == "stoprecording":
            path, count = recorder.stop()
            require(count, f"{begin}No frames to record.")
            return _Reply(f"{begin}Recording {count} frames successful to file {path}")
        require(not recorder.is_recording, f"{begin}Recording to file is already in progress.")
        try:
            recorder.start(file)
        except SimulationError as error:
            _log.warning("%s", error)
            raise SimulationError(f"{begin}Failed to open file {file or '(undefined)'}.") from None
        return _Reply(f"{begin}successful.")


def _parsed(text: str) -> Element | None:
    """The element of a command; None for another text."""
    if "<!DOCTYPE" in text:  # whose entities can grow without end
        return None
    try:
        element = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError):
        return None
    return element if element.tag.lower() == "command" else None


def _asked(command: Element) -> dict[str, str]:
    """{name: value or ""} of the parameters in a command. Raises SimulationError if they name another device."""
    device = command.get("UsDeviceId", "")
    require(device in ("", ULTRASOUND), f"Device {device} is not found.")
    found = [child for child in command if child.tag.lower() == "parameter"]
    return {child.get("Name", ""): child.get("Value", "") for child in found}


def _ids(names: list[str]) -> _Reply:
    return _Reply(",".join(names), metadata={name: name for name in names})


def _parameters(preset: Preset) -> dict[str, str]:
    """{name: text, as Plus writes it} of all that this device has."""
    numbers = {
        name: (getattr(getattr(preset, section), field) - start) / step
        for name, (section, field, start, step) in _NUMBERS.items()
    }
    numbers[_FOCUS] = 100.0 * numbers["FocusDepthMm"] / numbers["DepthMm"]
    gains = [getattr(preset.display, f"depth_gain_{slider}_db") for slider in range(1, 9)]
    compensation = f"{gains[0]:g} {0.5 * (gains[3] + gains[4]):g} {gains[7]:g} "  # face, middle, and image depth
    return {**{name: f"{value:g}" for name, value in numbers.items()}, _TGC: compensation}


def _changed(preset: Preset, name: str, text: str) -> Preset:
    """A preset with one of these parameters changed.

    Raises KeyError for an unknown one, ValueError for a text without a number, or without three of them for
    TimeGainCompensation, and SimulationError for a value that is out of range, and for one of _NOT_SET.
    """
    require(name not in _NOT_SET, f"{name} cannot be changed in this device")
    values = [float(part) for part in text.split()]
    if name == _TGC:
        face, middle, depth = values
        gains = np.interp(range(1, 9), (1, 4, 5, 8), (face, middle, middle, depth)).tolist()
        return preset.changed("display", **{f"depth_gain_{slider}_db": gain for slider, gain in enumerate(gains, 1)})
    (value,) = values
    if name == _FOCUS:
        name, value = "FocusDepthMm", 0.01 * value * preset.probe.depth_mm
    section, field, start, step = _NUMBERS[name]
    return preset.changed(section, **{field: start + step * value})
