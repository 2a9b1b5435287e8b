"""Label maps of other programs: recognised by numbers, places and names, or refused in one line with a remedy."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import ndimage
from scipy.spatial import cKDTree

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, TissueTable, Volume
from SlicerUSSim.Logic.mri import segment_mri
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.tissue import LabelMapping, names_of_file, read_label_file, read_label_map, read_names
from SlicerUSSim.Logic.tissue.freesurfer import freesurfer_names
from SlicerUSSim.Logic.tissue.label_sources import is_label_file
from SlicerUSSim.Logic.tissue.names import nearest_tissue, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.schemes import schemes
from SlicerUSSim.Logic.tissue.totalsegmentator import CT, CT_V1, MR, numbered

#: Labels that recon-all wrote for one person (a public aseg.mgz), and those of SynthSeg's own table
ASEG = [
    2, 3, 4, 5, 7, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 24, 26, 28, 30, 31, 41, 42, 43, 44, 46, 47, 49, 50, 51, 52,
    53, 54, 58, 60, 62, 63, 72, 77, 80, 85, 251, 252, 253, 254, 255,
]  # fmt: skip
SYNTHSEG = [n for n in ASEG if n <= 60 and n != 30 and n != 31]
APARC = [n for n in ASEG if n not in (3, 42)] + [side + n for side in (1000, 2000) for n in range(1, 36) if n != 4]
WMPARC = [*APARC, *(side + n for side in (3000, 4000) for n in range(1, 36) if n != 4), 5001, 5002]
DESTRIEUX = [n for n in ASEG if n not in (3, 42)] + [
    side + n for side in (11100, 12100) for n in range(1, 76) if n != 42
]

#: Heights in the body, centimetres above the floor: rough guesses, made without the order that the program expects.
HEIGHTS = {
    "femur": 65, "prostate": 85, "urinary_bladder": 87, "hip": 90, "gluteus": 88, "sacrum": 93, "colon": 105,
    "liver": 118, "kidney": 112, "heart": 130, "lung": 132, "humerus": 130, "scapula": 138, "clavicula": 145,
    "brain": 168, "skull": 172,
}  # fmt: skip
SIDES = {"spleen": -8, "stomach": -6, "liver": 8, "gallbladder": 6}


def height_cm(name: str) -> float:
    """Of a structure of TotalSegmentator; the spine from S1 at 95 to C1 at 157, the ribs from 12 to 1."""
    part, _, number = name.rpartition("_")
    if part == "vertebrae":
        above = {"S": 0, "L": 6, "T": 18, "C": 25}[number[0]]
        return 95 + 62 / 25 * (above - int(number[1:]) + (number[0] == "S"))
    if part.startswith("rib"):
        return 146 - 2.5 * int(number)
    if name == "Brain-Stem" or "Cerebell" in name:
        return 80  # far below the cerebrum
    return next((cm for word, cm in HEIGHTS.items() if name.startswith(word)), 120)


def side_cm(name: str) -> float:
    """Towards the patient's right."""
    plain = name.lower().replace("_", "-")
    if "left" in plain or "-lh-" in plain:
        return -10
    return 10 if "right" in plain or "-rh-" in plain else SIDES.get(name, 0)


def made(labels: dict[int, str], *, mirrored: bool = False, dtype=np.int16) -> Volume:
    """A label map in which each structure is a small cube at its height and side, one behind the other.

    Those of both sides are beside each other.
    """
    array = np.zeros((180, 2 * len(labels) + 2, 30), dtype)
    places: dict[str, int] = {}
    for label, name in labels.items():
        place = places.setdefault(re.sub(r"left|right|(?<=[-_])[lr]h(?=[-_])", "", name.lower()), len(places))
        i = round(15 + side_cm(name) * (-1 if mirrored else 1))
        k = round(height_cm(name))
        array[k : k + 2, 2 * place + 1 : 2 * place + 3, i : i + 2] = label
    matrix = np.diag([5.0, 5.0, 10.0, 1.0])
    return Volume(array, matrix)


def freesurfer(labels, **options) -> Volume:
    names = freesurfer_names()
    return made({label: names[label] for label in labels}, **options)


def head(spacing_mm: float = 3.0) -> Volume:
    """A round brain in FreeSurfer's numbers, as float32: white matter in cortex, with ventricles and thalamus."""
    n = int(150 / spacing_mm)
    z, y, x = (np.indices((n, n, n)) - (n - 1) / 2) * spacing_mm
    radius = np.sqrt(x**2 + y**2 + z**2)
    ventricle = (np.abs(x) > 4) & (np.abs(x) < 12) & (np.abs(y) < 30) & (np.abs(z) < 8)
    array = np.select([radius > 68, ventricle, radius < 15, radius < 58], [0, 4, 10, 2], 3)
    array = np.where((x > 0) & (array > 0), array + 39, array).astype(np.float32)
    matrix = np.diag([spacing_mm] * 3 + [1.0])
    matrix[:3, 3] = -(n - 1) / 2 * spacing_mm
    return Volume(array, matrix)


def head_tissues(spacing_mm: float) -> tuple[Volume, TissueTable]:
    """(labels, their tissues) of the phantom head_mri by its grey levels: 40 csf, 85 grey and 110 white matter."""
    mri = head_mri(spacing_mm)
    labels = mri.with_array(np.digitize(mri.array, (10.0, 62.5, 97.5)).astype(np.uint8))
    return labels, TissueTable.brain(("csf", "grey matter", "white matter"))


