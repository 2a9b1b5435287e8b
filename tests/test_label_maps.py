"""Label maps of other programs: the user's words, names and codes, numbers of one program, or an error with choices."""

from __future__ import annotations

import json
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
from SlicerUSSim.Logic.tissue.label_sources import is_label_file, not_intensities
from SlicerUSSim.Logic.tissue.names import nearest_tissue, terminology_entry, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.schemes import recognised, schemes
from SlicerUSSim.Logic.tissue.table import write_label_files
from tests.conftest import name_labels

#: Labels that recon-all wrote for one person (a public aseg.mgz)
ASEG = [
    2, 3, 4, 5, 7, 8, 10, 11, 12, 13, 14, 15, 16, 17, 18, 24, 26, 28, 30, 31, 41, 42, 43, 44, 46, 47, 49, 50, 51, 52,
    53, 54, 58, 60, 62, 63, 72, 77, 80, 85, 251, 252, 253, 254, 255,
]  # fmt: skip
SYNTHSEG = [n for n in ASEG if n <= 60 and n != 30 and n != 31]
APARC = [n for n in ASEG if n not in (3, 42)] + [side + n for side in (1000, 2000) for n in range(1, 36) if n != 4]
FASTSURFER = sorted(schemes()["fastsurfer"].names)


def made(labels: dict[int, str], *, mirrored: bool = False, dtype=np.int16) -> Volume:
    """A label map in which each structure is a small cube on its side, one behind the other."""
    array = np.zeros((30, 2 * len(labels) + 2, 30), dtype)
    for place, (label, name) in enumerate(labels.items()):
        plain = name.lower().replace("_", "-")
        side = -10 if "left" in plain or "-lh-" in plain else 10 if "right" in plain or "-rh-" in plain else 0
        i = 15 + (-side if mirrored else side)
        array[14:16, 2 * place + 1 : 2 * place + 3, i : i + 2] = label
    return Volume(array, np.diag([5.0, 5.0, 10.0, 1.0]))


def numbered(labels, key: str = "freesurfer", **options) -> Volume:
    """`made` of labels of a numbering."""
    return made({label: schemes()[key].names[label] for label in labels}, **options)


def head(spacing_mm: float = 3.0) -> Volume:
    """A round brain in FreeSurfer's numbers, as float32: white matter in cortex, ventricles and corpus callosum."""
    n = int(150 / spacing_mm)
    z, y, x = (np.indices((n, n, n)) - (n - 1) / 2) * spacing_mm
    radius = np.sqrt(x**2 + y**2 + z**2)
    ventricle = (np.abs(x) > 4) & (np.abs(x) < 12) & (np.abs(y) < 30) & (np.abs(z) < 8)
    array = np.select([radius > 68, ventricle, radius < 15, radius < 58], [0, 4, 212, 2], 3)
    array = np.where((x > 0) & (array > 0), np.where(array == 212, 252, array + 39), array)
    array = np.where(array == 212, 251, array).astype(np.float32)
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


def test_a_name_finds_its_tissue_by_its_most_special_word():
    for name, tissue in (
        ("non-WM-hypointensities", "grey matter"), ("Left-choroid-plexus", "enhancing"), ("5th-Ventricle", "csf"),
        ("heart_ventricle_left", "blood"), ("kidney_cyst_left", "cyst"), ("liver tumor", "tumour"),
        ("non-enhancing tumor", "tumour"), ("Left lungs", "lung"),
        ("Meninges", "leptomeninges"), ("liquor", "csf"), ("tumour bed", "cavity"),
        ("resected tumour cavity", "cavity"),
    ):  # fmt: skip
        assert tissue_named(name).name == tissue
    for name, nearest in (
        ("stomach", "muscle"),
        ("pancreas", "liver"),
        ("cheese", None),
        ("non-tumor tissue", None),
        ("tumour-free margin", None),
        ("bone wax", None),
        ("white matter lesion", "tumour"),
        ("Liver lesion", "tumour"),
        ("soft tissue", "muscle"),
    ):
        with pytest.raises(SimulationError, match="no preset for tissue"):
            tissue_named(name)
        assert nearest_tissue(name) == nearest


