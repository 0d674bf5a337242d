"""What an operator or a timeline does to single streams while they play: at once, all or nothing, and told."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from support.controlled import whole_json
from support.playing import MS, START_NS, Played, Stage, config_of, faults, interleaved, play, recording, stream
from support.recordings import write

from pmutools.c37118 import AnalogChannel, Format, FrameType, PhasorChannel, Station, StreamConfig, decode_data
from pmutools.c37118.checksum import chk
from pmutools.clock import VirtualClock
from pmutools.errors import SettingsError
from pmutools.flow import Hangup
from pmutools.impair.profile import parse_profile
from pmutools.timebase import NS
from pmutools.tools.player.cast import emulated
from pmutools.tools.player.control import ControlSession
from pmutools.tools.player.material import Choice, material
from pmutools.tools.player.play import Player
from pmutools.tools.player.status import PlayerStatus

LATE_NS = 10 * MS
"""A sheet: what is planned already cannot be changed."""


def two(frames: int = 250) -> list[Any]:
    return interleaved(recording(stream(1, name="N1"), frames), recording(stream(2, name="S1"), frames))


def missing(played: Played, place: int = 0, frames: int = 250) -> list[int]:
    there = set(played.numbers(place))
    return [k for k in range(frames) if k not in there]


# --- at once


def test_a_stream_is_silent_from_the_next_sheet_on() -> None:
    for moment in (NS, NS + 3 * MS, NS + 9 * MS, NS + 15 * MS):
        played = play(two(), orders={moment: "disable N1", moment + NS: "enable N1"})
        gone = missing(played)
        assert gone == [*range(gone[0], gone[-1] + 1)]
        assert moment <= gone[0] * 20 * MS < moment + LATE_NS + 20 * MS
        assert moment + NS - 20 * MS <= gone[-1] * 20 * MS < moment + NS + LATE_NS
        assert missing(played, 1) == []
        assert played.fates == {"sent": 500 - len(gone), "disabled": len(gone)}


@pytest.mark.parametrize("name", ["N1", "1", "n*", '"N1"', "PMU 9, N1"])
def test_a_stream_has_several_names(name: str) -> None:
    played = play(two(), orders={0: f"disable {name}"})
    assert (len(missing(played)) >= 249, missing(played, 1)) == (True, [])


def test_faults_come_change_and_go(tmp_path: Path) -> None:
    said = {15 * MS: "fault N1 delay=constant(7)", NS + 15 * MS: "fault N1 delay=constant(3)\nfault S1 drop=every 2"}
    played = play(two(), orders=said | {2 * NS + 15 * MS: "fault * delay=none\nfault S1 drop=none"})
    late = [time - k * 20 * MS for k, time in zip(played.numbers(0), played.times(0), strict=True)]
    assert late == [0] + [7 * MS] * 50 + [3 * MS] * 50 + [0] * 149
    assert missing(played, 1) == [k for k in range(51, 101) if k % 2 == 0]


def test_what_is_set_is_told() -> None:
    told: list[dict[str, str]] = []

    def look(player: Player) -> None:
        told.append(dict(player.stream_status(0).faults))

    said: dict[int, Any] = {
        NS: "fault N1 loss=5%\nfault N1 delay=normal(16,2)",
        2 * NS: look,
        3 * NS: "fault * loss=none",
    }
    play(two(), orders=said | {4 * NS: look})
    assert told == [{"loss": "5%", "delay": "normal(16,2)"}, {"delay": "normal(16,2)"}]


@pytest.mark.parametrize(
    ("order", "why"),
    [
        ("disable N9", r"disable N9: no such stream; there are N1, S1"),
        ("fault N9 loss=5%", r"fault N9: no such stream"),
        ("fault N1 corrupt=bits(1) field=analogs", "stream N1: corrupt"),
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(order: str, why: str) -> None:
    refused: list[str] = []

    def attempt(player: Player) -> None:
        from pmutools.impair.profile import parse_action

        try:
            player.act(parse_action(order))
        except SettingsError as error:
            refused.append(str(error))

    played = play(two(), orders={NS: attempt})
    (text,) = refused
    assert why.replace("\\", "") in text
    assert played.fates == {"sent": 500}


def test_of_several_streams_all_are_changed_or_none() -> None:
    """One of them has no analogs."""
    rich = StreamConfig(
        3, (Station("RICH", 3, Format(0), (PhasorChannel("V1", 1),), analogs=(AnalogChannel("A"),)),), 50
    )
    flow = recording(stream(3), 0)[0].flow
    source = interleaved(recording(rich, 100, flow=flow), recording(stream(2, name="POOR"), 100))
    for order in ("fault * corrupt=bits(1) field=analogs", 'fault "RICH, POOR" corrupt=bits(1) field=analogs'):
        with pytest.raises(SettingsError, match="POOR"):
            play(source, orders={NS: order})

    def attempt(player: Player) -> None:
        from pmutools.impair.profile import parse_action

        with pytest.raises(SettingsError):
            player.act(parse_action("fault * corrupt=bits(1) field=analogs"))

    played = play(source, orders={NS: attempt})
    assert all(chk(sent.frame) == 0 for sent in played.data)
    originals = {message.frame.data[14:-2] for message in source if message.frame.type is FrameType.DATA}
    assert {sent.frame[14:-2] for sent in played.data} == originals


def test_many_streams_are_changed_with_one_order() -> None:
    played = play(recording(stream(), 100), cast=lambda reel: emulated(reel, 30, 1), orders={NS: "disable *-1?"})
    silent = {part for part in range(30) if len(played.numbers(part)) < 60}
    assert silent == {*range(9, 19)}


# --- configurations that change


def test_a_fault_that_the_new_configuration_cannot_have_ends_and_the_player_goes_on() -> None:
    rich = StreamConfig(
        7, (Station("PMU 7", 7, Format(0), (PhasorChannel("V1", 1),), analogs=(AnalogChannel("A"),)),), 50
    )
    flow = recording(stream(7), 0)[0].flow
    source = recording(rich, 50, flow=flow) + recording(stream(7), 50, first_slot=50, flow=flow)
    for fault in ("corrupt=bits(1) field=analogs", "drop=value A > 1e9"):
        played = play(source, profile=faults(fault, "delay=constant(5)"))
        assert len(played.data) == 100, fault
        assert {time % (20 * MS) for time in played.times()} == {5 * MS}, fault
        assert len(played.warnings) == 1


def test_the_end_of_a_fault_is_told() -> None:
    rich = StreamConfig(
        7, (Station("PMU 7", 7, Format(0), (PhasorChannel("V1", 1),), analogs=(AnalogChannel("A"),)),), 50
    )
    flow = recording(stream(7), 0)[0].flow
    source = recording(rich, 50, flow=flow) + recording(stream(7), 50, first_slot=50, flow=flow)
    profile = parse_profile(
        "[stream *]\ncorrupt = bits(1) field=analogs\ndelay = constant(5)\n"
        "[at 1.5]\ndo = fault * corrupt=bits(2) field=analogs",
        "x.ini",
    )
    played = play(source, profile=profile, loops=2)
    assert len(played.data) == 200
    first, second = played.warnings
    assert first.startswith("stream PMU 7: corrupt: ")
    assert first.endswith("; corrupt ends here")
    assert second.endswith("; what was to begin at 1.5 s does not")


# --- what TCP clients feel


def gates(*orders: tuple[int, str], profile: str = "", **options: Any) -> list[tuple[int, int, Hangup | None]]:
    clock = VirtualClock()
    stage = Stage(clock)
    play(
        two(),
        clock=clock,
        stage=stage,
        orders=dict(orders),
        profile=parse_profile(profile, "x.ini"),
        **options,
    )
    return stage.gates


def test_a_scheduled_silence_hangs_up_and_takes_up_at_its_frames() -> None:
    for release in ("skip", "burst"):
        seen = gates(profile=f"[stream N1]\ndisable = 1..2 tcp=rst release={release}")
        assert seen == [(NS, 0, Hangup.RST), (2 * NS, 0, None)], release


def test_silence_alone_hangs_up_on_nobody() -> None:
    assert gates((NS, "disable N1"), (2 * NS, "enable N1"), profile="[stream S1]\ndisable = 1..2") == []


@pytest.mark.parametrize("how", [Hangup.FIN, Hangup.RST, Hangup.REFUSE])
def test_an_ordered_silence_ends_for_clients_too(how: Hangup) -> None:
    """Also where nothing else is the matter with the stream, so that its frames pass by its faults."""
    seen = gates((NS + 15 * MS, f"disable N1 tcp={how}"), (2 * NS + 15 * MS, "enable N1"))
    assert seen == [(NS + 20 * MS, 0, how), (2 * NS + 20 * MS, 0, None)]


def test_what_was_sent_before_a_hang_up_was_sent_before_it() -> None:
    order: list[str] = []

    class Noting(Stage):
        def hang_up(self, handle: int, how: Hangup) -> int:
            order.append(f"hang up {self.now_ns // MS}")
            return super().hang_up(handle, how)

        def take_up(self, handle: int) -> None:
            order.append(f"take up {self.now_ns // MS}")

        def publish(self, frames: Any) -> list[int]:
            frames = list(frames)
            order.extend(f"{handle} {self.now_ns // MS}" for handle, _ in frames)
            return super().publish(frames)

    clock = VirtualClock()
    profile = parse_profile("[stream N1]\ndisable = 0.04..0.08 tcp=fin release=burst", "x.ini")
    play(two(6), clock=clock, stage=Noting(clock), profile=profile)
    assert [entry for entry in order if not entry.startswith("1")] == [
        "0 0", "0 20", "hang up 40", "take up 80", "0 80", "0 80", "0 80", "0 100"
    ]  # fmt: skip
    assert order.index("hang up 40") < order.index("1 40") < order.index("take up 80")


def test_a_hang_up_while_frames_are_delayed_is_at_the_gate() -> None:
    profile = "[stream N1]\ndelay = constant(100)\ndisable = 1..2 tcp=rst"
    assert gates(profile=profile) == [(NS, 0, Hangup.RST), (2 * NS, 0, None)]


# --- a concentrator's stream


def pdc(path: Path, **options: Any) -> Any:
    source = interleaved(
        recording(stream(1, name="N1"), 100),
        recording(stream(2, name="S1"), 50, slots=[*range(0, 100, 2)]),
        recording(stream(3, name="E1"), 60, first_slot=40),
    )
    write(path / "three.c37118", source)
    return material(Choice(files=[str(path / "three.c37118")], pdc_idcode=99, **options)).cast


def stations_there(played: Played) -> list[list[bool]]:
    config = played.cast.config(0, int(played.cast.editions[0]))
    there = []
    for sent in played.data:
        data = decode_data(sent.frame, config)
        there.append([bool(station.valid) for station in data.stations])
    return there


def test_streams_of_a_concentrator_are_aligned_and_what_is_missing_is_filled(tmp_path: Path) -> None:
    cast = pdc(tmp_path)
    played = play([], cast=lambda _: cast, reel=cast.reel)
    assert [part.idcode for part in cast.parts] == [99]
    there = stations_there(played)
    assert len(there) == 100
    assert there == [[True, k % 2 == 0, k >= 40] for k in range(100)]
    assert all(chk(sent.frame) == 0 for sent in played.data)


def test_one_station_of_a_concentrator_falls_silent(tmp_path: Path) -> None:
    cast = pdc(tmp_path)
    said = {215 * MS: "disable S1", 615 * MS: "enable S1"}
    played = play([], cast=lambda _: cast, reel=cast.reel, orders=said)
    there = stations_there(played)
    assert there == [[True, k % 2 == 0 and not 11 <= k < 31, k >= 40] for k in range(100)]
    assert Counter(sent.type for sent in played.data) == {FrameType.DATA: 100}


# --- what is told


def test_the_status_goes_over_the_wire_and_comes_back() -> None:
    seen: list[Any] = []

    def look(player: Player) -> None:
        session = ControlSession(player)
        session.feed(b'{"id": 1, "do": "stats"}\n')
        said = session.step(0)
        while session.busy:
            said += session.step(0)
        status = player.status()
        streams = tuple(status.streams)  # each is as it is when it is looked at
        seen.append((replace(status, streams=streams), json.loads(said)["result"]))

    said: dict[int, Any] = {NS: "loop 0.5 3\nspeed 2\nfault 1? loss=5%", 2 * NS: "pause", 2 * NS + MS: look}
    play(
        recording(stream(10), 250), cast=lambda reel: emulated(reel, 40, 1), orders=said | {3 * NS: "loop off\nresume"}
    )
    ((status, told),) = seen
    assert told == whole_json(status)
    assert whole_json(PlayerStatus.from_json(told)) == told
    assert (len(status.streams), status.streams[-1].name, len(status.streams[3:5])) == (40, "PMU 10-40", 2)
    assert (status.between, status.speed, str(status.state)) == ((0.5, 3.0), 2.0, "paused")
    assert status.sent == sum(stream.fates["sent"] for stream in status.streams)
    assert {stream.idcode for stream in status.streams if stream.faults} == {*range(10, 20)}


def test_frames_a_second_are_those_of_the_last_seconds() -> None:
    rates: list[float] = []
    said: dict[int, Any] = {
        k * NS + 500 * MS: lambda player: rates.append(player.status().frames_per_s) for k in (2, 5)
    }
    play(two(), orders=said | {2 * NS + 600 * MS: "pause", 6 * NS: "resume"})
    assert rates[0] == pytest.approx(100, abs=5)
    assert rates[1] == 0


def test_configurations_that_a_fault_makes_are_announced() -> None:
    played = play(two(), orders={NS + 15 * MS: "fault N1 config=count()"})
    announced = [config_of(sent) for sent in played.stage.sent if sent.type is FrameType.CFG2]
    assert [(config.idcode, config.stations[0].cfgcnt) for config in announced] == [(1, 1)]


# --- what is held back, and seeks


@pytest.mark.parametrize("silence", ["disable 7 release=burst", "fault 7 reorder=100% depth=50"])
def test_a_seek_amid_what_is_held_back_gives_every_copy_its_own_stamp(silence: str, tmp_path: Path) -> None:
    """Indices repeat when a player goes back; what is held of them keeps its origin."""
    ledger = tmp_path / "ledger.parquet"
    orders = {1 * NS + NS // 2: silence, 2 * NS: "seek 0", 3 * NS + NS // 2: "enable 7\nfault 7 reorder=none"}
    played = play(recording(stream(), 150), orders=orders, ledger=ledger)
    rows = pq.read_table(ledger).to_pylist()
    assert [row["source_time_ns"] for row in rows] == [START_NS + row["index"] * 20 * MS for row in rows]
    assert {(row["time_ns"] - row["source_time_ns"]) % NS for row in rows} == {0}
    assert len(played.data) == sum(row["fate"] == "sent" for row in rows)


def test_b_may_be_as_late_as_the_last_frame() -> None:
    source = recording(stream(), 200, latency_ns=lambda k: 400 * MS if k == 199 else 5 * MS)
    played = play(source, orders={0: "loop 3.5 4.4"}, loops=1, duration_ns=8 * NS)
    assert set(played.numbers()) == {*range(175, 200)}
