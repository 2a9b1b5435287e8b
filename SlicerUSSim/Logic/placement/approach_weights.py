"""ApproachWeights: weights in the comparison of approaches; a separate module, for fast --help."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from SlicerUSSim.Logic.base.declaration import Declared, parameter

#: What every list of candidates says
NO_ADVICE = "A simulation for research and teaching, and no medical advice."


def _weight(default: float, label: str, tip: str) -> Any:
    option = f"{label.lower().replace(' ', '-')}-weight"
    return parameter(default, f"Weight: {label.lower()}", tip, unit="mm", bounds=(0, 1000), option=option)


@dataclass(frozen=True)
class ApproachWeights(Declared):
    """Weights of the cost by which plan_approach ranks candidates, each in millimetres of brain that are as bad."""

    brain_weight: float = _weight(1.0, "Brain", "Each millimetre of brain before the target")
    outside_weight: float = _weight(0.5, "Outside", "Each millimetre of skin, scalp and bone")
    ventricle_weight: float = _weight(5.0, "Ventricle", "Each millimetre of fluid that is 15 mm below the surface")
    vessel_weight: float = _weight(5.0, "Vessel", "Each millimetre of a vessel, or of what enhances")
    air_weight: float = _weight(10.0, "Air", "Each millimetre of air in the head, such as a sinus")
    angle_weight: float = _weight(0.2, "Angle", "Each degree between probe and normal of the brain's surface")
    unseen_weight: float = _weight(2.0, "Unseen", "Each percent of the target outside of the field")
    unfocused_weight: float = _weight(0.05, "Unfocused", "Each percent of the target outside of the focal zone")