# ---- programs, by their numbers alone --------------------------------------------------------------------------------


def test_every_structure_of_the_programs_has_the_tissue_of_its_name():
    for scheme in schemes().values():
        for label, name in scheme.names.items():
            try:
                found = tissue_named(name).name
            except SimulationError:
                found = nearest_tissue(name)
            assert scheme.tissues[label] == found in TISSUES, name
    assert [len(scheme.names) for scheme in schemes().values()] == [4, 5, 3, 699, 100, 95, 15, 117, 104, 50, 3, 3, 4]


@pytest.mark.parametrize(
    ("labels", "title", "tissues", "suffix", "dtype"),
    [
        (ASEG, "FreeSurfer", 5, ".nii.gz", np.int16), (SYNTHSEG, "SynthSeg", 3, ".nrrd", np.float32),
        (APARC, "FreeSurfer", 5, ".mgz", np.int32), (FASTSURFER, "FastSurfer", 4, ".mgz", np.int16),
        (sorted(schemes()["fsl-first"].names), "FSL FIRST", 2, ".nii.gz", np.int16),
    ],
)  # fmt: skip
def test_freesurfers_numbers_are_recognised_in_every_file(labels, title, tissues, suffix, dtype, tmp_path):
    import nibabel

    path = tmp_path / f"seg{suffix}"
    made_ = numbered(labels, dtype=dtype)
    if suffix == ".mgz":
        nibabel.save(nibabel.MGHImage(made_.array.T, made_.ijk_to_ras), path)
    else:
        made_.write(path)
    volume = Volume.read(path)
    assert volume.array.dtype == dtype and is_label_file(path, volume)
    found = read_label_file(path, volume)
    assert found.message == f"{title}: {len(labels)} labels to {tissues} tissues" and not found.warnings
    for label in labels:
        assert found.names[found.relabelled[label] - 1] == tissue_named(schemes()["freesurfer"].names[label]).name
        assert (found.labels.array[volume.array == label] == found.relabelled[label]).all()
    assert not found.labels.array[volume.array == 0].any()


@pytest.mark.parametrize("key", ["totalsegmentator", "totalsegmentator-v1", "totalsegmentator-mr"])
def test_totalsegmentators_whole_bodies_are_recognised_and_reported(key):
    names = schemes()[key].names
    found = read_label_map(made(names))
    assert found.message.startswith(f"{schemes()[key].title}: {len(names)} labels to ")
    table = {name: found.names[found.relabelled[label] - 1] for label, name in names.items()}
    assert (table["liver"], table["spleen"], table["aorta"], table["hip_left"]) == ("liver", "spleen", "blood", "bone")
    doubts = "\n".join(found.warnings)
    assert "the nearest tissue is used for" in doubts and "as muscle" in doubts


@pytest.mark.parametrize(
    ("labels", "choices"),
    [
        ((1, 2, 3), ["ussim", "spm", "totalsegmentator-tissues", "brats"]),
        ((1, 2, 3, 4), ["ussim", "brats"]),
        ((1, 2, 3, 4, 5), ["ussim-t1gd", "totalsegmentator"]),
        ((2, 3, 41, 42), ["freesurfer", "totalsegmentator", "totalsegmentator-v1", "totalsegmentator-mr"]),
        ((2, 3, 4, 5, 7, 8, 10, 11, 12, 13, 17, 18, 26, 28),
         ["freesurfer", "totalsegmentator", "totalsegmentator-v1", "totalsegmentator-mr"]),
        (range(1, 10), ["totalsegmentator", "totalsegmentator-v1"]),  # of a head, as `ussim segment --outside` counts
        ((1, 3, 7, 52), ["totalsegmentator", "totalsegmentator-v1"]),
        ((120, 121, 122), ["freesurfer"]),  # in its table, and in no segmentation
    ],
)  # fmt: skip
def test_numbers_of_several_programs_are_refused_with_choices_that_work(labels, choices):
    volume = made(dict.fromkeys(labels, ""))
    message = str(refusal_of(volume))
    assert "have no names; state their program: --map" in message and f"--map {labels[0]}=TISSUE" in message
    offered = [part.split()[0] for part in message.split("--map ")[1:-1]]
    assert set(offered) == set(choices), message
    for key in choices:
        if not schemes()[key].is_lesion:
            found = read_label_map(volume, mapping=LabelMapping.of(key))
            assert [found.names[found.relabelled[label] - 1] for label in labels] == [
                schemes()[key].tissues[label] for label in labels
            ]


