"""How a session in real time ends: by its time, on request, by an error; each time with 0 V. A full disk is no end."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path

import pytest
from support.disk import full_disk
from support.virtual_platform import Bench, Item, stream, virtual_platform

from dcon.core.values import SystemState
from dcon.engine import Engine
from dcon.limiter import SLEW_MW_PER_S
from dcon.replay.replay import replay
from pmutools.errors import SourceError

Make = Callable[..., Bench]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    def make(items: Iterable[tuple[int, Item]] = (), name: str = "s.mcap") -> Bench:
        return virtual_platform(tmp_path / name, items, monkeypatch)

    return make


def active_mw(made: Bench, at_s: float) -> float:
    """The command at a time; the tests below want it to be far from 0 when the end comes."""
    k = next(k for k, sent in enumerate(made.driver.sent) if sent[2] >= at_s)
    return made.driver.sent[k][1] * 12.5


def ramped(made: Bench, at_s: float) -> None:
    assert abs(active_mw(made, at_s)) > 10
    assert max(made.steps_mw()) <= SLEW_MW_PER_S / 60 + 1e-9
    down = [volts * 12.5 for *_, volts, passed in made.driver.sent if passed > at_s + 0.02]
    assert all(abs(b) <= abs(a) + 1e-9 for a, b in pairwise(down))
    assert made.driver.sent[-1][2] - at_s == pytest.approx(1.0, abs=0.06)


def test_the_end_of_its_time_ramps_the_command_down(bench: Make) -> None:
    made = bench(stream(6))
    summary = made.run(3.2)
    assert summary.final_state == "STANDBY"
    ramped(made, 3.21)
    made.ended_well()


def test_a_request_to_stop_ramps_the_command_down(bench: Make) -> None:
    made = bench(stream(6))
    made.clock.at(3.2, made.platform.stop)
    summary = made.run(None)
    assert summary.final_state == "STANDBY"
    ramped(made, 3.21)
    made.ended_well()


def test_a_request_to_stop_while_nothing_is_driven_ends_at_once(bench: Make) -> None:
    made = bench(stream(2))
    made.platform.stop()
    assert made.run(None).ticks == 0
    assert [volts for _, volts, _ in made.driver.sent] == [0.0]


def test_a_full_disk_does_not_stop_the_controller(
    bench: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Ticks that find no room are counted, every command goes out, and a new part follows when there is room again."""
    disk = full_disk(tmp_path, monkeypatch)
    made = bench(stream(30))
    made.clock.at(5.2, lambda: setattr(disk, "capacity", 0))
    made.clock.at(9.0, lambda: setattr(disk, "capacity", float("inf")))
    summary = made.run(28)
    assert [Path(name).name for name in summary.log_parts] == ["s.mcap", "s.part2.mcap"]
    assert len(made.driver.sent) == summary.ticks + 1 == pytest.approx(28 * 60, abs=90)
    assert 10 * 60 <= summary.unlogged_ticks <= 12 * 60
    logged = [record.tick_ns for record in made.records]
    assert len(logged) + summary.unlogged_ticks == summary.ticks
    assert made.records[-1].events or made.records[-1].state is SystemState.STANDBY
    assert caplog.text.count("control goes on") == 1 and caplog.text.count("logging again") == 1
    assert max(made.steps_mw()) <= SLEW_MW_PER_S / 60 + 1e-9
    result = replay(made.path)
    assert result.different == 0 and result.stopped.startswith("the log lost something before tick")
    (gap,) = result.gaps  # which ends with the next checkpoint
    assert gap.passed and gap.ticks < 5 * 60 and result.ticks + gap.ticks == len(logged)


def test_a_log_that_cannot_be_opened(bench: Make, tmp_path: Path) -> None:
    made = bench(stream(1))
    made.path = tmp_path / "no" / "s.mcap"
    with pytest.raises(SourceError, match=r"^[^\n]*No such file[^\n]*$"):
        made.run(1)
    assert [volts for _, volts, _ in made.driver.sent] == [0.0]
    assert made.driver.closed and made.script.closed


@pytest.mark.parametrize("error", [RuntimeError("a bug"), KeyboardInterrupt(), MemoryError()])
def test_whatever_else_goes_wrong_leaves_0_v_and_a_readable_log(
    error: BaseException, bench: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = bench(stream(6))
    tick = Engine.tick

    def failing(self: Engine, *given: object) -> object:
        if made.clock.passed_s > 3.2:
            raise error
        return tick(self, *given)  # type: ignore[arg-type]

    monkeypatch.setattr(Engine, "tick", failing)
    with pytest.raises(type(error)):
        made.run(20)
    monkeypatch.undo()
    assert abs(made.driver.sent[-2][1]) > 0.5
    assert len(made.records) == len(made.driver.sent) - 1
    made.ended_well()
