"""DICOM as hospitals have it is one volume in its place, or an error of one line."""

from __future__ import annotations

import numpy as np
import pydicom
import pytest
from pydicom.uid import JPEGLSLossless, RLELossless, generate_uid

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.mri import read_mask
from tests.dicom_files import SERIES, as_ultrasound, enhanced, images, save, segmentation

SHUFFLED = np.random.default_rng(1).permutation(12).tolist()


def slopes(one, number):
    one.RescaleSlope = 1 + number % 2


def rounded(one, number):
    one.ImagePositionPatient[2] = 3.0 * number + 0.004 * (number % 2)


def tilted(one, number):
    one.ImagePositionPatient[1] += 0.5 * number


def of_an_older_class():
    """MR Image Storage whose frames have places."""
    one = enhanced(images())
    one.SOPClassUID = one.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.4"
    one.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices = 7.0
    return one


def frames_without_places():
    one = images()[0]
    one.NumberOfFrames, one.PixelData = 12, SERIES.array.tobytes()
    return one


def compressed(syntax):
    def change(one, number):
        one.compress(syntax)

    return change


#: {case: what is written, and what was stored by the numbers of SERIES}
READ = {
    "classic": lambda folder: save(folder, images()),
    "below": lambda folder: save(folder / "DICOM" / "0000", images()),
    "names in another order": lambda folder: save(folder, images(), SHUFFLED),
    "slope of a slice": lambda folder: save(folder, images(change=slopes)),
    "JPEG-LS": lambda folder: save(folder, images(change=compressed(JPEGLSLossless))),
    "RLE": lambda folder: save(folder, images(change=compressed(RLELossless))),
    "enhanced": lambda folder: save(folder, [enhanced(images())]),
    "enhanced CT": lambda folder: save(folder, [enhanced(images(), modality="CT")]),
    "enhanced US": lambda folder: save(folder, [as_ultrasound(enhanced(images()))]),
    "enhanced shuffled": lambda folder: save(folder, [enhanced(images(), SHUFFLED)]),
    "enhanced slopes": lambda folder: save(folder, [enhanced(images(change=slopes))]),
    "enhanced rounded": lambda folder: save(folder, [enhanced(images(change=rounded))]),
    "frames of an older class": lambda folder: save(folder, [of_an_older_class()]),
    "frames without places": lambda folder: save(folder, [frames_without_places()]),
}


@pytest.mark.parametrize("case", list(READ))
def test_a_dicom_volume_is_read_in_its_place(case, tmp_path, caplog):
    READ[case](tmp_path)
    found = Volume.read(tmp_path)
    scale = np.array([1, 2] * 6)[:, None, None] if "slope" in case else 1
    np.testing.assert_array_equal(found.array, SERIES.array * scale)
    np.testing.assert_allclose(found.ijk_to_ras, SERIES.ijk_to_ras, atol=5e-3)
    assert (found.modality == "CT") == (case == "enhanced CT")
    assert ("those below it are read" in caplog.text) == (case == "below")
    assert any("frames have no places" in doubt for doubt in found.doubts) == (case == "frames without places")
    one = next(tmp_path.rglob("*.dcm"))
    np.testing.assert_array_equal(Volume.read(one).array, found.array)


def with_values(at: int | None = 3, **values):
    """A change of one image of a series, or of all."""

    def change(one, number):
        if at in (None, number):
            for name, value in values.items():
                setattr(one, name, value)

    return change


