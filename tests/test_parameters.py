"""Free parameters: names, bounds, and the conversion between search positions, tissues and display."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import DisplaySettings, SimulationError, TissueTable
from SlicerUSSim.Logic.fitting.parameters import TISSUE_BOUNDS, FreeParameters, all_names

TISSUES, DISPLAY = TissueTable.brain(), DisplaySettings()


def of(free) -> FreeParameters:
    return FreeParameters.of(free, TISSUES, DISPLAY)


def test_groups_stand_for_all_of_their_own():
    # The others are on request only: they compete with attenuation, or with each other
    together = ["gain_db", "dynamic_range_db", "tgc_db_cm_mhz", "near_gain_db", "noise_db"]
    assert of(["display"]).names == together and of("tgc_reach").names == ["tgc_reach"]
    assert of(["White-Matter"]).names == [f"white matter.{name}" for name in TISSUE_BOUNDS]
    assert of(["gain_db", "leptomeninges.mu0"]).names == ["gain_db", "leptomeninges.mu0"]
    assert of("gain_db").names == ["gain_db"]
    mixed = of({"display": None, "gain_db": (-3, 3)})
    assert len(mixed) == len(together) and (mixed[0].low, mixed[0].high) == (-3.0, 3.0)


def test_bounds_are_those_of_the_documentation():
    """docs/optimization.md says them in words."""
    expected = {
        "gain_db": (-30, 30), "dynamic_range_db": (30, 90), "tgc_db_cm_mhz": (0, 1.2),
        "near_gain_db": (-40, 10), "noise_db": (-120, -30),
        "white matter.attenuation_db_cm_mhz": (0.1, 1.2), "white matter.mu0": (0.02, 1.5),
        "white matter.mu1": (-1, 1.5), "white matter.sigma0": (0.02, 1),
    }  # fmt: skip
    assert {p.name: (p.low, p.high) for p in of(["display", "white matter"])} == expected


@given(st.lists(st.floats(0, 1), min_size=9, max_size=9))
def test_positions_and_values_are_inverse(units):
    parameters = of(["display", "white matter"])
    tissues, display = parameters.apply(np.array(units), TISSUES, DISPLAY)
    assert np.allclose(parameters.units(tissues, display), units, atol=1e-9)
    values = parameters.values(np.array(units))
    assert np.allclose(parameters.current(tissues, display), values)
    for parameter, value in zip(parameters, values, strict=True):
        assert parameter.low <= value <= parameter.high


@given(st.floats(-1, 2), st.floats(-1, 2))
def test_positions_outside_are_moved_to_the_nearest_bound(a, b):
    parameters = of({"gain_db": (-10, 10), "white matter.mu0": (0.1, 0.5)})
    tissues, display = parameters.apply(np.array([a, b]), TISSUES, DISPLAY)
    assert -10 <= display.gain_db <= 10 and 0.1 <= tissues[3].mu0 <= 0.5


def test_other_parameters_stay_as_they_are():
    tissues, display = of(["white matter.mu0"]).apply(np.array([0.5]), TISSUES, DISPLAY)
    assert display == DISPLAY and tissues[2] == TISSUES[2] and tissues.membrane == TISSUES.membrane
    assert tissues[3].sigma0 == TISSUES[3].sigma0 and tissues[3].mu0 != TISSUES[3].mu0


def test_tissues_stands_for_those_with_scatterers():
    names = [f"{tissue}.{name}" for tissue in ("grey matter", "white matter", "leptomeninges")
             for name in ("echogenicity_db", "attenuation_db_cm_mhz")]  # fmt: skip
    assert of(["tissues"]).names == names
    assert set(of(["display", "tissues"]).names) <= set(all_names(TISSUES))


@given(st.floats(-11, 11))
def test_echogenicity_is_var_and_keeps_the_ratio_of_mu0_and_sigma0_and_mu1(change):
    parameters = of(["white matter.echogenicity_db"])
    level = 10.0 * np.log10(TISSUES[3].scatterer_variance) + change
    tissues, _ = parameters.apply(np.array([(change + 12.0) / 24.0]), TISSUES, DISPLAY)
    found, before = tissues[3], TISSUES[3]
    assert 10.0 * np.log10(found.scatterer_variance) == pytest.approx(level)
    assert found.mu0 / found.sigma0 == pytest.approx(before.mu0 / before.sigma0) and found.mu1 == before.mu1
    assert parameters.current(tissues, DISPLAY) == pytest.approx([level])
    assert parameters.varied() == {"white matter": {"mu0", "sigma0"}}


def test_no_noise_starts_at_the_lowest_level():
    parameters = of(["noise_db"])
    assert parameters.units(TISSUES, DisplaySettings(noise_db=None)).tolist() == [0.0]


@pytest.mark.parametrize(
    "free, message",
    [
        ([], "no free parameter"),
        (["brightness"], "no free parameter 'brightness', expected display, tissues, gain_db"),
        (["white matter.speed_of_sound_m_s"], "no free parameter 'white matter.speed_of_sound_m_s'"),
        (["liver.mu0"], "no free parameter 'liver.mu0'"),
        (["csf.echogenicity_db"], "csf.echogenicity_db cannot be free: csf has no scatterers"),
        (
            ["white matter.echogenicity_db", "white matter.mu0"],
            "white matter.echogenicity_db is free together with white matter.mu0, expected one or the other",
        ),
        ({"gain_db": (3, -3)}, "bounds of gain_db are 3.0 to -3.0, expected two numbers, the smaller one first"),
        ({"gain_db": (0, float("nan"))}, "the smaller one first"),
        ({"gain_db": 5}, "bounds of gain_db are 5, expected two numbers"),
        ({"dynamic_range_db": (-5, 60)}, "dynamic_range_db is -5.0"),
    ],
)
def test_what_is_not_a_parameter_or_no_range_is_refused_in_one_line(free, message):
    with pytest.raises(SimulationError) as caught:
        of(free)
    assert message in str(caught.value) and "\n" not in str(caught.value)
