"""DeviceBar: the OpenCL devices in Slicer, in the panel's section Advanced, with a message above the panel."""

from __future__ import annotations

import json
from typing import Any

import qt
import slicer
from slicer.i18n import tr as _

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.imaging.device_trials import DeviceTrials, TriedDevice
from SlicerUSSim.Logic.opencl.devices import Runtime
from SlicerUSSim.Widget.packages import install_runtime, runtimes_to_install
from SlicerUSSim.Widget.presenter import PanelPresenter

#: Names in Slicer's settings: the chosen device, and {TriedDevice.key: milliseconds} as JSON
_DEVICE, _TIMES = "USSim/device", f"USSim/deviceTimes-{__version__}"
_POLL_MS = 300


class DeviceBar:
    """Shows which device computes and how fast each is, remembers the choice, and offers a runtime where none is.

    Parameters
    ----------
    above : QVBoxLayout for messages, and for what remedies a computer without a device.
    advanced : QFormLayout for the choice of the device and of faster runtimes.
    presenter : gets the trials and the chosen device.
    """

    def __init__(self, above: Any, advanced: Any, presenter: PanelPresenter) -> None:
        self._above, self._presenter = above, presenter
        self._settings = slicer.app.userSettings()
        self._shown: list[str] = []  # keys of the devices in the list
        self.trials: DeviceTrials | None = None
        self.label, self.devices = qt.QLabel(""), qt.QComboBox()
        self.label.setProperty("wordWrap", True)
        self.devices.setToolTip(_("The OpenCL device that computes images, with its time for one image"))
        self.devices.currentTextChanged.connect(self._choose)
        #: {name of a runtime: its button}
        self.buttons = {runtime.name: self._button(runtime) for runtime in runtimes_to_install()}
        self.devices.setSizePolicy(qt.QSizePolicy.Ignored, qt.QSizePolicy.Fixed)  # names of processors are long
        above.addWidget(self.label)
        advanced.addRow(_("Device:"), self.devices)
        for widget in (self.label, self.devices, *self.buttons.values()):
            widget.setVisible(False)
        for button in self.buttons.values():
            advanced.addRow(button)

    def begin(self) -> None:
        """Try the devices, if the packages for that are installed; once."""
        if self.trials is None:
            known = json.loads(self._settings.value(_TIMES) or "{}")
            self.trials = DeviceTrials(known, str(self._settings.value(_DEVICE) or ""))
            self._presenter.trials = self.trials
            self._poll()

    def stop(self) -> None:
        """End the trials."""
        if self.trials is not None:
            self.trials.stop()
            self.trials = None

    def _poll(self) -> None:
        if self.trials is None:
            return
        self._refresh(self.trials)
        if not self.trials.isDone:
            qt.QTimer.singleShot(_POLL_MS, self._poll)

    def _refresh(self, trials: DeviceTrials) -> None:
        tried = [device for device in trials.devices or () if device.ms is not None]
        if trials.used is not None and self._presenter.logic.device is None:
            self._presenter.logic.device = trials.used.key
        keys = [device.key for device in tried]
        if keys != self._shown:
            self._shown = keys
            was = self.devices.blockSignals(True)
            self.devices.clear()
            for device in tried:
                self.devices.addItem(
                    _("{ms:.0f} ms per image: {name} ({platform})").format(
                        name=device.name, platform=device.platform, ms=device.ms
                    )
                )
            chosen = self._presenter.logic.device
            self.devices.setCurrentIndex(keys.index(chosen) if chosen in keys else 0)
            self.devices.blockSignals(was)
            self._settings.setValue(_TIMES, json.dumps({device.key: device.ms for device in tried}))
        self.devices.setVisible(bool(tried))
        text = _text(trials)
        self.label.setText(text)
        self.label.setVisible(bool(text))
        has_gpu = any(device.kind == "GPU" for device in tried)
        for button in self.buttons.values():
            if trials.isDone and not tried:
                self._above.addWidget(button)
            button.setVisible(trials.isDone and not has_gpu)

    def _choose(self, *_unused) -> None:
        key = self._shown[self.devices.property("currentIndex")]
        self._settings.setValue(_DEVICE, key)
        self._presenter.logic.device = key

    def _button(self, runtime: Runtime) -> Any:
        text = _("Install {name} for processors ({megabytes} MB)")
        button = qt.QPushButton(text.format(name=runtime.name, megabytes=runtime.megabytes))
        button.setToolTip(_("An OpenCL runtime: it computes images on the processor, without a graphics card"))
        button.clicked.connect(lambda *_unused: self._install(runtime))
        return button

    def _install(self, runtime: Runtime) -> None:
        try:
            install_runtime(runtime)
        except SimulationError as error:
            slicer.util.errorDisplay(str(error))
            return
        self.buttons.pop(runtime.name).setVisible(False)
        self._settings.remove(_DEVICE)
        self._presenter.logic.device = None
        self.stop()
        self.begin()


def _text(trials: DeviceTrials) -> str:
    """What a user should know of the devices, in lines."""
    if trials.devices is None:
        return _("Looking for OpenCL devices ...")
    lines = [trials.error[:1].upper() + trials.error[1:]] if trials.error else []
    for device in trials.devices:
        if device.error:
            lines.append(_("{name} cannot be used: {reason}").format(name=device.name, reason=device.error))
    waiting: list[TriedDevice] = [device for device in trials.devices if device.ms is None and not device.error]
    if waiting and not trials.isDone:
        lines.append(_("Kernels are built for {name}, once ...").format(name=waiting[0].name))
    return "\n".join(lines)
