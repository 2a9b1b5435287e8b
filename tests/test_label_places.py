"""Label maps whose numbers or header would mislead: tissues in another order, heads upside down, parts of one."""

from __future__ import annotations

import re
from itertools import permutations, product

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.mri import segment_mri
from SlicerUSSim.Logic.tissue import LabelMapping, read_label_file, read_label_map
from SlicerUSSim.Logic.tissue.freesurfer import freesurfer_names
from SlicerUSSim.Logic.tissue.interpolated_labels import share_between
from SlicerUSSim.Logic.tissue.label_sources import is_label_file
from SlicerUSSim.Logic.tissue.probability_maps import combined_probability_maps
from tests.test_label_maps import (
    ASEG,
    DESTRIEUX,
    SYNTHSEG,
    WMPARC,
    brain,
    freesurfer,
    head,
    probability_maps,
    refusal_of,
    refused,
)

NAMES = ("csf", "grey matter", "white matter")
FAST = {"csf": "T1_pve_0.nii.gz", "grey matter": "T1_pve_1.nii.gz", "white matter": "T1_pve_2.nii.gz"}
SPM = {"grey matter": "c1T1.nii.gz", "white matter": "c2T1.nii.gz", "csf": "c3T1.nii.gz"}


def in_order(numbers: tuple[int, int, int], *, has_sulci: bool = False) -> Volume:
    """A brain with CSF in its ventricles, or also around it, whose CSF, grey and white matter have these numbers."""
    z, y, x = np.indices((50, 50, 50)) * 3.0 - 73.5
    radius = np.sqrt(x**2 + y**2 + z**2)
    ventricle = (np.abs(x) > 3) & (np.abs(x) < 15) & (np.abs(y) < 30) & (np.abs(z) < 9)
    outermost = 1 if has_sulci else 0
    shells = np.select([radius > 68, radius > 65, ventricle, radius > 50], [0, outermost, 1, 2], 3)
    return Volume(np.array([0, *numbers], np.uint8)[shells], np.diag([3.0, 3.0, 3.0, 1.0]))


# ---- three tissues in some order -------------------------------------------------------------------------------------


@pytest.mark.parametrize("has_sulci", [False, True])
def test_three_tissues_are_read_in_our_order_and_refused_in_others(has_sulci):
    for csf, grey, white in permutations((1, 2, 3)):
        numbers = (csf, grey, white)
        volume = in_order(numbers, has_sulci=has_sulci)
        truth = dict(sorted(zip(numbers, NAMES, strict=True)))
        if numbers == (1, 2, 3):
            assert "ussim segment and FSL FAST" in read_label_map(volume).message
            continue
        message = str(refusal_of(volume))
        maps = " ".join(f"--map {number}={name.split()[0]}" for number, name in truth.items())
        assert message.endswith(f"if that is right, say so with {maps}"), message
        found = read_label_map(volume, mapping=LabelMapping.of(re.findall(r"--map (\S+)", message)))
        assert [found.names[found.relabelled[number] - 1] for number in truth] == list(truth.values())


@pytest.mark.parametrize("numbers", [(10, 150, 250), (2, 3, 4), (120, 121, 122)])
def test_other_numbers_get_a_proposal_but_no_tissues(numbers):
    """2 to 4 were moved by one: CSF was grey matter, and white matter leptomeninges; FreeSurfer never writes 120."""
    message = str(refusal_of(in_order(numbers, has_sulci=True)))
    assert message.endswith("--map {}=csf --map {}=grey --map {}=white".format(*numbers)), message
    assert "FreeSurfer" not in message


def test_a_tumour_as_label_4_is_no_leptomeninges():
    """9 ml deep in white matter became leptomeninges, as did deep nuclei, and a lesion as thin as the slices."""
    brain_ = in_order((1, 2, 3), has_sulci=True)
    z, y, x = np.indices(brain_.array.shape) * 3.0 - 73.5
    ball = np.hypot(np.hypot(x - 30, y), z) < 13
    message = str(refusal_of(brain_.with_array(np.where(ball, 4, brain_.array))))
    assert "3 white matter" in message and "4 something else (" in message
    assert message.endswith("--map 1=csf --map 2=grey --map 3=white --map 4=TISSUE")
    thin = np.zeros(ball.shape, bool)
    thin[24:26, 24:27, 36:39] = True  # 6 mm, two voxels
    assert (brain_.array[thin] == 3).all()
    assert "4 something else" in str(refusal_of(brain_.with_array(np.where(thin, 4, brain_.array))))
    radius = np.sqrt(x**2 + y**2 + z**2)
    sulci = (np.abs(radius - 62) < 4) & (np.abs(np.sin(x / 9)) < 0.3) & (brain_.array == 2)
    found = read_label_map(brain_.with_array(np.where(sulci, 4, brain_.array)))
    assert "leptomeninges" in found.names


