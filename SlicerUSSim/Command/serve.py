"""`ussim serve`: the workstation in the browser."""

from __future__ import annotations

import importlib.util
import os
import secrets
import socket
import sys
from pathlib import Path

import click

from SlicerUSSim.Command.options import contrast_option, device_option, mask_option
from SlicerUSSim.Command.tracked import calibration_option, read_sequence, to_mri, to_mri_option, transform_option
from SlicerUSSim.Logic.base.errors import SimulationError

_PORT = 8080


@click.command()
@click.argument("mri", type=click.Path(), required=False)
@click.option("--labels", type=click.Path(), help="Label map to simulate from, instead of segmenting the MRI.")
@click.option("--sequence", "sequence_file", type=click.Path(), help="Tracked ultrasound to play and to compare with.")
@transform_option
@calibration_option
@to_mri_option
@click.option("--preset", "preset_file", type=click.Path(), help="Probe, display, settings and tissues as JSON.")
@contrast_option
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
    mri, labels, sequence_file, path, calibration, to_mri_file, preset_file, contrast, mask, port, host, igtl,
    igtl_device, device,
) -> None:  # fmt: skip
    """The workstation in the browser: MRI, probe, image, live. Without a file, the demo brain."""
    for name in ("trame_slicer", "greenlet"):
        if importlib.util.find_spec(name) is None:
            raise SimulationError(f'the workstation needs {name}; install it with: pip install "SlicerUSSim[serve]"')
    # What a page could only show is said here, where it was caused.
    for file in (mri, labels, mask):
        if file is not None and not Path(file).exists():
            raise SimulationError(f"{file}: no such file")
    if igtl is not None:
        from SlicerUSSim.Logic.tracked.openigtlink import parse_address

        parse_address(igtl)
    port = _usable_port(host, port)

    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.opencl.devices import choose_device

    choose_device(device)
    volumes = {file: Volume.read(file) for file in (mri, labels, mask) if file is not None}
    preset = Preset.read(preset_file) if preset_file else None
    sequence = read_sequence(sequence_file, calibration) if sequence_file else None
    to_ras = to_mri(to_mri_file)

    _prepare_libraries()
    from SlicerUSSim.Workstation.access import guard, is_loopback
    from SlicerUSSim.Workstation.opener import Files
    from SlicerUSSim.Workstation.workstation import Workstation

    token = "" if is_loopback(host) else secrets.token_urlsafe(24)
    workstation = Workstation(
        Files(
            mri=mri, labels=labels, contrast=contrast, mask=mask, preset=preset, sequence=sequence,
            sequence_name=Path(sequence_file).name.split(".")[0] if sequence_file else "", transform=path,
            to_ras=to_ras, tracker=igtl, tracker_device=igtl_device, volumes=volumes,
        ),
        device,
    )  # fmt: skip
    server = workstation.server
    server.controller.on_server_bind.add(lambda wslink: guard(wslink.app, token))

    def tell(**_) -> None:
        shown = host if host not in ("0.0.0.0", "::") else socket.gethostname()
        shown = f"[{shown}]" if ":" in shown else shown
        click.echo(f"http://{shown}:{server.port}/" + (f"?token={token}" if token else ""))

    server.controller.on_server_ready.add(tell)
    server.start(port=port, host=host, open_browser=False, show_connection_info=False, disable_logging=True, timeout=0)


def _usable_port(host: str, port: int | None) -> int:
    """`port`, or one that is free. Raises SimulationError for a host that is not ours and a port that is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
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
