"""Choice of the OpenCL device, and the kernels it builds."""

from __future__ import annotations

import ctypes
import os
import re
import struct
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from SlicerUSSim.Logic import LinearProbe, SimulationError, TissueTable, UltrasoundSimulator, Volume, list_devices
from SlicerUSSim.Logic.opencl import pocl
from SlicerUSSim.Logic.opencl.device import Device, kernel_folder
from SlicerUSSim.Logic.opencl.devices import DeviceInfo, choose_device, faster_hint
from SlicerUSSim.Logic.opencl.layout import shared_source
from SlicerUSSim.Logic.opencl.limits import lack_of_programs_disk
from SlicerUSSim.Logic.opencl.pocl import (
    _passes_self_test,
    name_processor,
    remove_damaged_kernels,
    require_linker,
)
from SlicerUSSim.Logic.opencl.runtimes import pocl_of_pip
from SlicerUSSim.Logic.probe import pose_looking_at
from tests.conftest import SPECKLE, block, rigid, simulator


def fake(index, name, platform, kind, rank) -> DeviceInfo:
    return DeviceInfo(index, name, platform, kind, 2, 1000, rank, handle=None)


GPU = fake("2:0", "GeForce", "NVIDIA CUDA", "GPU", 0)
INTEL = fake("1:0", "Xeon", "Intel(R) OpenCL", "CPU", 1)
POCL = fake("0:0", "pthread-Xeon", "Portable Computing Language", "CPU", 2)


@pytest.fixture
def three_devices(monkeypatch):
    monkeypatch.setattr(
        "SlicerUSSim.Logic.opencl.devices.list_devices", lambda: sorted([POCL, INTEL, GPU], key=lambda d: d.rank)
    )
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    monkeypatch.delenv("USSIM_DEVICE", raising=False)


def test_there_is_a_device_and_the_list_is_in_order():
    devices = list_devices()
    assert devices, "PoCL comes with the package on Linux"
    assert [d.rank for d in devices] == sorted(d.rank for d in devices)
    assert len({(d.platform, d.name) for d in devices if d.kind == "CPU"}) == sum(d.kind == "CPU" for d in devices)


def test_the_fastest_is_taken_unless_told_otherwise(three_devices, monkeypatch):
    assert choose_device()[0] is GPU
    monkeypatch.setenv("USSIM_DEVICE", "pocl")
    assert choose_device() == (POCL, "chosen by USSIM_DEVICE")
    monkeypatch.setenv("PYOPENCL_CTX", "1:0")
    assert choose_device() == (INTEL, "chosen by PYOPENCL_CTX")
    assert choose_device("geforce") == (GPU, "chosen by argument")
    monkeypatch.setenv("PYOPENCL_CTX", "1")
    assert choose_device()[0] is INTEL


def test_an_unknown_choice_lists_what_there_is(three_devices, monkeypatch):
    with pytest.raises(SimulationError, match=r"argument: no OpenCL device fits 'Radeon', expected one of: 2:0 NVIDIA"):
        choose_device("Radeon")
    monkeypatch.setenv("USSIM_DEVICE", "7:7")
    with pytest.raises(SimulationError, match="USSIM_DEVICE: no OpenCL device fits '7:7'"):
        choose_device()


@pytest.mark.parametrize(
    ("system", "machine", "advice", "hint"),
    [
        (
            "linux", "x86_64", "install the driver of a graphics card, or with pip for the processor Intel's runtime "
            "(intel-opencl-rt, intel-cmplr-lib-rt) or PoCL (pocl-binary-distribution)",
            "pip install intel-opencl-rt intel-cmplr-lib-rt",
        ),
        (
            "linux", "aarch64",
            "install the system's OpenCL runtime, which Debian and Ubuntu have in the package pocl-opencl-icd", None,
        ),
        (
            "win32", "AMD64",
            "install the driver of a graphics card, or with pip for the processor Intel's runtime (intel-opencl-rt)",
            "pip install intel-opencl-rt",
        ),
        (
            "darwin", "arm64",
            "macOS computes on its graphics processor only, and this Mac offers none to this program", None,
        ),
    ],
)  # fmt: skip
def test_what_to_install_is_what_there_is_for_the_computer(monkeypatch, system, machine, advice, hint):
    """Packages that pip finds, and no commands: Slicer shows the message in a dialog."""
    monkeypatch.setattr("SlicerUSSim.Logic.opencl.devices.list_devices", lambda: [])
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr("platform.machine", lambda: machine)
    with pytest.raises(SimulationError) as caught:
        choose_device()
    assert str(caught.value) == f"no OpenCL device found; {advice}"
    assert faster_hint(POCL) == hint  # only a slow device gets one
    assert faster_hint(INTEL) is None and faster_hint(GPU) is None


