"""Options of declared parameters, keys of --set, and dataclasses of options as one parameter of a command.

Name, help, default and checks of a parameter's option are derived from its declaration (base/declaration.py).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import Field, field, fields
from difflib import get_close_matches
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.declaration import Declared, Parameter, parameters_of
from SlicerUSSim.Logic.base.errors import SimulationError, either, require
from SlicerUSSim.Logic.base.reading import UNTRUSTED
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings

Command = Callable[..., None]
Decorator = Callable[[Command], Command]

#: Key in click.Context for the number of --verbose options, before and after the subcommand
_VERBOSITY = "SlicerUSSim.verbosity"

device_option = click.option(
    "--device", help='OpenCL device: "platform:device" or part of its name (see `ussim devices`).'
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, expose_value=False, help="Replace outputs that exist; an input is never replaced."
)


def out_option(about: str, **more: Any) -> Decorator:
    """-o/--out: where a command writes."""
    return click.option("-o", "--out", type=click.Path(path_type=Path), help=about, **(more or {"required": True}))


def verbose_option(command: click.Command) -> click.Command:
    """The command with --verbose, which may be before the subcommand, after it, or both."""
    command.params.append(
        click.Option(
            ["-v", "--verbose"], count=True, expose_value=False, callback=_set_verbosity,
            help="Write choices and the interpretation of inputs to stderr; -vv: also times and caches."
        )
    )  # fmt: skip
    return command


def _set_verbosity(ctx: click.Context, _: click.Parameter, count: int) -> None:
    ctx.meta[_VERBOSITY] = ctx.meta.get(_VERBOSITY, 0) + count
    if isinstance(ctx.command, click.Group):
        return  # the subcommand has the same option, adds its count and shows the log

    show_log(ctx, ctx.meta[_VERBOSITY])


def untrusted_option(command: click.Command, *, hidden: bool = False) -> click.Command:
    """The command with --untrusted, before the subcommand or, `hidden` in its --help, after it."""
    command.params.append(
        click.Option(
            ["--untrusted"], is_flag=True, expose_value=False, callback=_trust_nothing, hidden=hidden,
            help="Read every file in a separate process, with limits on time and memory: for untrusted files."
        )
    )  # fmt: skip
    return command


def _trust_nothing(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not os.environ.get(UNTRUSTED):
        os.environ[UNTRUSTED] = "1"  # for programs that this one starts, too
        ctx.find_root().call_on_close(lambda: os.environ.pop(UNTRUSTED, None))


# ---- options of declared parameters ----------------------------------------------------------------------------------


class ParameterType(click.ParamType):
    """The values of a declared parameter. Raises SimulationError that names option and parameter for invalid ones."""

    def __init__(self, entry: Parameter) -> None:
        self.entry = entry
        self.name = "|".join(entry.choices) or {int: "integer", float: "number"}.get(entry.type, "text")

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        option = param.opts[0] if param else self.entry.name
        return self.entry.from_text(option, value) if isinstance(value, str) else value

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        return [CompletionItem(choice) for choice in self.entry.choices if choice.startswith(incomplete)]


def _option(entry: Parameter, of_preset: bool) -> click.Option:
    """The option of a parameter; with `of_preset`, one that was not given is None."""
    names = "/".join(f"--{name}" for name in str(entry.option).split("/"))
    default, about = None if of_preset else entry.default, help_text(entry, of_preset)
    if entry.type is bool:
        return click.Option([names, entry.name], default=default, help=about)
    kind = ParameterType(entry)
    metavar = f"[{kind.name}]" if entry.choices else kind.name.upper()
    return click.Option([names, entry.name], type=kind, default=default, metavar=metavar, help=about)


def help_text(entry: Parameter, of_preset: bool = False) -> str:
    """Help text of a parameter, such as "Gain [dB]: brightness of all echoes (default: the preset's, 0)."."""
    if entry.type is bool:
        text = entry.tip
        default = "none" if entry.default is None else f"--{(entry.option or '').split('/')[not entry.default]}"
    else:
        tip = entry.tip[0].lower() + entry.tip[1:] if entry.tip[1:2].islower() else entry.tip
        says_it = not entry.unit and tip.startswith(entry.label.lower())
        text = entry.tip if says_it else f"{entry.full_label}: {tip}"
        default = written(entry.default)
    whose = "the preset's, " if of_preset else ""
    return f"{text} (default: {whose}{default})."


def written(value: Any) -> str:
    """A value in the format of options."""
    if isinstance(value, bool) or value is None:
        return str(value).lower()
    return f"{value:.10g}" if isinstance(value, int | float) else str(value)


# ---- dataclasses of options as one parameter of a command ------------------------------------------------------------


def declared(*names: str, **about: Any) -> Any:
    """A field of a dataclass of options, with its option of these names; without names it is an argument."""
    return field(metadata={"option": (names, about)})


def declared_parameters(kind: type, *, of_preset: bool = False) -> Any:
    """A field of a dataclass of options: a `kind` with its parameters that have an option.

    With `of_preset` it is {name: value} of those that were given, and --help refers to the preset for the default.
    """
    return field(metadata={"kind": kind, "of_preset": of_preset})


class Key(NamedTuple):
    """A name of --set and the preset: a parameter of a command, whether --help shows its option or not."""

    option: click.Parameter
    #: Its declaration, if it has one
    entry: Parameter | None
    default: Any
    #: Whether the preset has it for what the option says, so that it is read there
    of_preset: bool = False


def gathered(keys: str = "", **kinds: type) -> Callable[[Command], Command]:
    """Decorator: adds the options of these dataclasses to a command, which gets one parameter for each dataclass.

    With gathered(patient=PatientOptions) the command's parameter `patient` is a PatientOptions; with
    gathered(fit=FitSettings) `fit` is a FitSettings, whose parameters without an option have their defaults.
    Each can also be given by --set and, in an object of its name, in the preset: fit.restarts. Those of `keys`, by
    their names with blanks between them, have no option.
    """

    def decorate(command: Command) -> Command:
        known = {key: entry for name, kind in kinds.items() for key, entry in _keys_of(name, kind)}
        rare = keys.split()

        @wraps(command)
        def with_options(**_: Any) -> None:
            context = click.get_current_context()
            _read_keys(context, known)
            given = dict(context.params)
            options = {name: _filled(kind, given) for name, kind in kinds.items()}
            command(**options, **given)

        shown = [entry.option for entry in known.values() if entry.option.name not in rare]
        below = getattr(command, "__click_params__", [])
        with_options.__click_params__ = [*below, *reversed(shown)]  # type: ignore[attr-defined]
        with_options.keys = known  # type: ignore[attr-defined]
        return with_options

    return decorate


def keys_of(command: click.Command) -> dict[str, Key]:
    """{"section.name": Key} of a command's parameters."""
    return getattr(command.callback, "keys", {})


