"""Every row of the validation, its phantoms, and its sensitivity to wrong physics."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from validation import phantoms, run
from validation.__main__ import main
from validation.checks import ORIENTATIONS, PROBES, Outcome, Row
from validation.measurement import echo_near, fit_rayleigh, full_width
from validation.phantoms import Echo
from validation.run import all_checks, validate

#: A cheap check of each phenomenon; side lobes and aberration have separate tests (test_side_lobes, test_aperture)
_QUICK = (
    "attenuation and time", "echo level", "mirroring", "refraction and reflectance", "resolution", "speckle coherence",
)  # fmt: skip
#: Further ones of a few seconds. `python -m validation` runs all checks in all orientations, before a release.
_SLOW = (
    "echogenicity", "elevational tilt", "energy", "focal zones", "interface width", "range distortion", "refraction",
    "ring-down", "shadow and enhancement", "sheets", "specular echoes", "speckle statistics", "sub-voxel interfaces",
    "thin sheet", "total reflection",
)  # fmt: skip
CHECKS = {check.name: check for check in all_checks()}


@pytest.mark.parametrize("name", [*_QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in _SLOW)])
def test_theory_and_simulation_agree(name):
    outcome = CHECKS[name].measure(ORIENTATIONS["oblique"], None)
    assert outcome.rows
    off = [
        f"{row.quantity}: {row.measured:.5g}, predicted {row.predicted:.5g} ({row.limits})"
        for row in outcome.rows
        if not row.passed
    ]
    assert not off, "; ".join(off)


def test_every_check_has_its_own_name_and_three_orientations():
    for check in all_checks():
        # Views of heads have random orientations.
        assert set(check.orientations) == set(ORIENTATIONS) or check.name == "beams in heads"
    assert len({check.name for check in all_checks()}) == len(all_checks())


@pytest.mark.parametrize(
    ("kind", "measured", "passed"),
    [
        ("within", 10.4, True),
        ("within", 9.4, False),
        ("within", float("nan"), False),
        ("at most", -90.0, True),
        ("at most", 10.6, False),
        ("at least", 90.0, True),
        ("at least", 9.4, False),
        ("at least", float("nan"), False),
    ],
)
def test_a_row_passes_only_inside_its_tolerance(kind, measured, passed):
    assert Row("x", "mm", 10.0, measured, 0.5, kind).passed is passed


# ---- wrong physics is noticed ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("check", "wrong"),
    [
        ("attenuation and time", {"reference_speed_m_s": 1560.0}),
        ("mirroring", {"reflections": False}),
        ("interface width", {"elevational_rays": 1}),
        ("specular echoes", {"interface_reflection": "energy"}),
        ("speckle statistics", {"scatterers_per_mm3": 4.0}),
    ],
)
def test_wrong_physics_fails_the_check_of_its_phenomenon(monkeypatch, check, wrong):
    """The same measurement on a simulator in which the phenomenon of the check is missing or wrong."""

    class Distorted(UltrasoundSimulator):
        def __init__(self, labels, tissues, settings=None, device=None):
            super().__init__(labels, tissues, replace(settings or SimulationSettings(), **wrong), device)

    for module in ("artefacts", "beams", "rays", "speckle"):
        monkeypatch.setattr(f"validation.{module}.UltrasoundSimulator", Distorted)
    assert not all(row.passed for row in CHECKS[check].measure(ORIENTATIONS["aligned"], None).rows)


# ---- the report -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_report_holds_every_row_and_its_pictures(tmp_path):
    report = validate(tmp_path / "out", only=["sub-voxel", "thin sheet", "shadow"])
    assert not report.failed
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written["passed"] is True and len(written["rows"]) == len(report.findings)
    assert {row["orientation"] for row in written["rows"]} == set(ORIENTATIONS)
    table = (tmp_path / "out" / "report.md").read_text()
    assert (
        table.count("| pass |") == len(report.findings)
        and "| [thin sheet](#thin-sheet) | 9 | 9 |" in table
        and "FAIL" not in table
    )
    assert report.pictures == ("sub-voxel-interfaces.png", "thin-sheet.png", "shadow-and-enhancement.png")
    for picture in report.pictures:
        assert (tmp_path / "out" / picture).stat().st_size > 10_000 and f"({picture})" in table


def test_the_command_says_what_is_off_and_exits_with_one(tmp_path, monkeypatch):
    good = CHECKS["thin sheet"]

    def off(rotation, device):
        return Outcome((replace(good.measure(rotation, device).rows[0], predicted=2.0),))

    monkeypatch.setattr(run, "all_checks", lambda: (replace(good, measure=off),))
    result = CliRunner().invoke(main, ["--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "out of limits: thin sheet, fraction of rays that hit it, linear, oblique: 1" in result.output
    assert json.loads((tmp_path / "report.json").read_text())["passed"] is False
    assert "**FAIL**" in (tmp_path / "report.md").read_text()


def test_the_command_exits_with_zero_if_all_is_well_two_for_a_wrong_name(tmp_path):
    assert CliRunner().invoke(main, ["--out", str(tmp_path), "--only", "thin sheet"]).exit_code == 0
    result = CliRunner().invoke(main, ["--out", str(tmp_path), "--only", "gravity"])
    assert result.exit_code == 2 and "check is 'gravity', expected part of" in result.stderr


@pytest.mark.slow
def test_the_command_replaces_a_report_only_with_overwrite(tmp_path):
    def run_it(*options):
        return CliRunner().invoke(main, ["--out", str(tmp_path), *options])

    assert run_it("--only=thin sheet").exit_code == 0
    result = run_it("--only=sub-voxel")
    assert result.exit_code == 2 and "exists; give another name, or --overwrite to replace it" in result.stderr
    assert list(tmp_path.glob("*.png")) and run_it("--only=sub-voxel", "--overwrite").exit_code == 0


def test_a_report_that_cannot_be_written_is_one_clear_error(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(SimulationError, match="taken: cannot be created"):
        validate(tmp_path / "taken", only=["thin sheet"])


# ---- phantoms and measurements --------------------------------------------------------------------------------------


@settings(max_examples=10)
@given(st.tuples(*[st.floats(-90, 90)] * 3))
def test_a_rotated_phantom_has_the_same_size_and_a_rigid_pose(angles):
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    turned = phantoms.thin_rod(rotation, width_mm=3.0)
    np.testing.assert_allclose(turned.probe_to_ras[:3, :3], rotation)
    # The grid holds more of the bar than the box that it has to hold, so only a part of it is measured.
    ijk = np.argwhere(turned.labels.array == 1)[:, ::-1]
    along = (np.c_[ijk, np.ones(len(ijk))] @ turned.labels.ijk_to_ras.T)[:, :3] @ rotation
    inside = abs(along[:, 0]) < 10.0
    voxel = turned.labels.spacing_mm.prod()
    assert inside.sum() * voxel == pytest.approx(20.0 * 3.0 * 3.0, rel=0.06)
    assert abs(along[:, 1] - 30.0).max() < 1.51 and abs(along[:, 2]).max() < 1.51


def test_a_rotation_that_is_none_is_refused():
    with pytest.raises(SimulationError, match="rotation is not rigid"):
        phantoms.mirror(2.0 * np.eye(3))
    with pytest.raises(SimulationError, match=r"rotation has shape \(2, 2\)"):
        phantoms.mirror(np.eye(2))


@pytest.mark.parametrize(
    "make",
    [
        phantoms.voxel_sphere,
        phantoms.voxel_sheet,
        phantoms.thin_rod,
        lambda rotation: phantoms.layered([phantoms.FLUID, phantoms.STEEL], [21.0], rotation),
    ],
    ids=["sphere", "sheet", "rod", "layers"],
)
def test_phantoms_echo_from_where_they_say(make):
    phantom = make(ORIENTATIONS["oblique"])
    # Only the bar echoes by its scatterers; a bright grain beside another object is not an error.
    is_bar = phantom.name == "thin rod"
    chosen = SimulationSettings(scatterers_per_mm3=300.0, reflections=False, scattering=is_bar)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, chosen)
    for probe in PROBES.values():
        frame = simulator.simulate(probe, phantom.probe_to_ras)
        (echo,) = phantom.expected(probe)
        # Both faces of a sheet, a voxel apart, echo alike; the brightest grain of a bar can be anywhere in 1.2 mm.
        tolerance = {"voxel sheet": 1.1, "thin rod": 0.9}.get(phantom.name, 0.3)
        assert echo_near(frame, probe, echo.shown_mm, 1.5)[1] == pytest.approx(echo.shown_mm[1], abs=tolerance)


@pytest.mark.parametrize("probe", PROBES.values(), ids=PROBES)
def test_refraction_between_equal_speeds_displaces_nothing(probe):
    phantom = phantoms.refracting_wedge(speeds_m_s=(1540.0, 1540.0))
    for echo in phantom.expected(probe):
        assert isinstance(echo, Echo)
        away = np.subtract(echo.object_mm, echo.shown_mm)
        assert np.linalg.norm(away) == pytest.approx(0.6, abs=1e-6)  # the wire's radius: its front is what echoes


def test_the_rayleigh_fit_finds_sigma_and_refuses_other_distributions():
    rng = np.random.default_rng(0)
    fit = fit_rayleigh(rng.rayleigh(3.0, 400_000))
    top = 255.0 / 3.0  # grey levels per unit, times the largest of that many samples
    assert fit.sigma == pytest.approx(3.0 * top / np.sqrt(2 * np.log(400_000)), rel=0.1)
    assert fit.sse < 1e-5
    assert fit_rayleigh(np.abs(rng.normal(1.0, 0.1, 100_000))).sse > 1e-3


@given(st.floats(0.3, 3.0), st.floats(-2.0, 2.0))
def test_the_width_of_a_gaussian_is_found_wherever_it_lies(sigma, centre):
    x = np.linspace(-12, 12, 2001)
    assert full_width(x, np.exp(-((x - centre) ** 2) / (2 * sigma**2))) == pytest.approx(2.3548 * sigma, rel=1e-3)
