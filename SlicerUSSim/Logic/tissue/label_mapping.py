"""LabelMapping: what a user says about the labels of a label map (--map)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from SlicerUSSim.Logic.base.declaration import kind_of, short
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.tissue.label_files import TABLE_SUFFIXES, read_names
from SlicerUSSim.Logic.tissue.names import plain_name, similar_tissues, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.schemes import schemes
from SlicerUSSim.Logic.tissue.table import TissueTable

#: What a label is mapped to in order to remove it
_NOTHING = ("0", "background", "coupling", "none")
_LARGEST_LABEL = 99_999
_EXPECTED = (
    'expected LABEL=TISSUE such as 24=csf, NAME=TISSUE, a .json file with {{"24": "csf"}}, a table of names, or one of '
    "{schemes}"
)


@dataclass(frozen=True)
class LabelMapping:
    """The user's words about labels.

    >>> from SlicerUSSim.Logic.tissue import LabelMapping
    >>> mapping = LabelMapping.of(["24=csf", "Left-Lesion=tumour", "60=0"])
    >>> mapping.by_label, mapping.by_name
    ({24: 'csf', 60: 'coupling'}, {'left lesion': 'tumour'})
    """

    #: {label: tissue}; "coupling" removes the label
    by_label: Mapping[int, str] = field(default_factory=dict)
    #: {name of a label, in plain spelling: tissue}
    by_name: Mapping[str, str] = field(default_factory=dict)
    #: {label: name} of a table of names
    names: Mapping[int, str] = field(default_factory=dict)
    #: Key of the numbering scheme
    scheme: str | None = None

    @classmethod
    def of(cls, texts: Iterable[str] | Mapping[object, str], tissues: TissueTable | None = None) -> LabelMapping:
        """From texts "24=csf", "Left-Lesion=tumour", files and keys of schemes, or from a mapping {24: "csf"}.

        One text alone may be given without a list. `tissues` are known by their names in addition to the presets.
        Raises SimulationError for other texts, for unknown tissues, and for two tissues of one label.
        """
        if isinstance(texts, Mapping):
            texts = [f"{label}={tissue}" for label, tissue in texts.items()]
        by_label: dict[int, str] = {}
        by_name: dict[str, str] = {}
        names: dict[int, str] = {}
        scheme = None
        for text in [texts] if isinstance(texts, str) else texts:
            key, equals, value = text.partition("=")
            path = Path(text)
            if text.strip().lower() in schemes():
                before, scheme = scheme, text.strip().lower()
                require(before in (None, scheme), f"--map {before} and --map {scheme}: expected one numbering")
            elif path.suffix.lower() == ".json" and (not equals or path.exists()):
                for entry, tissue in _read_json(path).items():
                    _add(by_label, by_name, entry, tissue, str(path), tissues)
            elif path.suffix.lower() in TABLE_SUFFIXES and (not equals or path.exists()):
                found = read_names(path)
                require(found, f"{path}: has no names of labels, expected lines such as: 24 CSF 60 60 60 0")
                names |= found
            else:
                is_pair = key.strip() and value.strip() and "=" not in value
                require(is_pair, f"--map is {short(text)}, {_expected()}")
                _add(by_label, by_name, key, value, f"--map {text}", tissues)
        return cls(by_label, by_name, names, scheme)

    def __bool__(self) -> bool:
        return bool(self.by_label or self.by_name or self.names or self.scheme)

    def tissue_of(self, label: int, name: str | None) -> str | None:
        """The tissue that the user gave to a label, by its number or else by its name; None without."""
        if label in self.by_label:
            return self.by_label[label]
        return None if name is None else self.by_name.get(plain_name(name))

    def unused(self, present: Mapping[int, str | None]) -> list[str]:
        """Its labels and names that do not occur among those of a label map, {label: name}."""
        there = {plain_name(name) for name in present.values() if name is not None}
        labels = [str(label) for label in self.by_label if label not in present and label != 0]
        return [*labels, *(name for name in self.by_name if name not in there)]


def _expected() -> str:
    return _EXPECTED.format(schemes=", ".join(schemes()))


def _read_json(path: Path) -> dict:
    values = read_json(path)
    if isinstance(values, dict) and "tissues" in values:
        raise SimulationError(f"--map {path}: is a tissue table, give it with --tissues")
    require(isinstance(values, dict), f'{path}: is {kind_of(values)}, expected a mapping such as {{"24": "csf"}}')
    for label, tissue in values.items():
        is_tissue = isinstance(tissue, str) or tissue == 0
        require(is_tissue, f"{path}: label {label} is {kind_of(tissue)}, expected the name of a tissue, or 0")
    return values


def _add(
    by_label: dict[int, str], by_name: dict[str, str], key: str, value: object, owner: str, tissues: TissueTable | None
) -> None:
    key = key.strip()
    tissue = _tissue(str(value).strip(), owner, tissues)
    if key.lstrip("+-").replace(".", "", 1).isdecimal():
        require(
            key.isdecimal() and int(key) <= _LARGEST_LABEL,
            f"{owner}: label is {key}, expected a whole number from 0 to {_LARGEST_LABEL}",
        )
        before = by_label.setdefault(int(key), tissue)
    else:
        before = by_name.setdefault(plain_name(key), tissue)
    require(
        plain_name(before) == plain_name(tissue),
        f"{owner}: label {key} is {before} already and cannot be {tissue}, too; expected one tissue for each label",
    )


def _tissue(text: str, owner: str, tissues: TissueTable | None) -> str:
    if text.lower() in _NOTHING:
        return "coupling"
    mine = [] if tissues is None else [tissue.name for tissue in tissues.all_tissues()]
    for name in mine:
        if plain_name(name) == plain_name(text):
            return name
    try:
        return tissue_named(text).name
    except SimulationError:
        near = similar_tissues(text, mine) or list(dict.fromkeys([*mine, *TISSUES]))
        raise SimulationError(
            f"{owner}: no tissue {text!r}, expected 0 (nothing) or one of: {', '.join(near)}"
        ) from None