def ussim(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def refused(*arguments) -> str:
    """The one line of a command that failed."""
    result = ussim(*arguments)
    errors = [line for line in result.stderr.splitlines() if line.startswith("ussim: ")]
    assert result.exit_code == 2 and len(errors) == 1 and "Traceback" not in result.output, result.output
    return errors[0]


# ---- names -----------------------------------------------------------------------------------------------------------


def test_every_structure_of_the_programs_has_a_tissue():
    names = [*freesurfer_names().values(), *CT, *CT_V1, *MR]
    for name in names:
        try:
            assert tissue_named(name)
        except SimulationError:
            assert nearest_tissue(name) in TISSUES, name
    assert len(freesurfer_names()) > 600 and (len(CT), len(CT_V1), len(MR)) == (117, 104, 50)


@pytest.mark.parametrize(
    ("name", "tissue"),
    [
        ("Left-Cerebellum-Cortex", "grey matter"), ("Right-VentralDC", "grey matter"), ("Brain-Stem", "white matter"),
        ("WM-hypointensities", "white matter"), ("non-WM-hypointensities", "grey matter"),
        ("Optic-Chiasm", "white matter"), ("CC_Mid_Posterior", "white matter"), ("Left-vessel", "blood"),
        ("Left-choroid-plexus", "enhancing"), ("5th-Ventricle", "csf"), ("Left-Inf-Lat-Vent", "csf"),
        ("ctx-lh-insula", "grey matter"), ("wm-rh-insula", "white matter"), ("ctx_rh_G_insular_short", "grey matter"),
        ("heart_ventricle_left", "blood"), ("heart", "heart"), ("kidney_cyst_left", "cyst"), ("kidney_left", "kidney"),
        ("liver tumor", "tumour"), ("rib_left_7", "bone"), ("vertebrae_L5", "bone"), ("Left lungs", "lung"),
        ("portal_vein_and_splenic_vein", "blood"), ("spinal_cord", "white matter"), ("skull", "skull"),
    ],
)  # fmt: skip
def test_a_name_finds_its_tissue_by_its_most_special_word(name, tissue):
    assert tissue_named(name).name == tissue


def test_the_nearest_tissue_is_not_taken_for_a_tissue():
    for name in ("stomach", "pancreas", "brain", "urinary_bladder"):
        with pytest.raises(SimulationError, match="no preset for tissue"):
            tissue_named(name)
    assert [nearest_tissue(name) for name in ("stomach", "pancreas", "cheese")] == ["muscle", "liver", None]


# ---- programs, by their numbers alone --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("labels", "title", "tissues", "suffix", "dtype"),
    [
        (ASEG, "FreeSurfer aseg", 5, ".nii.gz", np.int16),
        (SYNTHSEG, "FreeSurfer's numbers, as SynthSeg uses them", 3, ".nrrd", np.float32),
        (APARC, "FreeSurfer or FastSurfer aparc+aseg", 5, ".nii.gz", np.int32),
        (WMPARC, "FreeSurfer wmparc", 5, ".nii.gz", np.float32),
        (DESTRIEUX, "FreeSurfer aparc.a2009s+aseg", 5, ".nrrd", np.int16),
    ],
    ids=["aseg", "synthseg", "aparc", "wmparc", "a2009s"],
)
def test_freesurfers_segmentations_are_recognised_in_every_file(labels, title, tissues, suffix, dtype, tmp_path):
    path = tmp_path / f"seg{suffix}"
    freesurfer(labels, dtype=dtype).write(path)
    volume = Volume.read(path)
    assert volume.array.dtype == dtype and volume.looks_like_labels()
    found = read_label_file(path, volume)
    assert found.message == f"{title}: {len(labels)} labels to {tissues} tissues" and not found.warnings
    assert found.labels.array.dtype == np.uint8 and found.labels.array.max() == tissues == len(found.names)
    for label in labels:
        tissue = found.names[found.relabelled[label] - 1]
        assert tissue == tissue_named(freesurfer_names()[label]).name
        assert (found.labels.array[volume.array == label] == found.relabelled[label]).all()
    assert not found.labels.array[volume.array == 0].any()


@pytest.mark.parametrize(
    ("names", "key"), [(CT, "totalsegmentator"), (CT_V1, "totalsegmentator-v1"), (MR, "totalsegmentator-mr")]
)
def test_totalsegmentators_whole_bodies_are_recognised_and_said(names, key):
    found = read_label_map(made(numbered(names)))
    assert found.message.startswith(f"{schemes()[key].title}: {len(names)} labels to ")
    table = {name: found.names[found.relabelled[label] - 1] for label, name in numbered(names).items()}
    assert (table["liver"], table["spleen"], table["aorta"], table["hip_left"]) == ("liver", "spleen", "blood", "bone")
    doubts = "\n".join(found.warnings)
    assert "the nearest tissue is used for" in doubts and "as muscle" in doubts and "has no label" in doubts


def test_a_part_of_a_body_is_recognised_by_its_places():
    abdomen = {n: name for n, name in numbered(CT).items() if n in (1, 2, 3, 5, 6, 29, 30, 31, 32, 52, 99, 100, 111)}
    assert read_label_map(made(abdomen)).message.startswith("TotalSegmentator CT: 13 labels to ")


def test_tissues_of_a_head_without_their_names_are_not_taken_for_organs(tmp_path):
    """Nine shells as `ussim segment --outside` numbers them, without their .json, were read as organs of an abdomen."""
    grid = np.stack(np.meshgrid(*[np.arange(64.0)] * 3, indexing="ij"))
    shells = np.zeros((64, 64, 64), np.uint8)
    # A little to the sides, as chance has it: all pairs of organs with these numbers lie as they should.
    sides = {1: -1, 5: 1, 6: -1, 4: 1, 3: -1, 2: 1, 9: -1, 8: 1, 7: 0}
    for number, radius in ((6, 29.0), (5, 27.0), (8, 25.0), (7, 23.0), (9, 21.0), (1, 18.0), (4, 15.0), (2, 12.0)):
        middle = np.array([31.5, 31.5, 31.5 + sides[number]])[:, None, None, None]
        shells[((grid - middle) ** 2).sum(axis=0) < radius**2] = number
    shells[((grid - np.array([31.5, 31.5, 30.5])[:, None, None, None]) ** 2).sum(axis=0) < 64.0] = 3
    head_of_nine = Volume(shells, np.diag([3.0, 3.0, 3.0, 1.0]))
    path = tmp_path / "head.nii.gz"
    head_of_nine.write(path)
    refusal = refused("simulate", path, "--pose", "auto", "-o", tmp_path / "x.png")
    assert "no program's numbers are recognised" in refusal
    assert "TotalSegmentator" not in refusal and "--map 1=0" not in refusal
    assert not (tmp_path / "x.png").exists()
    with pytest.raises(SimulationError, match="no program's numbers"):
        read_label_map(head_of_nine, of_ct=True)


