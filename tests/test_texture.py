"""Hybrid scatterers (docs/physics.md#hybrid-scatterers): tissues by probability, amplitudes that follow the MRI."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk
from click.testing import CliRunner
from scipy import ndimage
from scipy.spatial.transform import Rotation

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import (
    LinearProbe,
    SimulationError,
    SimulationSettings,
    Texture,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
)
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.probe import PROBES, craniotomy_pose
from SlicerUSSim.Logic.tissue.texture import volume_shares
from tests.conftest import SPECKLE, block, rigid
from tests.remembered import segment_once
from validation.measurement import correlation, level_db, region_level_db

pytestmark = pytest.mark.usefixtures("segmented_once")

PROBE = LinearProbe(36, 46, scan_lines=145, focus_mm=25, elevation_focus_mm=25)
POSE = rigid(np.eye(3), [0, -23, 0])
DIM = replace(SPECKLE, name="dim", mu0=0.25 * SPECKLE.mu0, sigma0=0.25 * SPECKLE.sigma0)
SOLID = block(lambda x, y, z: np.ones_like(x), half_mm=(30, 30, 12))
TABLE = TissueTable({0: SPECKLE, 1: SPECKLE, 2: DIM})


def texture(share=0.0, deviation=None) -> Texture:
    shape = SOLID.array.shape
    return Texture(
        np.full(shape, 2, np.uint8),
        np.full(shape, share, np.float32),
        np.zeros(shape, np.float32) if deviation is None else deviation,
    )


def frames(known=None, seeds=range(4), table=TABLE, **settings):
    return [
        UltrasoundSimulator(SOLID, table, SimulationSettings(seed=seed, **settings), texture=known).simulate(
            PROBE, POSE
        )
        for seed in seeds
    ]


def inner(found) -> np.ndarray:
    return np.stack([f.iq[:, 64:-64] for f in found])


def test_off_is_the_paper_bit_for_bit():
    (plain,), (with_texture,) = frames(seeds=[0]), frames(texture(0.5), seeds=[0], partial_volume=False)
    np.testing.assert_array_equal(plain.iq, with_texture.iq)
    # A texture without information beyond the labels does not change the image either.
    (ignorant,) = frames(texture(0.0), seeds=[0], partial_volume=True, mri_modulation_db=3.0)
    np.testing.assert_array_equal(plain.iq, ignorant.iq)
    (mixed,) = frames(texture(0.5), seeds=[0])  # the default
    assert not np.array_equal(plain.iq, mixed.iq)


@pytest.mark.parametrize("share", [0.25, 0.9])
def test_mixed_tissues_echo_with_the_mean_of_their_variances(share):
    mixed = inner(frames(texture(share), partial_volume=True))
    variance = (1 - share) * SPECKLE.scatterer_variance + share * DIM.scatterer_variance
    assert level_db(mixed) == pytest.approx(10 * np.log10(variance), abs=0.5)


def test_amplitudes_follow_the_mri_and_the_tissue_keeps_its_power():
    """Against the same scatterers without the MRI, so that the draw of the speckle does not count."""
    x = (np.arange(SOLID.array.shape[2]) * 1.0 - 30.0) * np.ones(SOLID.array.shape)
    bright = x > 10.0  # a third of the tissue: gains of +-6 dB alone would raise its mean power by 1.7 dB
    deviation = np.where(bright, 1.0, -1.0).astype(np.float32)
    power = (bright.mean() * 10**0.6 + (1 - bright.mean()) * 10**-0.6, np.array([10**-0.6, 10**0.6]))
    expected = 10 * np.log10(power[1] / power[0])
    plain, found = frames(), frames(texture(deviation=deviation), mri_modulation_db=6.0)
    for (a, b), level in zip(((-16, 8), (12, 17)), expected, strict=True):
        change = [
            region_level_db(f, PROBE, (a, b, 3, 43)) - region_level_db(p, PROBE, (a, b, 3, 43))
            for f, p in zip(found, plain, strict=True)
        ]
        assert np.mean(change) == pytest.approx(level, abs=0.15)


def test_the_mri_changes_smoothly_not_voxel_by_voxel():
    """A ramp of the MRI is a ramp of the level; the steps of 1 mm voxels do not show."""
    x = (np.arange(SOLID.array.shape[2]) * 1.0 - 30.0) * np.ones(SOLID.array.shape)
    found = frames(texture(deviation=np.clip(x / 8, -2, 2).astype(np.float32)), seeds=range(8), mri_modulation_db=4.0)
    power = (np.abs(inner(found)) ** 2).mean(axis=(0, 2))
    lines = PROBE.line_positions()
    middle = np.abs(lines) < 12
    fit = np.polynomial.Polynomial.fit(lines[middle], 10 * np.log10(power[middle]), 1)
    assert fit.convert().coef[1] == pytest.approx(4.0 / 8, rel=0.1)
    assert np.abs(10 * np.log10(power[middle]) - fit(lines[middle])).max() < 1.5


def test_scatterers_stay_fixed_in_the_patient():
    rng = np.random.default_rng(3)
    shape = SOLID.array.shape
    known = Texture(
        np.full(shape, 2, np.uint8), rng.random(shape, np.float32), rng.normal(size=shape).astype(np.float32)
    )
    settings = SimulationSettings(partial_volume=True, mri_modulation_db=2.0)
    sim = UltrasoundSimulator(SOLID, TABLE, settings, texture=known)
    moved = POSE.copy()
    moved[0, 3] += PROBE.line_spacing
    here, there = sim.simulate(PROBE, POSE).iq, sim.simulate(PROBE, moved).iq
    assert correlation(here[1:], there[:-1]) > 0.99


def test_the_signal_stays_linear_in_the_deviation_of_the_scatterers():
    rng = np.random.default_rng(4)
    shape = SOLID.array.shape
    known = Texture(
        np.full(shape, 2, np.uint8), rng.random(shape, np.float32), rng.normal(size=shape).astype(np.float32)
    )

    def signal(mu0, sigma0):
        table = TissueTable({label: replace(t, mu0=mu0, sigma0=sigma0) for label, t in TABLE.items()})
        (frame,) = frames(known, seeds=[0], table=table, partial_volume=True, mri_modulation_db=2.0)
        return frame.iq

    expected = signal(1.0, 0.0) * np.sqrt(0.25 * 0.4**2 + 0.5 * 0.15**2) / np.sqrt(0.25)  # mu1 is 0
    np.testing.assert_allclose(signal(0.4, 0.15), expected, atol=1e-5 * np.abs(expected).max())


@pytest.fixture(scope="module")
def ramp_segmentation():
    """An MRI of three tissues with soft borders and a little noise, segmented without a filter."""
    x = np.linspace(0, 3, 61)
    step = 40 + 40 * (1 / (1 + np.exp(-(x - 1) / 0.05)) + 1 / (1 + np.exp(-(x - 2) / 0.05)))
    rng = np.random.default_rng(0)
    array = (step + rng.normal(0, 4, (24, 24, 61))).astype(np.float32)
    mri = Volume(array, np.eye(4))
    return segment_mri(mri, mask=mri.with_array(np.ones(array.shape, np.uint8)), filter_radius=0, thin_sulci=False)


def test_a_segmentation_knows_second_tissues_and_deviations(ramp_segmentation):
    known, labels = ramp_segmentation.texture(), ramp_segmentation.labels.array
    assert not (known.second_label == labels)[known.second_share > 0].any()
    assert known.second_share.max() == pytest.approx(0.5, abs=0.02)  # or the label would be the other one
    # Far from every border the label is sure; where intensities are half-way it is not.
    means = ramp_segmentation.means
    image = known.deviation  # per label; the intensity itself decides below
    sure = known.second_share[:, :, [5, 30, 55]]
    assert np.median(sure) < 0.01 and known.second_share[:, :, 20].mean() > 0.04
    assert set(np.unique(known.second_label[:, :, 20][known.second_share[:, :, 20] > 0.05])) <= {1, 2}
    for label in (1, 2, 3):
        of_tissue = image[labels == label]
        assert of_tissue.mean() == pytest.approx(0, abs=1e-3) and of_tissue.std() == pytest.approx(1, abs=1e-3)
    assert means[0] < means[1] < means[2]


def test_an_mri_beside_any_label_map_gives_its_intensity():
    array = np.arange(SOLID.array.size, dtype=np.float32).reshape(SOLID.array.shape)
    known = Texture.from_mri(SOLID.with_array(array), SOLID)
    assert known.deviation.mean() == pytest.approx(0, abs=1e-3) and not known.second_share.any()
    flat = Texture.from_mri(SOLID.with_array(np.full(array.shape, 7.0)), SOLID)
    assert not flat.deviation.any()


def tilted_plane(turn_deg: float, spacing_mm: float, noise: float) -> tuple[Volume, Volume, np.ndarray]:
    """(image, labels, (k, j, i) part beyond) of the plane y = 0, in voxels that are turned against it."""
    turned = Rotation.from_euler("xz", [turn_deg, 0.6 * turn_deg], degrees=True).as_matrix()
    count = np.ceil(np.array([60.0, 60.0, 48.0]) / spacing_mm).astype(int)
    ijk_to_ras = rigid(turned, [0, 0, 0]) @ np.diag([spacing_mm] * 3 + [1.0])
    ijk_to_ras[:3, 3] = -ijk_to_ras[:3, :3] @ (0.5 * (count - 1) + 0.23)
    k, j, i = np.meshgrid(*(np.arange(n) for n in count[::-1]), indexing="ij")
    beyond_mm = ijk_to_ras[1, 0] * i + ijk_to_ras[1, 1] * j + ijk_to_ras[1, 2] * k + ijk_to_ras[1, 3]
    part = np.clip(0.5 + beyond_mm / np.abs(ijk_to_ras[1, :3]).sum(), 0.0, 1.0)
    rng = np.random.default_rng(0)
    image = (100.0 * part + 100.0 * noise * rng.standard_normal(part.shape)).astype(np.float32)
    return Volume(image, ijk_to_ras), Volume((1 + (image > 50.0)).astype(np.uint8), ijk_to_ras), part


def texture_of(image: np.ndarray, labels: np.ndarray) -> Texture:
    second = (3 - labels).astype(np.uint8)
    # A class is more certain than the parts of a voxel.
    share = np.clip(0.5 - np.abs(image - 50.0) / 40.0, 0.0, 0.5).astype(np.float32) + np.float32(1e-3)
    return Texture(second, share, np.zeros_like(share), volume_shares(image, labels, second, share))


@pytest.mark.parametrize(("turn_deg", "spacing_mm"), [(2.0, 1.0), (15.0, 0.5)])
def test_shares_of_voxels_place_planes_that_labels_may_not(turn_deg, spacing_mm):
    """The steps of a plane turned by 2 degrees are 28 voxels long; the MRI knows where it is. 3 % of noise."""
    before, behind = (replace(SPECKLE, name=str(z), impedance_mrayl=z) for z in (1.54, 1.8))
    table = TissueTable({0: before, 1: before, 2: behind})
    image, labels, _ = tilted_plane(turn_deg, spacing_mm, noise=0.075)  # 3 % of white matter, between CSF and grey
    settings = SimulationSettings(scattering=False, specular_exponent=0.0)
    probe = LinearProbe(20, 40, scan_lines=81, focus_mm=25, elevation_focus_mm=25)
    lowest = {}
    for name, known in (("labels", None), ("shares", texture_of(image.array, labels.array))):
        simulator = UltrasoundSimulator(labels, table, settings, texture=known)
        frame = simulator.simulate(probe, rigid(np.eye(3), [0, -25, 0]))
        level = 20 * np.log10(np.abs(frame.iq[10:-10]).max(axis=1) * (1.8 + 1.54) / (1.8 - 1.54))
        lowest[name] = level.min() - settings.interface_gain_db
    assert lowest["shares"] > -1.0
    # A plane without an end labels place as well, by samples of the whole map; noise of the MRI must not make it worse.
    assert lowest["shares"] > lowest["labels"] - 0.2


def test_shares_of_voxels_follow_from_the_image():
    image, labels, part = tilted_plane(15.0, 1.0, noise=0.03)
    known = texture_of(image.array, labels.array)
    assert known.volume_share is not None
    beyond = np.where(labels.array == 2, 1.0 - known.volume_share, known.volume_share)
    mixed = (part > 0.2) & (part < 0.8)
    assert np.sqrt(np.mean((beyond - part)[mixed] ** 2)) < 0.12
    assert (beyond == labels.array - 1)[(part == 0.0) | (part == 1.0)].mean() > 0.99
    # Where intensities do not tell two tissues apart, the class does.
    alike = np.random.default_rng(1).normal(50.0 + labels.array, 1.0).astype(np.float32)
    shares = volume_shares(alike, labels.array, known.second_label, known.second_share)
    np.testing.assert_array_equal(shares[mixed], known.second_share[mixed])


def test_a_segmentation_knows_the_shares_of_its_voxels():
    segmentation = segment_once(head_mri(4.0))
    known = segmentation.texture()
    assert known.volume_share is not None and 0.01 < (known.volume_share > 0).mean() < 0.5
    assert known.volume_share.max() <= 0.5
    edge = ndimage.maximum_filter(segmentation.labels.array, 3) != ndimage.minimum_filter(segmentation.labels.array, 3)
    assert edge[known.volume_share > 0].all()


def test_textures_that_do_not_fit_are_refused():
    with pytest.raises(SimulationError, match=r"mri_modulation_db 2 need a texture; pass segmentation\.texture"):
        UltrasoundSimulator(SOLID, TABLE, SimulationSettings(mri_modulation_db=2.0))
    small = Texture(*(np.zeros((2, 2, 2), dtype) for dtype in (np.uint8, np.float32, np.float32)))
    with pytest.raises(SimulationError, match=r"the texture has shape \(2, 2, 2\), expected that of the labels"):
        UltrasoundSimulator(SOLID, TABLE, SimulationSettings(partial_volume=True), texture=small)
    with pytest.raises(SimulationError, match=r"second_share goes from 0 to 1\.5, expected 0 to 1"):
        Texture(np.zeros((2, 2, 2), np.uint8), np.linspace(0, 1.5, 8).reshape(2, 2, 2), np.zeros((2, 2, 2)))
    with pytest.raises(SimulationError, match="lie on different grids"):
        Texture.from_mri(block(lambda x, y, z: x, half_mm=(5, 5, 5)), SOLID)


@pytest.mark.slow
def test_the_command_takes_its_settings_for_an_mri_and_not_for_labels(tmp_path):
    from PIL import Image

    head_mri(spacing_mm=4.0).write(tmp_path / "mri.nii.gz")
    arguments = ["simulate", str(tmp_path / "mri.nii.gz"), "--pose", "auto", "--overwrite"]
    arguments += ["-o", str(tmp_path / "a.png")]
    images = []
    for extra in ([], ["--set", "settings.partial_volume=false"], ["--set", "settings.mri_modulation_db=3"]):
        result = CliRunner().invoke(main, [*arguments, *extra])
        assert result.exit_code == 0, result.output
        images.append(np.asarray(Image.open(tmp_path / "a.png")).astype(int))
    assert np.abs(images[1] - images[0]).max() > 0 and np.abs(images[2] - images[0]).max() > 0
    SOLID.write(tmp_path / "labels.nii.gz")
    arguments[1] = str(tmp_path / "labels.nii.gz")
    result = CliRunner().invoke(main, [*arguments, "--set", "settings.partial_volume=true"])
    assert result.exit_code == 2
    assert "is a label map; partial_volume and mri_modulation_db need an MRI" in result.stderr


def test_the_image_does_not_depend_on_the_order_of_voxels_in_a_file():
    segmentation = segment_once(head_mri(4.0))
    labels, known, table = segmentation.labels, segmentation.texture(), TissueTable.brain(segmentation.tissue_names)
    turned = Volume.from_sitk(sitk.DICOMOrient(labels.to_sitk(), "SPL"))
    arrays = [
        sitk.GetArrayFromImage(sitk.DICOMOrient(labels.with_array(array).to_sitk(), "SPL"))
        for array in vars(known).values()
    ]
    settings = SimulationSettings(partial_volume=True, mri_modulation_db=2.0)
    probe, pose = PROBES["phased"], craniotomy_pose(labels, PROBES["phased"])
    one, other = (
        UltrasoundSimulator(where, table, settings, texture=texture).simulate(probe, pose).image
        for where, texture in ((labels, known), (turned, Texture(*arrays)))
    )
    assert one.max() > 100 and np.mean(np.abs(one.astype(int) - other) > 1) < 0.001