def test_a_few_organs_are_read_where_the_programs_that_label_a_ct_agree():
    organs = made({2: "kidney_right", 5: "liver", 14: "lung_lower_lobe"})
    assert "--map freesurfer (" in str(refusal_of(organs))
    assert read_label_map(organs, of_ct=True).names == ("kidney", "liver", "lung")
    message = str(refusal_of(made({2: "kidney_right", 10: "lung"}), of_ct=True))
    assert "CT: 2 kidney right, 10 lung upper lobe left), --map totalsegmentator-v1 (" in message


def test_parts_and_slabs_are_read_as_the_whole():
    for part in (head().array[:, :, :25], head().array[24:26], head().array[20:30, 20:30, 20:30]):
        labels = np.unique(part[part > 0])
        assert recognised(labels.astype(int).tolist())[0].key == "freesurfer"
        assert read_label_map(Volume(part, np.eye(4))).message.startswith("FreeSurfer: ")


def refusal_of(volume: Volume, *arguments, **options) -> SimulationError:
    with pytest.raises(SimulationError) as caught:
        read_label_map(volume, *arguments, **options)
    assert "\n" not in str(caught.value)
    return caught.value


# ---- tumours and masks -----------------------------------------------------------------------------------------------


def brain(numbers: dict[str, int], half_mm: int = 75) -> Volume:
    """Spheres in each other: fluid outside, then grey and white matter."""
    z, y, x = np.indices((2 * half_mm // 3,) * 3) * 3.0 - half_mm
    radius = np.sqrt(x**2 + y**2 + z**2)
    names = ["nothing", "csf", "grey matter", "white matter"]
    shells = np.select([radius > 68, radius > 65, radius > 50], [0, 1, 2], 3)
    return Volume(
        np.array([{"nothing": 0, **numbers}[name] for name in names], np.uint8)[shells], np.diag([3, 3, 3, 1])
    )


def tumour(labels: tuple[int, int, int]) -> Volume:
    """A necrotic core, an enhancing rim and oedema in an empty head of 240 x 240 x 155 mm, at 3 mm."""
    z, y, x = (np.indices((52, 80, 80)) - 30) * 3.0
    radius = np.sqrt(x**2 + y**2 + z**2)
    core, oedema, rim = labels
    return Volume(np.select([radius < 10, radius < 15, radius < 25], [core, rim, oedema], 0).astype(np.uint8),
                  np.diag([3.0, 3.0, 3.0, 1.0]))  # fmt: skip


@pytest.mark.parametrize("stored", [np.uint8, np.float32])
def test_a_tumour_of_brats_is_not_a_patient(stored, tmp_path):
    path = tmp_path / "BraTS-GLI-00001-000-seg.nii.gz"
    found = tumour((1, 2, 4))
    found.with_array(found.array.astype(stored)).write(path)
    message = refused("simulate", path, "--pose", "auto", "-o", tmp_path / "o.png")
    assert "a tumour's labels (as BraTS 2017 to 2022: necrotic core, oedema, enhancing tumour; 3 labels, 67" in message
    assert f"not a patient's tissues; add it to a segmentation with --add brats={path}" in message
    tumour((1, 2, 3)).write(path)
    message = refused("simulate", path, "--pose", "auto", "-o", tmp_path / "o.png")
    assert "--map brats (BraTS since 2023: 1 necrotic core, 2 oedema, 3 enhancing tumour)" in message


def test_a_binary_mask_is_not_a_patient_unless_the_user_says_what_it_is(tmp_path):
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
    assert "a lesion (Glioma; 1 label, 67 ml)" in str(refusal_of(mask, {255: "Glioma"}))
    assert "a binary mask" in str(refusal_of(mask, {255: "brain"}))  # a mask of the brain, and not white matter
    assert read_label_map(mask, {255: "Liver"}).names == ("liver",)


def test_a_command_for_an_mri_says_what_a_label_map_is_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tumour((255, 255, 255)).write("glioma.nii.gz")
    tumour((1, 2, 4)).write("brats.nii.gz")
    unknown = head()
    unknown.with_array(np.where(unknown.array > 1, unknown.array + 512, unknown.array)).write("unknown.nii.gz")
    for name, message in (
        (
            "glioma",
            "add it to a segmentation with --add tumour=glioma.nii.gz, or simulate it alone with --map 255=tumour",
        ),
        ("brats", "--add brats=brats.nii.gz, or simulate it alone"),
        ("unknown", "unknown.nii.gz: is a label map (8 labels), expected an MRI; use it directly (ussim simulate unkn"),
    ):
        assert message in refused("segment", "-o", "out.nii.gz", f"{name}.nii.gz")
    assert not Path("out.nii.gz").exists()


# ---- what the user says ----------------------------------------------------------------------------------------------


def test_two_tissues_for_one_label_are_refused(tmp_path):
    for texts in (["24=csf", "24=tumour"], ["Left-Lesion=csf", "left lesion=tumour"], ["24=csf", "{json}"]):
        (tmp_path / "map.json").write_text('{"24": "tumour"}')
        with pytest.raises(SimulationError, match=r"is csf already and cannot be tumour, too; expected one tissue"):
            LabelMapping.of([text.format(json=tmp_path / "map.json") for text in texts])
    assert LabelMapping.of(["24=csf", "24=CSF"]).by_label == {24: "csf"}


def test_unknown_labels_are_listed_with_volumes_and_a_remedy_that_works(tmp_path):
    volume = head()
    volume.array[:6, :6, :6] = 512
    volume.array[6:9, :6, :6] = 513
    volume.array[9:12, :6, :6] = 514
    message = str(refusal_of(volume))
    assert "label 512 (5.8 ml), label 513" in message
    file = tmp_path / "mapping.json"
    file.write_text(json.dumps({"512": "skull", "513": "skull", "514": "skull", "3": "csf", "42": 0}))
    skull = [f"{label}=skull" for label in (512, 513, 514)]
    for texts in ([str(file)], [*skull, "Left-Cerebral-Cortex=csf", "42=0"]):
        found = read_label_map(volume, mapping=LabelMapping.of(texts))
        assert found.message == "FreeSurfer: 11 labels to 3 tissues"
    message = str(refusal_of(made({90: "", 150: "", 151: ""})))
    assert "no program's numbers are recognised, and no tissue is called label 90 (" in message and "150 (" in message


def test_few_unknown_labels_are_taken_as_what_is_around_them():
    volume = head()
    beside = int(volume.array[25, 25, 38])
    volume.array[24:27, 24:27, 37:40] = 9999
    for texts in ((), "freesurfer"):
        found = read_label_map(volume, mapping=LabelMapping.of(texts))
        assert found.relabelled[9999] == found.relabelled[beside]
        assert "label 9999 (0.73 ml) is unknown and taken as white matter, which is around" in found.warnings[0]


def test_a_numbering_that_is_given_has_to_have_most_labels():
    message = str(refusal_of(numbered(ASEG), mapping=LabelMapping.of("brats")))
    assert message.endswith("do not belong to --map brats; expected --map freesurfer")
    found = read_label_map(tumour((1, 2, 3)), mapping=LabelMapping.of("brats"))
    assert found.names == ("necrosis", "oedema", "enhancing") and "has a tumour alone" in found.warnings[0]
    found = read_label_map(tumour((1, 2, 4)), mapping=LabelMapping.of("brats"))
    assert "its labels belong to BraTS 2017 to 2022 (--map brats-2022)" in found.warnings[1]


def test_a_mapping_goes_before_names_and_numbers_and_removes_labels():
    volume = numbered(ASEG)
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


def test_labels_are_not_an_mri_also_with_fractions_and_noise():
    labels = numbered(ASEG).array.astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 1e-3, labels.shape)
    for array, message in (
        (labels + 0.3 * (labels > 0), "uniform regions with fractions"), (labels + noise, "label map"),
    ):  # fmt: skip
        with pytest.raises(SimulationError, match=message):
            segment_mri(Volume(array, np.eye(4)))


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


def test_names_have_quotes_and_files_marks_of_their_encoding(tmp_path):
    for name, text, expected in (
        ("snap.txt", '\ufeff1 255 0 0 1 1 1 "Grey \\"matter\\", left"\n', {1: 'Grey "matter", left'}),
        ("excel.csv", "\ufeff1;Grey matter;1;2;3\n2;Tumour;1;2;3\n", {1: "Grey matter", 2: "Tumour"}),
    ):
        for encoding in ("utf-8", "utf-16-le"):  # as Windows writes them
            (tmp_path / name).write_bytes(text.encode(encoding))
            assert read_names(tmp_path / name) == expected


TERMS = """LabelValue,Name,Color_R,Scheme,Type_CodeValue,M,TypeModifier_CodeValue,Category_CodeValue,Region_CodeValue
1,Leptomeninges,102,SCT,113257007,Structure of bone,
2,Segment_2,102,SCT,12738006,Brain,389080008
3,Hirnhaut,102,SCT,1231004,Meninges,
4,non-tumor tissue,1,SCT,85756007,Tissue,
5,Substantia alba,1,SCT,12738006,Brain,,123037004,68594002
6,Wucherung,1,SCT,108369006,Neoplasm,,49755003,10200004
7,Herd,1,SCT,52988006,Lesion,,49755003,10200004
"""


def test_codes_of_slicer_name_what_has_no_name_of_a_tissue(tmp_path):
    import nrrd

    (tmp_path / "seg_ColorTable.csv").write_text(TERMS)
    expected = {1: "Leptomeninges", 2: "white matter", 3: "leptomeninges", 4: "non-tumor tissue"}
    expected |= {5: "white matter", 6: "tumour", 7: "Herd"}
    assert read_names(tmp_path / "seg_ColorTable.csv") == expected
    volume = tumour((1, 2, 3))
    header = {"space": "left-posterior-superior"}
    for n, (name, tissue) in enumerate((("Segment_1", "grey matter"), ("Tumor", "liver"), ("Gewebe", "white matter"))):
        header |= {f"Segment{n}_Name": name, f"Segment{n}_LabelValue": str(n + 1)}
        header |= {f"Segment{n}_Tags": f"Segmentation.Status:done|TerminologyEntry:{terminology_entry(tissue)}|"}
    path = tmp_path / "painted.seg.nrrd"
    nrrd.write(str(path), volume.array.T, header)
    assert read_label_file(path, Volume.read(path)).names == ("grey matter", "tumour", "white matter")
    assert "SCT^389080008^White Matter" in terminology_entry("white matter") and terminology_entry("gel") == ""
    message = str(refusal_of(tumour((1, 1, 4)), {1: "liver", 4: "non-tumor tissue"}))
    assert "no tissue is called 'non-tumor tissue' (4, " in message


@pytest.mark.parametrize("name", ["labels.nii.gz", "labels.nii", "labels.seg.nrrd", "labels.nrrd"])
def test_labels_keep_their_names_without_the_table_beside_them(tmp_path, name):
    path, names = tmp_path / name, ("csf", "grey matter", "white matter")
    labels = brain({"csf": 1, "grey matter": 2, "white matter": 3})
    write_label_files(path, labels, TissueTable.brain(names)).unlink()
    volume = Volume.read(path)
    assert read_label_file(path, volume).names == names and np.array_equal(volume.array, labels.array)
    if name.endswith(".nrrd"):
        assert volume.label_codes[3] == ("389080008",)


def test_totalsegmentators_header_names_the_labels(tmp_path):
    volume, path = tumour((5, 12, 12)), tmp_path / "segmentations.nii.gz"
    volume.write(path)
    name_labels(path, ["", "", "", "", "liver", *[""] * 6, "aorta"])
    assert names_of_file(path, Volume.read(path)) == ({5: "liver", 12: "aorta"}, "its header")
    assert read_label_file(path, Volume.read(path)).names == ("liver", "blood")


def layered(path, values: tuple[int, ...]) -> Volume:
    """Segments of 3D Slicer of which the last, a tumour in a separate layer, overlaps the others."""
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
    assert f"segments overlap, the last is taken: 'Tumor' covers {covered:.3g} ml of earlier ones" in result.stderr
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


# ---- probability maps ------------------------------------------------------------------------------------------------

NAMES = {"SPM": ("c3T1.nii", "c1T1.nii", "c2T1.nii"), "CAT12": ("p3T1.nii", "p1T1.nii", "p2T1.nii"),
         "FSL FAST": ("T1_pve_0.nii.gz", "T1_pve_1.nii.gz", "T1_pve_2.nii.gz")}  # fmt: skip


@pytest.mark.parametrize("program", list(NAMES))
def test_tissue_probability_maps_are_combined_and_reported(program, tmp_path):
    labels, names = brain({"csf": 1, "grey matter": 2, "white matter": 3}), NAMES[program]
    for number, name in enumerate(names, 1):
        smooth = ndimage.gaussian_filter((labels.array == number).astype(np.float32), 0.7)
        labels.with_array(smooth).write(tmp_path / name)
    for name in names:
        path = tmp_path / name
        assert is_label_file(path, Volume.read(path))
        found = read_label_file(path, Volume.read(path))
        assert f"tissue probability maps: {names[0]} csf, {names[1]} grey matter" in found.message
        assert found.names == ("csf", "grey matter", "white matter")
        assert np.mean(found.labels.array == labels.array) > 0.97  # except at the borders
    swapped = LabelMapping.of(["1=white", "3=csf"])  # as FAST counts in a T2
    assert read_label_file(path, Volume.read(path), swapped).names == ("white matter", "grey matter", "csf")
    Volume.read(path).write(tmp_path / names[0].replace("_0", "_3"))
    if program == "FSL FAST":
        with pytest.raises(SimulationError, match=r"four or more .*, expected three.*-n 3"):
            read_label_file(path, Volume.read(path))
        return
    (tmp_path / names[0]).unlink()
    with pytest.raises(SimulationError, match=f"a tissue probability map, expected {names[0]} beside it"):
        read_label_file(path, Volume.read(path))
    (tmp_path / names[1]).unlink()
    assert not is_label_file(path, Volume.read(path))  # an MRI whose name begins so
    Volume(labels.array[1:].astype(np.float32) * 0.3, labels.ijk_to_ras).write(tmp_path / names[0])
    Volume(labels.array[1:].astype(np.float32) * 0.3, labels.ijk_to_ras).write(tmp_path / names[1])
    with pytest.raises(SimulationError, match=f"{names[0]}: has another grid than {names[2]}"):
        read_label_file(path, Volume.read(path))


# ---- label map or MRI ------------------------------------------------------------------------------------------------


def parcellation(mni, step: int = 1) -> np.ndarray:
    """(k, j, i) int32 labels of the MNI152's grey and white matter: 150 parcels of each, 2000 and 3000 + n."""
    grey, white = (volume.array[::step, ::step, ::step] for volume in mni[1:])
    random = np.random.default_rng(0)
    tissue = np.where(white > 0.5, 2, np.where(grey > 0.5, 3, 0))
    labels = np.zeros(tissue.shape, np.int32)
    for number in (2, 3):
        where = np.argwhere(tissue == number)
        nearest = cKDTree(where[random.choice(len(where), 150, replace=False)]).query(where)[1]
        labels[tuple(where.T)] = 1000 * number + random.permutation(150)[nearest]
    return labels


@pytest.fixture(scope="module")
def parcels(mni) -> np.ndarray:
    return parcellation(mni, step=3)


def test_an_mri_in_any_numbers_is_an_mri(mni, parcels):
    t1 = mni[0].array[::2, ::2, ::2]
    share = (t1 / t1.max()).astype(np.float32)
    mris = [share, np.kron(t1[::2, ::2, ::2], np.ones((2, 2, 2), np.uint8)), (share * 1e-6).astype(np.float32)]
    mris += [t1.astype(np.int16) - shift for shift in (1, 120, 400)]
    mris += [t1 * np.float32(scale) for scale in (0.1, 0.2118, 1.01, 2.5)]  # as stored with a scale
    for array in mris:
        for name in ("t1.nii.gz", "c1_t1.nii.gz"):  # or called as SPM's maps are
            assert not is_label_file(Path(name), Volume(array, np.eye(4)))
    assert Volume(np.kron(parcels, np.ones((2, 2, 2), int)), np.eye(4)).looks_like_labels()
    for array, is_labels in ((parcels, True), (t1, False)):
        found = not_intensities(Volume(ndimage.zoom(array.astype(float), 1.4, order=1), np.eye(4)))
        assert ("nearest-neighbour" in str(found)) == is_labels


@pytest.mark.slow
@pytest.mark.parametrize("mm", [3, 8])
def test_a_parcellation_is_not_an_mri_in_coarse_voxels(mm, mni):
    """Cortex and white matter in random parcels, with wmparc's numbers; at 8 mm less than half of neighbours agree."""
    coarse = (slice(mm // 2, None, mm),) * 3
    assert Volume(parcellation(mni)[coarse], np.eye(4)).looks_like_labels()
    t1 = ndimage.gaussian_filter(mni[0].array.astype(float), mm / 2.5)[coarse]
    for levels in (256, 2000):
        assert not Volume(np.rint(t1 / t1.max() * levels).astype(np.int16), np.eye(4)).looks_like_labels()


def test_labels_stored_as_bytes_with_a_scale_are_rounded_and_reported(tmp_path):
    path = tmp_path / "aseg.nii.gz"
    exact, scale = numbered(SYNTHSEG), 60 / 255  # as nibabel stores floats of 0 to 60 in bytes
    stored = np.rint(exact.array / scale).astype(np.float32) * np.float32(scale)
    exact.with_array(stored).write(path)
    volume = Volume.read(path)
    assert volume.looks_like_labels()
    found, truth = read_label_file(path, volume), read_label_map(exact)
    assert found.message == truth.message and np.array_equal(found.labels.array, truth.labels.array)
    assert "was stored with a scale; labels are rounded by up to 0.1" in found.warnings[-1] and not truth.warnings


def test_labels_out_of_range_are_refused_as_labels(parcels, tmp_path):
    path = tmp_path / "labels.nii.gz"
    for out in (
        np.where(parcels > 3100, -parcels, parcels), parcels * 1000, parcels.astype(np.uint8).astype(np.int8),
        np.where(parcels == 2001, 600_000_001, parcels),
    ):  # fmt: skip
        Volume(out, np.diag([3.0, 3.0, 3.0, 1.0])).write(path)
        message = refused("segment", path, "-o", tmp_path / "o.nii.gz")
        assert "label map" in message or "expected labels, whole numbers from 0 to 99999" in message, message
    low = head()
    message = str(refusal_of(low.with_array((low.array - 1).astype(np.int16))))  # eight labels, all one too low
    assert message.endswith("set its background to 0, or add 1 if all labels are one too low")


def test_a_head_of_freesurfer_is_simulated_as_float_and_whole_numbers(tmp_path):
    from PIL import Image

    images = []
    for name, dtype in (("seg.nii.gz", np.float32), ("seg.nrrd", np.int32)):
        volume = head()
        volume.with_array(volume.array.astype(dtype)).write(tmp_path / name)
        out = tmp_path / f"{name}.png"
        result = ussim("simulate", tmp_path / name, "--pose", "auto", "-o", out)
        assert result.exit_code == 0, result.output
        assert f"{name}: FreeSurfer: 8 labels to 3 tissues" in result.stderr
        images.append(np.asarray(Image.open(out)))
    np.testing.assert_array_equal(*images)
    assert images[0].std() > 10
