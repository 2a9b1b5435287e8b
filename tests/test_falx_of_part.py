"""The falx in a part of a brain, which no atlas leads."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import Volume, segment_mri
from SlicerUSSim.Logic.mri.sheets import find_sheets
from SlicerUSSim.Logic.mri.sheets.falx_of_part import falx_of_part
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.sulcal import sulci
from SlicerUSSim.Logic.tissue import Surfels

FLUID, GREY, WHITE, NOISE = 20.0, 100.0, 140.0, 4.0
#: Top of the corpus callosum and of the brain, and the deep end of other sulci, S mm
CALLOSUM, TOP, OTHER = 17.0, 62.0, 42.0


def midline(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """R mm of the fissure between the hemispheres: bent, and oblique to the slab."""
    return 2.0 * np.sin(z / 15.0) + 0.2 * y


def slab(has_fissure: bool = True) -> tuple[Volume, np.ndarray]:
    """(image of a coronal slab of 14 mm in voxels of 1 mm, brain (k, j, i) bool): a fissure and sulci in cortex."""
    z, y, x = (axis.astype(float) for axis in np.indices((110, 14, 90)))
    z, y, x = z - 42.0, y - 7.0, x - 45.0
    brain = np.asarray(np.hypot(x / 42.0, (z - 10.0) / (TOP - 10.0)) < 1.0)
    depth = np.asarray(ndimage.distance_transform_edt(brain))
    banks = [np.where(z > OTHER, np.abs(x - side), 99.0) for side in (-22.0, -12.0, 14.0, 24.0)]
    if has_fissure:
        banks.append(np.where(z > CALLOSUM, np.abs(x - midline(y, z)), 99.0))
    near = np.minimum.reduce(banks)
    is_grey = (near < 3.2) | (depth < 3.0)
    image = np.where(is_grey, GREY, WHITE)
    share = np.clip(0.6 - near + 0.5, 0.0, 1.0)
    image = np.where(brain, image * (1.0 - share) + FLUID * share, 0.0)
    image += np.where(brain, np.random.default_rng(3).normal(0.0, NOISE, image.shape), 0.0)
    matrix = np.eye(4)
    matrix[:3, 3] = [-45.0, -7.0, -42.0]
    return Volume(image.astype(np.float32), matrix), brain


def falx_in(image: Volume, brain: np.ndarray) -> Surfels:
    head = Head(image, brain, FLUID, GREY, WHITE, NOISE, is_enhanced=False, registered=None)
    return falx_of_part(head, sulci(head, np.zeros(head.brain.shape, bool)))


def test_the_falx_is_the_deepest_straight_sulcus_down_to_its_free_edge():
    found = falx_in(*slab())
    x, y, z = found.place.T
    assert np.percentile(np.abs(x - midline(y, z)), 90) < 1.0
    assert np.abs(found.normal[:, 0]).min() > 0.9
    # From the hull to some millimetres above the callosum, everywhere in the slab and without holes
    assert z.max() > TOP - 5.0 and CALLOSUM + 3.0 < z.min() < CALLOSUM + 9.0
    truth_y, truth_z = np.meshgrid(np.arange(-5.0, 5.0), np.arange(CALLOSUM + 9.0, TOP - 6.0))
    truth = np.stack([midline(truth_y, truth_z), truth_y, truth_z], axis=-1).reshape(-1, 3)
    assert KDTree(found.place).query(truth)[0].max() < 2.0
    assert found.kinds() == ("falx",)


def test_sulci_of_one_hemisphere_are_not_a_falx():
    assert len(falx_in(*slab(has_fissure=False))) == 0
    empty = Volume(np.full((20, 20, 20), WHITE, np.float32), np.eye(4))
    assert len(falx_in(empty, np.ones((20, 20, 20), bool))) == 0


@pytest.mark.parametrize(
    ("axis", "degrees", "is_falx"),
    [("y", 10.0, True), ("z", 90.0, False), ("y", 40.0, False), ("y", 180.0, False)],
    ids=["rolled", "across front and back", "as steep as the tentorium", "from below, as cisterns"],
)
def test_a_plane_that_does_not_divide_left_from_right_is_not_a_falx(axis, degrees, is_falx):
    image, brain = slab()
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    assert (len(falx_in(Volume(image.array, turn @ image.ijk_to_ras), brain)) > 100) == is_falx


def test_find_sheets_has_the_falx_of_a_part_and_not_twice():
    image, brain = slab()
    mask = image.with_array(brain.astype(np.uint8))
    segmentation = segment_mri(image, mask=mask, thin_sulci=False)
    assert segmentation.atlas is None
    found = find_sheets(image, segmentation, contrast="t1", kinds=("sulcus", "falx"))
    falx, others = found.surfels.of_kind("falx"), found.surfels.of_kind("sulcus")
    assert len(falx) > 300 and len(others) > 300
    x, y, z = others.place.T
    beside = (np.abs(x - midline(y, z)) < 1.5) & (z > CALLOSUM + 9.0) & (z < TOP - 8.0)
    assert beside.mean() < 0.02
    assert any("as deep as the fissure" in line for line in found.notes)
