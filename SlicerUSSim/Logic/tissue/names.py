"""Names of tissues, as label maps and segmentations of other programs use them."""

from __future__ import annotations

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import Tissue

#: Synonyms in label maps and segmentations.
_ALIASES = {
    "background": "coupling", "cerebrospinal fluid": "csf", "ventricles": "csf", "edema": "oedema",
    "hematoma": "haematoma", "clot": "haematoma",
    "gray matter": "grey matter",
    "gm": "grey matter", "wm": "white matter", "tumor": "tumour", "dura": "falx", "skin": "scalp", "vessels": "blood",
    "vessel": "blood", "cortical bone": "bone", "choroid plexus": "enhancing",
}  # fmt: skip


#: Tissue of a longer name, such as one of FreeSurfer's, by a word in it; the first match is used.
_WORDS = {
    "necrosis": "necrosis", "necrotic": "necrosis", "oedema": "oedema", "edema": "oedema", "cyst": "cyst",
    "cystic": "cyst", "resection": "cavity", "surgical cavity": "cavity", "haematoma": "haematoma",
    "hematoma": "haematoma", "haemorrhage": "haematoma", "hemorrhage": "haematoma", "clot": "haematoma",
    "white matter": "white matter", "corpus callosum": "white matter", "ventricle": "csf", "csf": "csf",
    "choroid plexus": "enhancing", "grey matter": "grey matter", "gray matter": "grey matter", "cortex": "grey matter",
    "ctx": "grey matter", "thalamus": "grey matter", "caudate": "grey matter", "putamen": "grey matter",
    "pallidum": "grey matter", "hippocampus": "grey matter", "amygdala": "grey matter", "accumbens": "grey matter",
    "brain stem": "white matter", "tumor": "tumour", "tumour": "tumour", "glioma": "tumour", "metastasis": "tumour",
    "meningioma": "tumour", "falx": "falx", "tentorium": "falx", "dura": "falx", "artery": "blood", "vein": "blood",
    "vessel": "blood", "sinus": "blood", "skull": "skull", "scalp": "scalp", "skin": "scalp", "bone": "bone",
    "muscle": "muscle", "liver": "liver", "kidney": "kidney", "fat": "fat", "air": "air",
}  # fmt: skip


def plain_name(name: str) -> str:
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def same_name(a: str, b: str) -> bool:
    """Whether two names differ only in case, hyphens and underscores."""
    return plain_name(a) == plain_name(b)


def tissue_named(name: str) -> Tissue:
    """The preset for a tissue name, with synonyms and by words in a longer name ("Left-Cerebral-White-Matter").

    Raises SimulationError for a name that matches no preset.
    """
    key = plain_name(name)
    key = _ALIASES.get(key, key)
    if key not in TISSUES:
        texts = f" {key} ", f" {key} ".replace("s ", " ")  # unchanged, and without plurals
        key = next((tissue for word, tissue in _WORDS.items() if any(f" {word} " in text for text in texts)), key)
    require(key in TISSUES, f"no preset for tissue {name!r}, expected one of: {', '.join(TISSUES)}")
    return TISSUES[key]
