"""The kernels against the same model in plain numpy, and the devices of this computer against each other."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationError,
    SimulationSettings,
    Texture,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    list_devices,
    seed_of_pose,
)
from SlicerUSSim.Logic.imaging import bmode, medium, noise, raytracing
from SlicerUSSim.Logic.mri.sheets import Surfels
from SlicerUSSim.Logic.opencl.layout import ACQUISITION, CONSTANTS
from SlicerUSSim.Logic.probe.arrays import PROBES as STANDARD_PROBES
from SlicerUSSim.Logic.tissue.tissue import Membrane
from tests import reference as numpy_model
from tests.conftest import block, rigid
from tests.reference import NumpyModel
from tests.reference.acquisition import (
    acquisition_record,
    axial_sigma_mm,
    elevational_quantiles,
    line_roots,
    noise_key,
    pulse_taps,
    stratum_centres,
)
from tests.test_raytracing import RIB_TISSUES, rib

FLUID = Tissue("fluid", 1520, 1.52, 0.0, 0.0, 0.0, 0.0)
BRAIN = Tissue("brain", 1546, 1.60, 0.5, 0.3, 0.0, 0.15)
STONE = Tissue("stone", 2600, 3.5, 1.0, 0.5, 0.3, 0.3)
PROBES = {
    "linear": LinearProbe(24, 30, scan_lines=48, frequency_mhz=5),
    "convex": ConvexProbe(20, 60, 30, scan_lines=48, frequency_mhz=4),
    "phased": PhasedProbe(70, 30, scan_lines=48, frequency_mhz=5),
}


def scene(membrane: bool = True):
    """(labels, tissues): brain with a cyst, a stone and, if there is a membrane, a thin bent sulcus in it, in fluid."""

    def label(x, y, z):
        brain = np.where(np.hypot(x, np.hypot(y - 14, z)) < 17, 1, 0)
        brain = np.where(np.hypot(x + 5, np.hypot(y - 10, z)) < 4, 2, brain)
        bent = np.abs(np.hypot(x + 6, y - 28) - 14.3 + 0.2 * z) < 0.8
        brain = np.where(membrane & bent & (brain == 1) & (np.hypot(x, np.hypot(y - 14, z)) < 14), 4, brain)
        return np.where(np.hypot(x - 7, np.hypot(y - 16, z)) < 3, 3, brain)

    tissues = {0: FLUID, 1: BRAIN, 2: FLUID, 3: STONE}
    pia = Tissue("pia", 1546, 1.60, 0.6, 0.9, 0.0, 0.5)
    skin = Membrane(pia, 1.0, ("fluid", "pia")) if membrane else None
    if membrane:
        tissues[4] = pia
    return block(label, half_mm=(22, 34, 12)), TissueTable(tissues, membrane=skin)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k != "linear")) for k in PROBES])
@pytest.mark.parametrize(
    "turn",
    [np.eye(3), pytest.param([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], marks=pytest.mark.slow)],
)
def test_the_kernels_draw_what_numpy_draws(kind, turn):
    labels, tissues = scene()
    simulator = UltrasoundSimulator(labels, tissues)
    pose, display = rigid(turn, [1.0, -4.0, 0.5]), DisplaySettings(noise_db=-30.0, tgc_reach=0.6, image_size=(240, 200))
    seed = seed_of_pose(pose)
    image = simulator.simulate(PROBES[kind], pose, display, noise_seed=seed).image
    model = NumpyModel(simulator)
    difference = np.abs(image.astype(int) - model.simulate(PROBES[kind], pose, display, noise_seed=seed))
    assert image.max() > 100
    assert (difference <= 1).mean() > 0.97  # a ray that just grazes a voxel may go the other way: a line of 48
    assert set(model.timings_ms) >= {
        "ray tree", "scatterers", "interfaces", "beam", "pulse", "B-mode", "scan conversion"
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", [0.0, 25.0])
def test_numpy_meets_the_sheets_that_were_found(turn_deg):
    """A falx that has a coherent echo and an oblique sulcus, beside the sheets of the labels."""
    labels, tissues = scene()
    across = np.stack(np.meshgrid(np.arange(-9.0, 9.0, 0.7), np.arange(-9.0, 9.0, 0.7)), -1).reshape(-1, 2)
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    place = np.stack([across[:, 0], 9.3 + sine * across[:, 0], across[:, 1]], axis=1)
    normal = np.tile([-sine, cosine, 0.0], (len(place), 1))
    falx = Surfels.of("falx", place, normal, 0.7, 0.9, 0.5)
    sulcus = Surfels.of("sulcus", place + [0.0, 8.0, 0.0], normal, 1.2, 0.6, 0.5)
    simulator = UltrasoundSimulator(labels, tissues, sheets=Surfels.joined([falx, sulcus]))
    pose, display = rigid(np.eye(3), [1.0, -4.0, 0.5]), DisplaySettings(image_size=(240, 200))
    image = simulator.simulate(PROBES["linear"], pose, display).image
    model = NumpyModel(simulator)
    difference = np.abs(image.astype(int) - model.simulate(PROBES["linear"], pose, display))
    assert (difference <= 1).mean() > 0.97
    plain = UltrasoundSimulator(labels, tissues).simulate(PROBES["linear"], pose, display).image
    assert (np.abs(image.astype(int) - plain) > 10).mean() > 0.03  # the sheets are in it
    tree = simulator.tracer.download()
    assert (tree.hits["label_before"] == tree.hits["label_behind"]).any() or turn_deg > 0.0


@pytest.mark.slow
def test_beams_that_a_thin_layer_splits_are_as_wide_as_in_numpy():
    """A layer along the beams, of another speed of sound: their intensity has lobes."""
    turned = Rotation.from_euler("xyz", [25.0, -35.0, 15.0], degrees=True)

    def label(x, y, z):
        across, along, _ = np.tensordot(turned.as_matrix().T, np.stack(np.broadcast_arrays(x, y, z)), 1)
        return (np.abs(across - 2.0 - 0.1 * along) < 0.8).astype(int)

    layer = replace(BRAIN, name="layer", speed_of_sound_m_s=1504.5)
    settings = SimulationSettings(interfaces=False)
    simulator = UltrasoundSimulator(
        block(label, half_mm=(20, 20, 20), spacing_mm=0.8), TissueTable({0: BRAIN, 1: layer}), settings
    )
    probe, pose = replace(PROBES["convex"], frequency_mhz=5), rigid(turned.as_matrix(), [0.0, -18.0, 0.0])
    display = DisplaySettings(image_size=(240, 200))
    image = simulator.simulate(probe, pose, display).image
    difference = np.abs(image.astype(int) - NumpyModel(simulator).simulate(probe, pose, display))
    assert image.max() > 100
    assert (difference <= 1).mean() > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROBES)
def test_numpy_follows_beams_through_and_past_strong_tissue(kind):
    """A plate that does not bend, stone behind it, and both beside open parts of the aperture."""

    def label(x, y, z):
        plate = np.where((y > 8) & (y < 10.5) & (x > -8) & (x < 1), 2, 1)
        return np.where((y > 15) & (y < 16.5) & (x > 2) | (y > 18) & (y < 20) & (x > -7) & (x < -1), 3, plate)

    gristle = Tissue("gristle", 1700, 2.4, 1.5, 0.4, 0.1, 0.2)
    tissues = TissueTable({0: BRAIN, 1: BRAIN, 2: gristle, 3: STONE})
    simulator = UltrasoundSimulator(block(label, half_mm=(22, 34, 12)), tissues)
    pose, display = rigid(np.eye(3), [1.0, -4.0, 0.5]), DisplaySettings(image_size=(240, 200))
    image = simulator.simulate(PROBES[kind], pose, display).image
    difference = np.abs(image.astype(int) - NumpyModel(simulator).simulate(PROBES[kind], pose, display))
    assert image.max() > 100
    assert (difference <= 1).mean() > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROBES)
@pytest.mark.parametrize("attenuations", [(4.0, 1.9), (12.0, 7.0)])
def test_numpy_follows_beams_past_lossy_tissue(kind, attenuations):
    """Plates before parts of the aperture, in which pieces end or not; with borders of their own and without."""

    def label(x, y, z):
        plates = np.where((y > 6) & (y < 9.5) & (x > -8) & (x < 0), 2, 1)
        return np.where((y > 13) & (y < 17) & (x > 2) | (y > 19) & (y < 21) & (x > -7) & (x < -1), 3, plates)

    lossy = [replace(BRAIN, name=f"{db} dB", attenuation_db_cm_mhz=db) for db in attenuations]
    simulator = UltrasoundSimulator(
        block(label, half_mm=(22, 34, 12)), TissueTable(dict(enumerate([BRAIN, BRAIN, *lossy])))
    )
    pose, display = rigid(np.eye(3), [1.0, -4.0, 0.5]), DisplaySettings(image_size=(240, 200))
    image = simulator.simulate(PROBES[kind], pose, display).image
    difference = np.abs(image.astype(int) - NumpyModel(simulator).simulate(PROBES[kind], pose, display))
    assert image.max() > 100
    assert (difference <= 1).mean() > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["linear", "convex"])
def test_numpy_follows_beams_from_a_face_that_stands_in_bone(kind):
    """Its edges in marrow and bone: lines go through them, and what the rest of the aperture sees beside them."""

    def label(x, y, z):
        bone = (np.abs(x - 1.0) > 6) & (y < 3)
        return np.where(bone, np.where(y < -1, 2, 3), 1)

    marrow = replace(BRAIN, name="marrow", attenuation_db_cm_mhz=20.0)
    tissues = TissueTable({0: BRAIN, 1: BRAIN, 2: marrow, 3: STONE})
    simulator = UltrasoundSimulator(block(label, half_mm=(22, 34, 12)), tissues)
    pose, display = rigid(np.eye(3), [1.0, -4.0, 0.5]), DisplaySettings(image_size=(240, 200))
    image = simulator.simulate(PROBES[kind], pose, display).image
    difference = np.abs(image.astype(int) - NumpyModel(simulator).simulate(PROBES[kind], pose, display))
    assert image.max() > 100
    assert (difference <= 1).mean() > 0.97


@pytest.mark.slow
def test_numpy_spreads_what_a_rib_reflects_where_fat_meets_muscle():
    simulator = UltrasoundSimulator(rib(), TissueTable(dict(enumerate([RIB_TISSUES[0], *RIB_TISSUES]))))
    pose, display = rigid(np.eye(3), [1.0, -20.0, 0.5]), DisplaySettings(image_size=(240, 200))
    image = simulator.simulate(PROBES["linear"], pose, display).image
    expected = NumpyModel(simulator).simulate(PROBES["linear"], pose, display)
    assert (np.abs(image.astype(int) - expected) <= 1).mean() > 0.97
    shadow = np.s_[140:]  # where what the rib reflects is drawn
    assert image[shadow].max() > 30 and (np.abs(image.astype(int) - expected)[shadow] <= 1).mean() > 0.97


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        SimulationSettings(scattering=False, reflection_spreading=False),
        SimulationSettings(interfaces=False, seed=7, scatterers_per_mm3=10),
        SimulationSettings(interface_reflection="energy", max_ray_depth=2, reference_speed_m_s=1480),
    ],
)
def test_numpy_follows_the_settings(settings):
    labels, tissues = scene(membrane=False)
    simulator = UltrasoundSimulator(labels, tissues, settings)
    pose = rigid(np.eye(3), [0.0, -4.0, 0.0])
    frame = simulator.simulate(PROBES["convex"], pose)
    difference = np.abs(frame.image.astype(int) - NumpyModel(simulator).simulate(PROBES["convex"], pose))
    assert (difference <= 1).mean() > 0.99


def test_every_device_of_this_computer_draws_the_same_image():
    devices = list_devices()
    if len(devices) < 2:
        pytest.skip("one OpenCL device only")
    labels, tissues = scene()
    pose = rigid(np.eye(3), [0.0, -4.0, 0.0])
    images = [UltrasoundSimulator(labels, tissues, device=info).simulate(PROBES["phased"], pose).image
              for info in devices]  # fmt: skip
    for image in images[1:]:
        assert (np.abs(image.astype(int) - images[0]) <= 1).mean() >= 0.999


def test_numpy_has_no_texture_and_says_so():
    labels, tissues = scene()
    simulator = UltrasoundSimulator(labels, tissues)
    simulator.settings = SimulationSettings(mri_modulation_db=2.0)
    with pytest.raises(SimulationError, match="partial_volume and mri_modulation_db 0"):
        NumpyModel(simulator)


# ---- it shares nothing with what it checks ---------------------------------------------------------------------------

#: What files of the numpy model may take from the rooms of what they check: the simulator as the one who knows label
#: map, tissues, settings and the names of the stages; what a stage is; names and formats of records.
MAY_SHARE = {
    "imaging.found_sheets.found_sheets",  # which voxels have planes of given sheets; what is drawn there is checked
    "imaging.simulator.UltrasoundSimulator", "imaging.stage.HostFrame", "imaging.stage.Stage",
    "opencl.layout.ACQUISITION", "opencl.layout.CONSTANTS", "opencl.layout.HIT", "opencl.layout.SEGMENT",
    "opencl.layout.TISSUE",
}  # fmt: skip
#: Numbers of formats and codes, not of the model
MAY_SHARE_CONSTANTS = {"BLOCK", "MAX_TISSUES", "MEMBRANE_LABEL"}
#: What it reads of the simulator
MAY_READ = {"settings", "stages", "medium"}


def test_it_imports_nothing_of_what_it_checks():
    taken, constants, read = set(), set(), set()
    for path in Path(numpy_model.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                assert not any(alias.name.startswith("SlicerUSSim") for alias in node.names), path
            elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("SlicerUSSim.Logic."):
                module = str(node.module).removeprefix("SlicerUSSim.Logic.")
                taken |= {f"{module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Subscript) and ast.unparse(node.value) == "CONSTANTS":
                constants.add(ast.literal_eval(node.slice))
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("simulator", "self.simulator"):
                read.add(node.attr)
    assert {name for name in taken if name.split(".")[0] in ("imaging", "opencl")} == MAY_SHARE
    assert {name for name in taken if name.startswith("probe.arrays")} == {
        f"probe.arrays.{name}" for name in ("ConvexProbe", "LinearProbe", "PhasedProbe", "Probe")
    }
    assert constants <= MAY_SHARE_CONSTANTS
    assert read <= MAY_READ


def test_of_a_probe_it_reads_only_what_a_user_gives():
    fields = {name for probe in STANDARD_PROBES.values() for name in probe.to_dict()}
    folder = Path(numpy_model.__file__).parent
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "probe":
                assert node.attr in fields, f"{path.name}: probe.{node.attr}"


@pytest.mark.slow
def test_nothing_is_computed_on_the_device(small_image):
    """While the numpy model draws it, the device refuses to work."""
    assert small_image.max() > 100


# ---- record, lines, pulse and medium are those of the simulator ------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        SimulationSettings(),
        SimulationSettings(
            seed=77, reference_speed_m_s=1480, samples_per_cycle=6, interface_gain_db=31, lateral_rays=3
        ),
        SimulationSettings(reflections=False, scatterers_per_mm3=99, beam_cutoff=3.0, interface_reflection="energy"),
    ],
)
@pytest.mark.parametrize("name", STANDARD_PROBES)
def test_the_record_of_a_frame_follows_from_the_equations(name, settings):
    labels, tissues = scene()
    simulator = UltrasoundSimulator(labels, tissues, settings)
    pose = rigid(np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]), [1.0, -4.0, 0.5])
    probe = replace(STANDARD_PROBES[name], focus_mm=31.0, fractional_bandwidth=0.63)
    record, expected = (
        simulator.acquisition(probe, pose),
        acquisition_record(probe, pose, settings, NumpyModel(simulator).medium),
    )
    for field in ACQUISITION.names or ():
        close = 0.003 if field == "speckle_height_mm" else 1e-6  # two integrals, each over points of its own
        np.testing.assert_allclose(record[field], expected[field], rtol=close, atol=1e-5, err_msg=field)
    assert simulator.axial_sigma_mm(probe) == pytest.approx(axial_sigma_mm(probe, settings))
    np.testing.assert_allclose(raytracing.line_roots(record), line_roots(expected), atol=1e-5)
    traced, rays = int(record["traced_lines"]), int(record["elevational_rays"])
    np.testing.assert_allclose(raytracing.beam_quantiles(traced, rays), elevational_quantiles(traced, rays), atol=1e-5)
    np.testing.assert_allclose(raytracing.ray_centres(rays), stratum_centres(np.arange(rays), rays), atol=1e-5)
    assert noise.noise_key(record, 12345) == noise_key(expected, 12345)


@pytest.mark.parametrize("sigma", [0.3, 0.7, 2.0, 11.5])
def test_the_pulse_follows_from_the_equations(sigma):
    np.testing.assert_allclose(bmode.pulse_taps(sigma), pulse_taps(sigma), rtol=1e-5)


@pytest.mark.parametrize("has_shares", [False, True])
def test_the_medium_is_the_same_on_the_host(has_shares):
    labels, tissues = scene()
    texture = None
    if has_shares:
        rng, shape = np.random.default_rng(0), labels.array.shape
        second = rng.choice(np.unique(labels.array), shape).astype(np.uint8)
        nothing = np.zeros(shape, np.float32)
        texture = Texture(second, nothing, nothing, rng.uniform(0.0, 0.5, shape).astype(np.float32))
    simulator = UltrasoundSimulator(labels, tissues, texture=texture)
    found, model = simulator.medium, NumpyModel(simulator).medium
    shape, download = model.label.shape, found.device.download
    voxels = download(found.voxel_buffer, shape, np.uint16)
    assert np.array_equal(voxels & CONSTANTS["LABEL_MASK"], model.label)
    assert model.distance is not None
    off = np.abs((voxels >> 8).astype(int) - model.distance)
    # In steps of 1 / 58 sigma. Newton's method for layers amplifies the rounding of either side in single voxels
    assert off.max() <= 2 and np.count_nonzero(off) < 100 and np.count_nonzero(off > 1) <= 3
    planes = download(found.sheet_buffer, shape, np.uint32)
    sheets = model.sheets
    assert sheets is not None and found.sheet_label == sheets.label == 4 and sheets.is_thin.sum() > 500
    has_plane = sheets.gradient.any(axis=-1)
    assert np.array_equal(planes > 0, has_plane)
    beside, distance = planes >> 26, (planes >> 18 & 255).astype(int) - 128
    assert np.array_equal(beside[has_plane], sheets.beside[has_plane])
    # Of either sign, together with the gradient's
    assert np.abs(np.abs(distance) - 64.0 * np.abs(sheets.distance))[has_plane].max() <= 1.01
    assert np.array_equal(download(found.group_buffer, shape, np.uint8) & CONSTANTS["GROUP_MASK"], model.group)
    smooth = download(found.smooth_buffer, (found.smooth_groups, *shape), np.uint16)
    assert model.smooth_groups == found.smooth_groups
    assert np.abs(smooth.astype(int) - model.smooth).max() <= 2  # of 65535
    for name in found.rows.dtype.names or ():
        np.testing.assert_allclose(found.rows[name], model.rows[name], rtol=1e-6)


@pytest.mark.slow
def test_changed_tissues_are_taken_up():
    labels, tissues = scene()
    simulator = UltrasoundSimulator(labels, tissues)
    model, pose = NumpyModel(simulator), rigid(np.eye(3), [1.0, -4.0, 0.5])
    simulator.set_tissues(tissues.replace("brain", mu0=1.2, attenuation_db_cm_mhz=0.1))
    difference = np.abs(simulator.simulate(SMALL, pose).image.astype(int) - model.simulate(SMALL, pose))
    assert (difference <= 1).mean() > 0.99


# ---- so it notices what is wrong -------------------------------------------------------------------------------------

#: Quick in numpy, and everything about it counts: its aperture is fully open from 7.5 mm on
SMALL = ConvexProbe(20, 24, 18, scan_lines=24, frequency_mhz=4, aperture_mm=3.0)
WRONG_RECORDS = {
    "elevation_sigma": 1.1, "elevation_focus": 1.1, "elevation_rayleigh": 1.2, "transmit_sigma": 1.2,
    "transmit_focus": 1.2, "transmit_rayleigh": 1.3, "receive_sigma_min": 1.1, "receive_sigma_slope": 1.1,
    "speckle_scale": 1.05, "cell_mm": 1.01, "cycles_per_mm": 1.01, "sample_mm": 1.01, "line_spacing": 1.01,
    "first_line": 1.02, "apex_radius_mm": 1.05, "interface_gain": 1.3, "membrane_reach": 1.2, "beam_cutoff": 0.9,
    "reference_speed_m_s": 1.01, "frequency_mhz": 1.1, "specular_exponent": 10.0, "fractional_bandwidth": 2.0,
    "sheet_reach_mm": 1.3, "membrane_gain": 1.1, "membrane_exponent": 1.5, "membrane_phase": 3.0, "screen_step": 1.2,
    "fan_step": 1.3, "speckle_height_mm": 1.1,
}  # fmt: skip


SMALL_VIEW = (rigid(np.eye(3), [1.0, -4.0, 0.5]), DisplaySettings(noise_db=-30.0, image_size=(120, 60)))


@pytest.fixture(scope="module")
def small_image():
    """One image of the numpy model, drawn while the device refuses to do anything."""
    simulator = UltrasoundSimulator(*scene())

    def refused(*arguments, **options):
        raise AssertionError("the device was used")

    with pytest.MonkeyPatch.context() as patch:
        for name in ("run", "download", "upload", "write"):
            patch.setattr(simulator.device, name, refused)
        return NumpyModel(simulator).simulate(SMALL, *SMALL_VIEW, noise_seed=3)


@pytest.fixture(scope="module")
def compared(small_image):
    """The share of pixels of a new simulator within one grey level of one image of the numpy model."""
    labels, tissues = scene()

    def share() -> float:
        image = UltrasoundSimulator(labels, tissues).simulate(SMALL, *SMALL_VIEW, noise_seed=3).image
        return float((np.abs(image.astype(int) - small_image) <= 1).mean())

    return share


def test_the_small_image_is_as_in_numpy(compared):
    """But for single pixels of the membrane, whose distance is rounded to another step in a few voxels."""
    assert compared() > 0.998


@pytest.mark.parametrize("field", WRONG_RECORDS)
def test_a_wrong_value_in_the_record_is_noticed(compared, monkeypatch, field):
    right = UltrasoundSimulator.acquisition

    def wrong(self, probe, pose):
        record = right(self, probe, pose)
        record[field] *= WRONG_RECORDS[field]
        return record

    monkeypatch.setattr(UltrasoundSimulator, "acquisition", wrong)
    assert compared() < 0.99


def _moved_distance(right):
    def wrong(*arguments):
        distance, reach = right(*arguments)
        return np.roll(distance, 1, axis=2), reach

    return wrong


SHIFT = np.array([0.05, 0.0, 0.0, 0.0], np.float32)
WRONG_STEPS = {
    "pulse": (bmode, "pulse_taps", lambda right: lambda sigma: right(1.1 * sigma)),
    "rays across the beam": (raytracing, "beam_quantiles", lambda right: lambda *n: np.float32(0.7) * right(*n)),
    "places of lines": (
        raytracing,
        "line_roots",
        lambda right: lambda a: right(a) + SHIFT,
    ),
    "noise": (bmode, "noise_key", lambda right: lambda *n: right(*n) ^ 1),
    "smoothed indicators": (
        medium,
        "smoothed_indicators",
        lambda right: lambda d, g, n, p, f, m: right(d, g, n, {0}, f, m),
    ),
    "fluid distance": (medium.Medium, "_fluid_distance", _moved_distance),
}


@pytest.mark.parametrize("what", WRONG_STEPS)
def test_a_wrong_step_is_noticed(compared, monkeypatch, what):
    owner, name, spoil = WRONG_STEPS[what]
    monkeypatch.setattr(owner, name, spoil(getattr(owner, name)))
    assert compared() < 0.99


@pytest.mark.slow
def test_numpy_follows_a_plane_that_ends_beside_the_beam():
    """It is placed by samples away from its edge; those beyond it, where there is no border, were NaN once."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xz", [0.4, 0.3], degrees=True).as_matrix()
    matrix[:3, 3] = [0.0, 25.0, 0.0] - matrix[:3, :3] @ [40.0, 24.5, 32.0]
    index = np.stack(np.meshgrid(*[np.arange(n) for n in (72, 50, 80)], indexing="ij")[::-1], axis=-1)
    place = index @ matrix[:3, :3].T + matrix[:3, 3]
    array = 1 + ((place[..., 1] > 25.0) & (place[..., 2] < 20.0)).astype(np.uint8)
    front, back = Tissue("front", 1540.0, 1.60, 0.0), Tissue("back", 1540.0, 1.76, 0.0)
    simulator = UltrasoundSimulator(
        Volume(array, matrix), TissueTable({0: front, 1: front, 2: back}),
        SimulationSettings(scattering=False, specular_exponent=0.0),
    )  # fmt: skip
    probe = ConvexProbe(60.0, 30.0, 35.0, frequency_mhz=5.0, scan_lines=48)
    display = DisplaySettings(image_size=(160, 120))
    image = simulator.simulate(probe, np.eye(4), display).image.astype(int)
    expected = NumpyModel(simulator).simulate(probe, np.eye(4), display)
    assert image.max() > 200 and np.isfinite(expected).all()
    assert (np.abs(image - expected) <= 1).mean() > 0.998 and np.abs(image - expected).max() <= 8
