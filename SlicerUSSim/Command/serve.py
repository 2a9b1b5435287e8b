"""`ussim serve`: the workstation in the browser."""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.additions import Additions, split_additions
from SlicerUSSim.Command.craniotomy_options import Craniotomy
from SlicerUSSim.Command.interrupts import end_at_once
from SlicerUSSim.Command.mri_options import NONE, ImageOptions, also_files, read_mri
from SlicerUSSim.Command.options import declared, gathered, given_options, require_no_mri_options
from SlicerUSSim.Command.patient_options import RARE
from SlicerUSSim.Command.sequence_options import TrackingOptions, read_sequence, read_to_mri
from SlicerUSSim.Command.set_option import Changes
from SlicerUSSim.Command.sheet_options import AUTO, DrawnSheets
from SlicerUSSim.Logic.base.errors import SimulationError, require

if TYPE_CHECKING:
    import ssl

    from SlicerUSSim.Logic.mrml.scene_record import SceneRecord
    from SlicerUSSim.Workstation.workstation import Workstation

_PORT = 8080
#: Parameters that are about a patient, his ultrasound or settings
_OF_PATIENT = (
    "labels", "maps", "sequence", "calibration", "to_mri", "preset", "outside", "mask", "also", "additions", "organs",
    "craniotomy",
)  # fmt: skip
#: Suffixes of files other than images that the page opens
_TEXTS = (".json", ".vtp", ".tfm", ".h5", ".hdf5", ".mat", ".xfm", ".xml", ".tag", ".txt")


@dataclass(frozen=True)
class ServeOptions(ImageOptions):
    """Arguments and options of `ussim serve`."""

    mri: str | None = declared(type=click.Path(), required=False)
    labels: str | None = declared(
        "--labels", type=click.Path(), help="Label map, used instead of a segmentation of the MRI."
    )
    sequence: str | None = declared(
        "--sequence", type=click.Path(), help="Tracked ultrasound for replay and comparison."
    )
    port: int | None = declared(
        "--port", type=click.IntRange(0, 65535), help=f"Port (default: {_PORT}, or a free one if it is taken)."
    )
    host: str = declared(
        "--host", default="127.0.0.1", show_default=True,
        help="Address to listen at. Access requires the token in the printed URL.",
    )  # fmt: skip
    cert: str | None = declared(
        "--cert", type=click.Path(), help="TLS certificate (PEM) for https; with --key. For --host."
    )
    key: str | None = declared("--key", type=click.Path(), help="Its private key (PEM), without a password.")
    igtl: str | None = declared(
        "--igtl",
        help="HOST:PORT of a tracker that sends TRANSFORM messages over OpenIGTLink and receives the images. :PORT "
        "waits for a client on this computer, listen:HOST:PORT for one on another computer (listen:0.0.0.0:18944). "
        "OpenIGTLink has no authentication: anyone who can reach the port can move the probe and receive the images.",
    )
    autosave: bool = declared(
        "--autosave/--no-autosave", default=True, show_default=True, envvar="USSIM_AUTOSAVE", show_envvar=True,
        help="Keep pose, settings and the names of files in a private file, to resume after a restart; see "
        "docs/security.md.",
    )  # fmt: skip
    igtl_device: str | None = declared(
        "--igtl-device", help="Name of the transform to follow (default: ProbeToReference, or else the first pose)."
    )


