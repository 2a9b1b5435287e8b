"""Craniotomies off the head."""

from __future__ import annotations

import json

import numpy as np
import pytest

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.placement.craniotomy import file_opening, opened
from tests.conftest import block


@pytest.mark.parametrize("what", ["mask", "curve"])
def test_a_craniotomy_off_the_head_is_refused_in_one_line(tmp_path, what):
    names = ("white matter", "skull", "scalp")
    radius = (70.0, 76.0, 84.0)
    head = block(
        lambda x, y, z: np.select([np.sqrt(x**2 + y**2 + z**2) < r for r in radius], [1, 2, 3], 0),
        half_mm=(90, 90, 90), spacing_mm=4.0,
    )  # fmt: skip
    if what == "mask":
        path, words = tmp_path / "mask.nii.gz", "is empty, or lies outside of the patient"
        Volume(np.ones((5, 5, 5), np.uint8), np.eye(4) + 400.0 * np.eye(4, k=3)).write(path)
    else:
        path, words = tmp_path / "curve.mrk.json", "there is no brain under the craniotomy"
        points = [{"position": [x + 400.0, y, 78.0]} for x, y in ((-20, -20), (20, -20), (20, 20), (-20, 20))]
        markup = {"type": "ClosedCurve", "coordinateSystem": "RAS", "coordinateUnits": "mm", "controlPoints": points}
        path.write_text(json.dumps({"markups": [markup]}))
    with pytest.raises(SimulationError, match=words) as error:
        opened(head, names, file_opening(head, names, str(path)))
    assert "\n" not in str(error.value)
