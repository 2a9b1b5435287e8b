"""`ussim serve`: the workstation in the browser."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.additions import Additions, add_option, split_additions
from SlicerUSSim.Command.craniotomy_options import Craniotomy, craniotomy_option
from SlicerUSSim.Command.interrupts import end_at_once
from SlicerUSSim.Command.mri_options import also_option, organs_option, read_mri, require_other_files, split_also
from SlicerUSSim.Command.options import ct_option, device_option, mask_option, parameter_option, require_no_mri_options
from SlicerUSSim.Command.patient_options import map_option
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.sequence_options import (
    calibration_option,
    read_sequence,
    read_to_mri,
    to_mri_option,
    transform_option,
)
from SlicerUSSim.Command.sheet_options import AUTO, NONE, DrawnSheets, drawn_sheets_option, no_sheet_option
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.mri.segmentation_settings import CT, SegmentationSettings

if TYPE_CHECKING:
    import ssl

    from SlicerUSSim.Logic.mrml.scene_record import SceneRecord
    from SlicerUSSim.Workstation.workstation import Workstation

_PORT = 8080
#: Names of options that are about a patient, his ultrasound or settings; and their values when they are not given
_OF_PATIENT = (
    "labels", "maps", "sequence", "calibration", "to_mri", "preset", "outside", "mask", "also", "additions", "organs",
)  # fmt: skip
_NOT_GIVEN = (None, False, ())
#: Suffixes of files that are no images, and that the page opens
_TEXTS = (".json", ".vtp", ".tfm", ".h5", ".hdf5", ".mat", ".xfm", ".xml", ".tag", ".txt")


@click.command()
@click.argument("mri", type=click.Path(), required=False)
@click.option("--labels", type=click.Path(), help="Label map, used instead of a segmentation of the MRI.")
@map_option
@click.option("--sequence", type=click.Path(), help="Tracked ultrasound for replay and comparison.")
@transform_option
@calibration_option
@to_mri_option
@click.option("--preset", type=click.Path(), help="Probe, display, settings and tissues as JSON.")
@parameter_option(SegmentationSettings, "contrast")
@ct_option
@parameter_option(SegmentationSettings, "skull_strip")
@parameter_option(SegmentationSettings, "outside")
@mask_option
@also_option
@add_option
@organs_option
@craniotomy_option
@drawn_sheets_option
@no_sheet_option
@click.option("--port", type=click.IntRange(0, 65535), help=f"Port (default: {_PORT}, or a free one if it is taken).")
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen at. Access requires the token in the printed URL.",
)
@click.option("--cert", type=click.Path(), help="TLS certificate (PEM) for https; with --key. For --host.")
@click.option("--key", type=click.Path(), help="Its private key (PEM), without a password.")
@click.option(
    "--igtl",
    help="HOST:PORT of a tracker that sends TRANSFORM messages over OpenIGTLink and receives the images. :PORT waits "
    "for a client on this computer, listen:HOST:PORT for one on another computer (listen:0.0.0.0:18944). OpenIGTLink "
    "has no authentication: anyone who can reach the port can move the probe and receive the images.",
)
@click.option(
    "--autosave/--no-autosave",
    default=True,
    show_default=True,
    envvar="USSIM_AUTOSAVE",
    show_envvar=True,
    help="Keep patient, probe and settings in a folder of yours, to be restored after a crash; see docs/security.md.",
)
@click.option("--igtl-device", help="Name of the transform to follow (default: the first one received).")
@device_option
def serve(
    mri: str | None,
    labels: str | None,
    maps: tuple[str, ...],
    sequence: str | None,
    transform: str,
    calibration: str | None,
    to_mri: str | None,
    preset: str | None,
    contrast: str,
    skull_strip: str,
    outside: bool,
    mask: str | None,
    also: tuple[str, ...],
    additions: tuple[str, ...],
    organs: str | None,
    craniotomy: str,
    sheets: str,
    no_sheets: tuple[str, ...],
    port: int | None,
    host: str,
    cert: str | None,
    key: str | None,
    igtl: str | None,
    autosave: bool,
    igtl_device: str | None,
    device: str | None,
) -> None:
    """The workstation in the browser, with live images. Without a file it shows the demo brain.

    The file is an MRI, or what the page opens, by its content: a scene (.mrb), tracked ultrasound, a preset, ...
    """
    _require_workstation()
    scene, also_open = None, None
    if mri is not None and _is_no_image(mri):
        given = click.get_current_context().params
        patient = [name for name in _OF_PATIENT if given[name] not in _NOT_GIVEN]
        scene, also_open, mri = _opened_first(mri, [f"--{name.replace('_', '-')}" for name in patient])
    added = split_additions(additions)
    others = split_also(also)
    if len(others) > 1:
        raise SimulationError(f"--also is given {len(others)} times, expected one further MRI in the workstation")
    require_other_files(mri, others)
    files = [
        file for file in (mri, labels, mask, organs, *(file for _, file in added), *others.values()) if file is not None
    ]
    # Checked here, so that the error is reported in the terminal and not on the page.
    for file in files:
        if not Path(file).exists():
            raise SimulationError(f"{file}: no such file")
    if maps:
        from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping

        if labels is None and organs is None:
            raise SimulationError("--map is for a label map, expected --labels too")
        LabelMapping.of(maps)
    if labels is not None and mri is None:
        require_no_mri_options(labels, "give an MRI, too, to segment it")
    if contrast == CT and mri is None:
        raise SimulationError(
            "the contrast is ct (--ct), expected a CT; without a file the demo brain is shown, an MRI"
        )
    if outside and contrast != CT:
        from SlicerUSSim.Logic.mri.outside import require_findable

        require_findable(contrast, skull_strip, mask is not None)
        if mri is None:
            raise SimulationError("--outside is for a whole head, expected an MRI of one; the demo brain has no head")
    require(organs is None or contrast == CT, "--organs is for a CT, expected --ct too")
    drawn = DrawnSheets.of(sheets, no_sheets, is_labels=labels is not None, contrast=contrast)
    opening = Craniotomy.of(craniotomy)
    if opening.is_wanted and labels is None:
        require(
            scene is None and also_open is None,
            f"--craniotomy is {craniotomy}, which opens the skull in the MRI of a head, and the file is none",
        )
        head = None
        if mri is not None and not outside:
            head = read_mri(mri, mask=mask, skull_strip=skull_strip, contrast=contrast, is_served=True)
        opening.require_head(
            head, outside=outside, contrast=contrast, skull_strip=skull_strip, has_mask=mask is not None
        )  # fmt: skip
    if opening.is_file:
        _require_opening(opening.source)
    if contrast == CT and others:
        raise SimulationError("--also is for an MRI, and the contrast is ct (--ct); leave it out")
    if igtl is not None:
        from SlicerUSSim.Logic.tracked.openigtlink import parse_address, require_usable

        require_usable(parse_address(igtl))
    require((cert is None) == (key is None), "--cert and --key are for each other, expected both or none")
    tls = _tls(cert, key)
    port = _usable_port(host, port)

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.mri.masks import with_label_names
    from SlicerUSSim.Logic.opencl.devices import choose_device

    choose_device(device)
    volumes = {file: Volume.read(file) for file in files if file != mri or labels is not None}
    if mri is not None and labels is None:
        volumes[mri] = read_mri(mri, mask=mask, skull_strip=skull_strip, contrast=contrast, is_served=True)
    checked = Additions.of((tissue, with_label_names(volumes[file], file), file) for tissue, file in added)
    if mri is not None and labels is None:
        checked.require_addable(
            volumes[mri], None if mask is None else volumes[mask], "none" if contrast == CT else skull_strip
        )
    if labels is not None and mri is not None and (mask is not None or others):
        what = " and ".join(
            name for name, is_given in (("--mask", mask is not None), ("--also", bool(others))) if is_given
        )
        note(f"{what}: for Segment in the page; the labels shown are those of {labels}")
    masks = tuple((tissue, file) for (tissue, _, _), (_, file) in zip(checked.masks, added, strict=True))
    chosen_preset = Preset.read(preset) if preset else None
    tracked = read_sequence(sequence, calibration) if sequence else None
    to_ras = read_to_mri(to_mri) if to_mri else None

    _prepare_libraries()
    from SlicerUSSim.Logic.mri.segmentation_settings import SheetSettings
    from SlicerUSSim.Workstation.opener import Files
    from SlicerUSSim.Workstation.session_store import SessionStore, sessions_folder
    from SlicerUSSim.Workstation.workstation import Workstation

    sheet_settings = SheetSettings()
    if sheets != NONE:
        sheet_settings = SheetSettings.of_kinds(drawn.kinds, find=sheets == AUTO)
    workstation = Workstation(
        Files(
            mri=mri, labels=labels, maps=maps, contrast=contrast, mask=mask, skull_strip=skull_strip, outside=outside,
            also=others,
            additions=masks, organs=organs, sheets=None if drawn.read is None else sheets,
            sheet_settings=sheet_settings,
            craniotomy=opening.source, craniotomy_mm=opening.diameter_mm, preset=chosen_preset,
            sequence=tracked, sequence_name=Path(sequence).name.split(".")[0] if sequence else "", transform=transform,
            to_ras=to_ras, scene=None if scene is None else scene[0], scene_name="" if scene is None else scene[1],
            also_open=also_open, tracker=igtl, tracker_device=igtl_device, volumes=volumes,
        ),
        device,
        SessionStore(sessions_folder()) if autosave else None,
    )  # fmt: skip
    _run(workstation, host, port, tls)


def _is_no_image(path: str) -> bool:
    """Whether a file is neither an MRI, nor a CT, nor a label map, of which the command knows more than the page."""
    from SlicerUSSim.Logic.tracked.sequence import is_tracked_sequence

    if not Path(path).is_file():
        return False
    return _is_zip(path) or Path(path).suffix.lower() in _TEXTS or is_tracked_sequence(path)


def _is_zip(path: str) -> bool:
    with Path(path).open("rb") as file:
        return file.read(4) == b"PK\x03\x04"


def _opened_first(path: str, options: list[str]) -> tuple[tuple[SceneRecord, str] | None, str | None, None]:
    """((scene, name), file that is opened as in the page, None); `options` are those about a patient.

    Raises SimulationError for a file that cannot be opened, and for a scene with such options.
    """
    from SlicerUSSim.Workstation.content import Kind, content_of
    from SlicerUSSim.Workstation.scene_files import read_scene

    if not _is_zip(path) and content_of(Path(path)).kind is not Kind.SCENE:
        return None, path, None
    require(not options, f"{path} is a scene, which has a patient and settings, expected no {', '.join(options)}")
    _prepare_libraries()
    return (read_scene(path), Path(path).name), None, None


def _require_opening(path: str) -> None:
    """Raise SimulationError for a file of --craniotomy that is neither a mask nor a polygon."""
    from SlicerUSSim.Logic.mri.markups import is_markup_name
    from SlicerUSSim.Logic.mri.masks import read_mask
    from SlicerUSSim.Logic.placement.craniotomy import is_open, polygon_of_file

    if is_markup_name(path):
        polygon_of_file(path)
    else:
        is_open(read_mask(path), path)


def _require_workstation() -> None:
    """Raise SimulationError unless the libraries of the workstation are installed."""
    for name in ("trame_slicer", "greenlet"):
        if importlib.util.find_spec(name) is None:
            raise SimulationError(f'the workstation needs {name}; install it with: pip install "SlicerUSSim[serve]"')


def _tls(cert: str | None, key: str | None) -> ssl.SSLContext | None:
    if cert is None or key is None:
        return None
    from SlicerUSSim.Workstation.access import tls_context

    return tls_context(cert, key)


def _run(workstation: Workstation, host: str, port: int, tls: ssl.SSLContext | None) -> None:
    """Print the URL and serve until the command is interrupted."""
    import socket

    from SlicerUSSim.Workstation.access import guard

    server, token = workstation.server, workstation.take_token(port)

    def bind(wslink: Any) -> None:
        guard(wslink.app, token, host)
        if tls is not None:
            wslink.config["ssl"] = tls

    server.controller.on_server_bind.add(bind)

    def tell(**_: Any) -> None:
        shown = host if host not in ("0.0.0.0", "::") else socket.gethostname()
        shown = f"[{shown}]" if ":" in shown else shown
        workstation.keep_token(server.port, token)
        click.echo(f"http{'' if tls is None else 's'}://{shown}:{server.port}/?token={token}")

    server.controller.on_server_ready.add(tell)
    try:
        server.start(
            port=port, host=host, open_browser=False, show_connection_info=False, disable_logging=True, timeout=0
        )
    finally:
        workstation.end_session()
    if workstation.is_computing:
        end_at_once()


def _usable_port(host: str, port: int | None) -> int:
    """`port`, or a free one. Raises SimulationError for a host of another computer and for a port in use."""
    import socket

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    reason = None
    for candidate in [port] if port is not None else [_PORT, 0]:
        try:
            with socket.create_server((host, candidate), family=family):
                return candidate
        except OSError as error:
            reason = error
    raise SimulationError(f"cannot listen at {host}:{port if port is not None else _PORT} ({reason}); choose another")


def _prepare_libraries() -> None:
    """Suppress messages of trame and VTK, and hide this command's options from trame."""
    os.environ.setdefault("WSLINK_READY_MSG", "")
    os.environ.setdefault("WSLINK_WS_COMPRESS", "0")  # nearly all data on the socket are JPEG
    # If the processor also renders the views (Mesa's llvmpipe), half of it is reserved for the ultrasound image.
    os.environ.setdefault("LP_NUM_THREADS", str(max((os.cpu_count() or 2) // 2, 1)))
    sys.argv = sys.argv[:1]
    import vtkmodules.vtkCommonCore as core

    core.vtkLogger.SetStderrVerbosity(core.vtkLogger.VERBOSITY_ERROR)
    core.vtkObject.GlobalWarningDisplayOff()
