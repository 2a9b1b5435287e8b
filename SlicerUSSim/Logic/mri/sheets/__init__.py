"""Thin sheets and small structures of the head that classes of intensity do not show, from a patient's MRI."""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .finding import ALL_KINDS as ALL_KINDS, STRUCTURES as STRUCTURES, Sheets as Sheets, find_sheets as find_sheets

lazy_exports(globals())