@pytest.mark.parametrize(("numbers", "thin"), [((3, 2, 1), 4), ((1, 3, 2), 4), ((1, 2, 3), 5)])
def test_labels_of_other_contrasts_are_refused_with_their_order(numbers, thin):
    """The advice was to leave all of it out."""
    brain_ = in_order(numbers, has_sulci=True)
    z, y, x = np.indices(brain_.array.shape) * 3.0 - 73.5
    radius = np.sqrt(x**2 + y**2 + z**2)
    sulci = (np.abs(radius - 62) < 4) & (np.abs(np.sin(x / 9)) < 0.3) & (brain_.array == numbers[1])
    array = np.where(sulci, thin, brain_.array)
    if thin == 5:
        array[24:27, 24:27, 24:27] = 4  # what enhances
    message = str(refusal_of(brain_.with_array(array)))
    truth = dict(zip(numbers, ("csf", "grey", "white"), strict=True)) | {thin: "leptomeninges"}
    for number, name in truth.items():
        assert f"--map {number}={name}" in message, message
    if thin == 5:
        assert message.endswith("--map 4=enhancing --map 5=leptomeninges")
        found = read_label_map(brain_.with_array(array), mapping=LabelMapping.of(re.findall(r"--map (\S+)", message)))
        assert found.names == ("csf", "grey matter", "white matter", "enhancing", "leptomeninges")
        array[14:35, 14:35, 14:35] = 4  # a fifth of the brain
        assert "--map 4=TISSUE" in str(refusal_of(brain_.with_array(array)))


# ---- the head's way up -----------------------------------------------------------------------------------------------


def whole_head(*, structures: tuple[str, ...] = ("cerebellum", "brain stem")) -> Volume:
    """A round brain with cerebellum and brain stem in FreeSurfer's numbers."""
    volume = head()
    array = volume.array.astype(np.int16)
    k, j, i = np.indices(array.shape)
    x, y, z = (volume.ijk_to_ras[:3, :3] @ np.stack([i, j, k]).reshape(3, -1)).reshape(3, *array.shape)
    x, y, z = (v + offset for v, offset in zip((x, y, z), volume.ijk_to_ras[:3, 3], strict=True))
    if "cerebellum" in structures:
        array[(x**2 / 3 + (y + 35) ** 2 + (z + 47) ** 2) < 16**2] = 8
        array[(array == 8) & (x > 0)] = 47
    if "brain stem" in structures:
        array[(x**2 + (y + 8) ** 2) * 2 + (z + 45) ** 2 < 15**2] = 16
    return volume.with_array(array)


def moved(volume: Volume, *, flip: str = "", turned: tuple[float, float, float] = (0, 0, 0)) -> Volume:
    """The volume with another header: axes mirrored, then turned by degrees about each axis."""
    mirror = np.diag([-1.0 if axis in flip else 1.0 for axis in "xyz"] + [1.0])
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xyz", turned, degrees=True).as_matrix()
    return Volume(volume.array, turn @ mirror @ volume.ijk_to_ras)


TILTS = [(0, 0, 0), (45, 0, 0), (-45, 0, 0), (0, 40, 0), (0, 0, -40), (30, 20, 20), (-30, -20, 20)]


@pytest.mark.parametrize("structures", [("cerebellum", "brain stem"), ("cerebellum",)])
def test_a_head_that_is_tilted_is_no_head_upside_down(structures):
    for turned in TILTS:
        found = read_label_map(moved(whole_head(structures=structures), turned=turned))
        assert found.message.startswith("FreeSurfer") and not found.warnings, turned


@pytest.mark.parametrize(("flip", "words"), [("z", "upside down"), ("y", "back to front"), ("yz", "upside down")])
def test_a_head_whose_header_is_mirrored_is_refused_also_if_it_is_tilted(flip, words):
    for turned in ((0, 0, 0), (30, 0, 0), (-30, 0, 0), (0, 30, 0)):
        assert words in str(refusal_of(moved(whole_head(), flip=flip, turned=turned))), turned


