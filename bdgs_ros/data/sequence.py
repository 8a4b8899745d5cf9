"""
What a recording is, and what the method wants of it.

A `Recording` gives images as the camera gave them: distorted, colour and depth apart, each with
its own stamp. A `Sequence` gives rectified pairs in order of time. `RecordedSequence` makes the
second from the first, the same way for every format.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera, Rectifier
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import ColorImage, DepthImage, RgbdFrame, Trajectory
from bdgs_ros.data.associate import MAX_DIFFERENCE_S, associate
from bdgs_ros.data.trajectory_io import format_stamp_ns, seconds_to_ns

_LOGGER = logging.getLogger(__name__)
_NAMES_SHOWN = 5
_FIRST_FEW = 5


class Recording(Protocol):
    """Colour and depth images as recorded, each kind in order of its stamps."""

    @property
    def name(self) -> str:
        """What the recording is called."""

    @property
    def camera(self) -> PinholeCamera:
        """The colour camera with its distortion; depth is registered to it."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """The poses of the camera, where they are known."""

    @property
    def color_stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the colour images, shape (N,)."""

    @property
    def depth_stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the depth images, shape (M,)."""

    def color_name(self, index: int) -> str:
        """Say which colour image this is, for messages."""

    def read_color(self, index: int) -> ColorImage:
        """Read one colour image, distorted."""

    def read_depth(self, index: int) -> DepthImage:
        """Read one depth image in metres, distorted; 0 = invalid."""


class Sequence(Protocol):
    """Rectified RGB-D frames in order of time."""

    @property
    def name(self) -> str:
        """What the recording is called."""

    @property
    def camera(self) -> PinholeCamera:
        """The camera with its distortion, as recorded; frames carry the rectified one."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """The poses of the camera, where they are known."""

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the frames (of their colour images), shape (N,)."""

    @property
    def unpaired_color(self) -> tuple[str, ...]:
        """Names of the colour images that no depth image is close enough to."""

    def __len__(self) -> int:
        """Return the number of frames."""

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Read all frames in order."""


class RearrangedSequence:
    """
    The frames of another sequence in another order, with stamps of their own.

    Parameters
    ----------
    sequence : Sequence
        Where the frames come from.
    indices : ndarray, shape (N,), int
        Which of its frames are shown, in this order.
    steps_ns : ndarray, shape (N - 1,), int
        Time from each frame to the next; the first has the stamp it was recorded with.

    """

    def __init__(
        self, sequence: Sequence, indices: NDArray[np.int64], steps_ns: NDArray[np.int64]
    ) -> None:
        self._sequence = sequence
        self._indices = indices
        first_ns = int(sequence.stamps_ns[indices[0]])
        self.stamps_ns: NDArray[np.int64] = first_ns + np.concatenate([[0], np.cumsum(steps_ns)])
        self.unpaired_color: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What the recording is called."""
        return self._sequence.name

    @property
    def camera(self) -> PinholeCamera:
        """The camera with its distortion, as recorded."""
        return self._sequence.camera

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._indices)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame; negative indices count from the end."""
        frame = self._sequence[int(self._indices[index])]
        return replace(frame, stamp_ns=int(self.stamps_ns[index]))

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Read all frames in order."""
        return (self[index] for index in range(len(self)))


