"""INI text to sections, sections to dataclasses: configparser's rules, our errors."""

from __future__ import annotations

import configparser
import contextlib
from dataclasses import dataclass, field

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pmutools.errors import SettingsError
from pmutools.parsers import boolean, integer, milliseconds_ns, number, parsed_by
from pmutools.settings import Entry, Section, Where, fill, parse_ini

EXAMPLE = """\
[DEFAULT]                     ; defaults for every [pmu ...]
rate = 60                     ; reaches [pmu ...] sections only
[pmu N1]
url = udp://0.0.0.0:4801?source=192.0.2.11
idcode = 101                  ; stream IDCODE; station = NAME picks one station of a PDC stream
[pmu  S1]
idcode: 201
rate = 30
[controller]
gain_mw_per_mhz = 9           ; 0..15
priority = N1-S1,
           N1-S2
; a comment of its own
# and another
100% = no interpolation; and no comment without a space before it
"""


def texts(section: Section) -> dict[str, str]:
    return {key: entry.text for key, entry in section.entries.items()}


def test_an_example() -> None:
    ini = parse_ini(EXAMPLE, "dcon.ini", defaults_for="pmu")
    assert [section.name for section in ini.sections] == ["pmu N1", "pmu S1", "controller"]
    north, south = ini.family("pmu")
    assert texts(north) == {"rate": "60", "url": "udp://0.0.0.0:4801?source=192.0.2.11", "idcode": "101"}
    assert texts(south) == {"rate": "30", "idcode": "201"}
    assert (south.kind, south.argument) == ("pmu", "S1")
    controller = ini.section("controller")
    assert texts(controller) == {
        "gain_mw_per_mhz": "9",
        "priority": "N1-S1,\nN1-S2",
        "100%": "no interpolation; and no comment without a space before it",
    }
    assert str(north.entries["rate"].where) == "dcon.ini:2: [DEFAULT] rate"
    assert str(controller.entries["priority"].where) == "dcon.ini:11: [controller] priority"
    assert texts(ini.section("watchdog")) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a]\nx = 1\n[b]\n[a]\n", "f.ini:4: [a]: section given twice, first on line 1; merge the two"),
        ("[a]\nx = 1\nX : 2\n", "f.ini:3: [a] x: key given twice, first on line 2; keep one"),
        ("x = 1\n", "f.ini:1: 'x = 1' stands before any section; add a [section] line above"),
        ("[a]\nno delimiter\n", "f.ini:2: 'no delimiter' is neither [section] nor key = value"),
        ("[a]\n= 3\n", "f.ini:2: '= 3' is neither [section] nor key = value"),
        ("[a\n", "f.ini:1: '[a' stands before any section; add a [section] line above"),
        ("[a]\n[b] = 3\n", "f.ini:2: '[b] = 3' is neither [section] nor key = value"),
    ],
)
def test_errors_name_the_line(text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        parse_ini(text, "f.ini")
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[contoller]\n", "f.ini:1: [contoller]: unknown section; did you mean 'controller'?"),
        ("[pmu]\n", "f.ini:1: [pmu]: unknown section; did you mean 'pmu NAME'?"),
        ("[controller x]\n", "f.ini:1: [controller x]: unknown section; did you mean 'controller'?"),
        ("[zzz]\n", "f.ini:1: [zzz]: unknown section; known: controller, pmu NAME"),
        ("[DEFAULT]\nrate = 1\n", "f.ini:1: [DEFAULT]: unknown section; known: controller, pmu NAME"),
    ],
)
def test_unknown_sections(text: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        parse_ini(text, "f.ini").only("controller", "pmu *")
    assert str(error.value) == message


@dataclass(frozen=True)
class Controller:
    gain: float = field(metadata=parsed_by(number(0, 15)))
    align: bool = field(default=True, metadata=parsed_by(boolean))
    wait_ms: int = field(default=0, metadata=parsed_by(milliseconds_ns))
    class_: int = field(default=1, metadata=parsed_by(integer()))
    name: str = "unset"

    def __post_init__(self) -> None:
        if self.align and self.gain == 13:
            raise ValueError("gain 13 and align clash; change one")


def filled(body: str) -> Controller:
    return fill(Controller, parse_ini("[controller]\n" + body, "f.ini").section("controller"), name="given")


def test_fill() -> None:
    assert filled("gain = 9\nalign = no\nwait_ms = 0.5\nclass = 3\n") == Controller(9.0, False, 500_000, 3, "given")
    assert filled("gain = 9\n") == Controller(9.0, True, 0, 1, "given")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("gain = 20", "f.ini:2: [controller] gain: 20 is out of range; it must be 0 to 15"),
        ("gain = 9\n\nalign = maybe", "f.ini:4: [controller] align: 'maybe' is neither yes nor no"),
        ("gain = 9\ngian = 9", "f.ini:3: [controller] gian: unknown key; did you mean 'gain'?"),
        ("gain = 9\nname = x", "f.ini:3: [controller] name: unknown key; known: gain, align, wait_ms, class"),
        ("align = no", "f.ini:1: [controller]: gain is missing; add a line 'gain = ...'"),
        ("gain = 13", "f.ini:1: [controller]: gain 13 and align clash; change one"),
        ("gain = 1\n  2", "f.ini:2: [controller] gain: '1\\n2' is not a number"),
    ],
)
def test_fill_errors(body: str, message: str) -> None:
    with pytest.raises(SettingsError) as error:
        filled(body)
    assert str(error.value) == message


def test_one_value_changed_from_outside() -> None:
    ini = parse_ini(EXAMPLE, "dcon.ini", defaults_for="pmu").changed("controller.GAIN_mw_per_mhz = 12")
    section = ini.section("controller")
    assert section.entries["gain_mw_per_mhz"] == Entry("12", Where("--set", 0, "controller", "gain_mw_per_mhz"))
    assert section.entries["priority"].text == "N1-S1,\nN1-S2"
    assert len(ini.sections) == 3
    added = ini.changed("log.folder=x").changed("pmu N1.idcode=7")
    assert added.section("log").entries["folder"].text == "x"
    assert added.family("pmu")[0].entries["idcode"].text == "7"
    with pytest.raises(SettingsError, match=r"--set: 'gain=12' is not SECTION\.KEY=VALUE"):
        ini.changed("gain=12")


LINES = """\
[a]
[b c]
  [a]
[d] ; note
[
[]
x = 1
x: 2
y=
= 1
k : v = w
q = a ; b ; c
x = a;b
100% = %(x)s
é = ü
  z = 3 ; note
more
  more
	more = less

; c
# c
 # c
"""


@given(st.lists(st.sampled_from(LINES.splitlines()), max_size=12).map("\n".join))
@example("[a]\nx = 1\n\n  y\n # c\n  z")
def test_configparser_reads_the_same(text: str) -> None:
    """What is text to one is text to the other, and says the same."""
    oracle = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=(";",), default_section="\0")
    expected, found = None, None
    with contextlib.suppress(configparser.Error):
        oracle.read_string(text)
        expected = {name: {key: value.strip() for key, value in oracle.items(name)} for name in oracle.sections()}
    with contextlib.suppress(SettingsError):
        found = {section.name: texts(section) for section in parse_ini(text, "f").sections}
    assert found == expected
