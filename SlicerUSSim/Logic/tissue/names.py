"""Names of tissues, as label maps and segmentations of other programs use them."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from functools import cache

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import Tissue

#: Synonyms in label maps and segmentations.
_ALIASES = {
    "background": "coupling", "cerebrospinal fluid": "csf", "ventricles": "csf", "edema": "oedema",
    "hematoma": "haematoma", "clot": "haematoma",
    "gray matter": "grey matter", "grey": "grey matter", "gray": "grey matter", "white": "white matter",
    "gm": "grey matter", "wm": "white matter", "gtv": "tumour", "gbm": "tumour",
    "ncr": "necrosis", "ed": "oedema", "et": "enhancing",  # of BraTS
    "tumor": "tumour", "dura": "falx", "vessels": "blood",
    "vessel": "blood", "cortical bone": "bone", "choroid plexus": "enhancing",
}  # fmt: skip


#: Words by which a longer name, such as one of FreeSurfer's or TotalSegmentator's, has a tissue. The first line with a
#: word in the name is used, so that what is special comes before what is general: a cyst of the kidney is no kidney,
#: and the ventricle of the heart is not the brain's.
_WORDS: tuple[tuple[str, str], ...] = (
    ("necrosis", "necrosis, necrotic"),
    ("oedema", "oedema, edema"),
    ("cyst", "cyst, cystic"),
    ("cavity", "resection, surgical cavity"),
    ("tumour", "non enhancing, nonenhancing"),
    ("enhancing", "enhancing, enhancement"),
    ("tumour", "tumor, tumour, glioma, glioblastoma, astrocytoma, metastasis, metastases, meningioma, cancer"),
    ("blood", "heart atrium, heart ventricle, atrial appendage, left atrium, right atrium"),
    ("haematoma", "haematoma, hematoma, haemorrhage, hemorrhage, bleeding, clot"),
    ("enhancing", "choroid plexus"),
    ("grey matter", "non wm, cortical dysplasia, hippocampal fissure"),
    ("white matter", "white matter, whitematter, wm, wmsa, corpus callosum, corpuscallosum, cc, cbmwm"),
    ("white matter", "unsegmentedwhitematter"),
    ("csf", "ventricle, vent, csf"),
    ("kidney", "kidney, renal"),
    ("grey matter", "grey matter, gray matter, graymatter, cortex, ctx, thalamus, caudate, putamen, pallidum"),
    ("grey matter", "hippocampus, amygdala, accumbens, ventraldc, ventral dc, vdc, claustrum, insula, operculum"),
    ("grey matter", "hypothalamus, cbm, cblumnodulus, floculus, vermis, basal ganglia, substancia nigra"),
    ("grey matter", "substantia nigra, subiculum, presubiculum, parasubiculum, ca1, ca2, ca3, ca4, gc dg, hata"),
    ("grey matter", "molecular layer hp, molecular layer subiculum, hp tail, cadg head, dcg, perirhinal, ectorhinal"),
    ("grey matter", "olfactory bulb, mammilare, tuberal region"),
    ("white matter", "brain stem, brainstem, midbrain, pons, medulla, scp, optic chiasm, chiasma, optic tract"),
    ("white matter", "optic nerve, opticus, fornix, fimbria, alveus, intcapsule, perforant pathway, commisure"),
    ("white matter", "commissure, spinal cord"),
    ("falx", "falx, tentorium, dura"),
    ("blood", "artery, arteries, arterie, vein, vena, vessel, aorta, sinus, brachiocephalic, blood"),
    ("skull", "skull, cranium, diploe, outer table, inner table"),
    ("scalp", "scalp"),
    ("skin", "skin, epidermis"),
    ("cancellous bone", "cancellous, trabecular, spongiosa"),
    ("metal", "metal, implant, screw, titanium"),
    ("bone", "bone, vertebra, vertebrae, rib, sternum, sacrum, humerus, scapula, clavicula, clavicle, femur, hip"),
    ("bone", "pelvis, tibia, fibula, patella, tarsal, metatarsal, carpal, metacarpal, phalanges, radius, ulna"),
    ("bone", "mandible, teeth"),
    ("muscle", "muscle, gluteus, autochthon, iliopsoas, psoas, tongue, diaphragm"),
    ("heart", "heart, myocardium"),
    ("liver", "liver"),
    ("spleen", "spleen"),
    ("lung", "lung"),
    ("fat", "fat, adipose"),
    ("air", "air, aircavity, trachea"),
)

#: The same for what has no preset of its own: the nearest tissue is used, and label_maps.py says so.
_NEAREST: tuple[tuple[str, str], ...] = (
    ("csf", "cerebral exterior, cerebellum exterior"),
    ("tumour", "lesion"),
    ("grey matter", "undetermined, epiphysis, hypophysis, infundibulum"),
    ("white matter", "brain"),
    ("water", "gallbladder, bladder, effusion, eye fluid, vitreous humor, globe, eyeball"),
    ("liver", "pancreas, gland, thyroid, prostate"),
    ("muscle", "esophagus, oesophagus, stomach, duodenum, bowel, colon, intestine, rectum, uterus, cartilage, disc"),
    ("muscle", "face"),
    ("fat", "breast"),
)


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
    found = _by_words(name, _WORDS)
    require(found is not None, f"no preset for tissue {name!r}, expected one of: {', '.join(TISSUES)}")
    return TISSUES[str(found)]


def similar_tissues(name: str, tissue_names: Iterable[str] = ()) -> list[str]:
    """Tissues that an unknown name may mean, for messages: a misspelt one, or the pathologies for "lesion"."""
    key = plain_name(name)
    if re.search(r"\b(lesion|pathology|mass|mask|roi|segment|label)s?\b", key):
        return ["tumour", "oedema", "necrosis", "cyst", "haematoma", "cavity"]
    spellings = {plain_name(known): known for known in (*tissue_names, *TISSUES) if known} | _ALIASES
    near = get_close_matches(key, spellings, n=3, cutoff=0.7)
    return list(dict.fromkeys(spellings[word] for word in near))


def nearest_tissue(name: str) -> str | None:
    """The preset nearest to a structure that has none, such as muscle for the wall of the stomach; None if unknown."""
    return _by_words(name, _NEAREST)


@cache
def _by_words(name: str, lines: tuple[tuple[str, str], ...]) -> str | None:
    key = plain_name(name)
    key = _ALIASES.get(key, key)
    if key in TISSUES:
        return key
    for tissue, words in lines:
        if re.search(rf"\b(?:{words.replace(', ', '|')})s?\b", key):  # also in the plural: "kidneys"
            return tissue
    return None