class RecordedSequence:
    """
    The frames of a recording: colour paired with the nearest depth, both rectified.

    Parameters
    ----------
    recording : Recording
        Where the images come from.
    max_difference_s : float
        Colour and depth further apart than this are not one frame.
    depth_offset_s : float
        By so much the stamps of depth are late.

    Raises
    ------
    DatasetError
        If not a single pair can be made, or all images have one and the same stamp.

    """

    def __init__(
        self,
        recording: Recording,
        max_difference_s: float = MAX_DIFFERENCE_S,
        depth_offset_s: float = 0.0,
    ) -> None:
        self.recording = recording
        self._offset_ns = seconds_to_ns(depth_offset_s)
        self._check_stamps()
        pairs = associate(
            recording.color_stamps_ns,
            recording.depth_stamps_ns - self._offset_ns,
            seconds_to_ns(max_difference_s),
        )
        self._pairs = self._without_repeated(pairs)
        self.repeated = len(pairs) - len(self._pairs)
        """How many frames were left out because they have the stamp of the one before."""
        self._rectifier = Rectifier(recording.camera)
        self.stamps_ns: NDArray[np.int64] = np.array(
            [recording.color_stamps_ns[i] for i, _ in self._pairs], dtype=np.int64
        )
        self.unpaired_color = self._find_unpaired()
        self._report(max_difference_s)

    @property
    def name(self) -> str:
        """What the recording is called."""
        return self.recording.name

    @property
    def camera(self) -> PinholeCamera:
        """The camera with its distortion, as recorded."""
        return self.recording.camera

    @property
    def ground_truth(self) -> Trajectory | None:
        """The poses of the camera, where they are known."""
        return self.recording.ground_truth

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Indices of the colour and depth image of every frame."""
        return list(self._pairs)

    def _check_stamps(self) -> None:
        stamps_ns = self.recording.color_stamps_ns
        if len(stamps_ns) > 1 and len(set(stamps_ns.tolist())) == 1:
            raise DatasetError(
                f"'{self.name}': all {len(stamps_ns)} colour images have the stamp "
                f'{format_stamp_ns(int(stamps_ns[0]))} s; stamps must advance: have the driver '
                'fill header.stamp, or write the list anew'
            )

    def _without_repeated(self, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
        stamps_ns = [int(self.recording.color_stamps_ns[color]) for color, _ in pairs]
        return [
            pair
            for pair, own, before in zip(pairs, stamps_ns, [None, *stamps_ns], strict=False)
            if own != before
        ]

    def _find_unpaired(self) -> tuple[str, ...]:
        paired = {i for i, _ in self._pairs}
        known = set(self.stamps_ns.tolist())
        stamps_ns = self.recording.color_stamps_ns.tolist()
        return tuple(
            self.recording.color_name(i)
            for i, stamp_ns in enumerate(stamps_ns)
            if i not in paired and stamp_ns not in known
        )

    def _report(self, max_difference_s: float) -> None:
        colors, depths = len(self.recording.color_stamps_ns), len(self.recording.depth_stamps_ns)
        limit_ms = max_difference_s * 1000
        if not self._pairs:
            raise DatasetError(
                f"'{self.name}' has {colors} colour and {depths} depth images but no two within "
                f'{limit_ms:g} ms of each other; check the recording, or raise --max-difference'
            )
        if self.repeated:
            _LOGGER.warning(
                "'%s': %d of %d frames have the stamp of the one before and are left out",
                self.name, self.repeated, self.repeated + len(self._pairs),
            )  # fmt: skip
        if self.unpaired_color:
            shown = ', '.join(self.unpaired_color[:_NAMES_SHOWN])
            more = ', ...' if len(self.unpaired_color) > _NAMES_SHOWN else ''
            _LOGGER.warning(
                "'%s': %d of %d colour images have no depth within %g ms: %s%s",
                self.name, len(self.unpaired_color), colors, limit_ms, shown, more,
            )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self._pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame; negative indices count from the end."""
        color, depth = self._pairs[index]
        return RgbdFrame(
            int(self.stamps_ns[index]),
            self._rectifier.color(self.recording.read_color(color)),
            self._rectifier.depth(self.recording.read_depth(depth)),
            self._rectifier.camera,
            self._delay_ns(color, depth),
        )

    def _delay_ns(self, color: int, depth: int) -> int:
        """Return by how much depth is later than colour, as far as the offset is right."""
        stamps_ns = self.recording.color_stamps_ns[color], self.recording.depth_stamps_ns[depth]
        return int(stamps_ns[1] - stamps_ns[0]) - self._offset_ns

    def __iter__(self) -> Iterator[RgbdFrame]:
        """Read all frames in order."""
        return (self[index] for index in range(len(self)))


class ReadableFrames:
    """
    Frames of a sequence, in order; those that are damaged are left out and counted.

    Parameters
    ----------
    sequence : Sequence
        Where they come from.
    chosen : iterable of int
        Which.

    """

    def __init__(self, sequence: Sequence, chosen: Iterable[int]) -> None:
        self._sequence = sequence
        self._chosen = chosen
        self._has_read = False
        self.skipped: list[str] = []
        """What was wrong with each."""

    def __iter__(self) -> Iterator[RgbdFrame]:
        """
        Read them.

        Raises
        ------
        DatasetError
            If none of the first few can be read: it is not an image that is wrong then.

        """
        error: DatasetError | None = None
        for index in self._chosen:
            frame, error = self._read(index)
            if frame is not None:
                yield frame
            elif error is not None and not self._has_read and len(self.skipped) >= _FIRST_FEW:
                raise error
        if error is not None and not self._has_read:
            raise error

    def _read(self, index: int) -> tuple[RgbdFrame | None, DatasetError | None]:
        try:
            frame = self._sequence[index]
        except DatasetError as error:
            self.skipped.append(str(error))
            if len(self.skipped) <= _NAMES_SHOWN:
                _LOGGER.warning('frame %d is left out: %s', index, error)
            return None, error
        self._has_read = True
        return frame, None
