"""The scene logic on real MRML nodes: inputs, position of the image, live update and its end."""

from __future__ import annotations

import gc
import inspect
import weakref
from dataclasses import replace
from datetime import datetime, timezone
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkCommand

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import (  # noqa: E402
    DisplaySettings,
    LinearProbe,
    Preset,
    SimulationError,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    seed_of_pose,
    segment_mri,
)
from SlicerUSSim.Logic.base.errors import Cancelled  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import node_labels, read_labels, write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import (  # noqa: E402
    ijk_to_ras,
    node_to_world,
    pose_in_labels,
    read_volume,
    set_node_to_world,
    write_volume,
)
from SlicerUSSim.Logic.mrml.taken_image import about_image, is_frozen, patient_of  # noqa: E402
from SlicerUSSim.Logic.probe.image_grid import ImageGrid  # noqa: E402
from SlicerUSSim.Logic.probe.poses import slice_under_probe  # noqa: E402
from tests.conftest import FLUID, SPECKLE, block, example, rigid  # noqa: E402

pytestmark = pytest.mark.usefixtures("segmented_once")

PRESET = Preset(
    LinearProbe(20, 30, scan_lines=48, focus_mm=15),
    DisplaySettings(image_size=(96, 64)),
    tissues=TissueTable({0: FLUID, 1: SPECKLE, 2: FLUID}),
)
ABOVE = rigid(np.eye(3), [0, -15, 0])


def cyst() -> Volume:
    return block(lambda x, y, z: np.where((x - 3) ** 2 + (y - 5) ** 2 + z**2 < 16, 2, 1), (12, 16, 8))


def add(scene, kind: str, name: str = ""):
    return scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name or kind)


def put(node, matrix: np.ndarray):
    node.SetMatrixTransformToParent(vtk_matrix(matrix))
    return node


def pixels(volume_node) -> np.ndarray:
    """(rows, columns)"""
    return Volume.from_vtk(volume_node.GetImageData(), np.eye(4)).array[0].copy()


class Bench:
    """A scene with a cyst in speckle, a probe above it, and a volume for the image."""

    def __init__(self, labels_kind: str = "LabelMapVolume") -> None:
        self.scene = slicer.vtkMRMLScene()
        self.logic = UltrasoundSceneLogic(self.scene)
        self.logic.preset = PRESET
        self.labels = add(self.scene, labels_kind, "tissues")
        self.probe = put(add(self.scene, "LinearTransform", "Probe"), ABOVE)
        self.image = add(self.scene, "ScalarVolume", "ultrasound")
        volume = cyst()
        write_labels(self.labels, volume, ("speckle", "fluid"), self.grid())

    def grid(self):
        """A volume node on the grid of the cyst."""
        volume = cyst()
        return volume_node(self.scene, volume.with_array(volume.array.astype(np.float32)), "grid")

    def simulate(self):
        return self.logic.simulate(self.labels, self.probe, self.image)

    def live(self, **options):
        self.logic.startLiveUpdate(self.labels, self.probe, self.image, **options)


def volume_node(scene, volume: Volume, name: str = "MRI"):
    node = add(scene, "ScalarVolume", name)
    write_volume(node, volume)
    return node


def expected(pose: np.ndarray, noise_seed: int | None = None) -> np.ndarray:
    """(rows, columns) with the noise of the pose, unless another is given."""
    noise_seed = seed_of_pose(pose) if noise_seed is None else noise_seed
    simulator = UltrasoundSimulator(cyst(), PRESET.tissues)
    return simulator.simulate(PRESET.probe, pose, PRESET.display, noise_seed=noise_seed).image


@pytest.fixture
def bench():
    return Bench()


# ---- the image and its place -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["LabelMapVolume", "Segmentation"])
def test_the_image_is_the_simulators_and_lies_in_the_probe_frame(kind):
    bench = Bench(kind)
    frame = bench.simulate()
    np.testing.assert_array_equal(pixels(bench.image), frame.image)
    assert np.mean(frame.image != expected(ABOVE)) < 0.001  # a segmentation is cropped to what it holds
    assert bench.image.GetTransformNodeID() == bench.probe.GetID()
    in_world = node_to_world(bench.image) @ ijk_to_ras(bench.image)
    np.testing.assert_allclose(in_world, frame.to_volume().ijk_to_ras, atol=1e-9)
    geometry = ijk_to_ras(bench.image)
    put(bench.probe, ABOVE @ rigid(np.eye(3), [1, 2, 3]))
    bench.simulate()
    np.testing.assert_array_equal(ijk_to_ras(bench.image), geometry)  # the slice moves with the transform alone


def test_any_chain_of_rigid_parents_gives_the_same_image_as_their_product(bench):
    a = rigid(Rotation.from_euler("xyz", [30, -50, 10], degrees=True).as_matrix(), [20, 5, -9])
    b = rigid(Rotation.from_euler("xyz", [-80, 15, 60], degrees=True).as_matrix(), [-3, 40, 7])
    tracker, reference = put(add(bench.scene, "LinearTransform"), a), put(add(bench.scene, "LinearTransform"), b)
    tracker.SetAndObserveTransformNodeID(reference.GetID())
    bench.probe.SetAndObserveTransformNodeID(tracker.GetID())
    put(bench.probe, np.linalg.inv(b @ a) @ ABOVE)
    image = bench.simulate().image
    assert np.mean(np.abs(image.astype(int) - expected(ABOVE)) > 2) < 0.01

    # Labels under the same parents as the probe: nothing moves against anything.
    bench.labels.SetAndObserveTransformNodeID(tracker.GetID())
    put(bench.probe, ABOVE)
    moved = bench.simulate()
    assert np.mean(np.abs(moved.image.astype(int) - expected(ABOVE)) > 2) < 0.01
    in_world = node_to_world(bench.image) @ ijk_to_ras(bench.image)
    geometry = moved.image_to_probe.copy()
    geometry[:3, 2] *= moved.pixel_spacing_mm[1]
    np.testing.assert_allclose(in_world, b @ a @ ABOVE @ geometry, atol=1e-9)


def noisy(bench) -> None:
    """Noise only, which fills the image."""
    fluid = TissueTable({0: FLUID, 1: Tissue("speckle", 1540.0, 1.54, 0.0), 2: FLUID})
    display = DisplaySettings(look="even", noise_db=-5.0, tgc_db_cm_mhz=0.0, image_size=(96, 64))
    bench.logic.preset = Preset(PRESET.probe, display, PRESET.settings, fluid)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_noise_lives_while_the_probe_moves_and_is_the_same_where_it_was(bench):
    noisy(bench)
    bench.live()
    first = pixels(bench.image)
    put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 0, 0.5]))
    other = pixels(bench.image)
    assert first.std() > 5 and abs(likeness(first, other)) < 0.1
    put(bench.probe, ABOVE)
    np.testing.assert_array_equal(pixels(bench.image), first)
    turned = put(add(bench.scene, "LinearTransform"), rigid(Rotation.random(random_state=4).as_matrix(), [9, 8, 7]))
    before = pixels(bench.image)
    bench.labels.SetAndObserveTransformNodeID(turned.GetID())  # patient and probe together: the same pose
    bench.probe.SetAndObserveTransformNodeID(turned.GetID())
    np.testing.assert_array_equal(pixels(bench.image), before)
    bench.logic.preset = bench.logic.preset.changed("display", gain_db=1.0)  # brighter, not another noise
    assert likeness(pixels(bench.image), before) > 0.99


