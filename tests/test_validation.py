"""Every row of the validation, its phantoms, and its sensitivity to wrong physics."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from validation import phantoms, run
from validation.__main__ import main
from validation.checks import ORIENTATIONS, PROBES, Outcome, Row
from validation.measurement import echo_near, fit_rayleigh, full_width, level_db
from validation.phantoms import Echo
from validation.run import all_checks, validate

#: Checks that take longer than some seconds
_LONG = ("beams behind cysts", "beams in folds", "beams in heads", "beams past strong tissue", "compounded angles",
         "compounding", "curved mirrors", "cyst contrast", "flanks and lines", "flat layers", "frequency downshift",
         "harmonic", "oblique walls", "planes along diagonals", "planes in small maps", "planes with edges",
         "range distortion", "rayleigh", "refraction", "reverberation", "rough planes", "rough sheets",
         "slice thickness", "small curved walls", "sparse speckle", "speckle correlation", "speckle everywhere",
         "speckle statistics", "steered lines", "thickness of sheets", "thin sulci", "turned planes", "uneven tissue",
         "walls and lines", "walls near ends", "wires and cysts")  # fmt: skip
#: Those of them that the tests have aligned and oblique alone, and the whole validation diagonal, too: of speckle and
#: beams in tissue whose steps of voxels echo nothing, of sheets re smooth ones in the same voxels, and of planes and
#: walls that the check itself turns in their voxels
_IN_TWO = ("beams behind cysts", "beams in folds", "beams past strong tissue", "compounding", "cyst contrast",
           "flanks and lines", "flat layers", "frequency downshift", "planes along diagonals", "planes in small maps",
           "planes with edges", "rough sheets", "slice thickness", "small curved walls", "sparse speckle",
           "speckle correlation", "speckle everywhere", "thin sulci", "uneven tissue")  # fmt: skip
#: Every check in its orientations once: the quick tests have the oblique one of all but the long checks
CASES = [
    pytest.param(
        check,
        orientation,
        id=f"{check.name}-{orientation}",
        marks=[] if orientation == "oblique" and check.name not in _LONG else [pytest.mark.slow],
    )
    for check in all_checks()
    for orientation in check.orientations
    if orientation != "diagonal" or check.name not in _IN_TWO
]


def test_the_checks_that_take_long_are_some_of_all():
    assert set(_IN_TWO) < set(_LONG) < {check.name for check in all_checks()}


@pytest.mark.parametrize(("check", "orientation"), CASES)
def test_theory_and_simulation_agree(check, orientation):
    outcome = check.measure(ORIENTATIONS[orientation], None)
    assert outcome.rows
    off = [
        f"{row.quantity}: {row.measured:.5g}, predicted {row.predicted:.5g} ({row.limits})"
        for row in outcome.rows
        if not row.passed
    ]
    assert not off, "; ".join(off)


def test_everything_the_specification_names_has_a_check_in_three_orientations():
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
        ("at most", 10.4, True),
        ("at most", -90.0, True),
        ("at most", 10.6, False),
        ("at least", 9.6, True),
        ("at least", 90.0, True),
        ("at least", 9.4, False),
        ("at least", float("nan"), False),
    ],
)
def test_a_row_passes_only_inside_its_tolerance(kind, measured, passed):
    assert Row("x", "mm", 10.0, measured, 0.5, kind).passed is passed


@given(
    st.sampled_from(["within", "at most", "at least"]),
    st.floats(-100, 100),
    st.floats(-100, 100),
    st.floats(0.01, 10),
)
def test_the_strain_of_a_row_is_above_one_just_where_it_fails(kind, predicted, measured, tolerance):
    row = Row("x", "", predicted, measured, tolerance, kind)
    if row.passed:
        assert row.strain <= 1.0 + 1e-9
    else:
        assert row.strain >= 1.0


@pytest.mark.parametrize("kind", ["within", "at most", "at least"])
def test_an_echo_that_was_not_there_is_farther_from_its_limit_than_any_other(kind):
    assert Row("x", "", 10.0, float("nan"), 0.5, kind).strain == float("inf")


# ---- wrong physics is noticed ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("check", "wrong"),
    [
        ("attenuation and time", {"reference_speed_m_s": 1560.0}),
        ("mirroring", {"reflections": False}),
        pytest.param("curved mirrors", {"reflection_spreading": False}, marks=pytest.mark.slow),
        pytest.param("reverberation", {"max_ray_depth": 1}, marks=pytest.mark.slow),
        ("interface width", {"elevational_rays": 1}),
        ("specular echoes", {"interface_reflection": "energy"}),
        pytest.param("slice thickness", {"beam_cutoff": 0.8}, marks=pytest.mark.slow),
        ("speckle statistics", {"scatterers_per_mm3": 4.0}),
        pytest.param("speckle correlation", {"beam_cutoff": 0.6}, marks=pytest.mark.slow),
    ],
)
def test_wrong_physics_fails_the_check_of_its_phenomenon(monkeypatch, check, wrong):
    """The same measurement on a simulator in which the phenomenon of the check is missing or wrong."""

    class Distorted(UltrasoundSimulator):
        def __init__(self, labels, tissues, settings=None, device=None):
            super().__init__(labels, tissues, replace(settings or SimulationSettings(), **wrong), device)

    (chosen,) = (c for c in all_checks() if c.name == check)
    for module in ("artefacts", "beams", "rays", "speckle"):
        monkeypatch.setattr(f"validation.{module}.UltrasoundSimulator", Distorted)
    assert not all(row.passed for row in chosen.measure(ORIENTATIONS["aligned"], None).rows)


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
    good = next(check for check in all_checks() if check.name == "thin sheet")

    def off(rotation, device):
        return Outcome((replace(good.measure(rotation, device).rows[0], predicted=2.0),))

    monkeypatch.setattr(run, "all_checks", lambda: (replace(good, measure=off),))
    result = CliRunner().invoke(main, ["--out", str(tmp_path)])
    assert result.exit_code == 1
    assert "out of limits: thin sheet, fraction of rays that hit it, linear, oblique: 1" in result.output
    assert json.loads((tmp_path / "report.json").read_text())["passed"] is False
    assert "**FAIL**" in (tmp_path / "report.md").read_text()


def test_the_command_exits_with_zero_when_all_is_well_and_two_for_a_wrong_name(tmp_path):
    assert CliRunner().invoke(main, ["--out", str(tmp_path), "--only", "thin sheet"]).exit_code == 0
    result = CliRunner().invoke(main, ["--out", str(tmp_path), "--only", "gravity"])
    assert result.exit_code == 2 and "check is 'gravity', expected part of" in result.stderr


@pytest.mark.slow
def test_the_command_replaces_only_its_own_reports(tmp_path):
    def run_it(*only):
        return CliRunner().invoke(main, ["--out", str(tmp_path), *(f"--only={text}" for text in only)])

    assert run_it("thin sheet").exit_code == 0
    (picture,) = tmp_path.glob("*.png")
    assert run_it("sub-voxel").exit_code == 0
    assert run_it("thin sheet").exit_code == 0  # its picture is known, also after a run of other checks
    table = tmp_path / "report.md"
    table.write_text(table.read_text() + "checked by hand")
    result = run_it("thin sheet")
    assert result.exit_code == 2 and f"{table}: exists and is not as this command wrote it" in result.stderr
    assert table.read_text().endswith("by hand") and picture.exists()


def test_a_report_that_cannot_be_written_is_one_clear_error(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(SimulationError, match="taken: cannot be created"):
        validate(tmp_path / "taken", only=["thin sheet"])


# ---- phantoms and measurements --------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("orientation", ORIENTATIONS)
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
def test_phantoms_echo_from_where_they_say(make, orientation):
    phantom = make(ORIENTATIONS[orientation])
    # Only the bar echoes by its scatterers; a bright grain beside another object is no error.
    is_bar = phantom.name == "thin rod"
    settings = SimulationSettings(scatterers_per_mm3=300.0, reflections=False, scattering=is_bar)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, settings)
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


def test_the_rayleigh_fit_finds_sigma_and_refuses_what_is_no_rayleigh():
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


def test_silence_has_a_level_that_json_can_hold():
    assert level_db(np.zeros(10)) == -300.0