def test_two_tissues_for_one_label_are_refused(tmp_path):
    for texts in (["24=csf", "24=tumour"], ["Left-Lesion=csf", "left lesion=tumour"], ["24=csf", "{json}"]):
        (tmp_path / "map.json").write_text('{"24": "tumour"}')
        with pytest.raises(SimulationError, match=r"is csf already and cannot be tumour, too; expected one tissue"):
            LabelMapping.of([text.format(json=tmp_path / "map.json") for text in texts])
    assert LabelMapping.of(["24=csf", "24=CSF"]).by_label == {24: "csf"}


def test_numbers_alone_do_not_make_a_program():
    """The controls: the same numbers elsewhere in the body, and atlases of others with the same range of numbers."""
    rng = np.random.default_rng(5)
    for names in (CT, MR):
        shuffled = dict(zip(numbered(names), rng.permutation(names), strict=True))
        with pytest.raises(SimulationError, match="no program's numbers are recognised, and no tissue is called lab"):
            read_label_map(made(shuffled))
    aal = {n: ("left" if n % 2 else "right") for n in range(1, 117)}  # AAL: odd numbers left, even ones right
    with pytest.raises(SimulationError, match="no program's numbers are recognised"):
        read_label_map(made(aal))
    shuffled = dict(zip(ASEG, rng.permutation([freesurfer_names()[n] for n in ASEG]), strict=True))
    with pytest.raises(SimulationError, match="in FreeSurfer's table, but structures of the left do not lie"):
        read_label_map(made(shuffled))


def test_labels_that_several_programs_use_alike_are_refused():
    # Spleen, kidneys and liver have the same numbers in all of TotalSegmentator's; 30 to 33 have not.
    shared = {n: numbered(CT)[n] for n in (1, 2, 3, 5)}
    assert "TotalSegmentator" not in str(refusal_of(made(shared)))  # too few structures to be sure
    few = {**shared, 4: "gallbladder", 6: "stomach"}
    assert read_label_map(made(few)).names[:2] == ("spleen", "kidney")
    both = {1: "spleen", 2: "kidney_right", 3: "kidney_left", 5: "liver", 6: "stomach", 4: "gallbladder", 7: "aorta"}
    message = str(refusal_of(made(both)))
    assert "labels 1, 2, 3, 5, 6, 4, 7 fit" in message.replace("1, 2, 3, 4, 5, 6, 7", "1, 2, 3, 5, 6, 4, 7")
    assert "TotalSegmentator CT and TotalSegmentator CT, version 1" in message and "--map totalsegmentator" in message
    mapped = read_label_map(made(both), mapping=LabelMapping.of(["totalsegmentator-v1"]))
    assert mapped.names[mapped.relabelled[7] - 1] == "blood"


def refusal_of(volume: Volume, *arguments, **options) -> SimulationError:
    with pytest.raises(SimulationError) as caught:
        read_label_map(volume, *arguments, **options)
    assert "\n" not in str(caught.value)
    return caught.value


def few(labels: tuple[int, ...]) -> Volume:
    """Cubes in a row."""
    array = np.zeros((20, 20, 20 * len(labels)), np.int16)
    for n, label in enumerate(labels):
        array[4:16, 4:16, 20 * n + 4 : 20 * n + 16] = label
    return Volume(array, np.diag([2.0, 2.0, 2.0, 1.0]))


def test_too_few_labels_are_refused_unless_their_program_is_said():
    refusal = str(refusal_of(few((90, 91)), mapping=LabelMapping.of("92=0")))
    assert "no program's numbers are recognised, and no tissue is called label 90" in refusal
    assert read_label_map(few((90, 91)), mapping=LabelMapping.of("totalsegmentator")).message.startswith("TotalSegm")


def test_a_mirrored_head_is_read_with_a_warning():
    found = read_label_map(freesurfer(ASEG, mirrored=True))
    assert found.message.startswith("FreeSurfer aseg")
    assert "labels of the left side are on the right; check the orientation" in found.warnings[0]


# ---- brains and tumours, whose numbers are alike ---------------------------------------------------------------------


