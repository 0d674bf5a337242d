"""The paper's cases in one course of 52 s: a recording of a grid, and a profile that does to its frames what they ask.

Generation trips in the south three times: with all streams alike, with the south 3 samples behind, and with 6. Between
these, while the swing is alive, what concerns single streams; a PMU that was disabled is not needed again for the 20 s
that it takes to be verified. Last of all every stream stops. Times are seconds from the first stamp.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from support.logged import NAMES, RATE

from pmutools.c37118.config import encode_config
from pmutools.grid.emulate import EmulatedStream
from pmutools.grid.grid import Grid
from pmutools.grid.modal import SINGLE_MODE, ModalPlant
from pmutools.grid.pmu_model import fleet, measure
from pmutools.grid.scenarios import SOUTH_LOSS, Pulse, Scenario
from pmutools.grid.signals import Bus
from pmutools.timebase import NS, parse_utc

START_NS: Final = parse_utc("2024-01-01T00:00:00Z")
ACTIVE_S: Final = 22.5
"""By then the controllers must be ACTIVE: their instances are READY at 20."""
LOSS_S: Final = (23.0, 36.0, 49.5)
TWO_ZERO_S: Final = (23.3, 24.1)
HELD_S, HELD_FRAMES = 24.2, 2
DROPPED_S: Final = 25.0
GAP_S, GAP_FRAMES = 26.05, 5
STOP_S: Final = (27.15, 29.15)
SKEW_S: Final = ((31.0, 32.5), (39.0, 40.5))
"""When the south falls 3 samples behind, and 3 more: bit by bit, or it would fall silent for so long."""
ALL_STOP_S: Final = 50.4
END_S: Final = 51.9
DELAY_MS: Final = 22.0
"""Of every frame: it arrives 1.3 ms after the tick before the one that takes it, and may be 15 ms late."""
NOISE_RAD: Final = 2e-5
"""So that no two frames are alike; 0.2 MW at 10 MW/mHz."""


def _silence(from_s: float, frames: int) -> str:
    """So many frames come with the one after them."""
    return f"{from_s}..{from_s + frames / RATE - 1e-3:.6f} release=burst"


PROFILE: Final = f"""
[stream *]
delay = {DELAY_MS}
        trace(17, 0.5) when={TWO_ZERO_S[0]}..{TWO_ZERO_S[1]}
disable = {ALL_STOP_S}..
[stream N1]
drop = {round(DROPPED_S * RATE)}
[stream S1]
disable = +{_silence(HELD_S, HELD_FRAMES)}
          {_silence(GAP_S, GAP_FRAMES)}
[stream N2]
disable = +{STOP_S[0]}..{STOP_S[1]}
[stream S*]
delay = +ramp({SKEW_S[0][0]}, {SKEW_S[0][1]}, 0, 50) + ramp({SKEW_S[1][0]}, {SKEW_S[1][1]}, 0, 50)
"""
"""``trace(17, 0.5)``: of two frames both come 39 ms after the stamp of the first, in one window; none in the next."""


def stamp_ns(slot: int, start_ns: int = START_NS) -> int:
    return start_ns + (slot * NS + RATE // 2) // RATE


def frames() -> dict[str, list[bytes]]:
    """Every frame of every PMU, as a grid that lives through the three losses lets them report.

    Each loss is the scenario's, but for its push on the swing: that lasts a period, so that little is left of the swing
    when the next one comes.
    """
    pmus = fleet(noise_rad=NOISE_RAD, seed=1)
    streams = {pmu.name: EmulatedStream([pmu], RATE) for pmu in pmus}
    losses = [SOUTH_LOSS._replace(start_s=at_s) for at_s in LOSS_S]
    period_s = 1 / SINGLE_MODE[0].f_hz
    pushes = [Pulse("brake", one.start_s, one.start_s + period_s, -one.swing_share * one.mw) for one in losses]
    grid = Grid(ModalPlant(SINGLE_MODE), Scenario("course", "", tuple(pushes)), start_ns=START_NS)
    found: dict[str, list[bytes]] = {name: [] for name in streams}
    for slot in range(round(END_S * RATE)):
        time_ns = stamp_ns(slot)
        grid.advance(time_ns)
        shared = {name: [one.common((time_ns - START_NS) / NS, name) for one in losses] for name in ("north", "south")}
        buses = {name: Bus(*bus[:4], *map(sum, zip(*shared[name], strict=True))) for name, bus in grid.buses().items()}
        for pmu in pmus:
            stream = streams[pmu.name]
            found[pmu.name].append(stream.data_frame([measure(pmu, buses, time_ns, slot)]))
    return found


def configs() -> dict[str, bytes]:
    """The configuration frame of every PMU."""
    return {pmu.name: encode_config(EmulatedStream([pmu], RATE).config) for pmu in fleet()}


def write(folder: Path, sent: dict[str, list[bytes]]) -> tuple[Path, Path]:
    """The recording, as raw bytes, and the profile."""
    recording, profile = folder / "course.c37118", folder / "course.ini"
    instants = zip(*(sent[name] for name in NAMES), strict=True)
    recording.write_bytes(b"".join((*configs().values(), *(frame for instant in instants for frame in instant))))
    profile.write_text(PROFILE)
    return recording, profile
