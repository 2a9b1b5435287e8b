"""Options that several commands share, and how options that belong together become one parameter of a command."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, fields
from functools import wraps
from pathlib import Path
from typing import Any

import click

Command = Callable[..., None]

#: Under which a click.Context keeps how often --verbose was given, before the subcommand and after it
_VERBOSITY = "SlicerUSSim.verbosity"

device_option = click.option(
    "--device", help='OpenCL device: "platform:device" or part of its name (see `ussim devices`).'
)
contrast_option = click.option(
    "--contrast",
    type=click.Choice(["t1", "t1gd", "t2", "flair"]),
    default="t1",
    show_default=True,
    help="MRI contrast.",
)
mask_option = click.option("--mask", type=click.Path(), help="Foreground on the MRI's grid (default: found by Otsu).")
sulci_option = click.option(
    "--thin-sulci/--no-thin-sulci", default=True, show_default=True,
    help="Label sulci too narrow to reach CSF intensity as leptomeninges.",
)  # fmt: skip


def verbose_option(command: click.Command) -> click.Command:
    """The command with --verbose, which may stand before the subcommand, after it, or at both places."""
    command.params.append(
        click.Option(
            ["-v", "--verbose"], count=True, expose_value=False, callback=_set_verbosity,
            help="Say on stderr what is chosen and what inputs are taken for; -vv: times and caches too.",
        )
    )  # fmt: skip
    return command


def _set_verbosity(ctx: click.Context, _: click.Parameter, count: int) -> None:
    ctx.meta[_VERBOSITY] = ctx.meta.get(_VERBOSITY, 0) + count
    if isinstance(ctx.command, click.Group):
        return  # the subcommand, which has the same option, adds its own and shows the log
    from SlicerUSSim.Command.log import show_log  # which --help does not wait for

    show_log(ctx, ctx.meta[_VERBOSITY])


def declared(option: Callable[[Command], Command]) -> Any:
    """A field of a dataclass of options, which a click.option or click.argument of the same name fills."""
    return field(metadata={"option": option})


def gathered(**kinds: type) -> Callable[[Command], Command]:
    """Decorator: the command takes the options declared in these dataclasses, and gets one parameter for each.

    With gathered(patient=PatientOptions) the command's parameter `patient` is a PatientOptions.
    """

    def decorate(command: Command) -> Command:
        @wraps(command)
        def with_options(**given: Any) -> None:
            options = {
                name: kind(**{entry.name: given.pop(entry.name) for entry in fields(kind)})
                for name, kind in kinds.items()
            }
            command(**options, **given)

        declarations = [entry.metadata["option"] for kind in kinds.values() for entry in fields(kind)]
        decorated: Command = with_options
        for option in reversed(declarations):  # the last one applied is the first one of --help
            decorated = option(decorated)
        return decorated

    return decorate


def check_output(out: Path, png: bool = False) -> None:
    """Refuse an output that cannot be written now rather than after the work."""
    from SlicerUSSim.Logic.base.files import require_place
    from SlicerUSSim.Logic.base.volume import require_image_name

    if not (png and out.suffix.lower() == ".png"):
        require_image_name(out)
    require_place(out)