def brain(numbers: dict[str, int], half_mm: int = 75) -> Volume:
    """Spheres in each other: fluid outside, then grey and white matter."""
    z, y, x = np.indices((2 * half_mm // 3,) * 3) * 3.0 - half_mm
    radius = np.sqrt(x**2 + y**2 + z**2)
    names = ["nothing", "csf", "grey matter", "white matter"]
    shells = np.select([radius > 68, radius > 65, radius > 50], [0, 1, 2], 3)
    return Volume(
        np.array([{"nothing": 0, **numbers}[name] for name in names], np.uint8)[shells], np.diag([3, 3, 3, 1])
    )


def test_a_brain_in_our_numbers_is_read_and_one_in_other_numbers_is_not():
    ours = read_label_map(brain({"csf": 1, "grey matter": 2, "white matter": 3}))
    assert ours.names == ("csf", "grey matter", "white matter") and "ussim segment and FSL FAST" in ours.message
    for others in ((3, 1, 2), (3, 2, 1), (2, 1, 3)):  # fMRIPrep (1 grey, 2 white, 3 fluid), and white matter first
        numbers = dict(zip(("csf", "grey matter", "white matter"), others, strict=True))
        assert "in no known program's order" in str(refusal_of(brain(numbers)))
        texts = [f"{number}={name}" for name, number in numbers.items()]
        assert LabelMapping.of({number: name for name, number in numbers.items()}) == LabelMapping.of(texts)
        found = read_label_map(brain(numbers), mapping=LabelMapping.of(texts))
        assert found.message == "mapped: 3 labels to 3 tissues"


def tumour(labels: tuple[int, int, int]) -> Volume:
    """A necrotic core, an enhancing rim and oedema in an empty head of 240 x 240 x 155 mm, at 3 mm."""
    z, y, x = (np.indices((52, 80, 80)) - 30) * 3.0
    radius = np.sqrt(x**2 + y**2 + z**2)
    core, oedema, rim = labels
    return Volume(np.select([radius < 10, radius < 15, radius < 25], [core, rim, oedema], 0).astype(np.uint8),
                  np.diag([3.0, 3.0, 3.0, 1.0]))  # fmt: skip


@pytest.mark.parametrize(("labels", "title"), [((1, 2, 4), "BraTS 2017 to 2022"), ((1, 2, 3), "BraTS since 2023")])
@pytest.mark.parametrize("stored", [np.uint8, np.float32])
def test_a_tumour_of_brats_is_no_patient(labels, title, stored, tmp_path):
    """Also stored as floating point, in which 1, 2 and 3 are the numbers of CAT12's p0 as well."""
    path = tmp_path / "BraTS-GLI-00001-000-seg.nii.gz"
    found = tumour(labels)
    found.with_array(found.array.astype(stored)).write(path)
    message = refused("simulate", path, "--pose", "auto", "-o", tmp_path / "o.png")
    assert f"a tumour's labels (as {title}: necrotic core, oedema, enhancing tumour; 3 labels, 67 ml)" in message
    assert f"not a patient's tissues; add it to a segmentation with --add brats={path}" in message
    assert not (tmp_path / "o.png").exists()


def test_a_binary_mask_is_no_patient_unless_the_user_says_what_it_is(tmp_path):
    path = tmp_path / "glioma.nii.gz"
    mask = tumour((255, 255, 255))
    mask.write(path)
    message = refused("simulate", path, "--pose", "auto", "-o", tmp_path / "o.png")
    assert f"{path}: a binary mask (1 label, 67 ml), not a patient's tissues" in message
    assert f"--add tumour={path}, or simulate it alone with --map 255=tumour (ussim simulate)" in message
    assert "--mask" not in message
    for tissue in ("liver", "tumour"):
        found = read_label_file(path, mask, LabelMapping.of(f"255={tissue}"))
        assert found.message == "mapped: 1 label to 1 tissue" and found.names == (tissue,)
    table = TissueTable({255 % 62: TISSUES["liver"]})
    with pytest.raises(SimulationError, match="a binary mask"):
        read_label_file(path, mask, table=table)


def test_a_command_for_an_mri_says_what_a_label_map_is_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tumour((255, 255, 255)).write("glioma.nii.gz")
    tumour((1, 3, 2)).write("brats.nii.gz")
    unknown = head()
    unknown.with_array(np.where(unknown.array == 3, 515, unknown.array)).write("unknown.nii.gz")
    for name, message in (
        (
            "glioma",
            "add it to a segmentation with --add tumour=glioma.nii.gz, or simulate it alone with --map 255=tumour",
        ),
        ("brats", "--add brats=brats.nii.gz, or simulate it alone"),
        ("unknown", "unknown.nii.gz: is a label map (8 labels), expected an MRI; use it as it is (ussim simulate unkn"),
    ):
        assert message in refused("segment", "-o", "out.nii.gz", f"{name}.nii.gz")
    assert not Path("out.nii.gz").exists()


def test_a_lesion_with_a_name_is_no_patient_but_an_organ_is():
    mask = tumour((1, 1, 1))
    assert "a lesion (Glioma; 1 label, 67 ml)" in str(refusal_of(mask, {1: "Glioma"}))
    assert "a binary mask" in str(refusal_of(mask, {1: "brain"}))  # a mask of the brain, and not white matter
    assert read_label_map(mask, {1: "Liver"}).names == ("liver",)


# ---- what the user says ----------------------------------------------------------------------------------------------


def test_unknown_labels_are_listed_with_volumes_and_a_remedy_that_works(tmp_path):
    volume = head()
    volume.array[:6, :6, :6] = 512
    message = str(refusal_of(volume))
    assert "no tissue is called label 512 (5.8 ml); map them with --map 512=TISSUE" in message
    file = tmp_path / "mapping.json"
    file.write_text(json.dumps({"512": "skull", "3": "csf", "42": 0}))
    for texts in ([str(file)], ["512=skull", "Left-Cerebral-Cortex=csf", "42=0"]):
        found = read_label_map(volume, mapping=LabelMapping.of(texts))
        assert found.message == "FreeSurfer aseg: 9 labels to 4 tissues"


def test_a_mapping_goes_before_names_and_numbers_and_removes_labels():
    volume = freesurfer(ASEG)
    assert LabelMapping.of("77=tumour") == LabelMapping.of(["77=tumour"])
    mapping = LabelMapping.of(["77=tumour", "Left-Cerebral-White-Matter=liver", "24=background", "0=fat", "9999=csf"])
    found = read_label_map(volume, mapping=mapping)
    tissue = {label: (found.names[new - 1] if new else None) for label, new in found.relabelled.items()}
    assert (tissue[77], tissue[2], tissue[24], tissue[0], tissue[41]) == (
        "tumour",
        "liver",
        None,
        "fat",
        "white matter",
    )
    assert "has no label 9999, which --map mentions" in found.warnings[0]
    with pytest.raises(SimulationError, match="all labels are mapped to 0"):
        read_label_map(volume, mapping=LabelMapping.of([f"{label}=0" for label in ASEG]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("csf", "--map is 'csf', expected LABEL=TISSUE such as 24=csf"),
        ("24=chese", "--map 24=chese: no tissue 'chese', expected 0"),
        ("-1=csf", "label is -1, expected a whole number from 0 to 99999"),
        ("none.json", "none.json: cannot be read"),
        ("nested.json", "label 24 is"),
        ("broken.json", "broken.json: is not JSON"),
        ("twice.json", "twice.json: is not JSON"),
        ("table.json", "is a tissue table, give it with --tissues"),
        ("two.txt", "two.txt: label 1 has two names, 'CSF' and 'Skull'"),
    ],
)
def test_a_bad_mapping_is_one_line(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = {
        "nested.json": '{"24": {"csf": 1}}', "broken.json": "{", "table.json": '{"tissues": {}}',
        "twice.json": '{"1": "csf", "1": "fat"}',
        "two.txt": "1 CSF 0 0 0 0\n1 Skull 0 0 0 0\n",
    }  # fmt: skip
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(SimulationError) as caught:
        LabelMapping.of([text])
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (lambda labels: labels + 0.3 * (labels > 0), "uniform regions of few values with fractions"),
        (lambda labels: labels + np.random.default_rng(0).normal(0, 1e-3, labels.shape), "label map"),
        (lambda labels: labels, "label map"),
    ],
)
def test_labels_are_no_mri_also_with_fractions_and_noise(changed, message):
    labels = freesurfer(ASEG)
    with pytest.raises(SimulationError, match=message):
        segment_mri(labels.with_array(changed(labels.array.astype(np.float32))))


def test_a_table_that_has_every_label_goes_before_names_and_programs(tmp_path):
    path = tmp_path / "seg.nii.gz"
    volume = brain({"csf": 2, "grey matter": 3, "white matter": 41})
    volume.write(path)
    table = TissueTable({2: TISSUES["water"], 3: TISSUES["liver"], 41: TISSUES["fat"]})
    (tmp_path / "seg.txt").write_text("2 CSF 0 0 0 0\n3 Skull 0 0 0 0\n41 Bone 0 0 0 0\n")
    found = read_label_file(path, volume, table=table)
    assert found.tissues == table and np.array_equal(found.labels.array, volume.array)
    assert read_label_file(path, volume).names == ("csf", "skull", "bone")
    table.write(tmp_path / "seg.json")
    assert read_label_file(path, volume).tissues == table  # beside it
    named = read_label_file(path, volume, table=TissueTable({1: TISSUES["csf"]}))  # lacks labels: read by their names
    assert named.names == ("csf", "skull", "bone")
    (tmp_path / "seg.json").write_text('{"Manufacturer": "another program\'s file"}')
    assert read_label_file(path, volume).names == ("csf", "skull", "bone")


# ---- names in files --------------------------------------------------------------------------------------------------

SNAP = """################################################
# ITK-SnAP Label Description File
    0     0    0    0        0  0  0    "Clear Label"
    5   255    0    0        1  1  1    "Left kidney"
    9     0  255    0        1  1  1    "Label 9"
   12     0    0  255        1  1  1    "Liver tumour"
"""
CTBL = "# Color table file seg.ctbl\n0 Background 0 0 0 0\n5 Left_kidney 255 0 0 255\n12 Liver_tumour 0 0 255 255\n"
LUT = "#No. Label Name:   R G B A\n5  Left-kidney  70 130 180 0\n12 Liver-tumour 1 2 3 0\n"
TSV = "index\tname\tabbreviation\n5\tLeft kidney\tK\n12\tLiver tumour\tT\n"
CSV = "LabelValue,Name,Color_R,Color_G,Color_B\n5,Left kidney,255,0,0\n12,Liver tumour,0,0,255\n"


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".txt", SNAP), (".label", SNAP), (".ctbl", CTBL), (".txt", LUT), (".tsv", TSV), (".csv", CSV),
        ("_ColorTable.csv", CSV), ("_ColorTable.ctbl", CTBL),
    ],
)  # fmt: skip
def test_tables_of_names_of_every_program_are_read(suffix, text, tmp_path):
    path = tmp_path / "seg.nii.gz"
    volume = tumour((5, 12, 12))
    volume.write(path)
    (tmp_path / f"seg{suffix}").write_text(text)
    names, where = names_of_file(path, Volume.read(path))
    assert (names[5][-6:], names[12][:5], 9 in names) == ("kidney", "Liver", False)
    found = read_label_file(path, volume)
    assert found.message == f"labels with names: 2 labels to 2 tissues, named in {where}" and where == f"seg{suffix}"
    assert found.names == ("kidney", "tumour")
    bare = tmp_path / "bare.nii.gz"
    volume.write(bare)
    mapped = read_label_file(bare, volume, LabelMapping.of([str(tmp_path / f"seg{suffix}")]))
    assert mapped.names == ("kidney", "tumour")


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("snap.txt", '\ufeff1 255 0 0 1 1 1 "Grey \\"matter\\", left"\n', {1: 'Grey "matter", left'}),
        ("excel.csv", "\ufeff1;Grey matter;1;2;3\n2;Tumour;1;2;3\n", {1: "Grey matter", 2: "Tumour"}),
    ],
)
def test_names_have_quotes_and_files_marks_of_their_encoding(name, text, expected, tmp_path):
    for encoding in ("utf-8", "utf-16-le"):  # as Windows writes them
        (tmp_path / name).write_bytes(text.encode(encoding))
        assert read_names(tmp_path / name) == expected