def rare_keys(command: click.Command) -> dict[str, Key]:
    """Those of its keys that --help has no option for."""
    return {key: entry for key, entry in keys_of(command).items() if entry.option not in command.params}


def about_key(error: click.NoSuchOption) -> str | None:
    """What to give instead of an unknown option, if it is a key of the command."""
    option = error.option_name
    for key, (known, *_) in rare_keys(error.ctx.command).items() if error.ctx else ():
        if option in (*known.opts, *known.secondary_opts):
            value = str(option in known.opts).lower() if known.secondary_opts else "VALUE"
            return f"{option} is a key of the preset now: --set {key}={value}"
    return None


def _keys_of(section: str, kind: type, of_preset: bool = False) -> Iterator[tuple[str, Key]]:
    if issubclass(kind, Declared):
        for entry in parameters_of(kind):
            if entry.option:
                default = None if of_preset else entry.default
                yield f"{section}.{entry.name}", Key(_option(entry, of_preset), entry, default, of_preset)
        return
    for place in fields(kind):  # type: ignore[arg-type]
        if "kind" in place.metadata:
            yield from _keys_of(place.name, place.metadata["kind"], place.metadata["of_preset"])
            continue
        names, about = place.metadata["option"]
        option = click.Option([*names, place.name], **about) if names else click.Argument([place.name], **about)
        default = about.get("default", () if "multiple" in about else None)
        yield f"{section}.{place.name}", Key(option, None, default)


