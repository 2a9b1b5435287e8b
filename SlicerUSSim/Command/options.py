"""Shared options, options of declared parameters, and dataclasses of options as one parameter of a command.

Name, help, default and checks of a parameter's option are derived from its declaration (base/declaration.py).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import Field, field, fields
from functools import wraps
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.declaration import Declared, Parameter, parameter_of, parameters_of
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.reading import UNTRUSTED
from SlicerUSSim.Logic.mri.segmentation_settings import CT, SegmentationSettings

Command = Callable[..., None]
Decorator = Callable[[Command], Command]

#: Value of an option that was not given, where None is a valid value.
_NOT_GIVEN = object()

#: Key in click.Context for the number of --verbose options, before and after the subcommand
_VERBOSITY = "SlicerUSSim.verbosity"

device_option = click.option(
    "--device", help='OpenCL device: "platform:device" or part of its name (see `ussim devices`).'
)
mask_option = click.option(
    "--mask", type=click.Path(), help="Brain mask on the MRI's grid (default: found in the MRI, see --skull-strip); "
    "of a CT: the patient."
)  # fmt: skip
ct_option = click.option(
    "--ct", "contrast", flag_value=CT, default=parameter_of(SegmentationSettings, "contrast").default,
    help="The image is a CT in Hounsfield units: short for --contrast ct.",
)  # fmt: skip


def verbose_option(command: click.Command) -> click.Command:
    """The command with --verbose, which may be before the subcommand, after it, or both."""
    command.params.append(
        click.Option(
            ["-v", "--verbose"], count=True, expose_value=False, callback=_set_verbosity,
            help="Write choices and the interpretation of inputs to stderr; -vv: also times and caches.",
        )
    )  # fmt: skip
    return command


def _set_verbosity(ctx: click.Context, _: click.Parameter, count: int) -> None:
    ctx.meta[_VERBOSITY] = ctx.meta.get(_VERBOSITY, 0) + count
    if isinstance(ctx.command, click.Group):
        return  # the subcommand has the same option, adds its count and shows the log

    show_log(ctx, ctx.meta[_VERBOSITY])


def untrusted_option(command: click.Command) -> click.Command:
    """The command with --untrusted, which may be before the subcommand or after it."""
    command.params.append(
        click.Option(
            ["--untrusted"], is_flag=True, expose_value=False, callback=_trust_nothing,
            help="Read every file in a process of its own, with limits on time and memory: for files of strangers.",
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


def parameter_option(kind: type, name: str) -> Decorator:
    """The option of one parameter of `kind`, with the parameter's name in the command and its default."""
    return _option(parameter_of(kind, name))


def _option(entry: Parameter, of_preset: bool = False) -> Decorator:
    """With `of_preset`, an option that was not given is None for a flag and _NOT_GIVEN otherwise."""
    assert entry.option is not None, f"{entry.name} has no option"
    names = "/".join(f"--{name}" for name in entry.option.split("/"))
    if entry.type is bool:
        return click.option(
            names, entry.name, default=None if of_preset else entry.default, help=help_text(entry, of_preset)
        )
    kind = ParameterType(entry)
    return click.option(
        names, entry.name, type=kind, default=_NOT_GIVEN if of_preset else entry.default,
        metavar=f"[{kind.name}]" if entry.choices else kind.name.upper(), help=help_text(entry, of_preset),
    )  # fmt: skip


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


def declared(option: Decorator) -> Any:
    """A field of a dataclass of options, with its click.option or click.argument of the same name."""
    return field(metadata={"options": (option,)})


def declared_parameters(
    kind: type, names: Iterable[str] | None = None, *, of_preset: bool = False, also: Iterable[Decorator] = ()
) -> Any:
    """A field of a dataclass of options: a `kind` with those of its parameters that have an option.

    `names` selects some of them; `also` are further options for the same values. With `of_preset` it is {name: value}
    of the options that were given, and --help refers to the preset for the default.
    """
    entries = [entry for entry in parameters_of(kind) if entry.option and (names is None or entry.name in names)]
    return field(
        metadata={
            "options": (*(_option(entry, of_preset) for entry in entries), *also),
            "names": tuple(entry.name for entry in entries),
            "flags": {entry.name for entry in entries if entry.type is bool},
            "made": dict if of_preset else kind,
        }
    )


