"""Recipe: what a data set is made of, read from TOML and checked: errors name the line and the key."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from SlicerUSSim.Logic.base.declaration import Declared, Parameter, built, parameter, parameters_of, short
from SlicerUSSim.Logic.base.errors import SimulationError, about_file, either, require, require_package
from SlicerUSSim.Logic.base.files import read_text
from SlicerUSSim.Logic.datasets.draws import Draw, generator
from SlicerUSSim.Logic.imaging.preset import Preset, preset_parameters
from SlicerUSSim.Logic.mri.pathology import LESIONS
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.placement.views import VIEWS
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.tissue import Tissue

#: {output: what it is}; those of simulate_batch, and what is computed from the patient
OUTPUTS = {
    "image": "B-mode", "labels": "tissue of every pixel", "labels_as_imaged": "the same as displaced by travel time",
    "depth": "mm along the scan line", "iq": "baseband signal", "rf": "radio-frequency signal",
    "envelope": "envelope along the scan lines", "bmode": "grey levels along the scan lines",
    "clean": "mean of images with other speckle and noise", "mri": "MRI or CT in the image plane",
    "attenuation": "one-way dB along straight lines", "travel_time": "µs there and back along straight lines",
    "walls": "reflection coefficient of the border at a pixel",
}  # fmt: skip
FORMATS = ("zarr", "hdf5", "png", "tracked")
#: Outputs of the formats of pictures
_PICTURES = ("image", "labels", "labels_as_imaged", "clean")
#: Recipes that come with the package, by name
READY = {path.stem: path for path in sorted((Path(__file__).parent / "recipes").glob("*.toml"))}
#: Bundled patients, which are no files
BUNDLED = ("mni152", "synthetic")
ALL = "all"
#: Probes that are drawn for a set: the record of a new one takes 20 ms
PROBE_POOL = 16
#: Images of a shard, and bytes of its arrays, of which an image has so many for each of its signals
_MOST_PER_SHARD, _SHARD_BYTES, _SIGNAL_BYTES = 64, 24e6, 1.6e6
#: Parameters that are fixed: all images have one size, and a simulator is built with them
_FIXED = (
    "display.image_size", "settings.quality", "settings.partial_volume", "settings.mri_modulation_db",
    "settings.reference_speed_m_s", "pose.on", "pose.file", "pose.transform", "pose.within_deg", "pose.aim",
    "lesions.each",
)  # fmt: skip
_DEGREES = {"unit": "°", "bounds": (-180.0, 180.0)}


@dataclass(frozen=True)
class SetSettings(Declared):
    """What a recipe says before its tables."""

    images: int = parameter(label="Images", tip="Number of images", bounds=(1, 10**9))
    seed: int = parameter(0, "Seed", "Seed of all that is drawn", bounds=(0, 2**32 - 1))
    outputs: tuple[str, ...] = parameter(("image", "labels"), "Outputs", "What is kept of every image")
    format: str = parameter("zarr", "Format", "Format of the files", choices=FORMATS)
    shard: int | None = parameter(None, "Shard", "Images of a file; none: up to 64", bounds=(1, 100_000))
    looks: int = parameter(16, "Looks", "Images of which a clean one is the mean", bounds=(2, 256))
    title: str = parameter("Simulated ultrasound", "Title", "Title of the set")
    licence: str = parameter("", "Licence", "Licence of the set")


@dataclass(frozen=True)
class PatientSettings(Declared):
    """One of `[[patients]]`."""

    file: str = parameter(label="File", tip="MRI, CT or label map, beside the recipe, or mni152 or synthetic")
    share: float = parameter(1.0, "Share", "Of the images, re those of the others", bounds=(0.001, 1000))
    ventricles: bool = parameter(False, "Ventricles", "Label the ventricles of an MRI apart from other CSF")
    add: tuple[str, ...] = parameter((), "Add", "Masks laid over the labels, as tumour=mask.nii.gz")
    licence: str = parameter("", "Licence", "Licence of the file")
    citation: str = parameter("", "Citation", "How the file is cited")


@dataclass(frozen=True)
class PoseSettings(Declared):
    """Where a probe stands: `[pose]`; angles, places and `view` may be distributions."""

    on: str = parameter(
        "craniotomy", "On", "Where poses begin", choices=("craniotomy", "skin", "surface", "view", "path", "sequence")
    )
    view: str = parameter("temporal", "View", "Standard view", choices=tuple(VIEWS))
    file: str = parameter("", "File", "Curve (.mrk.json) of a path, or tracked sequence")
    transform: str = parameter("ProbeToReference", "Transform", "Pose of the probe in a tracked sequence")
    within_deg: float = parameter(90.0, "Within", "Of the surface, so far from its top", unit="°", bounds=(0, 180))
    aim: str = parameter("", "Aim", "Tissue at whose innermost place the probe looks")
    right_deg: float = parameter(0.0, "Right", "Moved over the surface to the right", **_DEGREES)
    front_deg: float = parameter(0.0, "Front", "Moved over the surface to the front", **_DEGREES)
    rock_deg: float = parameter(0.0, "Rock", "Turned in the image plane", **_DEGREES)
    tilt_deg: float = parameter(0.0, "Tilt", "Turned out of the image plane", **_DEGREES)
    rotate_deg: float = parameter(0.0, "Rotate", "Turned about the axis", **_DEGREES)
    lift_mm: float = parameter(0.0, "Lift", "Drawn back along its axis", unit="mm", bounds=(-20, 50))


@dataclass(frozen=True)
class LesionSettings(Declared):
    """Balls with a rough surface, each in a part of the images: `[lesions]`; all but `each` may be distributions."""

    each: int = parameter(4, "Each", "Lesions of every patient, one at a time", bounds=(1, 10_000))
    tissue: str = parameter("tumour", "Tissue", "What it is", choices=tuple(n for n in LESIONS if n != "brats"))
    radius_mm: float = parameter(10.0, "Radius", "Mean radius", unit="mm", bounds=(2, 50))
    depth_mm: float = parameter(25.0, "Depth", "Of its middle below the brain's surface", unit="mm", bounds=(0, 80))
    roughness: float = parameter(0.25, "Roughness", "Deviation of its radius by the radius", bounds=(0, 0.6))


_PROBE = Parameter(name="name", type=str, label="Name", tip="Probe", default="phased", choices=tuple(PROBES))
#: Keys of draws that are none of a tissue begin with these
SECTIONS = ("pose", "probe", "display", "settings", "lesions")


class Case(NamedTuple):
    """A patient, with one lesion or none, in the shards from the first to before the last."""

    number: int
    patient: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Recipe:
    """A checked recipe. Image i depends on (seed, i) alone; images of one patient follow each other.

    >>> from SlicerUSSim.Logic.datasets import Recipe
    >>> recipe = Recipe.of_text('images = 100\\n[[patients]]\\nfile = "mni152"\\n[display]\\ngain_db = 3')
    >>> recipe.shards, recipe.drawn(7) == recipe.drawn(7)
    (3, True)
    """

    settings: SetSettings
    patients: tuple[PatientSettings, ...]
    segmentations: tuple[SegmentationSettings, ...]
    pose: PoseSettings
    lesions: LesionSettings | None
    #: {"display.gain_db": Draw, "pose.rock_deg": Draw, "white matter.mu0": Draw, ...}
    draws: Mapping[str, Draw]
    text: str
    #: Files are beside it
    folder: Path

    @classmethod
    def read(cls, path: str | Path) -> Recipe:
        """From a file, or one of READY by its name. Raises SimulationError that names file, line and key."""
        path = READY.get(str(path), Path(path))
        try:
            text = read_text(path)
        except (OSError, UnicodeDecodeError) as error:
            expected = f"expected a recipe in TOML, or one of {', '.join(READY)}"
            raise SimulationError(f"{path}: cannot be read ({getattr(error, 'strerror', error)}), {expected}") from None
        return cls.of_text(text, str(path), path.parent)

    @classmethod
    def of_text(cls, text: str, source: str = "recipe", folder: Path | None = None) -> Recipe:
        """From TOML; relative files are in `folder`."""
        return _Reader(text, source, folder or Path()).recipe()

    @property
    def _variants(self) -> int:
        return self.lesions.each if self.lesions else 1

    @cached_property
    def shard(self) -> int:
        """Images of a shard, but for the last."""
        s = self.settings
        rows, columns = self.draws["display.image_size"].values[0]
        signals = len({"iq", "rf", "envelope", "bmode"} & set(s.outputs))
        image_bytes = 4 * rows * columns * (len(s.outputs) - signals) + _SIGNAL_BYTES * signals
        fewest = s.images // (len(self.patients) * self._variants)
        return s.shard or max(min(_MOST_PER_SHARD, fewest, int(_SHARD_BYTES / image_bytes)), 1)

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.settings.images // self.shard)

    def images_of(self, shard: int) -> range:
        """Numbers of the images of a shard."""
        return range(shard * self.shard, min((shard + 1) * self.shard, self.settings.images))

    @cached_property
    def cases(self) -> tuple[Case, ...]:
        """Patients and lesions in their order; each has one shard at least."""
        shares = [patient.share / self._variants for patient in self.patients for _ in range(self._variants)]
        ends = [round(sum(shares[: n + 1]) / sum(shares) * self.shards) for n in range(len(shares))]
        starts = [0, *ends[:-1]]
        require(
            all(a < b for a, b in zip(starts, ends, strict=True)),
            f"{self.settings.images} images are {self.shards} shards for {len(ends)} patients with their lesions, "
            "expected one for each at least; make more images, or lower shard or lesions.each",
        )
        return tuple(Case(n, n // self._variants, *both) for n, both in enumerate(zip(starts, ends, strict=True)))

    def case_of(self, shard: int) -> Case:
        """The case of a shard."""
        return next(case for case in self.cases if case.first <= shard < case.last)

    def drawn(self, image: int) -> dict[str, Any]:
        """{"section.name": value} of an image but for its tissues; "probe" is its place in `probes`."""
        found = {
            key: draw(generator(self.settings.seed, image, key))
            for key, draw in self.draws.items() if key.startswith(("pose.", "display.", "settings."))
        }  # fmt: skip
        return found | {"probe": int(generator(self.settings.seed, image, "probe").integers(len(self.probes)))}

    @cached_property
    def probes(self) -> tuple[Probe, ...]:
        """The probes of the set; one if none of their values is drawn."""
        is_fixed = all(draw.is_fixed for key, draw in self.draws.items() if key.startswith("probe."))
        found = []
        for number in range(1 if is_fixed else PROBE_POOL):
            values = self._of_section("probe", number)
            preset = Preset(PROBES[values.pop("name", "phased")])
            found.append(preset.changed("probe", **values).probe if values else preset.probe)
        return tuple(found)

    def lesion(self, case: Case) -> dict[str, Any]:
        """The drawn values of the lesion of a case."""
        return self._of_section("lesions", case.number)

    def drawn_for_many(self, probe: int, case: Case) -> dict[str, Any]:
        """{"section.name": value} of a probe and a lesion, which several images have."""
        values = {"probe": self._of_section("probe", probe), "lesions": self.lesion(case)}
        return {f"{section}.{name}": value for section in values for name, value in values[section].items()}

    def _of_section(self, section: str, number: int) -> dict[str, Any]:
        return {
            key.partition(".")[2]: draw(generator(self.settings.seed, number, f"of {key}"))
            for key, draw in self.draws.items() if key.startswith(f"{section}.")
        }  # fmt: skip


class _Reader:
    """Checks the values of a TOML text."""

    def __init__(self, text: str, source: str, folder: Path) -> None:
        self.text, self.source, self.folder = text, source, folder
        self.values = _parsed(text, source)
        self.lines = dict(_lines(text))
        self.draws: dict[str, Draw] = {}

    def at(self, *path: object) -> str:
        """File and line of a key, or of the table around it."""
        place = next((path[:n] for n in range(len(path), 0, -1) if path[:n] in self.lines), None)
        return f"{self.source}: line {self.lines[place]}" if place else self.source

    def table(self, *path: object, given: Any = None) -> dict[str, Any]:
        """A table; of this path at the top, unless it is given."""
        values = self.values.get(str(path[0]), {}) if given is None else given
        require(isinstance(values, dict), f"{self.at(*path)}: {path[-1]} is {short(values)}, expected a table")
        return values

    def known(self, names: Collection[str], *path: object) -> str:
        """Where a key is, which is one of these."""
        where = self.at(*path)
        require(path[-1] in names, f"{where}: {short(path[-1])} is unknown, expected one of {', '.join(names)}")
        return where

    def recipe(self) -> Recipe:
        tables = ("patients", "pose", "probe", "display", "settings", "tissues", "lesions")
        settings = self.plain(SetSettings, {k: v for k, v in self.values.items() if k not in tables}, (), tables)
        self.check_outputs(settings)
        patients = self.values.get("patients", [])
        is_list = isinstance(patients, list) and bool(patients) and all(isinstance(one, dict) for one in patients)
        require(is_list, f"{self.at('patients')}: patients is {short(patients)}, expected [[patients]] with file = ...")
        segmentations = []
        for number, patient in enumerate(patients):
            place = ("patients", number, "segmentation")
            chosen = self.table(*place, given=patient.pop("segmentation", {}))
            self.plain(SegmentationSettings, chosen, place)
            segmentations.append(SegmentationSettings.of(None, **chosen))
        found = tuple(self.plain(PatientSettings, one, ("patients", n)) for n, one in enumerate(patients))
        self.sections()
        pose, lesions = self.first(PoseSettings, "pose"), self.first(LesionSettings, "lesions")
        needs = f"on is {pose.on}, which needs {'no' if pose.file else 'a'} file"
        require((pose.on in ("path", "sequence")) == bool(pose.file), f"{self.at('pose', 'on')}: {needs}")
        lesions = lesions if "lesions" in self.values else None
        made = Recipe(settings, found, tuple(segmentations), pose, lesions, self.draws, self.text, self.folder)
        for key, what in (("probe", "probes"), ("images", "cases")):
            with about_file(self.at(key)):
                getattr(made, what)  # what cannot be is said here
        return made

    def check_outputs(self, settings: SetSettings) -> None:
        for name in settings.outputs:
            is_known = name in OUTPUTS
            require(is_known, f"{self.at('outputs')}: output {short(name)} is unknown, expected {', '.join(OUTPUTS)}")
        other = ", ".join(name for name in settings.outputs if name not in _PICTURES)
        holds = f"format {settings.format} holds {either(_PICTURES)}, and outputs have {other}, expected zarr or hdf5"
        require(settings.format in ("zarr", "hdf5") or not other, f"{self.at('format')}: {holds}")

    def plain(self, kind: type, values: dict, place: tuple, tables: Collection[str] = ()) -> Any:
        """A `kind` of fixed values; beside them there may be tables."""
        known = {entry.name: entry for entry in parameters_of(kind)}
        for name, value in values.items():
            where = self.known([*known, *tables], *place, name)
            values[name] = tuple(value) if isinstance(value, list) else value
            known[name].checked(where, values[name])
        return built(kind, values, self.at(*place))

    def first(self, kind: type, section: str) -> Any:
        """A `kind` with what is fixed, and some value for the rest."""
        return kind(**{entry.name: self.draws[f"{section}.{entry.name}"].values[0] for entry in parameters_of(kind)})

    def sections(self) -> None:
        preset, own = preset_parameters(), {"pose": PoseSettings, "lesions": LesionSettings}
        extra = {f"{section}.{one.name}": one for section, kind in own.items() for one in parameters_of(kind)}
        known = {key: preset[key] for key in preset if key != "probe.kind"} | {"probe.name": _PROBE} | extra
        for section in SECTIONS:
            names = [key.partition(".")[2] for key in known if key.startswith(f"{section}.")]
            for name, value in self.table(section).items():
                key, where = f"{section}.{name}", self.known(names, section, name)
                self.draws[key] = Draw.of(value, known[key], where)
                is_free = key not in _FIXED or self.draws[key].is_fixed
                require(is_free, f"{where}: {name} is {short(value)}, expected one value for all images")
        numbers = {entry.name: entry for entry in parameters_of(Tissue) if entry.type is float}
        for tissue, given in self.table("tissues").items():
            self.known((ALL, *TISSUES), "tissues", tissue)
            for name, value in self.table("tissues", tissue, given=given).items():
                where = self.known(numbers, "tissues", tissue, name)
                self.draws[f"{tissue}.{name}"] = Draw.of(value, numbers[name], where, may_be_relative=True)
        for key, entry in extra.items():
            self.draws.setdefault(key, Draw(entry, "fixed", (entry.default,)))
        self.draws.setdefault("settings.seed", Draw(known["settings.seed"], "uniform", (0, 2**32 - 1)))
        self.draws.setdefault("display.image_size", Draw(known["display.image_size"], "fixed", ((256, 256),)))


def _parsed(text: str, source: str) -> dict[str, Any]:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        require_package("tomli", "SlicerUSSim[datasets]", "a recipe")
        import tomli as tomllib  # type: ignore[import-not-found]
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SimulationError(f"{source}: is not TOML ({error})") from None


def _lines(text: str) -> Iterator[tuple[tuple, int]]:
    """(path of a key or table, its line) of a TOML text; tables of a list have their number in the path."""
    table: tuple = ()
    counts: dict[tuple, int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*(\[\[?)\s*(.+?)\s*\]", line)
        key = re.match(r"\s*(\"[^\"]*\"|[\w.-]+)\s*=", line)
        if header:
            names = tuple(name.strip('"') for name in re.findall(r'"[^"]*"|[\w-]+', header[2]))
            if header[1] == "[[":
                counts[names] = counts.get(names, -1) + 1
            table = ()
            for name in names:
                table = (*table, name)
                table = (*table, counts[table]) if table in counts else table
            yield from ((table, number), (table[:1], number))
        elif key:
            yield (*table, *key[1].strip('"').split(".")), number