def test_images_of_a_sequence_have_noise_of_their_own_even_at_one_pose(bench):
    noisy(bench)
    images = add(bench.scene, "Sequence", "images")
    bench.logic.simulateSequence(bench.labels, sequence_of(bench.scene, [ABOVE] * 3), images)
    shown = [pixels(images.GetNthDataNode(number)) for number in range(3)]
    assert shown[0].std() > 5
    assert all(abs(likeness(a, b)) < 0.1 for a, b in ((shown[0], shown[1]), (shown[1], shown[2]), (shown[0], shown[2])))
    bench.logic.simulateSequence(bench.labels, sequence_of(bench.scene, [ABOVE] * 3), images)
    for number, image in enumerate(shown):
        np.testing.assert_array_equal(pixels(images.GetNthDataNode(number)), image)


def test_labels_under_a_scaling_transform_are_scaled(bench):
    scale = put(add(bench.scene, "LinearTransform"), np.diag([1.0, 1.2, 1.0, 1.0]))
    bench.labels.SetAndObserveTransformNodeID(scale.GetID())
    image = bench.simulate().image
    volume = cyst()
    stretched = Volume(volume.array, np.diag([1.0, 1.2, 1.0, 1.0]) @ volume.ijk_to_ras)
    simulator = UltrasoundSimulator(stretched, PRESET.tissues)
    true = simulator.simulate(PRESET.probe, ABOVE, PRESET.display, noise_seed=seed_of_pose(ABOVE)).image
    np.testing.assert_array_equal(image, true)


def test_the_image_is_shown_from_black_to_white_whatever_is_in_it(bench):
    bench.image.CreateDefaultDisplayNodes()
    display = bench.image.GetDisplayNode()
    assert display.GetAutoWindowLevel()  # which would change brightness from frame to frame
    bench.simulate()
    assert (display.GetWindowLevelMin(), display.GetWindowLevelMax()) == (0, 255) and not display.GetAutoWindowLevel()
    display.SetWindowLevelMinMax(0, 180)  # the user's own stays
    put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 0, 1]))
    bench.simulate()
    assert display.GetWindowLevelMax() == 180


def test_only_nodes_that_are_empty_or_hold_results_are_replaced(bench):
    """A CT, a surface or a recording that was chosen as the output was lost."""
    scan = volume_node(bench.scene, cyst(), "CT")
    before = pixels(scan)
    for call in (bench.logic.simulate, bench.logic.startLiveUpdate):
        with pytest.raises(SimulationError, match="output Volume 'CT' has data that this module did not make"):
            call(bench.labels, bench.probe, scan)
    np.testing.assert_array_equal(pixels(scan), before)
    assert scan.GetParentTransformNode() is None and not bench.logic.isLive

    surface = add(bench.scene, "Model", "skin")
    bench.logic.showOutline(surface, bench.probe)
    own = surface.GetPolyData()
    skin = add(bench.scene, "Model", "skin")
    skin.SetAndObservePolyData(own)
    with pytest.raises(SimulationError, match="outline Model 'skin' has data that this module did not make"):
        bench.logic.showOutline(skin, bench.probe)
    bench.logic.showOutline(surface, bench.probe)  # its own again

    recorded = sequence_of(bench.scene, [ABOVE] * 2)
    with pytest.raises(SimulationError, match=r"sequence of images Sequence .* did not make, so it is not replaced"):
        bench.logic.simulateSequence(bench.labels, sequence_of(bench.scene, [ABOVE] * 3), recorded)
    assert recorded.GetNumberOfDataNodes() == 2


ANGLES = st.tuples(*[st.floats(-180, 180)] * 3)
OFFSETS = st.tuples(*[st.floats(-200, 200)] * 3)
RIGID = st.builds(
    lambda angles, offset: rigid(Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), offset), ANGLES, OFFSETS
)


@given(chain=st.lists(RIGID, min_size=1, max_size=4), wanted=RIGID)
def test_a_node_in_any_chain_of_parents_is_where_their_product_puts_it(chain, wanted):
    scene = slicer.vtkMRMLScene()
    nodes = [put(add(scene, "LinearTransform"), matrix) for matrix in chain]
    for child, parent in pairwise(nodes):
        child.SetAndObserveTransformNodeID(parent.GetID())
    product = np.eye(4)
    for matrix in chain:
        product = matrix @ product
    np.testing.assert_allclose(node_to_world(nodes[0]), product, atol=1e-6)
    set_node_to_world(nodes[0], wanted)
    np.testing.assert_allclose(node_to_world(nodes[0]), wanted, atol=1e-6)
    volume = add(scene, "ScalarVolume")
    volume.SetAndObserveTransformNodeID(nodes[0].GetID())
    pose, moved = pose_in_labels(volume, wanted)  # labels and probe under the same transform: nothing between them
    np.testing.assert_allclose(pose, np.eye(4), atol=1e-6)
    np.testing.assert_array_equal(moved, np.eye(4))


