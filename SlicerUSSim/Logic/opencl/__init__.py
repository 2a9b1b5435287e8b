"""OpenCL: available devices, the choice of one, its programs and buffers.

`layout` declares the structs and constants shared by host and kernels.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .device import Device as Device, DeviceChoice as DeviceChoice, Workspace as Workspace
    from .devices import DeviceInfo as DeviceInfo, choose_device as choose_device, list_devices as list_devices
    from .layout import CONSTANTS as CONSTANTS

lazy_exports(globals())
