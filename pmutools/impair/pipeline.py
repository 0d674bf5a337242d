"""One stream's way through the faults: content, gate, drop and loss, duplicate, delay, reorder, rate and slot.

Pure: what happens to a frame follows from the profile, the seed, the stream's name and the frame's index and time.
Random stages are looked up by index, so a seek or a gate does not shift them; FIFO order, reordering, rate and slots
follow the frames as they come.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.draws import Draws
from pmutools.errors import SettingsError
from pmutools.impair.content import Corrupt, Corruption
from pmutools.impair.gate import HOLD_LIMIT, Gate, Verdict
from pmutools.impair.grammar import named_parts
from pmutools.impair.moment import CONTROL_LANE, Moment
from pmutools.impair.outgoing import Fate, Outgoing
from pmutools.impair.profile import STREAM_VERBS, Action, Profile
from pmutools.impair.stages import OPTIONS, Stages
from pmutools.impair.transmission import Transmission

_TYPES = (*FrameType, FrameType.COMMAND, FrameType.COMMAND)
"""By bits 6-4 of SYNC; the two undefined values pass as commands."""


class _Held(NamedTuple):
    """A frame in the gate's buffer."""

    number: int
    at: Moment
    data: bytes
    offset_ns: int
    marks: tuple[str, ...]