# ---- segmentation ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["LabelMapVolume", "Segmentation"])
def test_segment_names_and_colours_tissues_where_the_mri_is(kind):
    scene = slicer.vtkMRMLScene()
    logic = UltrasoundSceneLogic(scene)
    mri, labels = head_mri(3.5), add(scene, kind, "tissues")
    node = volume_node(scene, mri, "head of somebody")
    moved = put(add(scene, "LinearTransform"), rigid(np.eye(3), [5, 6, 7]))
    node.SetAndObserveTransformNodeID(moved.GetID())
    shares = []
    result = logic.segment(node, labels, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert labels.GetTransformNodeID() == moved.GetID() and patient_of(labels) == "head of somebody"
    expected_names = ["csf", "grey matter", "white matter", "leptomeninges"]
    table = logic.tissues(labels)
    assert [table[n].name for n in range(1, 5)] == expected_names
    if kind == "LabelMapVolume":
        voxels = Volume.from_vtk(labels.GetImageData(), ijk_to_ras(labels))
        np.testing.assert_array_equal(voxels.array, result.labels.array)
        np.testing.assert_allclose(voxels.ijk_to_ras, mri.ijk_to_ras)
        colours = labels.GetDisplayNode().GetColorNode()
        names = [colours.GetColorName(n) for n in range(1, 5)]
        values = [tuple(colours.GetLookupTable().GetTableValue(n)[:3]) for n in range(1, 5)]
    else:
        segments = [labels.GetSegmentation().GetNthSegment(n) for n in range(4)]
        names, values = [segment.GetName() for segment in segments], [segment.GetColor() for segment in segments]
    assert names == expected_names and len(set(values)) == 4
    # The same MRI, segmented into either kind of node, gives the same picture, also with its texture.
    probe, image = add(scene, "LinearTransform"), add(scene, "ScalarVolume")
    logic.placeProbe(labels, probe)
    pose = np.linalg.inv(node_to_world(moved)) @ node_to_world(probe)
    images = []
    for modulation_db in (0.0, 3.0):
        logic.preset = logic.preset.changed("settings", mri_modulation_db=modulation_db)
        images.append(logic.simulate(labels, probe, image).image)
        direct = UltrasoundSimulator(
            result.labels, TissueTable.brain(result.tissue_names), logic.preset.settings, texture=result.texture()
        )
        true = direct.simulate(logic.preset.probe, pose, noise_seed=seed_of_pose(pose)).image
        assert images[-1].mean() > 15 and np.mean(images[-1] != true) < 0.02
    assert (images[0] != images[1]).mean() > 0.1
    if kind == "Segmentation":
        labels.GetSegmentation().GetNthSegment(0).SetName("Cerebrospinal fluid")
    else:
        labels.GetImageData().Modified()  # painted on: the texture no longer fits these labels
    with pytest.raises(SimulationError, match="segment the MRI again"):
        logic.simulate(labels, probe, image)


@pytest.mark.slow
def test_a_mask_can_be_a_segmentation_on_another_grid():
    scene = slicer.vtkMRMLScene()
    logic, mri = UltrasoundSceneLogic(scene), head_mri(4.0)
    node, mask = volume_node(scene, mri), add(scene, "Segmentation")
    half = np.zeros(mri.array.shape, np.uint8)
    half[..., : half.shape[2] // 2] = 1
    write_labels(mask, Volume(half[4:-4], mri.ijk_to_ras @ rigid(np.eye(3), [0, 0, 4])), ("brain",), node)
    inside = logic.segment(node, add(scene, "LabelMapVolume"), mask_node=mask).labels.array > 0
    assert inside.any() and not inside[..., half.shape[2] // 2 :].any() and not inside[:4].any()


def test_cancelling_a_segmentation_leaves_the_node_as_it_was():
    scene = slicer.vtkMRMLScene()
    logic = UltrasoundSceneLogic(scene)
    node, labels = volume_node(scene, head_mri(4.0)), add(scene, "LabelMapVolume")

    def cancel(share):
        raise Cancelled

    with pytest.raises(Cancelled):
        logic.segment(node, labels, progress=cancel)
    assert labels.GetImageData() is None


def test_segment_names_choose_tissues_and_unknown_ones_are_listed(bench):
    segmentation = add(bench.scene, "Segmentation", "painted")
    write_labels(segmentation, cyst(), ("Left-White-Matter", "Tumor_1"), bench.grid())
    table = bench.logic.tissues(segmentation)
    assert [table[n].name for n in (1, 2)] == ["white matter", "tumour"]
    segmentation.GetSegmentation().GetNthSegment(1).SetName("Segment_2")
    with pytest.raises(SimulationError, match=r"'painted': no tissue is called 'Segment_2' .*to one of: speckle"):
        bench.logic.simulate(segmentation, bench.probe, bench.image)
    segmentation.GetSegmentation().GetNthSegment(1).SetName("Speckle")  # a tissue of the preset, before all others
    assert bench.logic.tissues(segmentation)[2].name == "speckle"


def test_label_maps_of_other_programs_are_recognised_and_masks_refused(bench):
    bench.logic.preset = Preset()
    aseg, mask = add(bench.scene, "LabelMapVolume", "aseg"), add(bench.scene, "LabelMapVolume", "mask")
    array = np.zeros((20, 20, 40), np.int16)
    for label, i in ((2, 4), (3, 8), (4, 12), (251, 20), (43, 26), (42, 30), (41, 34)):
        array[4:16, 4:16, i : i + 3] = label
    write_volume(aseg, Volume(array, np.eye(4)))
    table = bench.logic.tissues(aseg)
    assert [table[n].name for n in (1, 2, 3)] == ["white matter", "grey matter", "csf"]
    write_volume(mask, Volume((array > 0).astype(np.uint8), np.eye(4)))
    with pytest.raises(SimulationError, match=r"'mask': a binary mask .*in 3D Slicer, add it as a segment"):
        bench.logic.tissues(mask)
    lesion = add(bench.scene, "Segmentation", "painted")
    write_labels(lesion, Volume((array > 0).astype(np.uint8), np.eye(4)), ("tumour",), bench.grid())
    with pytest.raises(SimulationError, match="'painted': a lesion"):
        bench.logic.tissues(lesion)


def test_codes_of_slicers_terminologies_are_written_and_read(bench):
    values = np.repeat(np.arange(4, dtype=np.uint8), 16).reshape(4, 4, 4)
    for kind in ("Segmentation", "LabelMapVolume"):
        node = add(bench.scene, kind, "tissues")
        write_labels(node, Volume(values, np.eye(4)), ("white matter", "liver", "gel"), bench.grid())
        if kind == "Segmentation":
            segments = [node.GetSegmentation().GetNthSegment(n) for n in range(3)]
            entries = [segment.GetTerminology() for segment in segments]
            for segment in segments[:2]:
                segment.SetName("Segment_1")
        else:
            colours = node.GetDisplayNode().GetColorNode()
            entries = [colours.GetTerminologyAsString(label) for label in (1, 2, 3)]
            colours.SetColorName(1, "Gewebe")
        assert "^389080008^" in entries[0] and "^10200004^" in entries[1] and "^389080008^" not in entries[2]
        assert read_labels(node, TissueTable.brain()).names == ("white matter", "liver", "gel")


def test_tissues_are_one_layer_in_the_folder_of_the_patient(bench):
    hierarchy = slicer.vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(bench.scene)
    study = hierarchy.CreateStudyItem(hierarchy.GetSceneItemID(), "of DICOM")
    voxels = Volume(np.repeat(np.arange(4, dtype=np.uint8), 16).reshape(4, 4, 4), np.eye(4))
    for parent, folder in ((hierarchy.GetSceneItemID(), "MRI ultrasound"), (study, "of DICOM")):
        mri, tissues = add(bench.scene, "ScalarVolume", "MRI"), add(bench.scene, "Segmentation", "tissues")
        write_volume(mri, voxels)
        hierarchy.CreateItem(parent, mri)
        for _ in range(2):  # a second Segment moves nothing
            write_labels(tissues, voxels, ("csf", "grey matter", "white matter"), mri)
        parents = [hierarchy.GetItemParent(hierarchy.GetItemByDataNode(node)) for node in (mri, tissues)]
        assert parents[0] == parents[1] and hierarchy.GetItemName(parents[0]) == folder
        segmentation = tissues.GetSegmentation()
        assert segmentation.GetNumberOfSegments() == 3 and segmentation.GetNumberOfLayers() == 1
        np.testing.assert_array_equal(node_labels(tissues)[0].array, voxels.array)
    assert hierarchy.GetNumberOfItems() == 6  # two patients with a folder and two nodes each


def test_slicers_default_colours_do_not_make_bone_of_grey_matter(bench):
    """A label map that Slicer loads gets GenericAnatomyColors, where label 2 is "bone" and 3 is "skin"."""
    labels = add(bench.scene, "LabelMapVolume", "labels.nii")
    write_volume(labels, cyst())
    colours = add(bench.scene, "ColorTable", "GenericAnatomyColors")
    colours.SetTypeToUser()
    colours.SetNumberOfColors(3)
    colours.SetColor(1, "tissue", 1, 1, 1, 1)
    colours.SetColor(2, "bone", 1, 1, 1, 1)
    display = add(bench.scene, "LabelMapVolumeDisplay")
    labels.SetAndObserveDisplayNodeID(display.GetID())
    display.SetAndObserveColorNodeID(colours.GetID())
    assert [bench.logic.tissues(labels)[n].name for n in (1, 2)] == ["speckle", "fluid"]
    colours.SetName("mine")  # a table chosen by the user is used by its names
    with pytest.raises(SimulationError, match="no tissue is called"):
        bench.logic.preset = Preset(tissues=TissueTable({}))
        bench.logic.tissues(labels)
    colours.SetColorName(1, "liver")
    assert [bench.logic.tissues(labels)[n].name for n in (1, 2)] == ["liver", "bone"]


def test_labels_without_names_follow_the_tissues_that_have_their_numbers(bench):
    """They are read again when the same names belong to other labels; formerly the old ones remained."""
    labels = add(bench.scene, "LabelMapVolume", "labels.nii")
    write_volume(labels, cyst())
    assert [bench.logic.tissues(labels)[n].name for n in (1, 2)] == ["speckle", "fluid"]
    bench.logic.simulate(labels, bench.probe, bench.image)
    np.testing.assert_array_equal(pixels(bench.image), expected(ABOVE))
    bench.logic.preset = replace(PRESET, tissues=TissueTable({0: FLUID, 2: SPECKLE, 3: FLUID}))
    with pytest.raises(SimulationError, match=r"no tissue is called label 1 .*names of segments, to one of"):
        bench.logic.tissues(labels)
    bench.logic.preset = replace(PRESET, tissues=TissueTable({0: FLUID, 1: FLUID, 2: SPECKLE}))
    assert [bench.logic.tissues(labels)[n].name for n in (1, 2)] == ["fluid", "speckle"]


# ---- placing ---------------------------------------------------------------------------------------------------------


def test_the_probe_is_placed_on_the_surface_in_a_slice(bench):
    slice_node = add(bench.scene, "Slice", "Yellow")
    matrix = slice_node.GetSliceToRAS()
    x, y = np.array([0, 1.0, 0]), np.array([0, 0, 1.0])
    view = np.eye(4)
    view[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    view[:3, 3] = [4, 2, 1]
    matrix.DeepCopy(vtk_matrix(view))
    parent = put(add(bench.scene, "LinearTransform"), rigid(np.eye(3), [9, 9, 9]))
    bench.probe.SetAndObserveTransformNodeID(parent.GetID())
    bench.logic.placeProbe(bench.labels, bench.probe, slice_node)
    pose = node_to_world(bench.probe)
    np.testing.assert_allclose(pose[:3, 0], x, atol=1e-9)  # left to right as in the view
    np.testing.assert_allclose(pose[:3, 1], -y, atol=1e-9)  # depth runs down the view
    np.testing.assert_allclose(pose[:3, 3], [4, 2, 8.25], atol=0.3)  # on the top of the block
    bench.logic.placeProbe(bench.labels, bench.probe, slice_node, target_ras=(0, -6, 0))
    np.testing.assert_allclose(node_to_world(bench.probe)[:3, 3], [4, -6, 8.25], atol=0.3)
    view[1, 3] = 500.0
    matrix.DeepCopy(vtk_matrix(view))
    with pytest.raises(SimulationError, match="no tissue from"):
        bench.logic.placeProbe(bench.labels, bench.probe, slice_node)


# ---- live update -----------------------------------------------------------------------------------------------------


class Loop:
    """An event loop: functions wait until they are run."""

    def __init__(self) -> None:
        self.waiting = []

    def __call__(self, function) -> None:
        self.waiting.append(function)

    def run(self) -> int:
        count = 0
        while self.waiting:
            self.waiting.pop(0)()
            count += 1
        return count


def test_a_burst_of_changes_is_one_image_of_the_last(bench):
    loop, reports = Loop(), []
    bench.live(schedule=loop, report=reports.append)
    for step in range(100):
        put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 0, 0.02 * step]))
    assert reports == [""]  # the first image, at once
    assert loop.run() == 1 and reports == ["", ""]
    np.testing.assert_array_equal(pixels(bench.image), expected(ABOVE @ rigid(np.eye(3), [0, 0, 1.98])))
    bench.scene.StartState(bench.scene.BatchProcessState)
    put(bench.probe, ABOVE)
    assert not loop.waiting  # while a scene is loaded
    bench.scene.EndState(bench.scene.BatchProcessState)
    assert loop.run() == 1


@pytest.mark.parametrize("kind", ["LabelMapVolume", "Segmentation"])
def test_everything_the_image_depends_on_is_followed(kind):
    bench, loop = Bench(kind), Loop()
    parent = put(add(bench.scene, "LinearTransform"), np.eye(4))
    bench.probe.SetAndObserveTransformNodeID(parent.GetID())
    outline = add(bench.scene, "Model")
    bench.live(schedule=loop, outline_node=outline)
    seen = [pixels(bench.image)]

    def changes(name):
        assert loop.run() == 1, name
        now = pixels(bench.image)
        assert any(now.shape != old.shape or (now != old).mean() > 0.01 for old in seen[-1:]), name
        seen.append(now)

    put(parent, rigid(np.eye(3), [0, 0, 1]))
    changes("a parent of the probe")
    bench.logic.preset = bench.logic.preset.changed("display", gain_db=6)
    changes("gain")
    bench.logic.preset = bench.logic.preset.changed("settings", seed=9)
    changes("seed")
    tissues = bench.logic.preset.tissues.replace("speckle", mu0=0.1, sigma0=0.05)
    bench.logic.preset = Preset(*(getattr(bench.logic.preset, n) for n in ("probe", "display", "settings")), tissues)
    changes("a tissue")
    bench.logic.preset = bench.logic.preset.changed("probe", depth_mm=25.0)
    changes("depth")
    bounds = [0.0] * 6
    outline.GetRASBounds(bounds)
    np.testing.assert_allclose(bounds, (-10, 10, -15, -15 + 25, 1, 1), atol=1e-5)
    assert outline.GetDisplayNode().GetVisibility2D()
    other = put(add(bench.scene, "LinearTransform"), rigid(np.eye(3), [0, 1, 0]))
    bench.labels.SetAndObserveTransformNodeID(other.GetID())
    changes("the labels' transform")
    put(other, rigid(np.eye(3), [0, -1, 0]))
    changes("the labels' transform moved")
    volume = cyst()
    write_labels(bench.labels, volume.with_array(np.ones_like(volume.array)), ("speckle",), bench.grid())
    while loop.waiting:
        changes("voxels")
    bench.logic.stopLiveUpdate()


def test_what_is_wrong_is_reported_and_can_be_mended(bench):
    loop, reports = Loop(), []
    bench.live(schedule=loop, report=reports.append)
    warp = add(bench.scene, "GridTransform", "Warp")
    displacement = Volume(np.zeros((4, 4, 4), np.float32), np.eye(4)).to_vtk()
    grid = slicer.vtkOrientedGridTransform()
    displacement.AllocateScalars(10, 3)
    grid.SetDisplacementGridData(displacement)
    warp.SetAndObserveTransformFromParent(grid)
    bench.probe.SetAndObserveTransformNodeID(warp.GetID())
    loop.run()
    assert "'Probe' is under a transform that is not linear" in reports[-1] and bench.logic.isLive
    bench.probe.SetAndObserveTransformNodeID(None)
    loop.run()
    assert reports[-1] == ""
    put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 500, 0]))
    loop.run()
    assert "looks past the volume" in reports[-1]  # a warning is a report too
    assert bench.logic.taken.is_empty
    put(bench.probe, np.diag([2.0, 1, 1, 1]))
    loop.run()
    assert "'Probe' is not rigid" in reports[-1]


