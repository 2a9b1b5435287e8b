"""The public interface. Names are imported when first used, so that importing this package costs nothing."""

from __future__ import annotations

import importlib

_HOMES = {
    "AppearanceResult": "optimization",
    "ConvexProbe": "probe",
    "DisplaySettings": "settings",
    "Frame": "frame",
    "LinearProbe": "probe",
    "Membrane": "tissues",
    "PhasedProbe": "probe",
    "Preset": "preset",
    "Segmentation": "segmentation",
    "SimulationError": "errors",
    "SimulationSettings": "settings",
    "Texture": "texture",
    "Tissue": "tissues",
    "TissueTable": "tissues",
    "TrackedSequence": "sequence",
    "UltrasoundSimulator": "simulator",
    "Volume": "volume",
    "list_devices": "device",
    "optimize_appearance": "optimization",
    "segment_mri": "segmentation",
    "similarity": "similarity",
}
__all__ = list(_HOMES)


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