class Pipeline:
    """The faults of one stream. Give it frames in the order in which they are due.

    Parameters
    ----------
    profile
        Who suffers what; its timeline is followed here as far as it concerns this stream.
    stream
        The stream's name, key of its draws.
    seed
        Instead of the profile's; 0 where neither says.
    config
        Needed by content faults of single fields and of the stamp.
    aliases
        Other names that patterns may mean: the IDCODE, ``north``, ``south``.

    Raises
    ------
    SettingsError
        A content fault that this stream's configuration cannot have.
    """

    def __init__(
        self,
        profile: Profile,
        stream: str,
        seed: int | None = None,
        *,
        config: StreamConfig | None = None,
        aliases: Iterable[str] = (),
        stations=(),
    ) -> None:
        self.stream = stream
        self.names = (stream, *aliases)
        self.seed = next(value for value in (seed, profile.seed, 0) if value is not None)
        self._config = config
        self._actions = deque(action for action in profile.timeline if self._concerns(action))
        self._others = 0
        self._held = deque[_Held]()
        self._flushed: tuple[Outgoing, ...] = ()
        self._enabled = True
        self._transmission = Transmission(self._draws)
        self._stages = Stages()
        self._build(profile.stages(self.names), OPTIONS)
        for action in self._actions:
            for option, setting in action.rule.settings if action.rule else ():
                if option == "corrupt":
                    self._corruptions(setting.parts)

    @property
    def stages(self) -> Stages:
        """What is in force now."""
        return self._stages

    @property
    def enabled(self) -> bool:
        """The operator's switch; a scheduled ``disable`` does not move it."""
        return self._enabled

    @property
    def holding(self) -> bool:
        """Whether frames are held back that will come with later ones, or at the end."""
        return bool(self._held or self._flushed or self._transmission.holding)

    def act(self, action: Action) -> bool:
        """Do ``enable``, ``disable`` or ``fault`` from the next frame on; False where it does not concern this stream.

        An option that is set anew starts with empty queues; its draws stay those of the frame's index.
        """
        if not self._concerns(action) or action.rule is None:
            return False
        if action.verb == "fault":
            for option, setting in action.rule.settings:
                self._build(self._stages.changed(option, setting), (option,))
        else:
            self._enabled = action.verb == "enable"
            self._build(self._stages, ())
        return True

    def configure(self, config: StreamConfig) -> None:
        """From now on the stream's frames have this layout; raises SettingsError as the constructor does."""
        self._config = config
        self._build(self._stages, ("corrupt",))

    @property
    def clear(self):
        return self._enabled and self._short_cut is not None and self._short_cut.__name__ == "_no_delay"

    def delays_ns(self, indices):
        import numpy as np

        if not self._enabled or self._short_cut is None:
            return None
        return np.array([max(0, self._short_cut(i)) for i in indices.tolist()], np.int64)

    def apply(
        self, index: int, data: bytes, offset_ns: int, stream_ns: int | None = None, stamp_ns=None
    ) -> tuple[Outgoing, ...]:
        """What becomes of a frame; a row for each copy, also of those that will not be sent.

        Parameters
        ----------
        index
            Zero-based, among the stream's data frames, over the source and its loops. Frames of other types are
            counted here; for them it is only handed on.
        data
            The frame, stamped as it is to be sent.
        offset_ns
            When it is due, from the start of play.
        stream_ns
            Stream time: what it would be at speed 1; ``offset_ns`` where not given.

        Returns
        -------
        tuple of Outgoing
            May hold frames given before (held back until now), and may be empty (held back). Equal offsets leave in
            the order given.
        """
        frame_type = _TYPES[data[1] >> 4 & 7]
        if self._short_cut is not None and self._enabled:
            delay_ns = 0
            if frame_type is FrameType.DATA:
                delay_ns = max(0, self._short_cut(index))
            else:
                self._others += 1
            return (Outgoing(index, 0, data, offset_ns + delay_ns, Fate.SENT, delay_ns),)
        time_ns = offset_ns if stream_ns is None else stream_ns
        while self._actions and self._actions[0].at_ns <= time_ns:
            self.act(self._actions.popleft())
        if frame_type is FrameType.DATA:
            at = Moment(index, time_ns, frame_type)
        else:
            at = Moment(self._others, time_ns, frame_type, CONTROL_LANE)
            self._others += 1
        marks: tuple[str, ...] = ()
        for corruption in self._corrupt:
            data, mark = corruption.apply(data, at)
            if mark:
                marks = (*marks, mark)
        flushed, self._flushed = self._flushed, ()
        verdict = self._gate.verdict(at) if self._enabled else Verdict.CLOSED
        if verdict is not Verdict.OPEN:
            return (*flushed, *self._shut(verdict, _Held(index, at, data, offset_ns, marks)))
        send = self._transmission.send
        if not (flushed or self._held):
            return send(index, at, data, offset_ns, marks)
        rows = list(flushed)
        for number, then, kept, _, past in self._held:
            rows += send(number, then, kept, offset_ns, (*past, "burst"))
        self._held.clear()
        return (*rows, *send(index, at, data, offset_ns, marks))

    def apply_batch(
        self, first: int, frames: Sequence[bytes], offsets_ns: Sequence[int], stream_ns: Sequence[int] | None = None
    ) -> list[Outgoing]:
        """:meth:`apply` to consecutive data frames."""
        times = offsets_ns if stream_ns is None else stream_ns
        rows = list[Outgoing]()
        for index, (data, offset, time) in enumerate(zip(frames, offsets_ns, times, strict=True), first):
            rows += self.apply(index, data, offset, time)
        return rows

    def close(self) -> tuple[Outgoing, ...]:
        """The end: what is still held back; frames kept for a burst that never came were disabled."""
        rows = [*self._flushed, *self._transmission.flush(), *map(_disabled, self._held)]
        self._flushed = ()
        self._held.clear()
        return tuple(rows)

    def _shut(self, verdict: Verdict, frame: _Held) -> tuple[Outgoing, ...]:
        if verdict is Verdict.CLOSED:
            return (_disabled(frame),)
        self._held.append(frame)
        return (_disabled(self._held.popleft()),) if len(self._held) > HOLD_LIMIT else ()

    def _concerns(self, action: Action) -> bool:
        return action.verb in STREAM_VERBS and action.rule is not None and action.rule.matches(self.names)

    def _build(self, stages: Stages, options: Iterable[str]) -> None:
        """Put ``options`` of ``stages`` to work; what is at work for the other options goes on."""
        for option in options:
            if option == "corrupt":
                self._corrupt = self._corruptions(stages.corrupt)
            elif option == "disable":
                self._gate = Gate(stages.disable, self._draws)
            else:
                self._flushed += self._transmission.change(option, stages)
        self._stages = stages
        busy = stages.corrupt or stages.disable or self._actions or self._flushed or self._held
        self._short_cut = None if busy else self._transmission.delay_by_index()

    def _corruptions(self, parts: Sequence[Corrupt]) -> list[Corruption]:
        try:
            return [
                Corruption(part, self._draws(name), part.when.test(self._draws(f"{name}.when")), self._config)
                for name, part in named_parts("corrupt", parts)
            ]
        except ValueError as error:
            raise SettingsError(f"stream {self.stream}: corrupt: {error}") from None

    def _draws(self, stage: str) -> Draws:
        return Draws(self.seed, self.stream, stage)


def _disabled(frame: _Held) -> Outgoing:
    return Outgoing(frame.number, 0, frame.data, frame.offset_ns, Fate.DISABLED, 0, frame.marks)
