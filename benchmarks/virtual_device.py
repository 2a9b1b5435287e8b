"""Rate, latency and memory of the virtual ultrasound device with four clients, one of which is slow.

    python -m benchmarks.virtual_device [--seconds S] [--device NAME]

Each client is a process. One sends 50 poses a second, to which the images belong; the last reads five images a second.
First the link alone sends an image of 512 x 660 pixels for every pose; then the device simulates them on the MNI152
brain, at the rate that the machine has. Latency is from the time in the message, at which the pose was read, to its
arrival. Needs pip install "SlicerUSSim[serve]".
"""

from __future__ import annotations

import argparse
import multiprocessing
import socket
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.measuring import resident_mb
from SlicerUSSim.Logic import UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.device import VirtualDevice
from SlicerUSSim.Logic.imaging import Preset
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import craniotomy_pose, tilt_sweep
from SlicerUSSim.Logic.tracked.openigtlink import Address, TrackerLink

_HZ, _PORT = 50.0, 28944
_HEADER = struct.Struct(">H12s20sIIQQ")
#: Seconds for which poses are sent after the end
_LATER_S = 10.0
#: Seconds that each client takes for an image
_CLIENTS = {"sends poses": 0.0, "reads": 0.0, "reads too": 0.0, "is slow": 0.2}


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the two runs")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    segmentation = segment_mri(demo_mri()[0], device=arguments.device)
    preset = Preset()
    poses = tilt_sweep(craniotomy_pose(segmentation.labels, preset.probe), 20.0, 100)
    image = np.full((1, 512, 660), 90, np.uint8)

    def send(pose: np.ndarray) -> None:
        link.send(Volume(image, pose), {"ImageToProbe": np.eye(4), "ProbeToReference": pose})

    link = TrackerLink("127.0.0.1", _PORT, send, listen=True)
    _measure("link alone", link, poses, arguments.seconds, link.stop)

    tissues = preset.tissues.for_names(segmentation.tissue_names)
    simulator = UltrasoundSimulator(segmentation.labels, tissues, preset.settings, arguments.device)
    simulator.simulate(preset.probe, poses[0], preset.display)
    device = VirtualDevice(simulator, preset, poses[:1], Address("127.0.0.1", _PORT + 1, True), Path())
    threading.Thread(target=device.run).start()
    _measure("device", device.link, poses, arguments.seconds, device.stop, _PORT + 1)


def _measure(
    name: str, link: TrackerLink, poses: list[np.ndarray], seconds: float, stop: Callable[[], None], port: int = _PORT
) -> None:
    """Print rate and latency of every client, and the memory at a tenth and at the end."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(len(_CLIENTS)) as pool:
        jobs = [
            pool.apply_async(_client, (port, pause, seconds, poses if number == 0 else []))
            for number, pause in enumerate(_CLIENTS.values())
        ]
        time.sleep(0.1 * seconds + 2.0)
        early = resident_mb()
        found = [job.get() for job in jobs]
        late = resident_mb()
    for client, (images, wrong, latencies) in zip(_CLIENTS, found, strict=True):
        low, middle, high = 1e3 * np.percentile(latencies, [0, 50, 99]) if latencies else (np.nan,) * 3
        print(
            f"{name}: client that {client:12s} {images / seconds:5.1f} images/s, latency best {low:6.1f} median "
            f"{middle:6.1f} 99 % {high:6.1f} ms, {wrong} images without the time of their pose"
        )
    print(
        f"{name}: {link.received} poses used, {link.dropped} dropped, {link.sent} images sent; memory {early:.0f} MB "
        f"at a tenth, {late:.0f} MB at the end"
    )
    stop()


def _client(port: int, pause: float, seconds: float, poses: list[np.ndarray]) -> tuple[int, int, list[float]]:
    """(images, those whose time is not that of the pose before, latencies in s)."""
    images, wrong, latencies, last = 0, 0, [], None
    with socket.create_connection(("127.0.0.1", port), timeout=60.0) as end, end.makefile("rb") as stream:
        stopping = threading.Event()
        sender = threading.Thread(target=_send_poses, args=(end, poses, stopping))
        sender.start()
        until = time.time() + seconds
        while time.time() < until:
            _, kind, _, whole, part, size, _ = _HEADER.unpack(stream.read(_HEADER.size))
            stream.read(size)
            if kind.startswith(b"TRANSFORM"):
                last = whole, part
            elif kind.startswith(b"IMAGE"):
                images += 1
                wrong += last != (whole, part)
                latencies.append(time.time() - whole - part / 2**32)
                time.sleep(pause)
        stopping.wait(_LATER_S if poses else 0.0)  # the others may have begun later
        stopping.set()
        sender.join()
    return images, wrong, latencies


def _send_poses(end: socket.socket, poses: list[np.ndarray], stopping: threading.Event) -> None:
    from pyigtl import TransformMessage

    begun, number = time.monotonic(), 0
    while poses and not stopping.wait(max(begun + number / _HZ - time.monotonic(), 0.0)):
        end.sendall(TransformMessage(poses[number % len(poses)], device_name="ProbeToReference").pack())
        number += 1


if __name__ == "__main__":
    main()