def test_live_update_ends_when_images_take_too_long_and_says_why(bench, monkeypatch):
    """A probe or a device with which an image takes minutes must not hold the application image after image."""
    loop, reports, ended, now = Loop(), [], [], [0.0]
    simulate = bench.logic.simulate
    durations = iter((14.0, 0.1, 12.0, 13.0))  # the first prepares the patient

    def slow(*arguments, **options):
        now[0] += next(durations)
        return simulate(*arguments, **options)

    monkeypatch.setattr("SlicerUSSim.Logic.mrml.live.perf_counter", lambda: now[0])
    monkeypatch.setattr(bench.logic.images, "simulate", slow)
    bench.live(schedule=loop, report=reports.append, stopped=lambda: ended.append(1))
    loop.run()
    for shift in (1, 2, 3):
        assert bench.logic.isLive and not ended and "live update ended" not in "".join(reports)
        put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 0, shift]))
        loop.run()
    assert not bench.logic.isLive and ended == [1]
    assert reports[-1].startswith("live update ended: 2 images in a row took more than 10 s, the last 13 s; simulate")
    put(bench.probe, ABOVE)
    assert not loop.waiting
    monkeypatch.undo()
    bench.live(schedule=loop)
    assert bench.logic.isLive
    bench.logic.stopLiveUpdate()


