"""Frames in the order of their stamps although they arrive in another: a short buffer, checkpoints, one rollback.

The frames of the last `replay_s` are kept in the order (stamp, source, sequence), and now and then the picture before
a frame. A frame that belongs before others already consumed goes back to the last picture without any of those, and
all frames from there on are consumed again with it. What comes out is what the frames would have given in order.

Memory is bounded at any rate: pictures are `replay_s` / 16 apart, so there are about 17, and at most `REPLAY_FRAMES`
frames are kept. Work is bounded too: a rollback consumes at most `ROLLBACK_FRAMES` frames with
`ROLLBACK_DETECTIONS` detections. Where a late frame would need more, or is older than the buffer, nothing is rolled
back: it is consumed as it comes, every track judges by its own stamp whether it is news, and the buffer begins anew.
So no source, however fast, can make the frames of another useless.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from companion.tracking.picture import Picture
from companion.types import NS_PER_S, DetectionFrame

REPLAY_FRAMES = 256
ROLLBACK_FRAMES = 32
ROLLBACK_DETECTIONS = 512
CHECKPOINTS = 16  # in replay_s

OrderKey: TypeAlias = tuple[int, str, int]
Consume: TypeAlias = Callable[[Picture, DetectionFrame], Picture]


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """The picture after ``number`` frames, the last of them ``after`` (None: there was none)."""

    number: int
    after: OrderKey | None
    before_ns: int  # stamp of the frame before which it was taken
    picture: Picture

    def serves(self, key: OrderKey) -> bool:
        """Whether a frame of ``key`` can be consumed from here on."""
        return self.after is None or self.after < key


class Replay:
    """The buffer."""

    def __init__(self, replay_s: float) -> None:
        self._span_ns = round(replay_s * NS_PER_S)
        self.reset()

    def reset(self) -> None:
        self._newest: OrderKey | None = None  # of the frames consumed
        self._frames: list[DetectionFrame] = []  # consumed since the first checkpoint
        self._forgotten = 0  # frames consumed before those
        self._checkpoints: list[Checkpoint] = []

    def run(self, frames: Sequence[DetectionFrame], picture: Picture, consume: Consume) -> Picture:
        """The picture after ``frames``, late ones at their own place."""
        ordered = sorted(frames, key=_order_key)
        if self._span_ns == 0:
            for frame in ordered:
                picture = consume(picture, frame)
            return picture
        newest = self._newest
        if newest is not None and ordered and ordered[0].order_key < newest:
            place = bisect_left(ordered, newest, key=_order_key)
            number = self._checkpoint_for(ordered[:place], newest[0])
            if number < 0:
                self._forget(self._forgotten + len(self._frames))
                self._newest = None
            else:
                picture, again = self._rolled_back(number, ordered[:place])
                ordered = [*again, *ordered[place:]]
        for frame in ordered:
            self._keep(frame, picture)
            picture = consume(picture, frame)
        return picture

    def _checkpoint_for(self, late: list[DetectionFrame], newest_ns: int) -> int:
        """Index of the last checkpoint that serves all of ``late``, -1 where there is none or it is too far back."""
        if late[0].stamp_ns < newest_ns - self._span_ns:
            return -1
        number = sum(checkpoint.serves(late[0].order_key) for checkpoint in self._checkpoints) - 1
        if number < 0:
            return -1
        again = [*self._frames[self._checkpoints[number].number - self._forgotten :], *late]
        work = sum(len(frame.detections) for frame in again)
        return number if len(again) <= ROLLBACK_FRAMES and work <= ROLLBACK_DETECTIONS else -1

    def _rolled_back(self, number: int, late: list[DetectionFrame]) -> tuple[Picture, list[DetectionFrame]]:
        """The picture of that checkpoint, and the frames to consume from there with ``late`` among them."""
        checkpoint = self._checkpoints[number]
        kept = checkpoint.number - self._forgotten
        again = sorted([*self._frames[kept:], *late], key=_order_key)
        del self._frames[kept:], self._checkpoints[number + 1 :]
        self._newest = checkpoint.after
        return checkpoint.picture, again

    def _keep(self, frame: DetectionFrame, picture: Picture) -> None:
        """Note ``frame``, which ``picture`` does not know yet; forget what no late frame can ask for any more."""
        last = self._checkpoints[-1] if self._checkpoints else None
        if last is None or frame.stamp_ns - last.before_ns >= self._span_ns // CHECKPOINTS:
            number = self._forgotten + len(self._frames)
            self._checkpoints.append(Checkpoint(number, self._newest, frame.stamp_ns, picture))
        self._frames.append(frame)
        self._newest = frame.order_key if self._newest is None else max(self._newest, frame.order_key)
        oldest: OrderKey = (frame.stamp_ns - self._span_ns, "", 0)
        while len(self._checkpoints) > 1 and (self._checkpoints[1].serves(oldest) or len(self._frames) > REPLAY_FRAMES):
            self._forget(self._checkpoints[1].number)
        if len(self._frames) > REPLAY_FRAMES:  # all within one spacing
            self._forget(self._forgotten + len(self._frames))

    def _forget(self, number: int) -> None:
        """Forget the first ``number`` frames and the checkpoints among them."""
        del self._frames[: number - self._forgotten]
        self._forgotten = number
        self._checkpoints = [checkpoint for checkpoint in self._checkpoints if checkpoint.number >= number]


def _order_key(frame: DetectionFrame) -> OrderKey:
    return frame.order_key
