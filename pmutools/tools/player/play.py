"""The player: a plan sent on time by one loop, told what to do by its clients, its operator and its timeline."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from types import TracebackType
from typing import Any, overload

from pmutools import linux
from pmutools.c37118.session import Outcome, Served, served
from pmutools.clock import Clock, UtcOffset, utc_offset
from pmutools.errors import SettingsError
from pmutools.impair.pipeline import Pipeline
from pmutools.impair.profile import STREAM_VERBS, Action, Profile
from pmutools.net.endpoint import Endpoint
from pmutools.net.outlet import ServerEvent
from pmutools.net.server import Senders
from pmutools.parsers import no_such_stream
from pmutools.timebase import NS
from pmutools.tools.player.cast import Cast
from pmutools.tools.player.delivery import Delivery
from pmutools.tools.player.ledger import LedgerWriter
from pmutools.tools.player.plan import Plan
from pmutools.tools.player.results import Results
from pmutools.tools.player.stamps import StampPolicy
from pmutools.tools.player.status import PacingStatus, PlayerStatus, PlayState, StreamStatus

DRAIN_NS = 2 * NS
"""How long clients may take for the last frames of a TCP stream."""
POLL_NS = NS // 10
"""How often a waiting player looks whether it is to stop."""
LEAD_NS = 2_000_000
"""How long before its first frame is due a sheet is made."""
SHEET_NS = 10_000_000
SHEET_FRAMES = 256
"""A sheet is as long as about so many frames take, and at most SHEET_NS: making one holds up those that are due, and
what an operator changes begins with the next."""
UTC_CHECK_NS = NS


@dataclass(frozen=True)
class Options:
    """How to play; fields as on the command line of ``pmu play``."""

    to: Sequence[Endpoint] = ()
    listen: Sequence[Endpoint] = ()
    policy: StampPolicy = StampPolicy.SHIFT
    speed: Fraction = Fraction(1)
    loops: int = 1
    """0: for ever."""
    begin_utc_ns: int | None = None
    """Not before this UTC time."""
    cfg_period_ns: int = 60 * NS
    """0: announced at the start only."""
    profile: Profile = field(default_factory=Profile)
    seed: int | None = None
    duration_ns: int | None = None


class Player:
    """One run of a cast. Sockets are open once this is made; :attr:`results` are up to date at any time.

    ``stop`` is asked at least every 0.1 s whether to end early, ``tell`` is given the news of clients, ``warn`` what a
    person should know. ``native=False`` takes the portable path; ``senders`` is for tests. Raises SourceError where an
    endpoint cannot be opened, SettingsError for one that cannot be.
    """

    def __init__(
        self,
        cast: Cast,
        options: Options,
        clock: Clock,
        *,
        stop: Callable[[], bool] = lambda: False,
        tell: Callable[[ServerEvent], None] = lambda event: None,
        warn: Callable[[str], None] = lambda text: None,
        stamp_departures: bool = False,
        native: bool = linux.NATIVE,
        senders: Senders | None = None,
    ) -> None:
        self.cast, self.options, self.clock = cast, options, clock
        self._stop, self._tell, self._warn = stop, tell, warn
        configs = [cast.config(part, int(edition)) for part, edition in enumerate(cast.editions)]
        names = [part.name for part in cast.parts]
        self.results = Results(names, configs)
        self.pipelines = [
            Pipeline(
                options.profile,
                part.name,
                options.seed,
                config=config,
                aliases=part.aliases,
                stations=[station.name for station in config.stations],
            )
            for part, config in zip(cast.parts, configs, strict=True)
        ]
        self._state = PlayState.WAITING
        self._plan: Plan | None = None
        self._anchor_ns = 0
        self._recent = deque[tuple[int, int]](maxlen=2)
        self._actions = deque[Action]()
        self.senders = senders or Senders(
            clock,
            cfg_period_ns=options.cfg_period_ns or None,
            native=native,
            stamp_departures=stamp_departures,
            treat=lambda handle, frame: self.pipelines[handle].told(frame),
        )
        try:
            self.handles = [self.senders.add(_offer(cast, part, int(e))) for part, e in enumerate(cast.editions)]
            for endpoint in options.to:
                self.senders.send_to(endpoint, self._told_apart(f"--to {endpoint}", self._picked(endpoint)))
            for endpoint in options.listen:
                self.senders.listen(endpoint, self._told_apart(f"--listen {endpoint}", self._picked(endpoint)))
        except BaseException:
            self.senders.close()
            raise

    def _picked(self, endpoint: Endpoint) -> list[int]:
        """Handles of the streams that an endpoint's ``idcode`` picks; all without one."""
        parts = self.cast.parts
        chosen = [h for h, part in zip(self.handles, parts, strict=True) if endpoint.idcode in (None, part.idcode)]
        if not chosen:
            there = ", ".join(str(part.idcode) for part in parts[:20]) + (" ..." if len(parts) > 20 else "")
            raise SettingsError(f"{endpoint}: no stream of IDCODE {endpoint.idcode}; there are {there}")
        return chosen

    def _told_apart(self, where: str, handles: list[int]) -> list[int]:
        """``handles``, if their streams can be told apart there."""
        names: dict[int, str] = {}
        for handle in handles:
            part = self.cast.parts[handle]
            if (other := names.setdefault(part.idcode, part.name)) != part.name:
                both = f"{other} and {part.name} both have IDCODE {part.idcode}"
                raise SettingsError(
                    f"{where}: {both}; choose one with --select, or renumber it: --idcode '{part.name}=N'"
                )
        return handles

    # --- playing

    def play(self, ledger: LedgerWriter | None = None, progress: Callable[[], None] = lambda: None) -> None:
        """Play to the end, or for ``duration_ns``. With ``listen`` only, begins at the first start command.

        ``progress`` is called about once a second.
        """
        options, clock = self.options, self.clock
        end_ns = None if options.duration_ns is None else clock.monotonic_ns() + options.duration_ns
        if options.listen and not options.to and not self._wait_for_start(end_ns):
            return
        for part, pipeline in enumerate(self.pipelines):
            pipeline.rehearse(int(self.cast.first_numbers[part]))
        self.senders.announce()  # those of thousands take some 10 ms, so before the first deadline is set
        utc = utc_offset(clock)
        self._plan = plan = Plan(
            self.cast,
            options.policy,
            self.pipelines,
            max(clock.realtime_ns(), options.begin_utc_ns or 0),
            speed=options.speed,
            loops=options.loops,
            timeline=options.profile.player_timeline,
            marks=ledger is not None,
        )
        self._anchor_ns = utc.monotonic_ns(plan.start_utc_ns)
        names = [part.name for part in self.cast.parts]
        if ledger is not None:
            ledger.begin(names, plan.start_utc_ns)
        delivery = Delivery(
            self.senders,
            self.handles,
            self.cast,
            clock,
            self.results,
            lambda part, edition: _offer(self.cast, part, edition),
            ledger,
        )
        self._state = PlayState.PLAYING
        for action in self._actions:
            try:
                self._do(action)
            except SettingsError as error:
                self._warn(f"{action.verb} {action.argument}: {error}")
        self._actions.clear()
        going = self._run(plan, delivery, end_ns, self._watch(utc, progress))
        self._state = PlayState.ENDED
        if going and end_ns is None:
            self._drain()
        elif going and end_ns is not None:  # the end was asked for in time, not in frames
            self._serve_until(end_ns)
        if ledger is not None:
            ledger.stamp(*self.senders.departures())

    def _run(self, plan: Plan, delivery: Delivery, end_ns: int | None, watch: Callable[[], None]) -> bool:
        """Send the plan; false if told to stop before its end."""
        clock = self.clock
        last_ns = None if end_ns is None else end_ns - self._anchor_ns
        rate = self._frames_planned_per_s()
        while True:
            watch()
            next_ns = plan.next_ns()
            if next_ns is None:
                if plan.ended:
                    return True
                next_ns = clock.monotonic_ns() - self._anchor_ns + POLL_NS  # paused
            if last_ns is not None and next_ns >= last_ns:
                return True
            if self._anchor_ns + next_ns - clock.monotonic_ns() > LEAD_NS:
                if not self._serve_until(self._anchor_ns + next_ns - LEAD_NS, once=True):
                    return False
                continue
            until_ns = next_ns + _sheet_ns(rate * float(plan.speed))
            sheet = plan.until(until_ns if last_ns is None else min(until_ns, last_ns))
            for warning in plan.warnings():
                self._warn(warning)
            for gate in plan.gates():
                first = int(sheet.offset_ns.searchsorted(gate.offset_ns))
                if not delivery.send(sheet.take(slice(0, first)), self._anchor_ns, self._serve_until):
                    return False
                sheet = sheet.take(slice(first, None))
                if not self._serve_until(self._anchor_ns + gate.offset_ns):
                    return False
                delivery.turn(gate)
            if not delivery.send(sheet, self._anchor_ns, self._serve_until):
                return False

    def _frames_planned_per_s(self) -> float:
        """At speed 1."""
        return sum(float(self.cast.config(part, int(e)).rate) for part, e in enumerate(self.cast.editions))

    def _watch(self, utc: UtcOffset, progress: Callable[[], None]) -> Callable[[], None]:
        """What is to be looked at about once a second: progress, rates, and whether UTC was stepped."""
        clock = self.clock
        due_ns = clock.monotonic_ns()

        def watch() -> None:
            nonlocal due_ns, utc
            now_ns = clock.monotonic_ns()
            if now_ns < due_ns:
                return
            due_ns = now_ns + UTC_CHECK_NS
            self._recent.append((now_ns, self.results.sent))
            now = utc_offset(clock, tries=3)
            if step_ns := utc.step_ns(now):
                utc = now
                self._warn(f"UTC was stepped by {step_ns / NS:+.6f} s; stamps and deadlines go on as before the step")
            progress()

        return watch

    def _wait_for_start(self, end_ns: int | None) -> bool:
        while not self._stop() and (end_ns is None or self.clock.monotonic_ns() < end_ns):
            for event in self.senders.poll(POLL_NS):
                self._tell(event)
                if event.kind is Outcome.STARTED:
                    return True
        return False

    def _serve_until(self, deadline_ns: int, once: bool = False) -> bool:
        """Answer clients until ``deadline_ns``, or with ``once`` until something has happened; false: told to stop."""
        while not self._stop():
            for event in self.senders.serve_until(min(deadline_ns, self.clock.monotonic_ns() + POLL_NS)):
                self._tell(event)
            if once or self.clock.monotonic_ns() >= deadline_ns:
                return True
        return False

    def _drain(self) -> None:
        """Let TCP clients take what waits for them, and read what they last said: unread, it would reset them."""
        end_ns, timeout_ns = self.clock.monotonic_ns() + DRAIN_NS, 0
        while True:
            for event in self.senders.poll(timeout_ns):
                self._tell(event)
            if not self.senders.queued_bytes or self.clock.monotonic_ns() >= end_ns or self._stop():
                return
            timeout_ns = POLL_NS

    def close(self) -> None:
        self.senders.close()

    def __enter__(self) -> Player:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- being told, and telling

    def act(self, action: Action) -> None:
        """Do what an operator says; raises SettingsError where it cannot be done.

        Before the play has begun, it is done at its beginning.
        """
        if self._state is PlayState.ENDED:
            raise SettingsError("the play has ended")
        if action.verb == "step" and not (self._plan is not None and self._plan.paused):
            raise SettingsError("step goes on by frames from a pause; pause first")
        if self._plan is not None:
            self._do(action)
            self.senders.interrupt()  # something may be due before what is waited for
            return
        self._meant(action, [part for part, pipeline in enumerate(self.pipelines) if pipeline.check(action)])
        self._actions.append(action)

    def _do(self, action: Action) -> None:
        assert self._plan is not None
        if action.verb in STREAM_VERBS:
            self._meant(action, self._plan.fault(action))
        else:
            self._plan.act(action, self.clock.monotonic_ns() - self._anchor_ns)

    def _meant(self, action: Action, parts: Sequence[int]) -> None:
        """Raise SettingsError for an order to streams that concerns none."""
        if action.rule is not None and not parts:
            asked = f"{action.verb} {', '.join(action.rule.patterns)}"
            raise SettingsError(no_such_stream(asked, [part.name for part in self.cast.parts]))

    def status(self) -> PlayerStatus:
        """What it is doing now."""
        plan, reel = self._plan, self.cast.reel
        state = PlayState.PAUSED if plan is not None and plan.paused and not plan.ended else self._state
        between = plan.between_ns if plan is not None else None
        elapsed_ns = self.clock.monotonic_ns() - self._anchor_ns if plan is not None else 0
        return PlayerStatus(
            state,
            plan.position_ns / NS if plan is not None else 0.0,
            reel.length_ns / NS,
            plan.loop if plan is not None else 0,
            float(plan.speed if plan is not None else self.options.speed),
            (between[0] / NS, between[1] / NS) if between is not None else None,
            max(elapsed_ns, 0) / NS,
            self._frames_per_s(),
            self.results.sent,
            PacingStatus.of(self.results.lateness.summary()),
            _Statuses(self),
        )

    def stream_status(self, part: int) -> StreamStatus:
        """Of one stream."""
        return StreamStatus(
            self.cast.parts[part].name,
            self.cast.parts[part].idcode,
            self.pipelines[part].enabled,
            self.senders.audience(self.handles[part]),
            self.results.fates(part),
            PacingStatus.of(self.results.lateness.summary(part)),
            dict(self.pipelines[part].stages.texts),
        )

    def _frames_per_s(self) -> float:
        if not self._recent:
            return 0.0
        then_ns, then = self._recent[0]
        span_ns = self.clock.monotonic_ns() - then_ns
        return (self.results.sent - then) * NS / span_ns if span_ns > 0 else 0.0

    def to_json(self) -> list[dict[str, Any]]:
        """The results of all streams."""
        return [result.to_json() for result in self.results]


class _Statuses(Sequence[StreamStatus]):
    """Every stream's status, when it is asked for."""

    def __init__(self, player: Player) -> None:
        self._player = player

    def __len__(self) -> int:
        return len(self._player.cast.parts)

    @overload
    def __getitem__(self, place: int) -> StreamStatus: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[StreamStatus]: ...

    def __getitem__(self, place: int | slice) -> StreamStatus | Sequence[StreamStatus]:
        places = range(len(self))[place]
        if isinstance(places, int):
            return self._player.stream_status(places)
        return [self._player.stream_status(part) for part in places]


def _sheet_ns(frames_per_s: float) -> int:
    return int(min(SHEET_NS, max(1_000_000, SHEET_FRAMES / frames_per_s * NS))) if frames_per_s else SHEET_NS


def _offer(cast: Cast, part: int, edition: int) -> Served:
    config = cast.config(part, edition)
    return served(config, f"pmutools player, stream {config.idcode}")