@pytest.mark.parametrize("what", ["labels", "probe", "image", "scene", "stop", "logic"])
def test_live_update_ends_cleanly_with_its_nodes_its_scene_or_its_logic(bench, what):
    loop, ended = Loop(), []
    bench.live(schedule=loop, stopped=lambda: ended.append(1))
    put(bench.probe, ABOVE)  # an image is waiting when the end comes
    before, probe, observed = pixels(bench.image), bench.probe, (bench.probe, bench.labels, bench.image, bench.scene)
    if what == "scene":
        bench.scene.Clear(0)
    elif what == "stop":
        bench.logic.stopLiveUpdate()
    elif what == "logic":
        live = weakref.ref(bench.logic.live._update)
        bench.logic = None
        loop.waiting.clear()
        gc.collect()
        assert live() is None
    else:
        bench.scene.RemoveNode(getattr(bench, what))
    assert what == "logic" or (ended == [1] and not bench.logic.isLive)
    loop.run()
    put(probe, ABOVE @ rigid(np.eye(3), [0, 0, 3]))
    assert not loop.waiting
    if bench.image.GetImageData() is not None:
        np.testing.assert_array_equal(pixels(bench.image), before)
    labels, image, scene = observed[1:]
    labels.Modified()
    labels.InvokeEvent(labels.ImageDataModifiedEvent)
    image.InvokeEvent(vtkCommand.UserEvent + 7301)
    scene.Clear(0)
    assert not loop.waiting and len(ended) <= 1


def test_two_logics_share_what_is_set_and_the_newest_owns_an_output(bench):
    loop, ended = Loop(), []
    bench.live(schedule=loop, stopped=lambda: ended.append("first"))
    second = UltrasoundSceneLogic(bench.scene)
    assert second.preset == bench.logic.preset
    other = add(bench.scene, "ScalarVolume", "other")
    second.startLiveUpdate(bench.labels, bench.probe, other, schedule=loop)
    put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 0, 1]))
    assert loop.run() == 2 and not ended  # two outputs, both follow
    np.testing.assert_array_equal(pixels(other), pixels(bench.image))
    second.startLiveUpdate(bench.labels, bench.probe, bench.image, schedule=loop)
    assert ended == ["first"] and not bench.logic.isLive and second.isLive
    assert bench.image.GetTransformNodeID() == bench.probe.GetID()  # not frozen
    put(bench.probe, ABOVE)
    assert loop.run() == 1


# ---- sequences -------------------------------------------------------------------------------------------------------


def sequence_of(scene, poses):
    sequence = add(scene, "Sequence", "tracking")
    sequence.SetIndexName("time")
    sequence.SetIndexUnit("s")
    for number, pose in enumerate(poses):
        item = slicer.vtkMRMLLinearTransformNode()
        sequence.SetDataNodeAtValue(put(item, pose), str(number / 10))
    return sequence


def test_a_sequence_of_transforms_becomes_one_of_images(bench):
    poses = [ABOVE @ rigid(np.eye(3), [0, 0, z]) for z in (0, 1, 2)]
    transforms, images = sequence_of(bench.scene, poses), add(bench.scene, "Sequence", "images")
    shares = []
    count = bench.logic.simulateSequence(bench.labels, transforms, images, progress=shares.append)
    assert count == 3 and shares == [1 / 3, 2 / 3, 1.0] and images.GetIndexName() == "time"
    for number, pose in enumerate(poses):
        assert images.GetNthIndexValue(number) == str(number / 10)
        np.testing.assert_array_equal(pixels(images.GetNthDataNode(number)), expected(pose, number))


def test_an_image_of_a_sequence_is_shown_where_it_was_taken(bench, tmp_path):
    """Also after it was saved, which keeps no attributes of single images."""
    poses = [ABOVE @ rigid(np.eye(3), [0, 0, z]) for z in (0, 1)]
    transforms, images = sequence_of(bench.scene, poses), add(bench.scene, "Sequence", "images")
    bench.logic.simulateSequence(bench.labels, transforms, images)
    assert about_image(images.GetNthDataNode(1))["patient"] == "tissues"
    live = bench.live()
    taken = bench.logic.showSequenceImage(images, 1, bench.image)
    assert not bench.logic.isLive and live is None and bench.logic.taken is taken and bench.logic.lastFrame is None
    put(bench.probe, ABOVE)
    np.testing.assert_allclose(node_to_world(bench.image) @ ijk_to_ras(bench.image), taken.image_to_world, atol=1e-6)
    assert is_frozen(bench.image) and taken.number == 1 and not taken.is_empty
    np.testing.assert_allclose(taken.probe_to_world, poses[1], atol=1e-6)
    np.testing.assert_array_equal(pixels(bench.image), expected(poses[1], 1))
    assert taken.anatomy == bench.logic.anatomyOf(bench.labels)
    bench.logic.simulate(bench.labels, bench.probe, bench.image)  # into the same volume again
    assert not is_frozen(bench.image)
    images.SetAttribute("SlicerUSSim.images", None)
    with pytest.raises(SimulationError, match="has no records of its images, expected those of Simulate"):
        bench.logic.showSequenceImage(images, 1, bench.image)
    with pytest.raises(SimulationError, match="has 2 images, expected one with the number 2"):
        bench.logic.showSequenceImage(images, 2, bench.image)