def _read_keys(context: click.Context, known: Mapping[str, Key]) -> None:
    """Add the values of keys to the context: those of --set before options, and options before the preset."""
    own = {key: entry for key, entry in known.items() if not entry.of_preset}
    found: dict[str, list] = {}
    for key, value in _of_file(context.params.get("preset"), own):
        if context.get_parameter_source(own[key].option.name or "") is not ParameterSource.COMMANDLINE:
            found[key] = value if isinstance(value, list) else [value]
    of_file, rest, sections = set(found), [], {key.partition(".")[0] for key in own}
    for text in context.params.get("changes", ()):
        key, equals, value = (part.strip() for part in text.partition("="))
        if equals and key.partition(".")[0] in sections:
            entry = _known("--set: ", key, own).entry
            value = value if entry is None else entry.from_text(f"--set {key}", value)
            found[key] = [*(found[key] if key in found and key not in of_file else ()), value]
            of_file.discard(key)
        else:
            rest.append(text)
    for key, (option, _, default, _) in known.items():
        name = option.name or ""
        if key in found:
            value = found[key] if getattr(option, "multiple", False) else found[key][-1]
            try:
                option.handle_parse_result(context, {name: value}, [])
            except click.BadParameter as error:
                raise SimulationError(f"--set {key}: {error.message}") from None
            if key in of_file:
                context.set_parameter_source(name, ParameterSource.DEFAULT_MAP)
        context.params.setdefault(name, default)
    if "changes" in context.params:
        context.params["changes"] = tuple(rest)


def _of_file(preset: str | None, own: Mapping[str, Key]) -> Iterator[tuple[str, Any]]:
    """(key, value) of what a preset has for a command alone. Raises SimulationError for unknown names."""
    if not preset:
        return
    from SlicerUSSim.Logic.base.files import read_json

    content = read_json(preset)
    for section in dict.fromkeys(key.partition(".")[0] for key in own) if isinstance(content, dict) else ():
        values = content.get(section, {})
        require(isinstance(values, dict), f"{preset}: {section} is {values!r}, expected an object")
        for name, value in values.items():
            entry = _known(f"{preset}: ", f"{section}.{name}", own).entry
            is_plain = entry is None and not isinstance(value, list)
            yield (
                f"{section}.{name}",
                (str(value) if is_plain else value if entry is None else entry.checked(f"{preset}: {section}", value)),
            )


def _known(where: str, key: str, own: Mapping[str, Key]) -> Key:
    """The Key with a name. Raises SimulationError with similar ones, or those of its section, for an unknown name."""
    of_section = [other for other in own if other.partition(".")[0] == key.partition(".")[0]]
    require(
        key in own, f"{where}no parameter {key!r}, expected {either(get_close_matches(key, of_section) or of_section)}"
    )
    return own[key]


def _filled(kind: type, given: dict[str, Any]) -> Any:
    """A `kind` from click's values, which are removed from them."""
    if issubclass(kind, Declared):
        return kind(**{entry.name: given.pop(entry.name) for entry in parameters_of(kind) if entry.option})
    return kind(**{place.name: _value(place, given) for place in fields(kind)})  # type: ignore[arg-type]


def _value(place: Field, given: dict[str, Any]) -> Any:
    if "kind" not in place.metadata:
        return given.pop(place.name)
    if not place.metadata["of_preset"]:
        return _filled(place.metadata["kind"], given)
    values = {entry.name: given.pop(entry.name) for entry in parameters_of(place.metadata["kind"]) if entry.option}
    return {name: value for name, value in values.items() if value is not None}


def given_options(*names: str) -> list[str]:
    """Those of the running command's options with these names of parameters that the user gave, as "--mask"."""
    context = click.get_current_context()
    shown = {option: option.opts[0] for option in context.command.params}
    shown |= {entry.option: f"--set {key}" for key, entry in rare_keys(context.command).items()}
    return [
        text for option, text in shown.items()
        if option.name in names and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
    ]  # fmt: skip


def require_no_mri_options(labels: str, remedy: str) -> None:
    """Raise SimulationError if options for the segmentation of an MRI were given with the label map of this file."""
    names = (entry.name for entry in parameters_of(SegmentationSettings))
    _require_not_given(f"{labels}: is a label map", remedy, "mask", "also", "organs", *names)


def require_no_options_beside_ct(path: str) -> None:
    """Raise SimulationError if options that only MRIs have were given with the CT of this file."""
    names = {entry.name for entry in parameters_of(SegmentationSettings)} - {"contrast", "filter_radius"}
    _require_not_given(f"{path}: is a CT", "leave it out", "also", *sorted(names))