def test_a_colour_table_of_slicer_with_terminology_gives_names_alone(tmp_path):
    """Of "Leptomeninges" the terminology made bone."""
    slicer = pytest.importorskip("slicer", reason="Slicer's MRML libraries: pip install '.[slicer]'")
    table = slicer.vtkMRMLColorTableNode()
    table.SetTypeToUser()
    table.SetNumberOfColors(3)
    for label, name in enumerate(("Background", "Leptomeninges", "Tumour, left")):
        table.SetColor(label, name, 0.5, 0.25, 1.0, 1.0)
    table.SetTerminology(1, "SCT", "123037004", "Anatomical Structure", "SCT", "113257007", "Structure of bone")
    storage = slicer.vtkMRMLColorTableStorageNode()
    storage.SetFileName(str(tmp_path / "labels.csv"))
    assert storage.WriteData(table) == 1
    assert read_names(tmp_path / "labels.csv") == {0: "Background", 1: "Leptomeninges", 2: "Tumour, left"}


def test_segments_of_slicer_and_totalsegmentators_header_name_the_labels(tmp_path):
    import nibabel
    import nrrd

    volume = tumour((5, 12, 12))
    header = {"Segment0_Name": "Left kidney", "Segment0_LabelValue": "5", "Segment1_Name": "Segment_2",
              "Segment1_LabelValue": "7", "Segment2_Name": "Skull", "Segment2_LabelValue": "12"}  # fmt: skip
    path = tmp_path / "painted.seg.nrrd"
    nrrd.write(str(path), volume.array.T, {"space": "left-posterior-superior", **header})
    assert names_of_file(path, Volume.read(path)) == ({5: "Left kidney", 12: "Skull"}, "its header")
    image = nibabel.Nifti1Image(volume.array.T, volume.ijk_to_ras)
    labels = "".join(
        f'<Label Key="{n}" Red="0"><![CDATA[{name}]]></Label>' for n, name in ((5, "liver"), (12, "aorta"))
    )
    xml = f"<CaretExtension><VolumeInformation><LabelTable>{labels}</LabelTable></VolumeInformation></CaretExtension>"
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, xml.encode()))
    path = tmp_path / "segmentations.nii.gz"
    nibabel.save(image, path)
    assert names_of_file(path, Volume.read(path)) == ({5: "liver", 12: "aorta"}, "its header")
    assert read_label_file(path, Volume.read(path)).names == ("liver", "blood")


