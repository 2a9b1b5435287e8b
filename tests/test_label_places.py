"""Label maps whose numbers or header would mislead: tissues in another order, heads upside down, parts of one."""

from __future__ import annotations

import re
from itertools import permutations

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.mri import segment_mri
from SlicerUSSim.Logic.tissue import LabelMapping, read_label_file, read_label_map
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
    "labels",
    [
        FIRST,
        [2, 3, 41, 42],
        ASEG,
        WMPARC,
        DESTRIEUX,
        [label for label in SYNTHSEG if label not in (7, 8, 46, 47)],  # a cerebrum
    ],
    ids=["FIRST", "ribbon", "aseg", "wmparc", "a2009s", "cerebrum"],
)
def test_parts_of_a_brain_in_freesurfers_numbers_are_read(labels):
    assert not read_label_map(freesurfer(labels)).warnings


def test_a_body_in_three_layers_is_no_brain_and_read_by_its_numbering():
    _, y, x = np.indices((40, 50, 60)) * 8.0 - np.array([156, 196, 236])[:, None, None, None]
    radius = np.sqrt((x / 1.3) ** 2 + y**2)
    body = Volume(np.select([radius > 160, radius > 130, radius > 115], [0, 1, 3], 2).astype(np.uint8),
                  np.diag([8.0, 8.0, 8.0, 1.0]))  # fmt: skip
    assert "no program's numbers are recognised" in str(refusal_of(body))
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