def smaller(one, number):
    if number == 3:
        one.Rows, one.PixelData = 8, one.PixelData[: len(one.PixelData) // 2]


def cut(one, number):
    one.PixelData = one.PixelData[:-10] if number == 3 else one.PixelData


#: {case: (what changes an image, words)}
CLASSIC = {
    "tilt": (tilted, r"tilted by 9\.5 degrees"),
    "orientation": (with_values(ImageOrientationPatient=[0, 1, 0, 1, 0, 0]), "3.dcm has the ImageOrientationPatient"),
    "no unit": (with_values(None, ImageOrientationPatient=[2, 0, 0, 0, 1, 0]), "expected two perpendicular unit"),
    "no orientation": (with_values(ImageOrientationPatient=None), "3.dcm has no ImageOrientationPatient of 6 numbers"),
    "no position": (with_values(ImagePositionPatient=None), "3.dcm has no ImagePositionPatient of 3 numbers"),
    "spacing": (with_values(PixelSpacing=[3, 1]), r"3.dcm has the PixelSpacing \[3.0, 1.0\], and 0.dcm \[1.5, 1.25\]"),
    "no spacing": (with_values(None, PixelSpacing=[0, 0]), "has voxels of 0 x 0 mm, expected 0.01 to 50 mm"),
    "rows": (smaller, r"3.dcm has the rows, columns and bits \[8, 20, 16\], and 0.dcm \[16, 20, 16\], expected one"),
    "pixels": (cut, "3.dcm cannot be read .*; export it again"),
    "patients": (with_values(PatientID="another"), "its images are of 2 patients by their PatientID"),
}


@pytest.mark.parametrize("case", list(CLASSIC))
def test_images_that_are_not_a_volume_together_are_refused(case, tmp_path):
    change, words = CLASSIC[case]
    save(tmp_path, images(change=change))
    with pytest.raises(SimulationError, match=words) as error:
        Volume.read(tmp_path)
    assert "\n" not in str(error.value) and str(error.value).startswith(str(tmp_path))


@pytest.mark.parametrize("is_enhanced", [False, True])
@pytest.mark.parametrize("case", ["gap", "echoes", "tilt", "steps"])
def test_stacks_that_are_not_a_volume_are_refused(case, is_enhanced, tmp_path):
    """ITK read all of them without a word, with many frames."""
    series = images(change=tilted if case == "tilt" else None)
    words = "tilted by 9.5 degrees"
    if case == "steps":  # each of them by less than a fifth, but together by more than a slice
        for number, one in enumerate(series):
            one.ImagePositionPatient[2] = 3.0 * number + 0.5 * max(number - 6, 0)
        words = "slices are unevenly spaced, 3 to 3.5 mm, up to 1.3[0-9] mm away from an even stack"
    if case == "gap":
        del series[5]
        words = "slices are missing or unevenly spaced at 1 place, first 6 mm after slice 5 of 11, expected 3 mm"
    elif case == "echoes":
        same = {name: series[0].get(name) for name in ("SeriesInstanceUID", "FrameOfReferenceUID")}
        series += images(EchoTime=99.0, **same)
        words = "12 of 24 images lie at the place of another one"
    save(tmp_path, [enhanced(series)] if is_enhanced else series)
    with pytest.raises(SimulationError, match=words):
        Volume.read(tmp_path)


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_segments_are_labels_with_names_in_their_own_place(kind, tmp_path, caplog):
    """The frames of a SEG are those that a segment reaches, and each segment has its own."""
    masks = np.zeros((*SERIES.array.shape, 2), np.uint8)
    masks[3:6, 4:8, 4:8, 0] = 1
    masks[8:11, 6:12, 6:12, 1] = 1
    if kind == "BINARY":
        masks[4:6, 6:9, 6:9, 1] = 1
    stored = masks[..., 0] + 2 * masks[..., 1] if kind == "LABELMAP" else masks
    labels = [("Left tumour", "Neoplasm"), ("Segment_2", "Cyst")]
    save(tmp_path, [segmentation(stored * (1.0 if kind == "FRACTIONAL" else 1), labels, kind)])
    found = read_mask(tmp_path / "0.dcm")
    assert dict(found.label_names) == {1: "Left tumour", 2: "Cyst"}
    expected = np.where(masks[..., 1], 2, masks[..., 0])[3:11]
    np.testing.assert_array_equal(found.array, expected)
    np.testing.assert_allclose(found.ijk_to_ras @ [0, 0, 0, 1], SERIES.ijk_to_ras @ [0, 0, 3, 1], atol=1e-6)
    assert ("'Cyst' covers" in caplog.text) == (kind == "BINARY")


def test_slices_without_a_segment_are_empty_and_not_missing(tmp_path):
    """Segments drawn on every second slice, or on one, have frames for these alone."""
    masks = np.zeros((*SERIES.array.shape, 1), np.uint8)
    masks[2:9:2, 4:8, 4:8] = 1
    seg = segmentation(masks, [("Tumour", "Neoplasm")])
    del seg.SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0].SpacingBetweenSlices
    save(tmp_path / "a", [seg])
    np.testing.assert_array_equal(Volume.read(tmp_path / "a").array, masks[2:9, ..., 0])
    masks[3:] = 0
    save(tmp_path / "b", [segmentation(masks, [("Tumour", "Neoplasm")])])
    found = Volume.read(tmp_path / "b")
    assert found.array.sum() == 16 and found.spacing_mm[2] == 3.0


def test_frames_of_two_stacks_are_refused(tmp_path):
    one = enhanced(images())
    for number, frame in enumerate(one.PerFrameFunctionalGroupsSequence):
        frame.FrameContentSequence[0].StackID = str(number % 2)
    with pytest.raises(SimulationError, match="has 2 stacks of frames, expected one; export one of them"):
        Volume.read(save(tmp_path, [one]))


def test_what_is_in_a_folder_beside_a_series_does_not_change_it(tmp_path, caplog):
    """Reports, a directory of the disk, and what cannot be read, which may be an image and triggers a warning."""
    save(tmp_path, images())
    state = images()[0]
    del state.Rows, state.PixelData
    state.Modality, state.SeriesInstanceUID = "PR", generate_uid()
    state.save_as(tmp_path / "state.dcm")
    (tmp_path / "DICOMDIR").write_bytes((tmp_path / "3.dcm").read_bytes()[:200])
    assert np.array_equal(Volume.read(tmp_path).array, SERIES.array) and not caplog.text
    (tmp_path / "cut.dcm").write_bytes((tmp_path / "3.dcm").read_bytes()[:300])
    assert np.array_equal(Volume.read(tmp_path).array, SERIES.array)
    assert "cut.dcm cannot be read as DICOM; export the series again if an image is missing" in caplog.text