@pytest.mark.parametrize(
    "values, expected_values",
    [
        (("0.5", "0.50", "0.500"), ("0.5", "0.500001", "0.500002")),
        (("later", "sooner", "soon"), ("later", "sooner", "soon")),
    ],
)
def test_no_image_is_lost_for_an_index_value_that_is_hardly_or_not_another(bench, values, expected_values):
    poses = [ABOVE @ rigid(np.eye(3), [0, 0, z]) for z in (0, 1, 2)]
    transforms, images = add(bench.scene, "Sequence", "tracking"), add(bench.scene, "Sequence", "images")
    transforms.SetIndexType(transforms.TextIndex)  # which keeps any value
    for value, pose in zip(values, poses, strict=True):
        transforms.SetDataNodeAtValue(put(slicer.vtkMRMLLinearTransformNode(), pose), value)
    if values[0][0].isdigit():
        transforms.SetIndexType(transforms.NumericIndex)
    assert bench.logic.simulateSequence(bench.labels, transforms, images) == 3
    assert images.GetIndexType() == transforms.GetIndexType()
    found = [images.GetNthIndexValue(number) for number in range(images.GetNumberOfDataNodes())]
    assert tuple(found) == expected_values
    for number, (value, pose) in enumerate(zip(found, poses, strict=True)):
        np.testing.assert_array_equal(pixels(images.GetDataNodeAtValue(value, True)), expected(pose, number))


def test_with_its_browser_a_sequence_plays_images_under_the_probe(bench):
    sequences = slicer.vtkSlicerSequencesLogic()
    sequences.SetMRMLScene(bench.scene)
    reference = put(add(bench.scene, "LinearTransform"), rigid(np.eye(3), [0, 0, 0.5]))
    transforms = sequence_of(bench.scene, [ABOVE @ rigid(np.eye(3), [0, 0, z]) for z in (0, 1)])
    images, browser = add(bench.scene, "Sequence", "images"), add(bench.scene, "SequenceBrowser")
    browser.SetAndObserveMasterSequenceNodeID(transforms.GetID())
    sequences.UpdateProxyNodesFromSequences(browser)
    browser.GetProxyNode(transforms).SetAndObserveTransformNodeID(reference.GetID())
    bench.logic.simulateSequence(bench.labels, transforms, images, browser_node=browser)
    browser.SetSelectedItemNumber(1)
    sequences.UpdateProxyNodesFromSequences(browser)
    shown = browser.GetProxyNode(images)
    assert shown.GetParentTransformNode() is browser.GetProxyNode(transforms)
    np.testing.assert_array_equal(pixels(shown), expected(ABOVE @ rigid(np.eye(3), [0, 0, 1.5]), 1))


def test_a_curve_is_swept_and_compounded(bench):
    """Image planes across the curve on the surface; the volume has an image's grey levels where the image is."""
    sequences = slicer.vtkSlicerSequencesLogic()
    sequences.SetMRMLScene(bench.scene)  # registers browsers
    curve = add(bench.scene, "MarkupsCurve", "path")
    for z in (-6, 0, 6):
        curve.AddControlPointWorld(0.0, -16.0, float(z))
    browser, transforms = bench.logic.followPath(bench.labels, curve)
    images, volume = add(bench.scene, "Sequence", "images"), add(bench.scene, "ScalarVolume", "volume")
    assert bench.logic.simulateSequence(bench.labels, transforms, images, browser_node=browser) == 13
    bench.logic.compoundSequence(images, volume)
    first, middle = (bench.logic.sequenceImage(images, number) for number in (0, 6))
    np.testing.assert_allclose(np.abs(middle.probe_to_world[:3, 2]), [0, 0, 1], atol=0.1)
    found = read_volume(volume)
    own = slice_under_probe(found, middle.grid, middle.probe_to_world)
    inside = own > 0
    assert inside.mean() > 0.8
    there, beside = (np.corrcoef(own[inside], one.image[inside])[0, 1] for one in (middle, first))
    assert there > 0.6 and beside < 0.5 * there, (there, beside)  # voxels blend two or three images; 6 mm away
    with pytest.raises(SimulationError, match="has 0 points, expected two or more"):
        bench.logic.followPath(bench.labels, add(bench.scene, "MarkupsLine", "nothing"))


def test_a_sequence_that_fails_or_is_cancelled_leaves_the_old_images(bench):
    images = add(bench.scene, "Sequence", "images")
    good = sequence_of(bench.scene, [ABOVE])
    bench.logic.simulateSequence(bench.labels, good, images)
    bad = sequence_of(bench.scene, [ABOVE, np.diag([2.0, 1, 1, 1])])
    with pytest.raises(SimulationError, match="item 1 of Sequence 'tracking' is not rigid"):
        bench.logic.simulateSequence(bench.labels, bad, images)

    def cancel(share):
        raise Cancelled

    with pytest.raises(Cancelled):
        bench.logic.simulateSequence(bench.labels, sequence_of(bench.scene, [ABOVE] * 3), images, progress=cancel)
    assert images.GetNumberOfDataNodes() == 1

    def remove(share):
        bench.scene.RemoveNode(bench.labels)

    with pytest.raises(SimulationError, match=r"label map .* has been removed from the scene"):
        bench.logic.simulateSequence(bench.labels, sequence_of(bench.scene, [ABOVE] * 3), images, progress=remove)
    assert images.GetNumberOfDataNodes() == 1


# ---- what is wrong ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda b: b.logic.simulate(None, b.probe, b.image), "no label map chosen, expected a LabelMapVolume or"),
        (lambda b: b.logic.simulate(b.probe, b.probe, b.image), "label map is LinearTransform 'Probe', expected"),
        (lambda b: b.logic.simulate(b.labels, b.probe, b.labels), "input and output are both LabelMapVolume 'tissues'"),
        (lambda b: b.logic.simulate(add(b.scene, "Segmentation", "empty"), b.probe, b.image), "'empty' is empty"),
        (lambda b: b.logic.segment(b.image, b.labels), "MRI Volume 'ultrasound' has no image data"),
        (lambda b: b.logic.segment(b.image, b.probe), "output of Segment is LinearTransform 'Probe', expected"),
        (lambda b: b.logic.placeProbe(b.labels, b.image), "probe transform is Volume 'ultrasound'"),
        (lambda b: b.logic.simulateSequence(b.labels, sequence_of(b.scene, []), b.image), "expected a Sequence node"),
        (lambda b: b.live(outline_node=b.image), "outline is Volume"),
    ],
)
def test_a_wrong_node_is_one_clear_error(bench, call, message):
    with pytest.raises(SimulationError) as caught:
        call(bench)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not bench.logic.isLive


def test_the_mri_is_never_the_output_and_other_wrong_content_is_refused(bench):
    bench.logic.parameters.mri = bench.image
    with pytest.raises(SimulationError, match="output is the MRI"):
        bench.simulate()
    bench.logic.parameters.mri = None
    hollow = add(bench.scene, "Segmentation", "hollow")
    write_labels(hollow, cyst().with_array(np.zeros_like(cyst().array)), ("speckle",), bench.grid())
    with pytest.raises(SimulationError, match="'hollow' is empty, expected a segment with voxels"):
        bench.logic.simulate(hollow, bench.probe, bench.image)


# ---- what the scene remembers ----------------------------------------------------------------------------------------


def save_scene(scene, nodes, folder) -> None:
    """Save a scene as scene.mrml in a folder, with the data of `nodes` beside it, as Slicer does."""
    scene.SetRootDirectory(str(folder))
    for node in nodes:
        node.AddDefaultStorageNode()
        storage = node.GetStorageNode()
        storage.SetFileName(str(folder / f"{node.GetName()}.{storage.GetDefaultWriteFileExtension()}"))
        assert storage.WriteData(node) == 1
    scene.SetURL(str(folder / "scene.mrml"))
    assert scene.Commit()


