"""What a run leaves behind: samples, scans, reports."""

from tofssm_drake.recording.recorder import MessageLog, SampleRecorder
from tofssm_drake.recording.samples import Samples, read_samples, write_samples

__all__ = [
    "MessageLog",
    "SampleRecorder",
    "Samples",
    "read_samples",
    "write_samples",
]
