"""ReusedSimulator: one simulator for as long as its voxels stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import SimulationSettings, Texture, TissueTable
from SlicerUSSim.Logic.imaging.reuse import ReusedSimulator
from tests.conftest import FLUID, SPECKLE, block

LABELS = block(lambda x, y, z: np.ones_like(x), (5, 5, 5))
TABLE = TissueTable({0: FLUID, 1: SPECKLE})
SETTINGS = SimulationSettings()


def test_what_needs_no_other_voxels_keeps_the_simulator():
    reused = ReusedSimulator()
    first = reused.get(1, LABELS, TABLE, SETTINGS)
    assert reused.get(1, LABELS, TABLE, SETTINGS) is first
    bright = TABLE.replace("speckle", mu0=0.9)
    seeded = replace(SETTINGS, seed=5, reflections=False)
    assert reused.get(1, LABELS, bright, seeded) is first
    assert first.medium.tissues == bright and first.settings == seeded


def test_other_voxels_need_another_simulator():
    reused, known = ReusedSimulator(), Texture.from_mri(LABELS.with_array(LABELS.array.astype(float)), LABELS)
    seen = [reused.get(1, LABELS, TABLE, SETTINGS)]
    for version, texture, settings in (
        (2, None, SETTINGS),
        (2, known, SETTINGS),
        (2, known, replace(SETTINGS, partial_volume=False)),
        (2, known, replace(SETTINGS, mri_modulation_db=2.0)),
    ):
        seen.append(reused.get(version, LABELS, TABLE, settings, texture=texture))
        assert seen[-1] is not seen[-2] and seen[-1].settings == settings
    reused.forget()
    assert reused.get(2, LABELS, TABLE, settings, texture=known) is not seen[-1]


@pytest.mark.parametrize("partial_volume", [False, True])
def test_each_setting_of_the_texture_needs_another_simulator(partial_volume):
    """One setting changes at a time."""
    reused, known = ReusedSimulator(), Texture.from_mri(LABELS.with_array(LABELS.array.astype(float)), LABELS)
    before = replace(SETTINGS, partial_volume=partial_volume, mri_modulation_db=1.0)
    for change in ({"mri_modulation_db": 2.0}, {"partial_volume": not partial_volume}):
        first = reused.get(1, LABELS, TABLE, before, texture=known)
        assert reused.get(1, LABELS, TABLE, before, texture=known) is first
        assert reused.get(1, LABELS, TABLE, replace(before, **change), texture=known) is not first