def test_a_saved_scene_opens_as_it_was_left(bench, tmp_path):
    names = ("labels", "probe_transform", "output")
    for name, node in zip(names, (bench.labels, bench.probe, bench.image), strict=True):
        setattr(bench.logic.parameters, name, node)
    bench.logic.parameters.contrast = "flair"
    bench.logic.parameters.thin_sulci = False
    bench.logic.parameters.classes = 4
    bench.logic.preset = bench.logic.preset.changed("display", gain_db=7.5)
    image = bench.simulate().image
    save_scene(bench.scene, (bench.labels, bench.probe, bench.image), tmp_path)
    scene = slicer.vtkMRMLScene()
    scene.SetURL(str(tmp_path / "scene.mrml"))
    assert scene.Connect()
    logic = UltrasoundSceneLogic(scene)
    parameters = logic.parameters
    assert [getattr(parameters, name).GetName() for name in names] == ["tissues", "Probe", "ultrasound"]
    assert (parameters.contrast, parameters.thin_sulci, parameters.classes) == ("flair", False, 4)
    assert logic.preset == bench.logic.preset
    assert parameters.output.GetParentTransformNode() is parameters.probe_transform
    np.testing.assert_array_equal(pixels(parameters.output), image)
    again = logic.simulate(parameters.labels, parameters.probe_transform, parameters.output)
    np.testing.assert_array_equal(again.image, image)


def test_parameters_have_the_form_of_slicers_parameter_node_wrapper(bench):
    parameters = bench.logic.parameters
    parameters.labels = bench.labels
    parameters.thin_sulci = False
    parameters.classes = 4
    node = bench.scene.GetSingletonNode("USSim", "vtkMRMLScriptedModuleNode")
    assert node is parameters.node and node.GetAttribute("ModuleName") == "USSim"
    assert node.GetNodeReference("labels") is bench.labels and node.HasParameter("labels")
    assert node.GetParameter("thin_sulci") == "False" and node.GetParameter("classes") == "4"
    assert node.GetParameter("display.image_size") == "96, 64"
    parameters.labels = None
    assert parameters.labels is None
    with pytest.raises(SimulationError, match="no 'label'"):
        parameters.label = bench.labels
    with pytest.raises(SimulationError, match="no 'label'"):
        parameters.label  # noqa: B018
    with pytest.raises(SimulationError, match=r"scene: classes is 4\.5, expected a whole number between 3 and 4"):
        parameters.classes = 4.5
    with pytest.raises(SimulationError, match="mri is a str, expected vtkMRMLScalarVolumeNode"):
        parameters.mri = "Head"
    node.SetParameter("classes", "7")  # a scene made by hand
    for name in ("classes", "segmentation"):
        with pytest.raises(SimulationError, match=r"classes is .*, expected a whole number between 3 and 4"):
            getattr(parameters, name)
    node.SetParameter("bias_correction", "maybe")
    with pytest.raises(SimulationError, match="bias_correction is 'maybe', expected true or false"):
        parameters.bias_correction  # noqa: B018
    with pytest.raises(SimulationError, match=r"mri is a .*LinearTransformNode, expected vtkMRMLScalarVolumeNode"):
        parameters.mri = bench.probe


def test_methods_of_the_logic_are_those_of_the_class_with_their_words():
    assert "Label the tissues" in (UltrasoundSceneLogic.segment.__doc__ or "")
    assert "mri_node" in inspect.signature(UltrasoundSceneLogic.segment).parameters


@pytest.mark.parametrize("settings", ["t1", {"contrast": "t1"}])
def test_settings_of_another_kind_are_refused(settings):
    with pytest.raises(SimulationError, match=r"settings is .*, expected a SegmentationSettings"):
        segment_mri(cyst(), settings)


def test_a_changed_value_of_a_preset_is_one_changed_parameter(bench):
    parameters, logic = bench.logic.parameters, bench.logic
    logic.preset = Preset()
    before, events = parameters.texts, []
    tag = parameters.node.AddObserver(vtkCommand.ModifiedEvent, lambda *_: events.append(1))
    logic.preset = logic.preset.changed("display", gain_db=3.0, image_size=(64, 48))
    assert parameters.texts == {**before, "display.gain_db": "3.0", "display.image_size": "64, 48"} and len(events) == 1
    logic.preset = logic.preset.changed("display", gain_db=3.0)
    assert len(events) == 1 and logic.preset is logic.preset
    logic.preset = logic.preset.changed("display", gain_db=0.0, image_size=None)
    assert parameters.texts == before and logic.preset == Preset() and len(events) == 2
    parameters.node.RemoveObserver(tag)


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("display.gain_db", "loud", "display.gain_db is 'loud', expected a number between -200 and 200"),
        ("probe.kind", "round", "probe.kind is 'round', expected one of linear, convex, phased"),
        ("probe.radius_mm", "30", "probe: radius_mm is not a parameter of a phased probe"),
        ("tissues.2", '{"name": "mud"}', "tissue 2: lacks speed_of_sound_m_s"),
        ("tissues.2", "mud", "tissues.2 is 'mud', which is not JSON"),
        ("membrane.fluids", "3", "membrane: fluids is 3, expected"),
    ],
)
def test_an_invalid_value_in_a_scene_is_named(bench, name, text, message):
    bench.logic.preset = Preset()
    bench.logic.parameters.node.SetParameter(name, text)
    with pytest.raises(SimulationError) as caught:
        bench.simulate()
    assert str(caught.value).startswith("the scene's preset: ") and message in str(caught.value)


def test_segment_takes_settings_and_single_values(bench, monkeypatch):
    asked = []

    def segmented(mri, *, settings, **_):
        asked.append(settings)
        raise SimulationError("enough")

    monkeypatch.setattr("SlicerUSSim.Logic.mrml.segment_logic.segment_image", segmented)
    settings, mri = SegmentationSettings("t2", thin_sulci=False), bench.grid()
    for chosen, values, expected in (
        (None, {}, SegmentationSettings()), (settings, {}, settings),
        (settings, {"filter_radius": 2}, replace(settings, filter_radius=2)),
    ):  # fmt: skip
        with pytest.raises(SimulationError, match="enough"):
            bench.logic.segment(mri, add(bench.scene, "LabelMapVolume"), chosen, **values)
        assert asked[-1] == expected
    with pytest.raises(SimulationError, match="segmentation: 'sulci' is unknown, expected one of contrast, classes"):
        bench.logic.segment(mri, add(bench.scene, "LabelMapVolume"), sulci=True)


def test_every_declared_setting_is_remembered_one_by_one_and_together(bench):
    parameters = bench.logic.parameters
    assert parameters.segmentation == SegmentationSettings() and parameters.fit == FitSettings()
    settings = SegmentationSettings("flair", 4, thin_sulci=False, filter_radius=2, filter_epsilon=0.25)
    parameters.segmentation = settings
    assert parameters.segmentation == settings and (parameters.contrast, parameters.filter_epsilon) == ("flair", 0.25)
    parameters.filter_epsilon = None
    assert parameters.segmentation == replace(settings, filter_epsilon=None)
    parameters.fit = FitSettings(frames="0,5", free="gain_db", register=True, restarts=0)
    parameters.fit_evaluations = 70
    assert parameters.fit == FitSettings("0,5", "gain_db", False, True, 70, 0)


