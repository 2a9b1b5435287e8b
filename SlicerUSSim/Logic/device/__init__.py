"""A virtual ultrasound device: a simulator behind OpenIGTLink, with the commands of PlusServer and its recordings."""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .virtual_device import VirtualDevice as VirtualDevice

lazy_exports(globals())