@pytest.mark.parametrize("rounds", [True, False])
def test_a_device_that_does_not_round_divisions_is_warned_of_once(monkeypatch, caplog, rounds):
    monkeypatch.setattr(Device, "rounds_divisions", rounds)
    monkeypatch.setattr("SlicerUSSim.Logic.opencl.device._opened", {})
    options: list[list[str]] = []
    build = Device._build
    monkeypatch.setattr(
        Device, "_build", lambda self, name, source, given: (options.append(given), build(self, name, source, given))[1]
    )
    for _ in range(2):
        Device.get().kernels("scan_conversion.cl")
    assert ("-cl-fp32-correctly-rounded-divide-sqrt" in options[0]) == rounds
    said = [record for record in caplog.records if "does not round divisions" in record.getMessage()]
    assert len(said) == (not rounds)


def test_a_kernel_that_does_not_build_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "common.clh").write_text((kernel_folder() / "common.clh").read_text())
    (tmp_path / "broken.cl").write_text("__kernel void broken() { this is not C; }")
    monkeypatch.setattr("SlicerUSSim.Logic.opencl.device.kernel_folder", lambda: tmp_path)
    with pytest.raises(SimulationError, match=r"cannot build broken\.cl") as caught:
        Device.get().kernels("broken.cl")
    assert "\n" not in str(caught.value)


def test_profiles_name_every_kernel():
    sim = simulator(block(lambda x, y, z: x * 0 + 1, half_mm=(10, 10, 10)), SPECKLE)
    sim.device.profiling = True
    try:
        sim.simulate(LinearProbe(10, 15, scan_lines=32), rigid(np.eye(3), [0, -8, 0]))
        profile = sim.device.take_profile()
    finally:
        sim.device.profiling = False
    assert {"trace", "scatter", "lateral_beam", "convolve_pulse", "compress", "scan_convert"} <= set(profile)
    assert all(milliseconds > 0 for milliseconds in profile.values())
    assert sim.device.take_profile() == {}


@pytest.mark.slow
@pytest.mark.parametrize(("lanes", "chunk"), [(1, 16), (8, 64), (16, 64)])
def test_how_a_device_splits_the_work_does_not_change_the_image(lanes, chunk):
    """GPUs take one value and 16 samples at a time, processors vectors and 64."""
    solid = block(lambda x, y, z: np.where(y > 3, 0, 1), half_mm=(12, 12, 12))
    probe, pose = LinearProbe(10, 15, scan_lines=32), rigid(np.eye(3), [0, -8, 0])
    usual = simulator(solid, SPECKLE)
    reference = usual.simulate(probe, pose)
    other = Device(usual.device.info)
    other.lanes, other.chunk = lanes, chunk
    found = UltrasoundSimulator(solid, usual.medium.tissues, usual.settings, device=other).simulate(probe, pose)
    difference = np.abs(found.image.astype(int) - reference.image)
    assert (difference <= 1).mean() > 0.999


def test_pocl_takes_the_same_groups_for_label_maps_and_lines_of_any_number(monkeypatch):
    """It compiles a kernel for every size of its groups: seconds for every new patient, where they followed the map."""
    device = Device.get()
    if "Portable Computing Language" not in device.info.platform:
        pytest.skip("another runtime chooses groups itself")
    sizes: dict[str, set] = {}
    run = Device.run

    def noting(self, kernel, *arguments, **options):
        def told(queue, global_size, local_size, *given):
            sizes.setdefault(kernel.function_name, set()).add((local_size, len(global_size)))
            assert all(size % part == 0 for size, part in zip(global_size, local_size, strict=True))
            return kernel(queue, global_size, local_size, *given)

        run(self, told, *arguments, **options)

    monkeypatch.setattr(Device, "run", noting)
    for half_mm, lines in (((14, 15, 9), 40), ((16, 17, 11), 47), ((19, 13, 12.5), 53), ((15.5, 18.5, 10.5), 61)):
        labels = block(lambda x, y, z: 1 + (x + y > 3) + (y > 5), half_mm)
        probe = LinearProbe(18, 24, scan_lines=lines, focus_mm=12, elevation_focus_mm=12)
        simulator(labels, SPECKLE, SPECKLE, SPECKLE).simulate(probe, rigid(np.eye(3), [0, -12, 0]))
    assert {"smooth_rows", "halve", "smooth_rest", "scan_convert"} <= sizes.keys()
    of_map = {name: found for name, found in sizes.items() if name.startswith(("smooth", "halve"))}
    assert all(len(found) == 1 for found in of_map.values()), of_map
    assert all(len(found) <= 3 for found in sizes.values()), sizes


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_pocl_without_a_linker_is_an_error_and_not_the_end_of_the_process(tmp_path, monkeypatch):
    """PoCL 3 aborts if it cannot link, as on a minimal Debian; it looks for `ld` in PATH alone."""
    done = _in_process(
        "from SlicerUSSim.Logic.opencl.device import Device\nDevice.get('pocl').kernels('bmode.cl')",
        PATH="/nowhere", XDG_CACHE_HOME=str(tmp_path), OCL_ICD_VENDORS=_only_pocl(tmp_path),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-800:]
    assert "refused: PoCL, the OpenCL runtime in use, links its kernels with `ld`" in done.stdout
    monkeypatch.setattr("pathlib.Path.glob", lambda self, pattern: iter(()))
    with pytest.raises(SimulationError, match=r"libgcc, which is not in /usr/lib/gcc; install Debian's packages gcc"):
        require_linker("OpenCL 3.0 PoCL 3.0  Linux, Release, RELOC, LLVM 14.0.6")
    require_linker("OpenCL 3.0 PoCL 6.0  Linux, Release")  # which brings its own