def test_slicers_own_slice_view_shows_the_image_upright_and_not_mirrored(bench):
    """Through vtkMRMLSliceLogic, which renders Slicer's slice views."""
    application = slicer.vtkSlicerApplicationLogic()
    application.SetMRMLScene(bench.scene)
    application.GetColorLogic().SetMRMLScene(bench.scene)
    application.GetColorLogic().AddDefaultColorNodes()
    view_logic = slicer.vtkMRMLSliceLogic()
    view_logic.SetMRMLApplicationLogic(application)
    view_logic.SetMRMLScene(bench.scene)
    view = view_logic.AddSliceNode("Red")
    view_logic.ResizeSliceNode(200, 160)
    put(bench.probe, ABOVE @ rigid(Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), [0, 0, 0]))
    frame = bench.simulate()
    bench.logic.showInSlice(view, bench.image, bench.probe)
    assert view_logic.GetSliceCompositeNode().GetForegroundVolumeID() == bench.image.GetID()
    view_logic.UpdatePipeline()
    connection = view_logic.GetForegroundLayer().GetImageDataConnection()
    connection.GetProducer().Update()
    output = connection.GetProducer().GetOutputDataObject(0)
    shown = vtk_to_numpy(output.GetPointData().GetScalars())[:, 0].reshape(160, 200).astype(int)
    to_ras = np.array(view.GetXYToRAS().GetData()).reshape(4, 4)
    to_pixel = np.linalg.inv(frame.probe_to_ras @ frame.image_to_probe) @ to_ras
    compared = 0
    for x in range(3, 200, 7):
        for y in range(3, 160, 7):
            column, row, away, _ = to_pixel @ [x, y, 0, 1]
            assert abs(away) < 1e-6  # the view lies in the plane of the probe
            column, row = round(column), round(row)
            if 1 <= column < 62 and 1 <= row < 94:
                around = frame.image[row - 1 : row + 2, column - 1 : column + 2].astype(int)
                assert around.min() - 2 <= shown[y, x] <= around.max() + 2, (x, y)
                compared += 1
    assert compared > 100
    top = shown[np.flatnonzero(shown.any(axis=1))[-1]]  # VTK counts rows from below
    assert top.mean() > 0 and to_pixel[1, 1] < 0 < to_pixel[0, 0]  # depth runs down, left is left


@pytest.mark.long
def test_the_example_builds_a_scene_and_saves_it_so_that_it_opens(mni, tmp_path, capsys):
    slicer_scene = example("slicer_scene")
    slicer_scene.main(tmp_path / "brain.mrb")
    said = capsys.readouterr().out
    assert "13 images followed the probe" in said and "the same image (100.00%)" in said
    scene = slicer_scene.read_back(tmp_path / "brain.mrb")
    browser = scene.GetFirstNodeByClass("vtkMRMLSequenceBrowserNode")
    assert browser.GetNumberOfItems() == 13 and browser.GetNumberOfSynchronizedSequenceNodes(True) == 2
    nodes = UltrasoundSceneLogic(scene).parameters
    assert nodes.mri.GetImageData().GetDimensions() == (197, 233, 189)
    assert nodes.labels.GetSegmentation().GetNumberOfSegments() == 4
    # Live has ended: the image is where the probe was, and does not move with it
    assert nodes.output.GetParentTransformNode() is None and pixels(nodes.output).mean() > 10
    about = about_image(nodes.output)
    grid = ImageGrid.for_probe(Preset.from_dict(about["preset"]).probe, None)
    np.testing.assert_allclose(
        ijk_to_ras(nodes.output), np.array(about["probe_to_ras"]) @ grid.slice_to_probe, atol=1e-3
    )


# ---- what an image is of ---------------------------------------------------------------------------------------------


def test_an_image_says_whose_it_is_and_how_and_when_it_was_taken(bench):
    before = datetime.now(timezone.utc)
    bench.labels.SetAttribute("SlicerUSSim.patient", "somebody.nii.gz")
    bench.simulate()
    about = about_image(bench.image)
    assert about["patient"] == "somebody.nii.gz" and Preset.from_dict(about["preset"]) == bench.logic.preset
    np.testing.assert_allclose(about["probe_to_ras"], ABOVE)
    assert abs((datetime.fromisoformat(about["time"]) - before).total_seconds()) < 60.0
    assert about_image(bench.labels) == {}


def test_a_frozen_image_stays_where_it_was_taken(bench, tmp_path):
    """Under the probe's transform it was shown where the probe had been moved to."""
    loop = Loop()
    bench.live(schedule=loop)
    assert bench.image.GetTransformNodeID() == bench.probe.GetID() and not is_frozen(bench.image)
    taken = node_to_world(bench.image) @ ijk_to_ras(bench.image)
    put(bench.probe, ABOVE @ rigid(np.eye(3), [0, 0, 3]))  # of which no image was made before the end
    bench.logic.stopLiveUpdate()
    loop.run()
    put(bench.probe, ABOVE @ rigid(np.eye(3), [4, 0, 3]))
    assert is_frozen(bench.image) and bench.image.GetTransformNodeID() is None
    np.testing.assert_allclose(node_to_world(bench.image) @ ijk_to_ras(bench.image), taken, atol=1e-9)
    np.testing.assert_allclose(bench.logic.lastImage().ijk_to_ras, taken, atol=1e-9)
    np.testing.assert_allclose(about_image(bench.image)["probe_to_ras"], ABOVE, atol=1e-6)
    bench.live(schedule=loop)  # and follows again
    assert bench.image.GetTransformNodeID() == bench.probe.GetID() and not is_frozen(bench.image)


@pytest.mark.parametrize("is_live", [False, True])
def test_a_simulation_that_fails_leaves_no_old_image(bench, is_live, monkeypatch):
    loop = Loop()
    bench.live(schedule=loop) if is_live else bench.simulate()
    assert bench.image.GetImageData() is not None
    put(bench.probe, np.diag([2.0, 1, 1, 1]))
    if is_live:
        assert loop.run() == 1 and bench.logic.isLive
    else:
        with pytest.raises(SimulationError, match="not rigid"):
            bench.simulate()
    assert bench.image.GetImageData() is None and bench.logic.taken is None and about_image(bench.image) == {}
    with pytest.raises(SimulationError, match="there is no image"):
        bench.logic.lastImage()
    put(bench.probe, ABOVE)
    loop.run() if is_live else bench.simulate()
    np.testing.assert_array_equal(pixels(bench.image), expected(ABOVE))
    if not is_live:

        def cancelled(*_, **__):
            raise Cancelled

        monkeypatch.setattr(UltrasoundSimulator, "simulate", cancelled)
        with pytest.raises(Cancelled):
            bench.simulate()
        assert bench.image.GetImageData() is None and bench.logic.taken is None


def test_a_patient_is_forgotten(bench):
    bench.simulate()
    kept = weakref.ref(bench.logic.patients._simulators._simulator)
    bench.logic.clearImage(bench.image)
    bench.logic.forgetPatient()
    gc.collect()
    assert kept() is None and bench.logic.taken is None and bench.image.GetImageData() is None
