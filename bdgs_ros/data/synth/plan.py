"""What is recorded: scenario, seed, length, size and rate, and what follows from them."""

from __future__ import annotations

from dataclasses import dataclass

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.synth.scenarios import World, find_scenario, make_world

FIRST_STAMP_NS = 1000 * 10**9
_FR3 = (640, 480, 535.4, 539.2, 320.1, 247.6)


@dataclass(frozen=True)
class RecordingPlan:
    """What is recorded; equal plans give equal files."""

    scenario: str
    seed: int
    frames: int
    width: int
    height: int
    rate_hz: float

    def validate(self) -> None:
        """Raise `DatasetError` for a plan that cannot be recorded."""
        find_scenario(self.scenario)
        if self.frames < 1 or self.seed < 0 or not 0 < self.rate_hz <= 1000:
            raise DatasetError(
                f'frames {self.frames}, seed {self.seed}, rate {self.rate_hz:g} Hz: expected '
                'at least 1 frame, a seed of 0 or more and a rate in (0, 1000] Hz'
            )
        if min(self.width, self.height) < 32 or max(self.width, self.height) > 4096:
            raise DatasetError(
                f'size {self.width}x{self.height}: expected 32 to 4096 pixels each way'
            )

    @property
    def scale(self) -> float:
        """Metres per metre of the room."""
        return find_scenario(self.scenario).scale

    @property
    def camera(self) -> PinholeCamera:
        """The camera of TUM freiburg3 at the size of the plan, without distortion."""
        width, height, fx, fy, cx, cy = _FR3
        sx, sy = self.width / width, self.height / height
        return PinholeCamera(
            self.width,
            self.height,
            fx * sx,
            fy * sy,
            (cx + 0.5) * sx - 0.5,
            (cy + 0.5) * sy - 0.5,
        )

    def time_s(self, frame: int) -> float:
        """Return the time of a frame since the first."""
        return (self.stamp_ns(frame) - FIRST_STAMP_NS) * 1e-9

    def stamp_ns(self, frame: int) -> int:
        """Return the stamp of a frame, a whole number of microseconds."""
        return FIRST_STAMP_NS + round(frame * 1e6 / self.rate_hz) * 1000

    def world(self) -> World:
        """Return the world that is recorded."""
        return make_world(self.scenario, self.seed, self.frames / self.rate_hz)
