"""B-mode ultrasound simulated from a patient's MRI. The public interface is `SlicerUSSim.Logic`."""

__version__ = "0.1.0"
