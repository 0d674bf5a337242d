"""One stream's way through the faults: content, configuration, gate, drop and loss, duplicate, delay, reorder, rate and
slot, segmentation.

Pure: what happens to a frame follows from the profile, the seed, the stream's name and the frame's index and time.
Random stages are looked up by index, so a seek or a gate does not shift them; FIFO order, reordering, rate, slots and
``first after config`` follow the frames as they come.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pmutools.c37118.config import StreamConfig
from pmutools.c37118.constants import FrameType
from pmutools.draws import Draws
from pmutools.errors import SettingsError
from pmutools.flow import Hangup
from pmutools.impair.config_change import ConfigChange, Reconfiguration
from pmutools.impair.content import Corrupt, Corruption
from pmutools.impair.filler import filled
from pmutools.impair.gate import HOLD_LIMIT, Gate, Switch
from pmutools.impair.grammar import named_parts
from pmutools.impair.moment import CONTROL_LANE, Moment, Original
from pmutools.impair.outgoing import Fate, Outgoing
from pmutools.impair.profile import STREAM_VERBS, Action, Profile, StreamRule, Treatment
from pmutools.impair.stages import OPTIONS, Setting, Stages
from pmutools.impair.transmission import NO_DELAY, Transmission
from pmutools.timebase import NS

_TYPES = (*FrameType, FrameType.COMMAND, FrameType.COMMAND)
_SENT = Fate.SENT  # looking a member up takes longer than comparing it
_new = tuple.__new__  # what calling a NamedTuple comes to, for half the time
"""By bits 6-4 of SYNC; the two undefined values pass as commands."""


class _Held(NamedTuple):
    """A frame in the gate's buffer."""

    row: Outgoing
    at: Moment


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
        Needed by whatever reads more of a frame than its type: content faults of single fields and of the stamp, a
        change of configuration, selection by stamp or value.
    aliases
        Other names that patterns may mean: the IDCODE, ``north``, ``south``.
    stations
        Station names of a concentrator's stream. With more than one, a name that is none of the stream's own disables
        and enables that station alone, for which fillers are sent; under every other option it means the stream.

    Raises
    ------
    SettingsError
        What this stream's configuration cannot have: a field, a station, a value that it does not know.
    """

    def __init__(
        self,
        profile: Profile,
        stream: str,
        seed: int | None = None,
        *,
        config: StreamConfig | None = None,
        aliases: Iterable[str] = (),
        stations: Iterable[str] = (),
    ) -> None:
        self.stream = stream
        several = tuple(stations)
        self.stations = several if len(several) > 1 else ()
        self.names = (stream, *(name for name in (*aliases, *several) if name not in self.stations))
        self.seed = next(value for value in (seed, profile.seed, 0) if value is not None)
        self._config = config
        self._actions = deque(action for action in profile.timeline if self._concerns(action))
        self.refused: list[str] = []
        """What the timeline asked for and could not be, in words."""
        self._others = 0
        self._time_ns = self._offset_ns = 0
        self._held = deque[_Held]()
        self._flushed: tuple[Outgoing, ...] = ()
        self._switch: Switch | None = None
        self._closed: Switch | None = None
        self._absent = frozenset[str]()
        self._station_gates: dict[str, Gate] = {}
        self._fresh = True
        self._active: tuple[bool, ...] = ()
        self._notice = True
        self._transmission = Transmission(self._draws)
        treatment = profile.treatment(self.names, self.stations)
        self._check(treatment, self._actions, config)
        self._build(treatment, OPTIONS)

    @property
    def stages(self) -> Stages:
        """What is in force now."""
        return self._treatment.stages

    @property
    def enabled(self) -> bool:
        """The operator's switch; a scheduled ``disable`` does not move it."""
        return self._switch is None

    @property
    def hangup(self) -> Hangup | None:
        """What TCP clients see of the stream's silence, by order or at the last frame given; None while it flows.

        Frames kept for a burst have no rows meanwhile, so this alone tells of them.
        """
        silence = self._switch or self._closed
        return None if silence is None else silence.tcp

    @property
    def holding(self) -> bool:
        """Whether frames are held back that will come with later ones, or at the end."""
        return bool(self._held or self._flushed or self._transmission.holding)

    @property
    def clear(self) -> bool:
        """Whether nothing at all happens to frames, so that they may pass as they are, until the next action."""
        return self._short_cut is NO_DELAY

    def delays_ns(self, index: npt.NDArray[np.int64]) -> npt.NDArray[np.int64] | None:
        """The delays (N,) of data frames by index (N,), where nothing but such delays happens to them.

        Then :meth:`apply` would give each frame once, sent, that much later; it need not be called. None: it must be.
        """
        if self._short_cut is None:
            return None
        self._fresh = self._fresh and not index.size
        return np.maximum(self._short_cut.many(index), 0)

    @property
    def by_index(self) -> bool:
        """Whether nothing but delays that their index decides happens to frames: :meth:`delays_ns` tells them."""
        return self._delay_of is not None

    def passed(self) -> None:
        """Frames have passed that :meth:`apply` was not asked about."""
        self._fresh = False

    def act(self, action: Action) -> bool:
        """Do ``enable``, ``disable`` or ``fault`` from the next frame on; False where it does not concern this stream.

        An option that is set anew starts with empty queues; its draws stay those of the frame's index. Raises
        SettingsError, and changes nothing, for what this stream cannot have.
        """
        if not self.check(action) or action.rule is None:
            return False
        if action.verb == "fault":
            self._build(self._under(action.rule), [option for option, _ in action.rule.settings])
        else:
            self._throw(action, action.rule)
            self._refresh()
        return True

    def check(self, action: Action) -> bool:
        """Whether ``action`` concerns this stream; raises SettingsError where it cannot be done."""
        if not self._concerns(action) or action.rule is None:
            return False
        self._check(Treatment(), (action,), self._config)
        self._under(action.rule)
        return True

    def configure(self, config: StreamConfig) -> None:
        """From now on the stream's frames have this layout; raises SettingsError as the constructor does."""
        self._check(self._treatment, self._actions, config)
        self._config = config
        self._fresh = self._notice = True
        self._build(self._treatment, ("corrupt", "config"))

    def adapt(self, config: StreamConfig) -> list[str]:
        """As :meth:`configure`, but gives up faults that frames of this layout cannot have, and says which."""
        given_up, treatment = [], self._treatment
        for option in OPTIONS:
            try:
                self._check(Treatment(Stages(**{option: getattr(treatment.stages, option)})), (), config)
            except SettingsError as error:
                given_up.append(f"{error}; {option} ends here")
                treatment = treatment._replace(stages=treatment.stages.changed(option, Setting(())))
        for action in tuple(self._actions):
            try:
                self._check(Treatment(), (action,), config)
            except SettingsError as error:
                given_up.append(f"{error}; what was to begin at {action.at_ns / NS:g} s does not")
                self._actions.remove(action)
        if given_up:
            self._build(treatment, OPTIONS)
        self.configure(config)
        return given_up

    def apply(
        self,
        index: int,
        data: bytes,
        offset_ns: int,
        stream_ns: int | None = None,
        *,
        stamp_ns: int | None = None,
        tag: object = None,
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
        stamp_ns
            The stamp as recorded, POSIX UTC, for selectors; where not given, the one that ``data`` carries.
        tag
            Comes back with each copy, whenever that is.

        Returns
        -------
        tuple of Outgoing
            May hold frames given before (held back until now), and may be empty (held back). Equal offsets leave in
            the order given.
        """
        frame_type = _TYPES[data[1] >> 4 & 7]
        if self._delay_of is not None:
            delay_ns = 0
            if frame_type is FrameType.DATA:
                delay_ns = max(0, self._delay_of(index))
                self._fresh = False
            else:
                self._others += 1
                self._fresh = self._fresh or frame_type.is_config
            return (_new(Outgoing, (index, 0, data, offset_ns + delay_ns, _SENT, delay_ns, (), None, True, None, tag)),)
        time_ns = offset_ns if stream_ns is None else stream_ns
        self._time_ns, self._offset_ns = time_ns, offset_ns
        while self._actions and self._actions[0].at_ns <= time_ns:
            try:
                self.act(self._actions.popleft())
            except SettingsError as error:  # with what was set live before, it cannot be
                self.refused.append(str(error))
        original = Original(data, self._config, stamp_ns)
        marks: tuple[str, ...] = ()
        config = None
        if frame_type is FrameType.DATA:
            at = Moment(index, time_ns, frame_type, 0, offset_ns, self._fresh, original)
            self._fresh = False
        else:
            at = Moment(self._others, time_ns, frame_type, CONTROL_LANE, offset_ns, False, original)
            self._others += 1
            self._fresh = self._fresh or frame_type.is_config
        if self._altered:
            data, at, marks = self._spoilt(data, at)
            config = self._reconfiguration.config(self._active)
        row = Outgoing(index, 0, data, offset_ns, Fate.SENT, 0, marks, config, self._notice, tag=tag)
        return self._gated(row, at)

    def rehearse(self, index: int) -> None:
        """Draw for a frame and those after it ahead of time: some ms, which the first frame would be late."""
        at = Moment(index, self._time_ns)
        for corruption in self._corrupt:
            corruption.happens(at)
        self._transmission.rehearse(at)

    def told(self, data: bytes) -> tuple[bytes, ...]:
        """What becomes of a frame that a client is told at once: a configuration or a header, asked for or not.

        Content faults, drop, loss and duplicates that select such frames (``when=type config``) apply, in the stream
        time of the last data frame; a gate does not shut the command channel, and nothing is delayed.
        """
        frame_type = _TYPES[data[1] >> 4 & 7]
        self._fresh = self._fresh or frame_type.is_config
        if self._delay_of is not None or frame_type is FrameType.DATA:
            return (data,)
        original = Original(data, self._config, None)
        at = Moment(self._others, self._time_ns, frame_type, CONTROL_LANE, self._offset_ns, False, original)
        self._others += 1
        spoilt, _ = self._corrupted(data, at)
        return (spoilt,) * self._transmission.copies(at)

    def close(self) -> tuple[Outgoing, ...]:
        """The end: what is still held back; frames kept for a burst that never came were disabled."""
        rows = [*self._flushed, *self._transmission.flush(), *map(_disabled, self._held)]
        self._flushed = ()
        self._held.clear()
        return tuple(rows)

    def _spoilt(self, data: bytes, at: Moment) -> tuple[bytes, Moment, tuple[str, ...]]:
        """A frame after fillers, content faults and the change of configuration."""
        if at.type is not FrameType.DATA:
            if at.type.is_config:
                data = self._reconfiguration.announcement(data, self._active)
            data, marks = self._corrupted(data, at)
            return data, at, marks
        active = self._reconfiguration.active(at)
        if active != self._active:
            at = at._replace(fresh=True)
            if any(active):
                self._notice = self._reconfiguration.notice(active)
            self._active = active
        absent = self._absent_stations(at)
        if absent and self._config is not None:
            data = filled(data, self._config, absent)
        data, spoilt = self._corrupted(data, at)
        data, changed = self._reconfiguration.data(data, at, active)
        return data, at, (*(f"filler({station})" for station in absent), *spoilt, *changed)

    def _corrupted(self, data: bytes, at: Moment) -> tuple[bytes, tuple[str, ...]]:
        marks: tuple[str, ...] = ()
        for corruption in self._corrupt:
            data, mark = corruption.apply(data, at)
            if mark:
                marks = (*marks, mark)
        return data, marks

    def _absent_stations(self, at: Moment) -> tuple[str, ...]:
        return tuple(
            station
            for station in self.stations
            if station in self._absent
            or ((gate := self._station_gates.get(station)) is not None and gate.closure(at) is not None)
        )

    def _gated(self, row: Outgoing, at: Moment) -> tuple[Outgoing, ...]:
        """From the gate on: disabled, held, or sent after what was held."""
        flushed, self._flushed = self._flushed, ()
        self._closed = self._gate.closure(at)
        silence = self._switch or self._closed
        if silence is not None:
            frame = _Held(row, at)
            if not silence.holds:
                return (*flushed, _disabled(frame))
            self._held.append(frame)
            return (*flushed, _disabled(self._held.popleft())) if len(self._held) > HOLD_LIMIT else flushed
        send = self._transmission.send
        if not (flushed or self._held):
            return send(row, at)
        rows = list(flushed)
        for kept, then in self._held:
            rows += send(kept._replace(offset_ns=row.offset_ns, marks=(*kept.marks, "burst")), then)
        self._held.clear()
        self._refresh()
        return (*rows, *send(row, at))

    def _throw(self, action: Action, rule: StreamRule) -> None:
        """The operator's switch, of the stream or of some of its stations."""
        whole, stations = rule.matches(self.names), rule.among(self.stations)
        if action.verb == "enable":
            self._switch = None if whole else self._switch
            self._absent -= frozenset(stations)
        elif whole:
            self._switch = action.switch
        else:
            self._absent |= frozenset(stations)

    def _concerns(self, action: Action) -> bool:
        return action.verb in STREAM_VERBS and action.rule is not None and action.rule.matches(self._all_names)

    @property
    def _all_names(self) -> tuple[str, ...]:
        return (*self.names, *self.stations)

    def _under(self, rule: StreamRule) -> Treatment:
        return self._treatment.under(rule, self.names, self.stations)

    def _build(self, treatment: Treatment, options: Collection[str]) -> None:
        """Put ``options`` of a treatment to work; what is at work for the other options goes on."""
        stages = treatment.stages
        for option in options:
            if option == "corrupt":
                self._corrupt = self._corruptions(stages.corrupt, self._config)
            elif option == "config":
                self._reconfiguration = self._changes(stages.config, self._config)
                self._fresh = self._fresh or any(self._active)
                self._active = self._reconfiguration.none
            elif option == "disable":
                self._gate, self._closed = Gate(stages.disable, self._draws), None
                self._station_gates = {
                    station: Gate(parts, partial(self._station_draws, station))
                    for station, parts in treatment.stations.items()
                    if parts
                }
            else:
                self._flushed += self._transmission.change(option, stages)
        self._treatment = treatment
        self._refresh()

    def _refresh(self) -> None:
        """Whether frames change on their way, and whether a frame's index alone says what happens to it."""
        stages = self._treatment.stages
        self._altered = bool(stages.corrupt or stages.config or self._station_gates or self._absent)
        gated = stages.disable or self._switch or self._actions or self._flushed or self._held
        plain = not (self._altered or gated) and self._notice
        self._short_cut = self._transmission.delay_by_index() if plain else None
        self._delay_of = None if self._short_cut is None else self._short_cut.one

    def _check(self, treatment: Treatment, actions: Iterable[Action], config: StreamConfig | None) -> None:
        """Raise SettingsError for what a stream of this configuration cannot have, now or later."""
        parts: list[tuple[str, Sequence[Any]]] = [(option, getattr(treatment.stages, option)) for option in OPTIONS]
        parts += [("disable", silences) for silences in treatment.stations.values()]
        for action in actions:
            if action.rule is not None:
                parts += [(option, setting.parts) for option, setting in action.rule.settings]
        for option, some in parts:
            with self._naming(option):
                for part in some:
                    part.when.check(config)
            if option == "corrupt":
                self._corruptions(some, config)
            elif option == "config":
                self._changes(some, config)
        if config is None and (treatment.stations or any(map(self._means_a_station, actions))):
            problem = "a station can only be silent alone in a stream whose configuration is known"
            raise SettingsError(f"stream {self.stream}: disable: {problem}")

    def _means_a_station(self, action: Action) -> bool:
        """Whether an action that concerns this stream silences some of its stations alone."""
        if action.rule is None or action.rule.matches(self.names):
            return False
        return action.verb == "disable" or any(option == "disable" for option, _ in action.rule.settings)

    def _corruptions(self, parts: Sequence[Corrupt], config: StreamConfig | None) -> list[Corruption]:
        with self._naming("corrupt"):
            return [
                Corruption(part, self._draws(name), part.when.test(self._draws(f"{name}.when")), config)
                for name, part in named_parts("corrupt", parts)
            ]

    def _changes(self, parts: Sequence[ConfigChange], config: StreamConfig | None) -> Reconfiguration:
        with self._naming("config"):
            return Reconfiguration(parts, self._draws, config)

    @contextmanager
    def _naming(self, option: str) -> Iterator[None]:
        """Turns a ValueError into a SettingsError that names the stream and the option."""
        try:
            yield
        except ValueError as error:
            raise SettingsError(f"stream {self.stream}: {option}: {error}") from None

    def _draws(self, stage: str) -> Draws:
        return Draws(self.seed, self.stream, stage)

    def _station_draws(self, station: str, stage: str) -> Draws:
        return self._draws(f"{station}.{stage}")


def _disabled(frame: _Held) -> Outgoing:
    return frame.row._replace(fate=Fate.DISABLED)