@click.command()
@gathered(f"{RARE} transform igtl_device", patient=ServeOptions, recording=TrackingOptions)
def serve(patient: ServeOptions, recording: TrackingOptions) -> None:
    """The workstation in the browser, with live images. Without a file it shows the demo brain.

    The file is an MRI, or what the page opens, by its content: a scene (.mrb), tracked ultrasound, a preset, ...
    """
    from SlicerUSSim.Logic.base.volume import Volume

    require_workstation()
    scene, scene_name, also_open, mri = None, "", None, patient.mri
    if mri is not None and _is_no_image(mri):
        (scene, scene_name), also_open, mri = _opened_first(mri, given_options(*_OF_PATIENT))
    added = split_additions(patient.additions)
    others = also_files(patient.also)
    require(len(others) < 2, f"--also is given {len(others)} times, expected one further MRI in the workstation")
    own = (mri, patient.labels, patient.mask, patient.organs)
    files = [file for file in (*own, *(file for _, file in added), *others.values()) if file is not None]
    # Checked here, so that the error is reported in the terminal and not on the page.
    for file in files:
        require(Path(file).exists(), f"{file}: no such file")
    if patient.maps:
        from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping

        is_for_one = patient.labels is not None or patient.organs is not None
        require(is_for_one, "--map is for a label map, expected --labels too")
        LabelMapping.of(patient.maps)
    if patient.labels is not None and mri is None:
        require_no_mri_options(patient.labels, "give an MRI, too, to segment it")
    volumes = {}
    if mri is not None:
        volumes[mri] = Volume.read(mri) if patient.labels is not None else read_mri(mri, patient, is_served=True)
        patient = patient.for_image(volumes[mri])
    chosen, is_ct, has_mask = patient.segmentation, patient.is_ct, patient.mask is not None
    require(
        mri is not None or not is_ct, "--contrast is ct, expected a CT; without a file the demo brain is shown, an MRI"
    )
    if chosen.outside and not is_ct:
        from SlicerUSSim.Logic.mri.outside import require_findable

        require_findable(patient.contrast, chosen.skull_strip, has_mask)
        require(mri is not None, "--outside is for a whole head, expected an MRI of one; the demo brain has no head")
    require(patient.organs is None or is_ct, "--organs is for a CT, expected one; if this is one, give --contrast ct")
    drawn = DrawnSheets.of(
        patient.sheets, patient.no_sheets, is_labels=patient.labels is not None, contrast=patient.contrast
    )
    opening = Craniotomy.of(patient.craniotomy)
    if opening.is_wanted and patient.labels is None:
        opening.require_head(patient)
    require(not (is_ct and others), "--also is for an MRI, and this is a CT; leave it out")
    if patient.igtl is not None:
        from SlicerUSSim.Logic.tracked.openigtlink import parse_address, require_usable

        require_usable(parse_address(patient.igtl))
    tls = _tls(patient.cert, patient.key)
    port = _usable_port(patient.host, patient.port)

    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.mri.masks import with_label_names
    from SlicerUSSim.Logic.opencl.devices import choose_device

    choose_device(patient.device)
    volumes |= {file: Volume.read(file) for file in files if file != mri}
    checked = Additions.of((tissue, with_label_names(volumes[file], file), file) for tissue, file in added)
    masks = tuple((tissue, file) for (tissue, _, _), (_, file) in zip(checked.masks, added, strict=True))
    chosen_preset = Preset.read(patient.preset) if patient.preset else None
    if patient.changes:
        changes, preset = Changes.of(patient.changes), chosen_preset or Preset()
        chosen_preset = replace(changes.to_preset(preset), tissues=changes.to_tissues(preset.tissues))
    tracked = read_sequence(patient.sequence, recording.calibration) if patient.sequence else None
    to_ras = read_to_mri(recording.to_mri) if recording.to_mri else None

    _prepare_libraries()
    from SlicerUSSim.Logic.mri.segmentation_settings import SheetSettings
    from SlicerUSSim.Workstation.file_nodes import Files
    from SlicerUSSim.Workstation.kept_state import state_file
    from SlicerUSSim.Workstation.workstation import Workstation

    sheet_settings = SheetSettings()
    if patient.sheets != NONE:
        sheet_settings = SheetSettings.of_kinds(drawn.kinds, find=patient.sheets == AUTO)
    workstation = Workstation(
        Files(
            mri=mri, labels=patient.labels, maps=patient.maps, contrast=patient.contrast, mask=patient.mask,
            skull_strip=chosen.skull_strip, outside=chosen.outside, also=others, additions=masks,
            organs=patient.organs, sheets=None if drawn.read is None else patient.sheets,
            sheet_settings=sheet_settings, craniotomy=opening.source, craniotomy_mm=opening.diameter_mm,
            preset=chosen_preset, sequence=tracked, sequence_name=Path(patient.sequence or "").name.split(".")[0],
            transform=recording.transform, to_ras=to_ras, scene=scene, scene_name=scene_name, also_open=also_open,
            tracker=patient.igtl, tracker_device=patient.igtl_device, volumes=volumes
        ),
        patient.device,
        state_file() if patient.autosave else None,
    )  # fmt: skip
    _run(workstation, patient.host, port, tls)


def _is_no_image(path: str) -> bool:
    """Whether a file is neither an MRI, nor a CT, nor a label map, of which the command knows more than the page."""
    from SlicerUSSim.Logic.tracked.sequence import is_tracked_sequence

    if not Path(path).is_file():
        return False
    return _is_zip(path) or Path(path).suffix.lower() in _TEXTS or is_tracked_sequence(path)


def _is_zip(path: str) -> bool:
    with Path(path).open("rb") as file:
        return file.read(4) == b"PK\x03\x04"


def _opened_first(path: str, options: list[str]) -> tuple[tuple[SceneRecord | None, str], str | None, None]:
    """((scene, its name), file that is opened as in the page, None); `options` are those about a patient.

    Raises SimulationError for a file that cannot be opened, and for a scene with such patient.
    """
    from SlicerUSSim.Logic.imaging.content import Kind, content_of
    from SlicerUSSim.Workstation.scene_files import read_scene

    if not _is_zip(path) and content_of(Path(path)).kind is not Kind.SCENE:
        return (None, ""), path, None
    require(not options, f"{path} is a scene, which has a patient and settings, expected no {', '.join(options)}")
    _prepare_libraries()
    return (read_scene(path), Path(path).name), None, None


def require_workstation() -> None:
    """Raise SimulationError unless the libraries of the workstation are installed."""
    for name in ("trame_slicer", "greenlet"):
        remedy = f'the workstation needs {name}; install it with: pip install "SlicerUSSim[serve]"'
        require(importlib.util.find_spec(name) is not None, remedy)


def _tls(cert: str | None, key: str | None) -> ssl.SSLContext | None:
    require((cert is None) == (key is None), "--cert and --key are for each other, expected both or none")
    if cert is None or key is None:
        return None
    from SlicerUSSim.Workstation.access import tls_context

    return tls_context(cert, key)


def _run(workstation: Workstation, host: str, port: int, tls: ssl.SSLContext | None) -> None:
    """Print the URL and serve until the command is interrupted."""
    import secrets
    import socket

    from SlicerUSSim.Workstation.access import guard

    server, token = workstation.server, secrets.token_urlsafe(24)

    def bind(wslink: Any) -> None:
        guard(wslink.app, token, host)
        if tls is not None:
            wslink.config["ssl"] = tls

    server.controller.on_server_bind.add(bind)

    def tell(**_: Any) -> None:
        shown = host if host not in ("0.0.0.0", "::") else socket.gethostname()
        shown = f"[{shown}]" if ":" in shown else shown
        click.echo(f"http{'' if tls is None else 's'}://{shown}:{server.port}/?token={token}")

    server.controller.on_server_ready.add(tell)
    server.start(port=port, host=host, open_browser=False, show_connection_info=False, disable_logging=True, timeout=0)
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