#: Flags of a processor with vectors of 16 floats
_AVX512 = {
    "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "avx",
}  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel, and the memory that is searched, are Linux's")
@pytest.mark.parametrize(
    ("called", "flags", "named"),
    [
        ("generic", _AVX512, "skylake-avx512"),  # Zen 5
        ("znver3", _AVX512, "skylake-avx512"),  # Zen 4: vectors of 16 floats ended the process
        ("znver2", _AVX512 - {"avx512f"}, None),
        ("skylake-avx512", _AVX512, None),
        ("generic", set(), None),
    ],
)
def test_pocl_builds_for_a_processor_with_its_librarys_vectors(monkeypatch, tmp_path, caplog, called, flags, named):
    """Only after a child process has failed."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    name = libc.malloc(ctypes.c_size_t(24))
    ctypes.memmove(name, called.encode() + b"\0", len(called) + 1)
    structure = (ctypes.c_uint64 * 512)(3, 0, name)  # a device's structure, with a pointer to its processor's name
    handle = SimpleNamespace(
        version=f"OpenCL 3.0 PoCL HSTR: pthread-x86_64-{called}", int_ptr=ctypes.addressof(structure),
        driver_version="3.0-rc2",
    )  # fmt: skip
    monkeypatch.setattr("SlicerUSSim.Logic.opencl.pocl._processor_flags", lambda: flags)
    monkeypatch.setattr("SlicerUSSim.Logic.opencl.pocl.child_command", lambda code: (["true"], {}))
    assert name_processor(handle) is None
    for kept in tmp_path.iterdir():
        kept.unlink()
    monkeypatch.setattr("SlicerUSSim.Logic.opencl.pocl.child_command", lambda code: (["false"], {}))
    assert name_processor(handle) == named
    if named:  # opened again
        caplog.clear()
        assert name_processor(handle) is None and not caplog.records
    assert ctypes.string_at(name).decode() == (named or called)


@pytest.mark.parametrize("ends", [0, 1, pytest.param(None, marks=pytest.mark.long)])
@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_what_the_self_test_of_pocl_found_is_kept(monkeypatch, tmp_path, ends):
    """On some processors it fails, or never ends: then PoCL is patched. A child with a status takes its place here."""
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    if ends is not None:
        child = [sys.executable, "-c", f"raise SystemExit({ends})"], dict(os.environ)
        monkeypatch.setattr(pocl, "child_command", lambda _: child)
    passes = _passes_self_test("3.0 of this processor")
    kept = (tmp_path / "ussim-self-test").read_text()
    assert passes == (ends == 0) or ends is None
    assert kept == f"3.0 of this processor\n{'passed' if passes else 'failed'}"
    monkeypatch.setattr("subprocess.run", lambda *_, **__: pytest.fail("it was tried again"))
    assert _passes_self_test("3.0 of this processor") == passes


def test_threads_share_a_simulator_and_a_device():
    """Before, 232 of 360 images were wrong without a word."""
    probe = LinearProbe(width_mm=20, depth_mm=30, scan_lines=64)
    labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
    users = [UltrasoundSimulator(labels, TissueTable.named(["liver"])) for _ in range(2)]
    poses = [pose_looking_at((20.0 + step, 20.0, 39.0), (20.0, 20.0, 0.0)) for step in range(-3, 4)]
    expected = [users[0].simulate(probe, pose).image for pose in poses]
    work = [(user, number) for _ in range(3) for number in range(len(poses)) for user in users]

    def image(job) -> np.ndarray:
        user, number = job
        return user.simulate(probe, poses[number]).image

    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(image, work))
    wrong = [number for (_, number), found in zip(work, images, strict=True) if (found != expected[number]).any()]
    assert not wrong


_FORK = """
import os, sys
import numpy as np
from SlicerUSSim.Logic import LinearProbe, SimulationError, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.probe import pose_looking_at
from SlicerUSSim.Logic.opencl.runtimes import pocl_of_pip
from SlicerUSSim.Logic.opencl.device import Device

