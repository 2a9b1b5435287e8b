"""What fits equally well, without a simulation: draws along lines of equal Var, spreads, and the combinations."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import DisplaySettings, TissueTable
from SlicerUSSim.Logic.fitting.identifiability import (
    Identifiability,
    Spread,
    equal_variance_draws,
    quantities_of,
    variance_db,
)
from SlicerUSSim.Logic.fitting.parameters import FreeParameters
from SlicerUSSim.Logic.tissue.presets import TISSUES

DISPLAY = DisplaySettings(gain_db=3.0, dynamic_range_db=60.0, tgc_db_cm_mhz=0.4)
TISSUES_OF_BRAIN = TissueTable({1: TISSUES["csf"], 2: TISSUES["grey matter"], 3: TISSUES["white matter"]})


def drawn(free, count=12, best=None, seed=0):
    """(tissue of the best, tissues of the draws, parameters, draws)"""
    parameters = FreeParameters.of(free, TISSUES_OF_BRAIN, DISPLAY)
    best = parameters.units(TISSUES_OF_BRAIN, DISPLAY) if best is None else np.array(best)
    draws = equal_variance_draws(parameters, best, TISSUES_OF_BRAIN, DISPLAY, np.random.default_rng(seed), count)

    def white(units):
        return parameters.apply(units, TISSUES_OF_BRAIN, DISPLAY)[0].tissue("white matter")

    return white(best), [white(units) for units in draws], parameters, draws


# ---- solutions of equal variance -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_draws_have_the_variance_of_the_best_and_otherwise_differ(seed):
    best, tissues, parameters, draws = drawn(["white matter", "gain_db"], seed=seed)
    assert len(draws) == 12
    assert [variance_db(tissue) for tissue in tissues] == pytest.approx([variance_db(best)] * 12, abs=0.06)
    assert np.std([tissue.mu1 for tissue in tissues]) > 0.2
    assert np.std([tissue.mu0 / tissue.sigma0 for tissue in tissues]) > 0.2
    # What does not scatter does not change.
    for name in ("gain_db", "white matter.attenuation_db_cm_mhz"):
        place = parameters.names.index(name)
        assert len({units[place] for units in draws}) == 1


def test_draws_keep_within_bounds_that_no_other_mixture_reaches():
    """With mu0 and sigma0 held to a few percent, most values of mu1 would change Var: those are not drawn."""
    free = {"white matter.mu0": (0.32, 0.34), "white matter.sigma0": (0.14, 0.16), "white matter.mu1": (-1.0, 1.5)}
    best, tissues, _, draws = drawn(free)
    assert 0 < len(draws) <= 12
    for tissue, units in zip(tissues, draws, strict=True):
        assert variance_db(tissue) == pytest.approx(variance_db(best), abs=0.06)
        assert ((units >= 0) & (units <= 1)).all()
        assert 0.32 <= tissue.mu0 <= 0.34 and 0.14 <= tissue.sigma0 <= 0.16


# ---- spreads ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("low", "high", "was_tested", "answer"),
    [
        (-0.1, 0.1, True, True),
        (-0.1, 0.1, False, None),
        (-0.1, 0.11, True, False),
        (-0.1, 0.11, False, False),
        (0.05, 0.05, True, True),
    ],
)
def test_a_quantity_is_determined_if_all_and_a_restart_agree(low, high, was_tested, answer):
    spread = Spread("mu0", "", 0.05, low, high, 0.0, 0.0, 0.1, was_tested)
    assert spread.is_determined is answer


def spreads_of(as_good, again, free=("white matter", "display")):
    parameters = FreeParameters.of(free, TISSUES_OF_BRAIN, DISPLAY)
    best = parameters.units(TISSUES_OF_BRAIN, DISPLAY)
    quantities = quantities_of(parameters, 5.0, TISSUES_OF_BRAIN)

    def state_of(units):
        return parameters.apply(np.asarray(units), TISSUES_OF_BRAIN, DISPLAY)

    def moved(**changes):
        units = best.copy()
        for name, value in changes.items():
            place = next(n for n, p in enumerate(parameters) if p.attribute == name)
            units[place] = parameters[place].unit(value)
        return units

    found = Identifiability.of(
        quantities, state_of, best, [moved(**c) for c in as_good], [moved(**c) for c in again], 3, 0.01
    )
    return found, {p.name: v for p, v in zip(parameters, parameters.values(best), strict=True)}


def test_a_spread_holds_the_best_what_was_met_and_what_restarts_found():
    found, _ = spreads_of([{"gain_db": 1.0}, {"gain_db": 4.0}], [{"gain_db": 6.0}, {"gain_db": 3.0}])
    gain = found["gain_db"]
    assert (gain.value, gain.low, gain.high) == pytest.approx((3.0, 1.0, 6.0))
    assert gain.mean == pytest.approx(4.0) and gain.standard_deviation == pytest.approx(np.sqrt(3.0))
    assert gain.was_tested and found.solutions == 4 and (found.restarts_as_good, found.restarts) == (2, 3)
    assert gain.is_determined is False and found["dynamic_range_db"].is_determined is True


def test_without_a_restart_as_good_there_is_no_mean_and_json_says_null():
    found, _ = spreads_of([{"gain_db": 3.5}], [])
    assert np.isnan(found["gain_db"].mean) and found["gain_db"].is_determined is None
    written = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    (row,) = [row for row in written["spreads"] if row["name"] == "gain_db"]
    assert row["mean"] is None and row["standard_deviation"] is None and row["high"] == pytest.approx(3.5)
    assert (written["solutions"], written["restarts_as_good"], written["restarts"]) == (1, 0, 3)


# ---- combinations ----------------------------------------------------------------------------------------------------


def test_combinations_are_what_the_documentation_says_of_them():
    found, _ = spreads_of([], [{}])
    white, grey = TISSUES["white matter"], TISSUES["grey matter"]
    var = variance_db(white)
    share = white.scatterer_share
    assert var == pytest.approx(10 * np.log10(share * (1 - share) * white.mu0**2 + share * white.sigma0**2), abs=1e-6)
    for name, value in (
        ("net attenuation in white matter", 2 * 5.0 * (white.attenuation_db_cm_mhz - 0.4)),
        ("Var of white matter", var),
        ("Var of white matter re grey matter", var - variance_db(grey)),
        ("Var of white matter with gain", var + 3.0),
    ):
        assert found[name].value == pytest.approx(value), name


def test_combinations_stay_where_their_parts_trade_off():
    """More attenuation with more TGC, half the amplitude with 6 dB of gain: each moves, the combination does not."""
    white = TISSUES["white matter"]
    faded = {
        "attenuation_db_cm_mhz": white.attenuation_db_cm_mhz + 0.3, "tgc_db_cm_mhz": 0.7, "mu0": 0.5 * white.mu0,
        "sigma0": 0.5 * white.sigma0, "gain_db": 3.0 + 20 * np.log10(2.0),
    }  # fmt: skip
    found, _ = spreads_of([], [faded])
    still = ("net attenuation in white matter", "Var of white matter with gain")
    for name in (*still, "grey level of white matter at the face"):
        spread = found[name]
        assert spread.high - spread.low == pytest.approx(0.0, abs=1e-6) and spread.is_determined, name
    for name in ("gain_db", "tgc_db_cm_mhz", "white matter.attenuation_db_cm_mhz", "Var of white matter"):
        assert found[name].is_determined is False, name


def test_grey_level_at_the_face_is_that_of_the_display():
    """10 dB more are 10 / 60 of the grey levels of a display of 60 dB."""
    loud, plain = (
        quantities_of(FreeParameters.of(["gain_db"], TISSUES_OF_BRAIN, DISPLAY), 5.0, TISSUES_OF_BRAIN)[-1].of(
            TISSUES_OF_BRAIN, replace(DISPLAY, gain_db=gain)
        )
        for gain in (13.0, 3.0)
    )
    assert loud - plain == pytest.approx(255.0 * 10.0 / 60.0)


def test_combinations_are_of_what_scatters_and_is_free():
    """CSF is silent: nothing is compared with it, and a tissue without scatterers has a level that can be printed."""
    silent = replace(TISSUES["csf"], mu0=0.0, sigma0=0.0)
    assert variance_db(silent) == -200.0

    def names(*free):
        return [
            q.name for q in quantities_of(FreeParameters.of(free, TISSUES_OF_BRAIN, DISPLAY), 5.0, TISSUES_OF_BRAIN)
        ]

    alone = names("white matter")
    assert "Var of white matter re grey matter" in alone and not [name for name in alone if "csf" in name]
    both = names("white matter.mu0", "grey matter.mu0")  # two tissues are compared once
    assert [name for name in both if " re " in name] == ["Var of white matter re grey matter"]
    assert not [name for name in both if "with gain" in name or "net attenuation" in name]
    with_tgc = names("white matter.mu0", "tgc_db_cm_mhz")
    assert [name for name in with_tgc if "net attenuation" in name] == ["net attenuation in white matter"]


def test_what_was_not_free_of_a_tissue_is_not_called_determined():
    """Net attenuation changes with TGC alone where the tissue's attenuation is as given."""
    for free, is_fitted in (("white matter.mu0", False), ("white matter.attenuation_db_cm_mhz", True)):
        found, _ = spreads_of([], [{}], free=(free, "tgc_db_cm_mhz"))
        spread = found["net attenuation in white matter"]
        assert spread.is_fitted is is_fitted and spread.is_determined is (True if is_fitted else None)
        (row,) = [row for row in found.to_dict()["spreads"] if row["name"] == spread.name]
        assert (row["is_fitted"], row["is_determined"]) == (is_fitted, spread.is_determined)
