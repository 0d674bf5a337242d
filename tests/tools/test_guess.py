"""Which channels are a station's voltage, and of which level: from names, CFG-3 types and values."""

from __future__ import annotations

import cmath
import math

import pytest

from pmutools.c37118 import Format, PhasorChannel, PhasorScale, Station
from pmutools.tools.guess import guess_voltage, nominal_kv

NAN = complex(math.nan, math.nan)
TURN = cmath.exp(-2j * math.pi / 3)
CURRENT = 1 << 24


def station(*names: str, types: list[int] | None = None) -> Station:
    """Channels by name; those that begin with I are currents."""
    channels = [PhasorChannel(name, CURRENT if name.startswith("I") else 0) for name in names]
    if types is not None:
        channels = [
            PhasorChannel(name, phscale=PhasorScale(0, kind, 0, 1.0, 0.0))
            for name, kind in zip(names, types, strict=True)
        ]
    return Station("S", 1, Format(0), tuple(channels))


BY_NAME = {
    ("VA", "VB", "VC", "V1", "I1"): ("V1",),
    ("V1LPM", "VALPM", "VBLPM", "VCLPM"): ("V1LPM",),
    ("VA", "VB", "VC"): ("VA", "VB", "VC"),
    ("IA P", "IB P", "IC P", "VA P", "VB P", "VC P", "VN P"): ("VA P", "VB P", "VC P"),
    ("BUS A VA", "BUS A VB", "BUS A VC"): ("BUS A VA", "BUS A VB", "BUS A VC"),
    ("V1A", "V1B", "V1C", "V2A", "V2B", "V2C"): ("V1A", "V1B", "V1C"),
    ("Va", "Vb", "Vc"): ("Va", "Vb", "Vc"),
    ("VR", "VS", "VT"): ("VR", "VS", "VT"),
    ("VR", "VY", "VB"): ("VR", "VY", "VB"),
    ("BUS1 POS SEQ", "BUS1 NEG SEQ"): ("BUS1 POS SEQ",),
    ("NORTH VPOS", "NORTH VNEG"): ("NORTH VPOS",),
    ("500KV V+",): ("500KV V+",),
    ("LINE V1", "LINE V2", "LINE V0"): ("LINE V1",),
    ("V10", "V11"): (),
    ("POSTFACH",): (),
    ("IA", "IB", "IC", "I1"): (),
    (): (),
}


@pytest.mark.parametrize("names", BY_NAME, ids=lambda names: ",".join(names) or "none")
def test_by_name(names: tuple[str, ...]) -> None:
    guess = guess_voltage(station(*names), [NAN] * len(names))
    assert guess.channels == BY_NAME[names]
    assert guess.doubt == ""
    assert bool(guess.basis) == bool(guess.channels)


def test_numbered_channels_are_phases_only_where_their_values_say_so() -> None:
    numbered = station("PHS 1", "PHS 2", "PHS 3", "PHS 4")
    turned = [1000 * TURN**k for k in range(4)]
    assert guess_voltage(numbered, turned).channels == ("PHS 1", "PHS 2", "PHS 3")
    assert guess_voltage(numbered, [1000j] * 4).channels == ()
    assert guess_voltage(numbered, [NAN] * 4).channels == ()
    assert guess_voltage(station("V1", "V2", "V3"), turned[:3]).channels == ("V1", "V2", "V3")


@pytest.mark.parametrize("values", [[1000, 1000, 1000], [1000, 1000 / TURN, 1000 * TURN], [1000, 10 * TURN, TURN**2]])
def test_phases_that_do_not_look_like_phases_are_doubted(values: list[complex]) -> None:
    guess = guess_voltage(station("VA", "VB", "VC"), values)
    assert guess.channels == ("VA", "VB", "VC")
    assert guess.doubt == "the three are not a third of a turn apart"


def test_a_dead_bus_is_no_reason_for_doubt() -> None:
    assert guess_voltage(station("VA", "VB", "VC"), [0, 0, 0]).doubt == ""


def test_the_type_of_cfg3_comes_first() -> None:
    typed = station("X", "Y", "Z", "W", types=[4, 5, 6, 1])
    assert guess_voltage(typed, [NAN] * 4)[:2] == (("W",), "CFG-3 says so")
    assert guess_voltage(station("C", "B", "A", types=[6, 5, 4]), [NAN] * 3)[:2] == (("A", "B", "C"), "CFG-3 says so")
    assert guess_voltage(station("X", types=[1]), [NAN])[:2] == (("X",), "CFG-3 says so")


def test_a_type_that_all_channels_have_says_nothing() -> None:
    """As senders write it that do not know."""
    assert guess_voltage(station("VA", "VB", "VC", types=[1, 1, 1]), [NAN] * 3).basis == "guessed from their names"


def test_a_current_is_no_voltage_whatever_its_type() -> None:
    assert guess_voltage(station("V", "I", types=[4, 1 | 8]), [NAN] * 2).channels == ()


@pytest.mark.parametrize(
    ("phase_v", "kv"),
    [
        *((288_675.0, 500), (303_100.0, 500), (132_800.0, 230), (66_400.0, 115), (63_500.0, 110), (230.9, 0.4)),
        *((0.0, None), (-1.0, None), (math.nan, None), (math.inf, None), (66.4, None), (346_000.0, None)),
    ],
)
def test_the_nearest_usual_level(phase_v: float, kv: float | None) -> None:
    assert nominal_kv(phase_v) == kv