def body(*, flip: str = "", words: str = "{}") -> tuple[Volume, dict[int, str]]:
    """(labels, names) of a supine body in balls of 28 mm; their places in cm (right, front, up) as in an atlas."""
    places = {
        "sacrum": (0, -6, -20), "vertebrae_L5": (0, -4, -14), "vertebrae_L3": (0, -3, -7), "vertebrae_L1": (0, -4, 0),
        "vertebrae_T8": (0, -7, 16), "urinary_bladder": (0, 5, -24), "kidney_left": (-7, -3, 0), "liver": (8, 3, 6),
        "kidney_right": (7, -3, -2), "spleen": (-10, -4, 7), "heart": (-3, 4, 14), "sternum": (0, 10, 17),
        "autochthon_left": (-4, -9, 0), "autochthon_right": (4, -9, 0), "aorta": (-1, -1, 3),
        "spinal_cord": (0, -9, 10),
    }  # fmt: skip
    at = np.indices((70, 50, 50))[::-1] * 10.0 - np.array([250.0, 250.0, 350.0])[:, None, None, None]
    labels, names = np.zeros((70, 50, 50), np.uint8), {}
    for label, (name, place) in enumerate(places.items(), 1):
        centre = np.array(place, float) * 10.0
        centre[["xyz".index(axis) for axis in flip]] *= -1
        labels[np.linalg.norm(at - centre[:, None, None, None], axis=0) < 14.0] = label
        names[label] = words.format(name)
    return Volume(labels, np.diag([10.0, 10.0, 10.0, 1.0])), names


def test_a_body_whose_header_is_mirrored_is_refused_or_said():
    whole, names = body()
    assert not any("side" in warning for warning in read_label_map(whole, names).warnings)
    assert "by its header, structures lie in the wrong order: the body is upside down" in str(
        refusal_of(*body(flip="z"))
    )
    assert "the body is back to front" in str(refusal_of(*body(flip="y")))
    spaced = {label: name.replace("_", " ").title() for label, name in names.items()}
    for mirrored in (names, spaced):
        warnings = " ".join(read_label_map(body(flip="x")[0], mirrored).warnings)
        assert warnings.count("labels of the left side are on the right; check the orientation in its header") == 1
    some = {label: name for label, name in names.items() if "kidney" in name or name == "liver"}
    part = whole.with_array(np.where(np.isin(whole.array, list(some)), whole.array, 0))
    assert not read_label_map(part, some).warnings


def test_a_head_with_exchanged_axes_is_refused_or_its_sides_are_said():
    """Of the 48 orders and signs of axes only the right one passes in silence, and the one that exchanges sides."""
    head_ = whole_head()
    accepted = {}
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.eye(4)
            matrix[:3, :3] = np.diag(signs) @ np.eye(3)[list(order)]
            turned = Volume(head_.array, matrix @ head_.ijk_to_ras)
            try:
                accepted[(order, signs)] = read_label_map(turned).warnings
            except SimulationError as error:
                assert "in its header" in str(error)
    right, mirrored = ((0, 1, 2), (1.0, 1.0, 1.0)), ((0, 1, 2), (-1.0, 1.0, 1.0))
    assert right in accepted and set(accepted) <= {right, mirrored}
    assert not accepted[right] and all("left side" in line for line in accepted.get(mirrored, ()))


def test_one_structure_below_the_cerebrum_is_enough_for_a_head_upside_down():
    for structure in ("cerebellum", "brain stem"):
        message = str(refusal_of(moved(whole_head(structures=(structure,)), flip="z")))
        assert f"by its header, {structure} lies above the cerebrum's centre by" in message and "upside" in message


def test_names_are_judged_as_numbers_are_and_the_users_own_tissues_are_not():
    mirrored = moved(whole_head(), flip="z")
    of_label = {label: freesurfer_names()[label] for label in np.unique(mirrored.array).tolist() if label}
    assert "upside down" in str(refusal_of(mirrored, of_label))
    mapping = LabelMapping.of({8: "grey matter", 47: "grey matter", 16: "white matter"})
    assert read_label_map(mirrored, of_label, mapping).names


# ---- parts of FreeSurfer's segmentation ------------------------------------------------------------------------------