def layered(path, values: tuple[int, ...]) -> Volume:
    """Segments of 3D Slicer of which the last, a tumour in a layer of its own, overlaps the others."""
    import SimpleITK as sitk

    base = brain({"csf": values[0], "grey matter": values[1], "white matter": values[2]})
    z, y, x = np.indices(base.array.shape) - np.array([25, 25, 38])[:, None, None, None]
    tumour = np.where(x**2 + y**2 + z**2 < 5**2, values[3], 0).astype(np.uint8)
    image = sitk.GetImageFromArray(np.stack([base.array, tumour], axis=-1), isVector=True)
    image.CopyInformation(base.to_sitk())
    for place, (name, value) in enumerate(zip(("CSF", "Grey matter", "White matter", "Tumor"), values, strict=True)):
        for key, text in (("Name", name), ("Layer", place // 3), ("LabelValue", value), ("ID", f"Segment_{place}")):
            image.SetMetaData(f"Segment{place}_{key}", str(text))
    sitk.WriteImage(image, str(path), True)
    return base.with_array(np.where(tumour > 0, 4, np.where(base.array > 0, 1, 0)))


@pytest.mark.parametrize("values", [(1, 2, 3, 1), (7, 2, 9, 2)])
def test_overlapping_segments_of_slicer_are_read_with_the_last_on_top(values, tmp_path):
    path = tmp_path / "head.seg.nrrd"
    truth = layered(path, values)
    found = read_label_file(path, Volume.read(path))
    assert sorted(found.names) == ["csf", "grey matter", "tumour", "white matter"]
    tumour = found.labels.array == found.names.index("tumour") + 1
    assert np.array_equal(tumour, truth.array == 4) and np.array_equal(found.labels.array > 0, truth.array > 0)
    result = ussim("simulate", path, "--pose", "auto", "-o", tmp_path / "o.png")
    covered = np.count_nonzero(truth.array == 4) * truth.voxel_ml
    assert f"segments overlap, the last is taken: 'Tumor' covers {covered:.3g} ml of those before it" in result.stderr
    assert result.exit_code == 0 and "labels with names: 4 labels to 4 tissues, named in its header" in result.stderr


def test_several_components_without_segments_are_refused_with_a_remedy(tmp_path):
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(np.zeros((10, 10, 10, 2), np.uint8), isVector=True)
    sitk.WriteImage(image, str(tmp_path / "two.nrrd"))
    with pytest.raises(SimulationError, match="has 2 components per voxel, expected 1; save one of them, or a label"):
        Volume.read(tmp_path / "two.nrrd")
    image.SetMetaData("Segment0_Name", "Tumor")
    image.SetMetaData("Segment0_Layer", "5")
    sitk.WriteImage(image, str(tmp_path / "two.seg.nrrd"))
    with pytest.raises(SimulationError, match="segment 'Tumor' is in layer 5, expected less than 2"):
        Volume.read(tmp_path / "two.seg.nrrd")


def test_a_header_that_expands_without_limit_is_not_read(tmp_path):
    import nibabel

    bomb = '<!DOCTYPE a [<!ENTITY b "bbbb">]><LabelTable><Label Key="1">&b;</Label></LabelTable>'
    image = nibabel.Nifti1Image(np.ones((4, 4, 4), np.uint8), np.eye(4))
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, bomb.encode()))
    nibabel.save(image, tmp_path / "seg.nii.gz")
    assert names_of_file(tmp_path / "seg.nii.gz", Volume.read(tmp_path / "seg.nii.gz")) == ({}, "")


