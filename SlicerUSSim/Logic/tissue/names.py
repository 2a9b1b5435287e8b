"""Names and codes of tissues, as label maps and segmentations of other programs use them: labels/*.csv."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.segments import is_meaningful
from SlicerUSSim.Logic.tissue.presets import TISSUES, colour_of
from SlicerUSSim.Logic.tissue.tissue import Tissue

_LABELS = Path(__file__).with_name("labels")
BRAIN_TISSUES = ("csf", "grey matter", "white matter")
#: Tissues outside the brain of a whole head, in the order of their labels
OUTSIDE = ("skin", "scalp", "skull", "cancellous bone", "air")
#: A word after one of these is not what the name means: "non-tumor tissue", "brain without lesion"
_NOT = "".join(rf"(?<!\b{word} )" for word in ("non", "no", "not", "without"))
#: A name with one of these states what is absent
_ABSENT = re.compile(r"\b(free|absen(t|ce)|resected|removed)\b")
#: Context of codes in 3D Slicer's terminologies, and a coded entry with a category and a type
_ENTRY = (
    "Segmentation category and type - DICOM master list~SCT^{category_code}^{category}~SCT^{code}^{meaning}~^^~"
    "Anatomic codes - DICOM master list~^^~^^"
)


@cache
def label_table(name: str) -> list[dict[str, str]]:
    """The rows of a table in labels/, without the .csv."""
    with (_LABELS / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def plain_name(name: str) -> str:
    return " ".join(name.lower().translate(str.maketrans('_-"', "   ")).split())


def same_name(a: str, b: str) -> bool:
    """Whether two names differ only in case, hyphens and underscores."""
    return plain_name(a) == plain_name(b)


def labels_of(names: Iterable[str], wanted: Collection[str]) -> list[int]:
    """The labels, counted from 1, that have one of the names."""
    return [label for label, name in enumerate(names, 1) if name in wanted]


def tissue_named(name: str) -> Tissue:
    """The preset for a tissue name, with synonyms and by words in a longer name ("Left-Cerebral-White-Matter").

    Raises SimulationError for a name that matches no preset.
    """
    found = _by_words(name, "word")
    require(found is not None, f"no preset for tissue {name!r}, expected one of: {', '.join(TISSUES)}")
    return TISSUES[str(found)]


def nearest_tissue(name: str) -> str | None:
    """The preset nearest to a structure that has none, such as muscle for the wall of the stomach; None if unknown."""
    return _by_words(name, "nearest")


def similar_tissues(name: str, tissue_names: Iterable[str] = ()) -> list[str]:
    """Tissues that an unknown name may mean, for messages: a misspelt one, or the pathologies for "lesion"."""
    key = plain_name(name)
    if re.search(r"\b(lesion|pathology|mass|mask|roi|segment|label)s?\b", key):
        return ["tumour", "oedema", "necrosis", "cyst", "haematoma", "cavity"]
    spellings = {plain_name(known): known for known in (*tissue_names, *TISSUES) if known} | _synonyms()
    near = get_close_matches(key, spellings, n=3, cutoff=0.7)
    return list(dict.fromkeys(spellings[word] for word in near))


def name_or_term(name: str | None, codes: Iterable[str]) -> str:
    """A label's name; the tissue of its SNOMED CT codes instead, the first known, if the name matches no tissue."""
    text = str(name or "")
    if is_meaningful(name) and _by_words(text, "word"):
        return text
    return next((_tissues_by_code()[code] for code in codes if code in _tissues_by_code()), text)


def terminology_entry(tissue_name: str) -> str:
    """The entry of a tissue in 3D Slicer's terminologies; "" for one that these lack."""
    terms = (row for row in label_table("terms") if row["tissue"] == tissue_name)
    return next((_ENTRY.format(**row) for row in terms), "")


def segments_header(names: Mapping[int, str], size: Sequence[int]) -> dict[str, str]:
    """Header of a .seg.nrrd of 3D Slicer with these labels, named as tissues, in `size` voxels along i, j, k."""
    header = {}
    extent = " ".join(f"0 {n - 1}" for n in size)
    for place, (label, name) in enumerate(names.items()):
        colour = " ".join(f"{part:.3g}" for part in colour_of(name))
        values = {"ID": name, "Name": name, "Color": colour, "LabelValue": label, "Layer": 0, "Extent": extent}
        values["Tags"] = f"TerminologyEntry:{entry}|" if (entry := terminology_entry(name)) else ""
        header |= {f"Segment{place}_{key}": str(value) for key, value in values.items()}
    return header


@cache
def _tissues_by_code() -> dict[str, str]:
    tables = [label_table(path.stem) for path in sorted(_LABELS.glob("*.csv"))]
    return {row["code"]: row["tissue"] for table in tables for row in table if row.get("code")}


@cache
def _synonyms() -> dict[str, str]:
    return {row["words"]: row["tissue"] for row in label_table("words") if row["kind"] == "synonym"}


@cache
def _by_words(name: str, kind: str) -> str | None:
    """By the first row of words.csv with a word in the name, if it has this kind, so that special words come before
    general ones: neither a cyst nor a lesion of the kidney is kidney, nor is bone wax bone."""
    key = plain_name(name)
    key = _synonyms().get(key, key)
    if key in TISSUES:
        return key
    for row in label_table("words"):
        words = row["words"].replace(", ", "|")
        if row["kind"] != "synonym" and re.search(rf"\b{_NOT}(?:{words})s?\b", key):  # also in the plural: "kidneys"
            is_there = row["tissue"] == "cavity" or not _ABSENT.search(key)
            return row["tissue"] if row["kind"] == kind and is_there else None
    return None