def gathered(**kinds: type) -> Callable[[Command], Command]:
    """Decorator: adds the options of these dataclasses to a command, which gets one parameter for each dataclass.

    With gathered(patient=PatientOptions) the command's parameter `patient` is a PatientOptions; with
    gathered(settings=FitSettings) `settings` is a FitSettings, whose parameters without an option have their defaults.
    """

    def decorate(command: Command) -> Command:
        @wraps(command)
        def with_options(**given: Any) -> None:
            options = {name: _filled(kind, given) for name, kind in kinds.items()}
            command(**options, **given)

        decorated: Command = with_options
        for option in reversed([option for kind in kinds.values() for option in _options_of(kind)]):
            decorated = option(decorated)  # --help lists the last one applied first
        return decorated

    return decorate


def _options_of(kind: type) -> list[Decorator]:
    if issubclass(kind, Declared):
        return [_option(entry) for entry in parameters_of(kind) if entry.option]
    return [option for entry in fields(kind) for option in entry.metadata["options"]]  # type: ignore[arg-type]


def _filled(kind: type, given: dict[str, Any]) -> Any:
    """A `kind` from click's values, which are removed from them."""
    if issubclass(kind, Declared):
        return kind(**{entry.name: given.pop(entry.name) for entry in parameters_of(kind) if entry.option})
    return kind(**{entry.name: _value(entry, given) for entry in fields(kind)})  # type: ignore[arg-type]


def _value(entry: Field, given: dict[str, Any]) -> Any:
    names = entry.metadata.get("names")
    if names is None:
        return given.pop(entry.name)
    values = {name: given.pop(name) for name in names}
    flags = entry.metadata["flags"]
    was_given = {name: value for name, value in values.items() if value is not (None if name in flags else _NOT_GIVEN)}
    return entry.metadata["made"](**was_given)


def given_options(*names: str) -> list[str]:
    """Those of the running command's options with these names of parameters that the user gave, as "--mask".

    Of several options of one parameter, as --contrast and --ct, it is the one that stands for the value.
    """
    context = click.get_current_context()
    given = dict[str, str]()
    for parameter in context.command.params:
        name = parameter.name or ""
        if name not in names or context.get_parameter_source(name) is not ParameterSource.COMMANDLINE:
            continue
        stands_for = getattr(parameter, "flag_value", None) if getattr(parameter, "is_flag", False) else None
        if name not in given or (isinstance(stands_for, str) and stands_for == context.params.get(name)):
            given[name] = parameter.opts[0]
    return list(given.values())


def require_no_mri_options(labels: str, remedy: str) -> None:
    """Raise SimulationError if options for the segmentation of an MRI were given with the label map of this file."""
    names = (entry.name for entry in parameters_of(SegmentationSettings))
    _require_not_given(f"{labels}: is a label map", remedy, "mask", "also", "organs", *names)


def require_no_options_beside_ct(path: str) -> None:
    """Raise SimulationError if options that only MRIs have were given with the CT of this file."""
    names = {entry.name for entry in parameters_of(SegmentationSettings)} - {"contrast", "filter_radius"}
    _require_not_given(f"{path}: is a CT (--ct)", "leave it out", "also", *sorted(names))


def _require_not_given(what: str, remedy: str, *names: str) -> None:
    given = given_options(*names)
    kind = "a CT" if given == ["--ct"] else "an MRI"
    verb = "is" if len(given) == 1 else "are"
    require(not given, f"{what}, and {' and '.join(given)} {verb} for {kind}; {remedy}")


overwrite_option = click.option(
    "--overwrite", is_flag=True, expose_value=False, help="Replace outputs that exist; an input is never replaced."
)


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


def check_results(folder: Path, names: Iterable[str], summary: str) -> None:
    """Raise SimulationError if a folder of results cannot be written, or has one of these files without the `summary`.

    With it, a command wrote the files before and replaces them, unless it reads one.
    """
    from SlicerUSSim.Logic.base.files import require_folder

    require_folder(folder)
    is_own = (folder / summary).is_file()
    for path in (folder / name for name in (*names, summary)):
        require_no_input(path)
        require(
            is_own or not path.exists(),
            f"{path}: exists, and without {summary} the folder is not one of this command; give another folder (--out)",
        )


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
    from SlicerUSSim.Logic.mri.kept_mask import mask_beside
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