def test_mgz_is_read_where_nifti_is(tmp_path):
    import nibabel

    volume = head()
    matrix = np.array([[-1.0, 0, 0, 70], [0, 0, 1.2, -60], [0, -1.1, 0, 80], [0, 0, 0, 1]])  # as recon-all turns it
    data = volume.array.T.astype(np.int32)
    nibabel.save(nibabel.MGHImage(data, matrix), tmp_path / "aseg.mgz")
    nibabel.save(nibabel.Nifti1Image(data, matrix), tmp_path / "aseg.nii.gz")
    one, other = Volume.read(tmp_path / "aseg.mgz"), Volume.read(tmp_path / "aseg.nii.gz")
    np.testing.assert_array_equal(one.array, other.array)
    np.testing.assert_allclose(one.ijk_to_ras, other.ijk_to_ras, atol=1e-5)
    (tmp_path / "broken.mgz").write_bytes(b"no")
    with pytest.raises(SimulationError, match=r"broken\.mgz: cannot be read as an image"):
        Volume.read(tmp_path / "broken.mgz")


# ---- probability maps ------------------------------------------------------------------------------------------------

NAMES = {
    "SPM": {"grey matter": "c1T1.nii", "white matter": "c2T1.nii", "csf": "c3T1.nii"},
    "FSL FAST": {"csf": "T1_pve_0.nii.gz", "grey matter": "T1_pve_1.nii.gz", "white matter": "T1_pve_2.nii.gz"},
    "fMRIPrep": {"csf": "sub-1_label-CSF_probseg.nii.gz", "grey matter": "sub-1_label-GM_probseg.nii.gz",
                 "white matter": "sub-1_label-WM_probseg.nii.gz"},
}  # fmt: skip


def probability_maps(folder, names: dict[str, str]) -> Volume:
    """Smoothed maps of a brain in a folder; returns the labels."""
    numbers = {"csf": 1, "grey matter": 2, "white matter": 3}
    labels = brain(numbers)
    for tissue, name in names.items():
        smooth = ndimage.gaussian_filter((labels.array == numbers[tissue]).astype(np.float32), 0.7)
        labels.with_array(smooth).write(folder / name)
    return labels


@pytest.mark.parametrize("program", list(NAMES))
def test_tissue_probability_maps_are_combined_and_said(program, tmp_path):
    labels = probability_maps(tmp_path, NAMES[program])
    for tissue, name in NAMES[program].items():
        path = tmp_path / name
        found = read_label_file(path, Volume.read(path))
        assert f"a tissue probability map ({program}, {tissue}), combined with" in found.message
        assert found.names == ("csf", "grey matter", "white matter")
        assert np.mean(found.labels.array == labels.array) > 0.97  # but for voxels at the borders


def test_a_probability_map_without_the_others_is_refused(tmp_path):
    def refusal(name: str) -> str:
        with pytest.raises(SimulationError) as caught:
            read_label_file(tmp_path / name, Volume.read(tmp_path / name))
        return str(caught.value)

    probability_maps(tmp_path, NAMES["SPM"])
    (tmp_path / "c3T1.nii").unlink()
    assert "a tissue probability map (SPM, grey matter), not an MRI; put c3T1.nii beside it, or" in refusal("c1T1.nii")
    (tmp_path / "c1T1.nii").rename(tmp_path / "grey.nii")
    assert "a probability map (values from 0 to 1, most of them certain), not an MRI" in refusal("grey.nii")
    labels = probability_maps(tmp_path, NAMES["SPM"])
    Volume(labels.array[1:].astype(np.float32) * 0.3, labels.ijk_to_ras).write(tmp_path / "c2T1.nii")
    assert "c2T1.nii: has another grid than c1T1.nii" in refusal("c1T1.nii")


@pytest.fixture(scope="module")
def small_mni(mni) -> tuple[Volume, Volume]:
    """(T1, white matter as 41 and grey as 42) of the MNI152 in voxels of 2 mm."""
    t1, grey, white = (volume.array[::2, ::2, ::2] for volume in mni)
    matrix = mni[0].ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0])
    return Volume(t1, matrix), Volume(np.where(white > 0.5, 41, np.where(grey > 0.5, 42, 0)).astype(np.int16), matrix)


@pytest.mark.slow
def test_an_mri_in_other_units_is_an_mri(mni):
    t1 = mni[0]
    scaled = t1.with_array((t1.array / t1.array.max()).astype(np.float32))
    for name in ("t1.nii.gz", "c1_t1.nii.gz"):  # or called as SPM's maps are
        assert not is_label_file(Path(name), scaled)
    for shift in (0, 1, 120, 400):
        assert not t1.with_array(t1.array.astype(np.int16) - shift).looks_like_labels()
    z = (t1.array - t1.array.mean()) / t1.array.std()
    assert not t1.with_array(np.rint(z * 40).astype(np.int16)).looks_like_labels()


def test_labels_with_rounding_errors_are_labels(small_mni):
    t1, labels = small_mni
    rounded = t1.with_array((labels.array + 1e-4).astype(np.float32))
    assert rounded.looks_like_labels()
    mapping = LabelMapping.of({41: "white matter", 42: "grey matter"})
    found, exact = (read_label_map(each, mapping=mapping) for each in (rounded, labels))
    assert np.array_equal(found.labels.array, exact.labels.array)
    faint = t1.with_array((t1.array * 1e-6).astype(np.float32))  # an MRI in other units
    assert not faint.looks_like_labels()