def test_several_series_are_listed_and_a_localiser_is_left_out(tmp_path, caplog):
    save(tmp_path, images(SeriesDescription="T1"))
    localiser = images(SeriesNumber=7)[:3]
    save(tmp_path, localiser, [100, 101, 102])
    assert Volume.read(tmp_path).array.shape == SERIES.array.shape
    assert "has 2 DICOM series; the only volume is read" in caplog.text
    save(tmp_path, images(SeriesNumber=8), list(range(200, 212)))
    with pytest.raises(SimulationError, match=r"has 3 DICOM series, 2 of them .*'T1': 12 images of 20x16 \(0.dcm\)"):
        Volume.read(tmp_path)
    assert np.array_equal(Volume.read(tmp_path / "203.dcm").array, SERIES.array)


def test_segments_and_other_echoes_in_a_folder_are_not_the_mri(tmp_path):
    """As archives keep segments beside their MRI, and scanners the echoes of a series in files with many frames."""
    save(tmp_path / "a", images())
    masks = np.ones((*SERIES.array.shape, 1), np.uint8)
    save(tmp_path / "a", [segmentation(masks, [("Brain", "Brain")])], [99])
    assert np.array_equal(Volume.read(tmp_path / "a").array, SERIES.array)
    first, second = enhanced(images()), enhanced(images(change=slopes))
    second.SeriesInstanceUID = first.SeriesInstanceUID
    save(tmp_path / "b", [first, second])
    with pytest.raises(SimulationError, match="has 2 files with 12 frames each; give one of them"):
        Volume.read(tmp_path / "b")
    assert np.array_equal(Volume.read(tmp_path / "b" / "0.dcm").array, SERIES.array)


def test_names_of_patients_stay_out_of_messages_logs_and_files(tmp_path, caplog):
    caplog.set_level("DEBUG")
    for first, patient in ((0, "Doe^Jane"), (12, "Roe^Rick")):
        series = images(PatientName=patient, PatientID=f"{patient} Number4711")
        save(tmp_path / patient[:3], series)
        save(tmp_path / "both", series, range(first, first + 12))
    volume = Volume.read(tmp_path / "Doe")
    for suffix in (".nii", ".mha", ".nrrd", ".vti"):
        volume.write(tmp_path / f"out{suffix}")
    said = caplog.text.encode() + b"".join(path.read_bytes() for path in tmp_path.glob("out*"))
    with pytest.raises(SimulationError, match="of 2 different patients") as error:
        Volume.read(tmp_path / "both")
    said += str(error.value).replace(str(tmp_path), "").encode()
    for secret in (b"Jane", b"Rick", b"Number4711"):
        assert secret not in said


@pytest.mark.parametrize("is_verbose", [False, True])
def test_descriptions_and_names_of_files_are_logged_only_if_asked(tmp_path, caplog, is_verbose):
    """Both may be names of patients."""
    caplog.set_level("INFO" if is_verbose else "WARNING")
    place = save(tmp_path / "DICOM" / "Doe_Jane", images(SeriesDescription="T1 of Jane"))
    Volume.read(tmp_path / "DICOM")
    for file in place.iterdir():
        file.rename(tmp_path / file.name)
    Volume.read(tmp_path / "3.dcm")
    assert "those below it are read, in 1 folder" in caplog.text
    assert "is one image of a DICOM series, which is read: " in caplog.text
    assert ("Jane" in caplog.text, "Doe" in caplog.text) == (is_verbose, is_verbose)


def test_what_a_dicom_file_promises_is_bounded_before_it_is_read(tmp_path):
    save(tmp_path, images(change=with_values(None, NumberOfFrames=2_000_000, Rows=4000))[:1])
    with pytest.raises(SimulationError, match=r"has 20x4000x2000000 voxels, expected at most 2147483648 in all"):
        Volume.read(tmp_path)


def test_compressed_dicom_is_decoded_in_another_process(tmp_path, monkeypatch):
    """Decoders are where image libraries are broken into."""
    save(tmp_path, images(change=compressed(RLELossless)))
    monkeypatch.setattr(pydicom.dataset.Dataset, "pixel_array", property(lambda _: pytest.fail("decoded here")))
    np.testing.assert_array_equal(Volume.read(tmp_path).array, SERIES.array)


@pytest.mark.parametrize("below", [False, True])
def test_a_folder_with_more_files_than_any_study_is_refused(tmp_path, monkeypatch, below):
    monkeypatch.setattr("SlicerUSSim.Logic.base.dicom._MOST_FILES", 5)
    save(tmp_path / "below" if below else tmp_path, images())
    with pytest.raises(SimulationError, match="has more than 5 files in it, give the folder of the series"):
        Volume.read(tmp_path)