def _require_not_given(what: str, remedy: str, *names: str) -> None:
    given = given_options(*names)
    verb = "is" if len(given) == 1 else "are"
    require(not given, f"{what}, and {' and '.join(given)} {verb} for an MRI; {remedy}")


def check_outputs(*outputs: Path | None, state: Path | None = None) -> None:
    """Raise SimulationError before the computation if an output cannot be written, is an input or another output, or
    exists.

    The running command's --overwrite lets through one that exists, as a `state`, which is read before it is written,
    always is. None stands for an output that was not asked for.
    """
    from SlicerUSSim.Logic.base.files import require_place

    may_replace, outputs = bool(given_options("overwrite")), (*outputs, state)
    places = [out.resolve() for out in outputs if out]
    for out in filter(None, outputs):
        many = places.count(out.resolve())
        require(many == 1, f"{out}: given for {many} outputs, expected a separate file for each")
        require_place(out)
        require_no_input(out)
        is_free = may_replace or out == state or not out.exists()
        require(is_free, f"{out}: exists; give another name, or --overwrite to replace it")


def check_results(folder: Path, names: Iterable[str]) -> None:
    """Raise SimulationError if a folder of results cannot be written, or as check_outputs for one of these files."""
    from SlicerUSSim.Logic.base.files import require_folder

    require_folder(folder)
    if folder.exists():
        check_outputs(*(folder / name for name in names))


@contextmanager
def results_of(folder: Path) -> Iterator[Path]:
    """A temporary folder, whose files are moved to `folder` if the block succeeds: a run that fails changes nothing.

    Raises SimulationError if the folder cannot be created or a file cannot be written.
    """
    from SlicerUSSim.Logic.base.files import make_folder, move_into, partial_folder

    with partial_folder(make_folder(folder), "cannot be written to") as partial:
        yield partial
        move_into(folder, sorted(partial.iterdir()))


def require_no_input(out: Path) -> None:
    """Raise SimulationError if an output of the running command would replace a file that it reads."""
    for file in _inputs():
        is_same = out.resolve() == file.resolve() or (out.exists() and file.exists() and out.samefile(file))
        require(not is_same, f"{out} is an input, which it would replace; give another name")


def _inputs() -> list[Path]:
    """Files that the running command reads, and those that it reads or keeps beside the patient's.

    They are the values of its options and arguments that are text (outputs are Path objects), also behind a name, as in
    tumour=FILE.
    """
    from SlicerUSSim.Logic.base.files import mask_beside
    from SlicerUSSim.Logic.tissue.table import tissues_beside

    params = click.get_current_context().params
    texts = [text for value in params.values() for text in (value if isinstance(value, tuple) else (value,))]
    files = [Path(part) for text in texts if isinstance(text, str) for part in (text, *text.partition("=")) if part]
    mri, labels = params.get("mri"), params.get("mri_or_labels")
    files += [mask_beside(patient) for patient in (mri, labels) if patient]
    return [*files, tissues_beside(Path(labels))] if labels else files


# ---- the package's log on stderr: `ussim: LEVEL: MESSAGE` ------------------------------------------------------------

#: Level by the number of --verbose options
_LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


class _Handler(logging.Handler):
    """Writes to the current stderr, above a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            note(f"ussim: {record.levelname.lower()}: {self.format(record)}")
        except Exception:
            self.handleError(record)


def show_log(ctx: click.Context, verbosity: int) -> None:
    """Show the package's warnings until `ctx` ends; with `verbosity` 1 also INFO, with 2 also DEBUG.

    Of other packages, only errors without another handler are shown.
    """
    ours, last = logging.getLogger("SlicerUSSim"), logging.lastResort
    handler = _Handler()
    before = ours.level, ours.propagate, None if last is None else last.level
    ours.addHandler(handler)
    ours.setLevel(_LEVELS[min(verbosity, len(_LEVELS) - 1)])
    ours.propagate = False  # a library that adds a handler to the root logger would duplicate each line
    if last is not None:
        last.setLevel(logging.ERROR)

    def restore() -> None:
        ours.removeHandler(handler)
        ours.setLevel(before[0])
        ours.propagate = before[1]
        if last is not None and before[2] is not None:
            last.setLevel(before[2])

    ctx.find_root().call_on_close(restore)