def test_a_label_map_with_negative_labels_is_no_mri_and_refused(small_mni):
    t1, labels = small_mni
    labels = labels.with_array(np.where(np.indices(labels.array.shape)[0] < 2, -5, labels.array))
    assert labels.looks_like_labels()
    with pytest.raises(SimulationError, match="a label map with negative labels, has values from -5 to 42, expected"):
        read_label_map(labels)
    for offset in (100, 1):  # an MRI whose background is negative
        assert not t1.with_array(t1.array.astype(np.int16) - offset).looks_like_labels()
    low = head()
    message = str(refusal_of(low.with_array((low.array - 1).astype(np.int16))))  # eight labels, all one too low
    assert message.endswith("set its background to 0, or add 1 if all labels are one too low")


def test_labels_stored_as_bytes_with_a_scale_are_rounded_and_said(small_mni, tmp_path):
    path = tmp_path / "aseg.nii.gz"
    exact, scale = freesurfer(SYNTHSEG), 60 / 255  # as nibabel stores floats of 0 to 60 in bytes
    stored = np.rint(exact.array / scale).astype(np.float32) * np.float32(scale)
    assert 0.05 < np.abs(stored - exact.array).max() < scale / 2 + 1e-4
    exact.with_array(stored).write(path)
    volume = Volume.read(path)
    assert volume.looks_like_labels()
    found, truth = read_label_file(path, volume), read_label_map(exact)
    assert found.message == truth.message and np.array_equal(found.labels.array, truth.labels.array)
    assert "was stored with a scale; labels are rounded by up to 0.1" in found.warnings[-1] and not truth.warnings
    t1 = small_mni[0]
    for scale in (0.1, 0.2118, 1.01, 2.5):  # an MRI that is stored so
        assert not t1.with_array(t1.array.astype(np.float32) * np.float32(scale)).looks_like_labels()


# ---- label map or MRI ------------------------------------------------------------------------------------------------


def test_an_mri_enlarged_by_nearest_neighbours_is_an_mri(mni, parcels):
    small = mni[0].array[::3, ::3, ::3]
    for scale in (1, 1.37):
        twice = np.kron(small, np.ones((2, 2, 2))) * scale
        enlarged = Volume(twice.astype(np.uint8 if scale == 1 else np.float32), np.eye(4))
        assert not is_label_file(Path("t1.nii.gz"), enlarged)
    assert Volume(np.kron(parcels, np.ones((2, 2, 2), int)), np.eye(4)).looks_like_labels()


@pytest.mark.slow
@pytest.mark.parametrize("mm", [3, 8])
def test_a_parcellation_is_no_mri_in_coarse_voxels(mm, mni):
    """Cortex and white matter in random parcels, with wmparc's numbers; at 8 mm less than half of neighbours agree."""
    coarse = (slice(mm // 2, None, mm),) * 3
    assert Volume(parcellation(mni, 150)[coarse], np.eye(4)).looks_like_labels()
    t1 = ndimage.gaussian_filter(mni[0].array.astype(float), mm / 2.5)[coarse]
    for levels in (256, 2000):
        assert not Volume(np.rint(t1 / t1.max() * levels).astype(np.int16), np.eye(4)).looks_like_labels()


def parcellation(mni, regions: int, step: int = 1) -> np.ndarray:
    """(k, j, i) int32 labels of the MNI152's grey and white matter: lobes as in an aseg, and parcels of each."""
    grey, white = (volume.array[::step, ::step, ::step] for volume in mni[1:])
    random = np.random.default_rng(0)
    tissue = np.where(white > 0.5, 2, np.where(grey > 0.5, 3, 0))
    labels = np.zeros(tissue.shape, np.int32)
    for number in (2, 3):
        where = np.argwhere(tissue == number)
        seeds = where[random.choice(len(where), max(regions, 12), replace=False)]
        nearest = cKDTree(seeds).query(where)[1]
        base = 1000 * number if regions else 20 * number
        labels[tuple(where.T)] = base + random.permutation(len(seeds))[nearest]
    return labels


@pytest.fixture(scope="module")
def parcels(mni) -> np.ndarray:
    return parcellation(mni, 150, step=3)


@pytest.mark.parametrize("change", ["negative", "large", "one large", "wrapped"])
def test_labels_out_of_range_are_refused_as_labels(change, parcels, tmp_path):
    out = {
        "negative": np.where(parcels > 3100, -parcels, parcels),
        "large": parcels * 1000,
        "one large": np.where(parcels == 2001, 600_000_001, parcels),
        "wrapped": parcels.astype(np.uint8).astype(np.int8),
    }[change]
    path = tmp_path / "labels.nii.gz"
    Volume(out, np.diag([3.0, 3.0, 3.0, 1.0])).write(path)
    message = refused("segment", path, "-o", tmp_path / "o.nii.gz")
    assert "label map" in message or "expected labels, whole numbers from 0 to 99999" in message, message
    assert not (tmp_path / "o.nii.gz").exists()


def test_an_mri_with_a_whole_background_is_no_interpolated_label_map(mni):
    t1 = mni[0].array[:90]
    inside = t1 > 0
    scaled = np.where(inside, t1 / 104.3 - 1.0, -1.0).astype(np.float32)
    scaled[inside & (np.indices(inside.shape).sum(axis=0) % 9 == 0)] = 1.0  # clipped
    assert not is_label_file(Path("t1.nii.gz"), Volume(scaled, np.eye(4)))


def test_a_head_of_freesurfer_is_simulated_as_float_and_whole_numbers(tmp_path):
    from PIL import Image

    images = []
    for name, dtype in (("seg.nii.gz", np.float32), ("seg.nrrd", np.int32)):
        volume = head()
        volume.with_array(volume.array.astype(dtype)).write(tmp_path / name)
        out = tmp_path / f"{name}.png"
        result = ussim("simulate", tmp_path / name, "--pose", "auto", "-o", out)
        assert result.exit_code == 0, result.output
        assert f"{name}: FreeSurfer aseg: 8 labels to 3 tissues" in result.stderr
        images.append(np.asarray(Image.open(out)))
    np.testing.assert_array_equal(*images)
    assert images[0].std() > 10