@pytest.mark.parametrize("labels", [(2, 3, 4, 10), (2, 3), (3, 42), (2, 3, 4, 5, 7, 8, 10, 11, 12, 13, 17, 18, 26, 28)])
def test_a_part_of_freesurfers_segmentation_is_refused_with_its_numbering(labels):
    volume = head()
    array = np.where(np.isin(volume.array, labels), volume.array, 0).astype(np.int16)
    for place, label in enumerate(label for label in labels if not (array == label).any()):
        array[20 + place, 25:28, 15:18] = label
    part = volume.with_array(array)
    message = str(refusal_of(part))
    assert "are all in FreeSurfer's table" in message and message.endswith("say which with --map freesurfer"), message
    assert "leptomeninges" not in message  # no list of all tissues
    assert read_label_map(part, mapping=LabelMapping.of("freesurfer")).message.startswith("FreeSurfer")


FIRST = [10, 11, 12, 13, 17, 18, 26, 49, 50, 51, 52, 53, 54, 58, 16]


@pytest.mark.parametrize(
    ("labels", "missing"),
    [
        (FIRST, "without cortex, cerebral white matter, ventricles, cerebellum"),
        ([2, 3, 41, 42], "without ventricles, cerebellum"),
        (ASEG, None),
        (WMPARC, None),
        (DESTRIEUX, None),
        ([label for label in SYNTHSEG if label not in (7, 8, 46, 47)], None),  # a cerebrum
    ],
    ids=["FIRST", "ribbon", "aseg", "wmparc", "a2009s", "cerebrum"],
)
def test_parts_of_a_brain_in_freesurfers_numbers_are_read_and_said(labels, missing):
    warnings = read_label_map(freesurfer(labels)).warnings
    assert [missing in line for line in warnings] == [True] if missing else not warnings


def test_a_body_in_three_layers_is_no_brain_and_read_by_its_numbering():
    _, y, x = np.indices((40, 50, 60)) * 8.0 - np.array([156, 196, 236])[:, None, None, None]
    radius = np.sqrt((x / 1.3) ** 2 + y**2)
    body = Volume(np.select([radius > 160, radius > 130, radius > 115], [0, 1, 3], 2).astype(np.uint8),
                  np.diag([8.0, 8.0, 8.0, 1.0]))  # fmt: skip
    message = str(refusal_of(body))
    assert "TotalSegmentator tissue_types's table" in message and "litres, label 1 around the others" in message
    assert message.endswith("say which with --map totalsegmentator-tissues")
    found = read_label_map(body, mapping=LabelMapping.of("totalsegmentator-tissues"))
    assert [found.names[found.relabelled[label] - 1] for label in (1, 2, 3)] == ["fat", "fat", "muscle"]
    ours = in_order((1, 2, 3))
    double = Volume(ours.array, np.diag([2.0, 2.0, 2.0, 1.0]) @ ours.ijk_to_ras)  # a brain of eight times the size
    assert "no program's numbers are recognised" in str(refusal_of(double))


# ---- probability maps in larger numbers ------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale", "dtype"), [(255, np.uint8), (100, np.float32)])
def test_probability_maps_up_to_100_or_255_are_combined(scale, dtype, tmp_path):
    labels = probability_maps(tmp_path, SPM)
    for name in SPM.values():
        volume = Volume.read(tmp_path / name)
        volume.with_array(np.rint(volume.array * scale).astype(dtype)).write(tmp_path / name)
    for tissue, name in SPM.items():
        path = tmp_path / name
        assert is_label_file(path, Volume.read(path)), name
        found = read_label_file(path, Volume.read(path))
        assert f"a tissue probability map (SPM, {tissue}), combined with" in found.message
        assert np.mean(found.labels.array == labels.array) > 0.97  # but for voxels at the borders


def test_a_nearly_binary_probability_map_alone_is_refused(tmp_path):
    white = brain({"csf": 0, "grey matter": 0, "white matter": 1})
    fine = ndimage.gaussian_filter(ndimage.zoom(white.array.astype(np.float32), 2, order=0), 0.7)
    for name in ("white.nii.gz", "c2T1.nii.gz"):
        volume = Volume(np.rint(fine * 255).astype(np.uint8), np.diag([1.5, 1.5, 1.5, 1.0]))
        with pytest.raises(SimulationError, match=r"a (tissue )?probability map .*, not an MRI; "):
            assert is_label_file(tmp_path / name, volume)
            read_label_file(tmp_path / name, volume)


