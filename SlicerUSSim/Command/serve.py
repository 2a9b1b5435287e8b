"""`ussim serve`: the workstation in the browser."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from SlicerUSSim.Command.options import device_option, mask_option, parameter_option
from SlicerUSSim.Command.sequence_options import (
    calibration_option,
    read_sequence,
    read_to_mri,
    to_mri_option,
    transform_option,
)
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.mri.settings import SegmentationSettings

if TYPE_CHECKING:
    from trame_server import Server

_PORT = 8080


@click.command()
@click.argument("mri", type=click.Path(), required=False)
@click.option("--labels", type=click.Path(), help="Label map to simulate from, instead of segmenting the MRI.")
@click.option("--sequence", type=click.Path(), help="Tracked ultrasound to play and to compare with.")
@transform_option
@calibration_option
@to_mri_option
@click.option("--preset", type=click.Path(), help="Probe, display, settings and tissues as JSON.")
@parameter_option(SegmentationSettings, "contrast")
@mask_option
@click.option("--port", type=click.IntRange(0, 65535), help=f"Port (default: {_PORT}, or a free one if it is taken).")
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen at. Anything but this computer's own loopback needs the token in the URL that is printed.",
)
@click.option(
    "--igtl",
    help="HOST:PORT of a tracker that sends TRANSFORM messages over OpenIGTLink, and gets the images. :PORT waits for "
    "one on this computer to connect, listen:HOST:PORT for one elsewhere (listen:0.0.0.0:18944). OpenIGTLink knows no "
    "passwords: whoever reaches that port can move the probe and gets the images.",
)
@click.option("--igtl-device", help="Name of the transform to follow (default: the first that comes).")
@device_option
def serve(
    mri: str | None,
    labels: str | None,
    sequence: str | None,
    transform: str,
    calibration: str | None,
    to_mri: str | None,
    preset: str | None,
    contrast: str,
    mask: str | None,
    port: int | None,
    host: str,
    igtl: str | None,
    igtl_device: str | None,
    device: str | None,
) -> None:
    """The workstation in the browser: MRI, probe, image, live. Without a file, the demo brain."""
    _require_workstation()
    files = [file for file in (mri, labels, mask) if file is not None]
    # What a page could only show is said here, where it was caused.
    for file in files:
        if not Path(file).exists():
            raise SimulationError(f"{file}: no such file")
    if igtl is not None:
        from SlicerUSSim.Logic.tracked.openigtlink import parse_address, require_usable

        require_usable(parse_address(igtl))
    port = _usable_port(host, port)

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.opencl.devices import choose_device

    choose_device(device)
    volumes = {file: Volume.read(file) for file in files}
    chosen_preset = Preset.read(preset) if preset else None
    tracked = read_sequence(sequence, calibration) if sequence else None
    to_ras = read_to_mri(to_mri) if to_mri else None

    _prepare_libraries()
    from SlicerUSSim.Workstation.opener import Files
    from SlicerUSSim.Workstation.workstation import Workstation

    workstation = Workstation(
        Files(
            mri=mri, labels=labels, contrast=contrast, mask=mask, preset=chosen_preset, sequence=tracked,
            sequence_name=Path(sequence).name.split(".")[0] if sequence else "", transform=transform, to_ras=to_ras,
            tracker=igtl, tracker_device=igtl_device, volumes=volumes,
        ),
        device,
    )  # fmt: skip
    _run(workstation.server, host, port)


def _require_workstation() -> None:
    """Raise SimulationError unless the libraries of the workstation are installed."""
    for name in ("trame_slicer", "greenlet"):
        if importlib.util.find_spec(name) is None:
            raise SimulationError(f'the workstation needs {name}; install it with: pip install "SlicerUSSim[serve]"')


def _run(server: Server | None, host: str, port: int) -> None:
    """Print the URL and serve until the command is interrupted."""
    import secrets
    import socket

    from SlicerUSSim.Workstation.access import guard, is_loopback

    assert server is not None  # trame's get_server is declared to give one or None
    token = "" if is_loopback(host) else secrets.token_urlsafe(24)
    server.controller.on_server_bind.add(lambda wslink: guard(wslink.app, token))

    def tell(**_: Any) -> None:
        shown = host if host not in ("0.0.0.0", "::") else socket.gethostname()
        shown = f"[{shown}]" if ":" in shown else shown
        click.echo(f"http://{shown}:{server.port}/" + (f"?token={token}" if token else ""))

    server.controller.on_server_ready.add(tell)
    server.start(port=port, host=host, open_browser=False, show_connection_info=False, disable_logging=True, timeout=0)


def _usable_port(host: str, port: int | None) -> int:
    """`port`, or one that is free. Raises SimulationError for a host that is not ours and a port that is taken."""
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
    """What trame and VTK would print is not for the user of a command; nor are this command's options for trame."""
    os.environ.setdefault("WSLINK_READY_MSG", "")
    os.environ.setdefault("WSLINK_WS_COMPRESS", "0")  # nearly all that goes over the socket is JPEG
    # Where the processor draws the views too (Mesa's llvmpipe), it leaves half of it to the ultrasound image.
    os.environ.setdefault("LP_NUM_THREADS", str(max((os.cpu_count() or 2) // 2, 1)))
    sys.argv = sys.argv[:1]
    import vtkmodules.vtkCommonCore as core

    core.vtkLogger.SetStderrVerbosity(core.vtkLogger.VERBOSITY_ERROR)
    core.vtkObject.GlobalWarningDisplayOff()