labels = Volume(np.ones((30, 30, 30), np.uint8), np.eye(4))
probe = LinearProbe(width_mm=20, depth_mm=20, scan_lines=32)
pose = pose_looking_at((15, 15, 29), (15, 15, 0))
simulator = UltrasoundSimulator(labels, TissueTable.named(["liver"]))
simulator.simulate(probe, pose)
child = os.fork()
if child == 0:
    uses = lambda: simulator.simulate(probe, pose), Device.get, lambda: simulator.volume(probe, [pose] * 2)
    for use in uses:
        try:
            use()
            os._exit(3)
        except SimulationError as error:
            if "fork" not in str(error):
                os._exit(4)
    os._exit(5)
status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
simulator.simulate(probe, pose)  # here it still works
sys.exit(status)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_a_fork_says_that_it_cannot_use_the_device_and_does_not_hang():
    done = subprocess.run([sys.executable, "-c", _FORK], capture_output=True, text=True, timeout=300)
    assert done.returncode == 5, (done.returncode, done.stderr[-800:])


def cached_program(folder: Path, name: str, library: bytes, bitcode: bytes) -> Path:
    program = folder / "AB" / name
    place = program / "scatter" / "36-16-1"
    place.mkdir(parents=True)
    (place / "scatter.so").write_bytes(library)
    (program / "program.bc").write_bytes(bitcode)
    return program


def test_incomplete_files_of_pocls_cache_are_removed(tmp_path):
    table, sections = 128, 3
    elf = b"\x7fELF".ljust(40, b"\0") + struct.pack("<Q", table) + b"\0" * 10 + struct.pack("<HH", 64, sections)
    elf = elf.ljust(table + 64 * sections, b"\0")
    bitcode = b"BC\xc0\xde" + struct.pack("<II", 1, 4) + b"\0" * 16
    sound = cached_program(tmp_path, "sound", elf, bitcode)
    damaged = [
        cached_program(tmp_path, f"damaged{n}", *files)
        for n, files in enumerate(
            [(elf[:-1], bitcode), (b"", bitcode), (elf, bitcode[:-1]), (elf, b""), (elf, bitcode + b"1234")]
        )
    ]
    assert remove_damaged_kernels(tmp_path) == len(damaged)
    assert sound.exists() and not any(program.exists() for program in damaged)
    assert remove_damaged_kernels(tmp_path / "none") == 0


def _in_process(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A script in a separate process, which prints the message of a SimulationError."""
    caught = f"from SlicerUSSim.Logic import SimulationError\ntry:\n{textwrap.indent(script, '    ')}\n"
    caught += "except SimulationError as error:\n    print('refused:', error)\n"
    return subprocess.run(
        [sys.executable, "-c", caught], env={**os.environ, **environment}, capture_output=True, text=True
    )


_LIMITED = """
import resource
from SlicerUSSim.Logic import list_devices
from SlicerUSSim.Logic.opencl.runtimes import pocl_of_pip
from SlicerUSSim.Logic.opencl.device import Device
found = list_devices() if {after} else []
resource.setrlimit(resource.RLIMIT_AS, (400 * 10**6, resource.RLIM_INFINITY))
Device.get(found[0] if found else None)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits of a process")
@pytest.mark.parametrize("after", [False, True])
def test_too_small_an_address_space_is_named(after):
    """Without this: "no OpenCL device found; run: pip install", or Intel's runtime ends the process."""
    done = _in_process(_LIMITED.format(after=after))
    assert done.returncode == 0, done.stderr[-800:]
    assert re.search(r"refused: .*limited to 400 MB \(ulimit -v\), expected at least \d+ MB", done.stdout), done.stdout


def test_a_full_disk_for_programs_is_named_unless_they_are_built(tmp_path, monkeypatch):
    """The compiler ends the process."""
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=10**5))
    assert "is on a full disk (0.1 MB left, expected 4 MB)" in (lack_of_programs_disk(tmp_path / "none") or "")
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "all.so").write_bytes(bytes(5 * 10**6))
    assert lack_of_programs_disk(tmp_path) is None