def test_a_mask_or_label_map_up_to_255_is_no_probability_map(tmp_path):
    white = brain({"csf": 0, "grey matter": 17, "white matter": 255})
    for volume in (white, white.with_array(white.array // 255 * 255)):
        assert combined_probability_maps(tmp_path / "c2T1.nii.gz", volume) is None


T2 = {"white matter": "T2_pve_0.nii.gz", "grey matter": "T2_pve_1.nii.gz", "csf": "T2_pve_2.nii.gz"}


def test_fasts_maps_of_a_t2_are_refused_with_the_order_of_their_places(tmp_path):
    labels = probability_maps(tmp_path, T2)
    path, out = tmp_path / "T2_pve_0.nii.gz", tmp_path / "o.png"
    message = refused("simulate", path, "--pose", "auto", "-o", out)
    assert "(labels 1 T2_pve_0.nii.gz, 2 T2_pve_1.nii.gz, 3 T2_pve_2.nii.gz)" in message
    assert re.search(r"but 1 white matter \(\d+%\), 2 grey matter \(\d+%\), 3 csf \(\d+%\), as of a T2", message)
    assert message.endswith("say so with --map 1=white --map 2=grey --map 3=csf") and not out.exists()
    found = read_label_file(path, Volume.read(path), LabelMapping.of(re.findall(r"--map (\S+)", message)))
    truth = np.array(["", *NAMES])[labels.array]
    assert np.mean(np.array(["", *found.names])[found.labels.array] == truth) > 0.97


def test_maps_named_by_tissue_are_refused_only_if_another_order_is_sure(tmp_path):
    probability_maps(tmp_path, dict(zip(SPM, [SPM["white matter"], SPM["grey matter"], SPM["csf"]], strict=True)))
    message = refused("simulate", tmp_path / SPM["csf"], "--pose", "auto", "-o", tmp_path / "o.png")
    assert "--map 1=csf --map 2=white --map 3=grey" in message and "T2" not in message
    for folder, names, is_read in ((tmp_path / "spm", SPM, True), (tmp_path / "fast", T2, False)):
        folder.mkdir()
        probability_maps(folder, names)
        for name in names.values():  # a block within the brain, without an outside
            volume = Volume.read(folder / name)
            Volume(volume.array[15:35, 10:40, 3:24], volume.ijk_to_ras).write(folder / name)
        path = folder / names["csf"]
        if is_read:
            assert read_label_file(path, Volume.read(path)).names == NAMES
        else:
            with pytest.raises(SimulationError, match=r"are not surely 1 csf \(.*; if that is right, .*--map 3=white"):
                read_label_file(path, Volume.read(path))


def test_a_fourth_map_by_brightness_is_refused_and_not_left_out(tmp_path):
    probability_maps(tmp_path, FAST)
    fourth = tmp_path / "T1_pve_3.nii.gz"
    Volume.read(tmp_path / FAST["csf"]).write(fourth)
    for path in (tmp_path / FAST["grey matter"], fourth):
        with pytest.raises(SimulationError, match=r"of 4 classes .*, expected 3.*-n 3"):
            read_label_file(path, Volume.read(path))


def test_cat12s_partial_volume_map_is_read_as_its_nearest_tissues(tmp_path):
    labels = brain({"csf": 1, "grey matter": 2, "white matter": 3})
    fine = ndimage.gaussian_filter(ndimage.zoom(labels.array.astype(np.float32), 2, order=0), 0.7)
    p0 = Volume(np.rint(fine * 85).astype(np.float32) / np.float32(85), np.diag([1.5, 1.5, 1.5, 1.0]))
    with pytest.raises(SimulationError, match="is a partial volume map of three tissues, as CAT12's p0"):
        segment_mri(p0)
    found = read_label_file(tmp_path / "p0T1.nii", p0)
    assert found.message.startswith("CAT12's partial volume map (p0), 3 tissues: 1 csf")
    assert found.names == NAMES and np.mean(found.labels.array[::2, ::2, ::2] == labels.array) > 0.95


@pytest.mark.parametrize("name", ["mwp1T1.nii", "smwc1T1.nii", "m0wp1T1.nii"])
def test_a_modulated_map_is_refused_as_one(name, tmp_path):
    """It was refused with the contrast that it resembles."""
    probability_maps(tmp_path, SPM)
    grey = Volume.read(tmp_path / SPM["grey matter"])
    grey.with_array(grey.array * np.float32(1.3)).write(tmp_path / name)
    message = refused("segment", tmp_path / name, "-o", tmp_path / "l.nii.gz")
    assert f"{name}: a modulated tissue map ({name[:-6]}, volumes" in message and "c1, c2, c3 of SPM" in message


@pytest.mark.slow
@pytest.mark.parametrize("cut_at", [100, 80])  # also with the brightest cut off, as pictures have
def test_an_mri_of_their_range_is_no_tissue_map_whatever_it_is_called(cut_at, mni, tmp_path):
    t1 = mni[0].array[::2, ::2, ::2].astype(np.float32)
    top = np.percentile(t1[t1 > 0], cut_at)
    share = np.minimum(t1, top) / np.float32(top)
    small = Volume(share * np.float32(3), np.diag([2.0, 2.0, 2.0, 1.0]))
    assert not is_label_file(tmp_path / "p0T1.nii", small)
    assert not is_label_file(tmp_path / "mwp1T1.nii", small.with_array(t1))
    for scale in (100, 255):
        volume = small.with_array(np.rint(share * scale).astype(np.uint8))
        for name in SPM.values():
            volume.write(tmp_path / name)
        for name in ("t1.nii.gz", *SPM.values()):  # with two companions, which add up to three times as much
            assert combined_probability_maps(tmp_path / name, volume) is None


def test_a_background_that_is_not_0_is_recognised():
    """ITK-SNAP and machine learning use 255; it was one more label that no program knows."""
    right = in_order((1, 2, 3))
    volume = right.with_array(np.where(right.array == 0, 255, right.array).astype(np.uint8))
    with pytest.raises(SimulationError, match=r"label 255 fills \d+% of the volume and all its corners.*--map 255=0"):
        read_label_map(volume, source="b.nii.gz")
    found = read_label_map(volume, mapping=LabelMapping.of(["255=0"]), source="b.nii.gz")
    np.testing.assert_array_equal(found.labels.array, read_label_map(right).labels.array)


@pytest.mark.parametrize("scale", [0.2, 1.0, 3.0])
def test_a_brain_of_an_impossible_size_is_said(scale):
    volume = in_order((1, 2, 3))
    sized = Volume(volume.array, volume.ijk_to_ras @ np.diag([scale] * 3 + [1.0]))
    mapping = LabelMapping.of(dict(enumerate(NAMES, 1)))
    doubts = [line for line in read_label_map(sized, mapping=mapping).warnings if "size of the voxels" in line]
    assert bool(doubts) == (scale != 1.0), doubts


def test_a_mirrored_freesurfer_map_of_few_structures_says_so():
    """Formerly "no program's numbers are recognised", with the advice to leave all labels out."""
    array = np.zeros((30, 30, 30), np.uint8)
    for label, i in ((2, 20), (41, 6), (3, 24), (42, 2)):  # left structures at large i, which is right
        array[8:22, 8:22, i : i + 4] = label
    labels = Volume(array, np.diag([4.0, 4.0, 4.0, 1.0]))
    message = str(refusal_of(labels))
    assert "are all in FreeSurfer's table, but structures of the left do not lie to the left" in message
    assert "check the orientation in its header" in message and "--map freesurfer" in message
    known = read_label_map(labels, mapping=LabelMapping.of(["freesurfer"]))
    assert any("labels of the left side are on the right" in line for line in known.warnings)


# ---- parts of a brain ------------------------------------------------------------------------------------------------


def kept(volume: Volume, axis: int, low: float, high: float) -> Volume:
    """What lies between two coordinates (RAS mm) along an axis; the rest is 0."""
    ijk = np.indices(volume.array.shape)[::-1].reshape(3, -1)
    place = (volume.ijk_to_ras[axis, :3] @ ijk + volume.ijk_to_ras[axis, 3]).reshape(volume.array.shape)
    return volume.with_array(np.where((place >= low) & (place <= high), volume.array, 0))


@pytest.mark.parametrize(
    ("axis", "low", "high", "sides"),
    [
        (0, -80, 4, "the right"), (1, 0, 80, "the back"), (2, -80, 10, "the top"),
        (1, -30, 30, "the back and the front"),
    ],
)  # fmt: skip
def test_a_brain_that_was_cut_is_said_to_be_a_part_and_where_it_was_cut(axis, low, high, sides):
    assert not read_label_map(whole_head()).warnings
    part = kept(whole_head(), axis, low, high)
    cropped = part.array[tuple(slice(n.min(), n.max() + 1) for n in np.nonzero(part.array))]
    for volume in (part, Volume(cropped, part.ijk_to_ras)):
        warnings = read_label_map(volume, mapping=LabelMapping.of("freesurfer")).warnings
        assert any("a part of a brain of" in line and f"cut off at {sides}: what" in line for line in warnings), (
            warnings
        )


def test_a_part_of_a_brain_is_not_judged_by_where_the_whole_has_its_centre():
    """The lower half was refused as upside down, "below the cerebrum's centre"."""
    lower = kept(whole_head(), 2, -80, -25)
    assert any("cut off at the top: what" in line for line in read_label_map(lower).warnings)
    with pytest.raises(SimulationError, match=r"back to front|upside down"):
        read_label_map(moved(kept(whole_head(), 2, -80, 10), flip="y"), mapping=LabelMapping.of("freesurfer"))


def test_one_hemisphere_is_said_however_its_medial_face_lies():
    turned = moved(whole_head(), turned=(0, 0, 30))
    left = turned.with_array(np.where(np.isin(turned.array, [2, 3, 4, 8, 10]), turned.array, 0))
    (warning,) = read_label_map(left, mapping=LabelMapping.of("freesurfer")).warnings
    assert "cut off at the right" in warning


def turned_by_10_degrees(volume: Volume, order: int) -> Volume:
    """Whole numbers interpolated with splines of an order."""
    turn = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    offset = (np.eye(3) - turn) @ np.array(volume.array.shape) / 2
    return volume.with_array(np.rint(ndimage.affine_transform(volume.array.astype(float), turn, offset, order=order)))


def test_labels_that_were_interpolated_and_rounded_are_said():
    whole = whole_head()
    nearest, linear = (turned_by_10_degrees(whole, order) for order in (0, 1))
    assert not read_label_map(nearest).warnings
    halfway = whole.with_array(np.rint(ndimage.shift(whole.array.astype(float), (0, 0, 0.5), order=1)))
    for volume in (linear, halfway):  # 2 and 41 have any number between them, some of which FreeSurfer has not
        message = str(refusal_of(volume))
        assert "resampled with interpolation and rounded" in message and "nearest neighbours" in message
    known = np.isin(linear.array, list(freesurfer_names()))
    linear = linear.with_array(np.where(known, linear.array, 0))
    warnings = read_label_map(linear, mapping=LabelMapping.of("freesurfer")).warnings
    assert any("resampled with interpolation and rounded" in line for line in warnings), warnings


def test_layers_of_a_head_are_not_said_to_be_interpolated():
    """Skin, scalp, skull and marrow are numbered in their order, so that each is between its neighbours' numbers."""
    names = ("csf", "grey matter", "white matter", "leptomeninges", "skin", "scalp", "skull", "cancellous bone", "air")
    radii = (50.0, 62.0, 64.0, 66.0, 67.0, 69.0, 72.0, 75.0, 83.0, 86.0)
    axis = np.arange(-92.0, 92.1, 4.0)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    radius, labels = np.sqrt(x**2 + y**2 + z**2), np.zeros((len(axis),) * 3, np.uint8)
    for outer, number in reversed(list(zip(radii, (3, 2, 4, 1, 0, 7, 8, 7, 6, 5), strict=True))):
        labels[radius <= outer] = number
    labels[(np.abs(y) < 12) & (x**2 + (z + 20) ** 2 < 12**2)] = 1
    labels[(x**2 + (y - 79) ** 2 + (z + 30) ** 2) < 5**2] = 9
    whole = Volume(labels, np.diag([4.0, 4.0, 4.0, 1.0]))
    assert share_between(labels)[0] > 0.17  # by the numbers alone it is doubtful
    nearest, linear = (turned_by_10_degrees(whole, order) for order in (0, 1))
    told = [read_label_map(one, dict(enumerate(names, 1))).warnings for one in (whole, nearest, linear)]
    doubted = [any("resampled with interpolation" in line for line in lines) for lines in told]
    assert doubted == [False, False, True], told
