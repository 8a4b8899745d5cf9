"""What tracking says about every image it took: `bdgs/status`."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from bdgs_ros.bridge import conversions


class FrameState(Enum):
    """What became of an image."""

    OK = 'ok'
    LOST = 'lost'
    SKIPPED = 'skipped'
    """It could not be used; the reason is in the log and the diagnostics."""
    PAUSED = 'paused'
    PASSED_OVER = 'passed over'
    """Tracking was behind, and a newer image was there."""


_LEVELS = {
    FrameState.OK: DiagnosticStatus.OK,
    FrameState.LOST: DiagnosticStatus.ERROR,
    FrameState.SKIPPED: DiagnosticStatus.WARN,
    FrameState.PAUSED: DiagnosticStatus.OK,
    FrameState.PASSED_OVER: DiagnosticStatus.WARN,
}


@dataclass(frozen=True)
class FrameStatus:
    """One image after tracking has done with it, which includes the model view in lockstep."""

    stamp_ns: int
    state: FrameState
    is_keyframe: bool = False
    inlier_ratio: float = 0.0
    overlap: float = 0.0
    tracking_ms: float = 0.0
    latency_ms: float = 0.0
    """From the arrival of the image to the pose."""


def status_to_message(status: FrameStatus, frame_id: str) -> DiagnosticArray:
    """Encode a status; its header has the stamp of the image."""
    values = {
        'keyframe': str(status.is_keyframe).lower(),
        'inlier_ratio': f'{status.inlier_ratio:.6f}',
        'overlap': f'{status.overlap:.6f}',
        'tracking_ms': f'{status.tracking_ms:.3f}',
        'latency_ms': f'{status.latency_ms:.3f}',
    }
    entry = DiagnosticStatus(
        level=_LEVELS[status.state],
        name='bdgs_ros: frame',
        message=status.state.value,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
    return DiagnosticArray(header=conversions.header(status.stamp_ns, frame_id), status=[entry])


def status_from_message(message: DiagnosticArray) -> FrameStatus:
    """Decode a status."""
    entry = message.status[0]
    values = {item.key: item.value for item in entry.values}
    return FrameStatus(
        conversions.stamp_ns(message),
        FrameState(entry.message),
        values['keyframe'] == 'true',
        float(values['inlier_ratio']),
        float(values['overlap']),
        float(values['tracking_ms']),
        float(values['latency_ms']),
    )
