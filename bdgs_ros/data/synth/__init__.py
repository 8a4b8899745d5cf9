"""
Synthetic RGB-D recordings with exact truth.

`write_recording` makes one; `SynthTruth` reads what is true about it. What each file means is
written in `bdgs_ros.data.synth.truth`.
"""

from bdgs_ros.data.synth.scenarios import field_scenarios, scenarios
from bdgs_ros.data.synth.truth import SynthTruth
from bdgs_ros.data.synth.writer import RecordingSummary, write_recording

__all__ = ['RecordingSummary', 'SynthTruth', 'field_scenarios', 'scenarios', 'write_recording']