@pytest.mark.skipif(sys.platform != "linux", reason="PoCL's wheel is for Linux")
def test_a_cache_that_cannot_be_written_is_named(tmp_path):
    """PoCL has no device then; without this: "no OpenCL device found; run: pip install"."""
    (tmp_path / "file").write_text("")
    done = _in_process(
        "from SlicerUSSim.Logic.opencl.device import Device\nDevice.get('pocl')",
        XDG_CACHE_HOME=str(tmp_path / "file"), OCL_ICD_VENDORS=_only_pocl(tmp_path),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-800:]
    assert re.search(
        r"refused: .*PoCL keeps programs in .*file/pocl/kcache, which cannot be written \(Not a dir", done.stdout
    )


def _only_pocl(folder: Path) -> str:
    """A folder for the loader that names PoCL alone."""
    library = pocl_of_pip()
    if library is None:
        pytest.skip("needs PoCL's wheel")
    vendors = folder / "vendors"
    vendors.mkdir()
    (vendors / "pocl.icd").write_text(str(library))
    return str(vendors)


def test_a_full_disk_of_the_caches_is_named(monkeypatch):
    device = Device.get()
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=10**5))

    def fail(*_):
        raise device.cl.RuntimeError("clBuildProgram", -11, "failed to build the program")

    monkeypatch.setattr(device.cl, "Program", fail)
    with pytest.raises(SimulationError, match=r"is on a full disk \(0\.1 MB left, expected 4 MB\)\); free some of it"):
        device.kernels("smoothing.cl", 1, "NEVER_BUILT")


def test_a_refused_buffer_names_its_size(monkeypatch):
    device = Device.get()

    def refuse(*_, **__):
        raise device.cl.MemoryError("clCreateBuffer", -4, "")

    monkeypatch.setattr(device.cl, "Buffer", refuse)
    for ask in (lambda: device.empty(3 * 2**20), lambda: device.upload(np.zeros(3 * 2**20, np.uint8))):
        with pytest.raises(SimulationError, match="has no memory for a buffer of 3 MB; close other programs"):
            ask()


def test_kernels_call_no_function_that_devices_round_differently():
    """Built-in square roots and divisions are rounded as in IEEE 754, fma too; those named here are not."""
    names = (
        "log|log2|log10|exp|exp2|exp10|pow|powr|pown|sin|cos|tan|sincos|asin|acos|atan|atan2|sinh|cosh|tanh|erf|erfc"
    )
    names += "|cbrt|rsqrt|hypot|mad|length|normalize|distance|fast_[a-z]+|native_[a-z0-9]+|half_[a-z0-9]+|lgamma|tgamma"
    called = re.compile(rf"(?<![\w.])({names})\s*\(")
    found = []
    for path in sorted(kernel_folder().glob("*.cl*")):
        code = re.sub(r"//[^\n]*|/\*.*?\*/", "", path.read_text(), flags=re.DOTALL)
        found += [f"{path.name}: {match[1]}" for match in called.finditer(code)]
    assert not found


def test_sines_cosines_and_angles_of_the_kernels_are_those_of_numpy():
    device = Device.get()
    angles = np.linspace(-7.0, 7.0, 4001).astype(np.float32)
    x, y = np.cos(angles.astype(float)), np.sin(angles.astype(float))
    source = shared_source() + (kernel_folder() / "common.clh").read_text() + _ANGLES
    kernel = device.cl.Program(device.context, source).build(options=["-cl-std=CL1.2", "-DLANES=1"]).angles
    out = device.empty(4 * 3 * angles.size)
    pairs = device.upload(np.stack([x, y], -1).astype(np.float32))
    device.run(kernel, (angles.size,), device.upload(angles), pairs, out)
    sine, cosine, direction = device.download(out, (angles.size, 3), np.float32).T
    np.testing.assert_allclose(sine, y, atol=4e-7)
    np.testing.assert_allclose(cosine, x, atol=4e-7)
    expected = np.arctan2(y, x)
    np.testing.assert_allclose(
        np.where(np.abs(expected) > 3.14159, np.abs(direction), direction),
        np.where(np.abs(expected) > 3.14159, np.abs(expected), expected),
        atol=6e-7,
    )


_ANGLES = """
__kernel void angles(__global const float *of, __global const float *pairs, __global float *out) {
  const int n = get_global_id(0);
  out[3 * n] = sin_of(of[n]), out[3 * n + 1] = cos_of(of[n]);
  out[3 * n + 2] = direction_of(pairs[2 * n + 1], pairs[2 * n]);
}
"""
