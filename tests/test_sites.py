"""``[pmu NAME]``: what the file says is in force; clashes are one line that says where; streams are received once."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.playing import recording, stream
from support.recordings import write

from pmutools.c37118 import Format, Station, StreamConfig
from pmutools.errors import SettingsError, SourceError
from pmutools.net.endpoint import Endpoint, parse_endpoint
from pmutools.settings import parse_ini
from pmutools.sites import Site, StreamSites, load_sites, sites_of, streams_of
from pmutools.tools.recordings import saved_configs

GOOD = """\
[DEFAULT]
rate = 60
voltage = VA,VB,VC ; of every PMU
[pmu N1]
url = udp://0.0.0.0:4801?source=192.0.2.11
idcode = 101
side = north
nominal_kv = 500
[pmu P1]
url = tcp://192.0.2.30:4712
idcode = 300
station = NORTH ONE
voltage = V1LPM
[pmu P2]
url = tcp://192.0.2.30:4712?idcode=300
station = NORTH TWO
[pmu S1]
url = udp://0.0.0.0:4801?source=192.0.2.12
config = saved/s1.c37118
[controller]
gain_mw_per_mhz = whatever the controller makes of it
"""


def sites(text: str) -> tuple[Site, ...]:
    return sites_of(parse_ini(text, "f.ini", defaults_for="pmu"))


def test_what_the_file_says_is_in_force() -> None:
    n1, p1, p2, s1 = sites(GOOD)
    assert (n1.name, n1.stream, n1.side, n1.nominal_kv, n1.rate) == ("N1", 101, "north", 500.0, 60)
    assert n1.url == parse_endpoint("udp://0.0.0.0:4801?source=192.0.2.11")
    assert str(n1.endpoint) == "udp://0.0.0.0:4801?idcode=101&source=192.0.2.11"
    assert [p.station for p in (p1, p2)] == ["NORTH ONE", "NORTH TWO"]
    assert [p.voltage for p in (n1, p1, p2)] == [("VA", "VB", "VC"), ("V1LPM",), ("VA", "VB", "VC")]
    assert (s1.side, s1.stream, s1.nominal_kv) == ("none", None, None)


def test_defaults_reach_pmus_only() -> None:
    ini = parse_ini(GOOD, "f.ini", defaults_for="pmu")
    assert list(ini.section("controller").entries) == ["gain_mw_per_mhz"]
    assert sites("[pmu A]\nurl = udp://h:1\n")[0].rate is None


MISTAKES = {
    "an unknown section": ("[pmu S1]", "[pm S1]", "f.ini:17: [pm S1]: unknown section; did you mean 'pmu NAME'?"),
    "a section that wants a name": ("[pmu S1]", "[pmu]", "f.ini:17: [pmu]: unknown section; did you mean 'pmu NAME'?"),
    "an unknown key": ("side = north", "sides = north", "f.ini:7: [pmu N1] sides: unknown key; did you mean 'side'?"),
    "an unknown key for all": (
        "rate = 60\nv",
        "rat = 60\nv",
        "f.ini:2: [DEFAULT] rat: unknown key; did you mean 'rate'",
    ),
    "a section twice": ("[pmu P2]", "[pmu  N1]", "f.ini:14: [pmu N1]: section given twice, first on line 4"),
    "a key twice": ("side = north", "idcode = 102", "f.ini:7: [pmu N1] idcode: key given twice, first on line 6"),
    "a unit in a value": ("= 500", "= 500 kV", "f.ini:8: [pmu N1] nominal_kv: '500 kV' is not a number"),
    "a rate that is none": ("rate = 60\nv", "rate = 60/s\nv", "f.ini:2: [DEFAULT] rate: '60/s' is not a whole number"),
    "a rate out of range": ("rate = 60\nv", "rate = 0\nv", "f.ini:2: [DEFAULT] rate: 0 is out of range; it must be 1"),
    "an IDCODE out of range": ("= 101", "= 65535", "f.ini:6: [pmu N1] idcode: 65535 is out of range"),
    "two channels": (
        "= V1LPM",
        "= VA,VB",
        "f.ini:13: [pmu P1] voltage: 'VA,VB' is neither one positive-sequence channel",
    ),
    "a side that is none": ("= north", "= east", "f.ini:7: [pmu N1] side: 'east' is not one of north, south, none"),
    "no url": ("url = tcp://192.0.2.30:4712\n", "", "f.ini:9: [pmu P1]: url is missing; add a line 'url = ...'"),
    "a url that is none": (
        "udp://0.0.0.0:4801?source=192.0.2.11",
        "0.0.0.0:4801",
        "f.ini:5: [pmu N1] url: 0.0.0.0:4801",
    ),
    "two IDCODEs": (
        "idcode=300",
        "idcode=301\nidcode = 300",
        "f.ini:16: [pmu P2] idcode: 300, but the url says 301; keep one",
    ),
    "one station twice": (
        "NORTH TWO",
        "NORTH ONE",
        "f.ini:14: [pmu P2]: tcp://192.0.2.30:4712?idcode=300 gives it the frames of P1 too; tell the two apart by "
        "idcode, station or ?source=",
    ),
    "a station, and the whole stream": (
        "station = NORTH TWO\n",
        "",
        "f.ini:14: [pmu P2]: tcp://192.0.2.30:4712?idcode=300",
    ),
    "any sender, and one of them": ("?source=192.0.2.12", "", "f.ini:17: [pmu S1]: udp://0.0.0.0:4801 gives it the"),
    "two rates of one stream": (
        "NORTH TWO",
        "NORTH TWO\nrate = 50",
        "f.ini:17: [pmu P2] rate: 50, but P1 in the same stream has 60; keep one",
    ),
    "a rate that is not the default's": (
        "voltage = V1LPM",
        "rate = 30",
        "f.ini:13: [pmu P1] rate: 30, but P2 in the same stream has 60; keep one",
    ),
    "two hosts of one port": (
        "udp://0.0.0.0:4801?source=192.0.2.12",
        "udp://127.0.0.1:4801",
        "f.ini:18: [pmu S1] url: udp://127.0.0.1:4801 and udp://0.0.0.0:4801?source=192.0.2.11 of N1 are one port of "
        "this machine; write the same host in both",
    ),
    "data to a port of another's": (
        "url = udp://0.0.0.0:4801?source=192.0.2.12",
        "url = tcp+udp://192.0.2.9:4712?data=4801\n[pmu S2]\nurl = udp://127.0.0.1:4801",
        "f.ini:20: [pmu S2] url: udp://127.0.0.1:4801 and",
    ),
}


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_one_line_that_says_where(old: str, new: str, message: str) -> None:
    assert GOOD.count(old) == 1
    with pytest.raises(SettingsError) as error:
        sites(GOOD.replace(old, new))
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_no_pmu_at_all() -> None:
    with pytest.raises(SettingsError, match=r"f.ini: no \[pmu NAME\] section; add one for each PMU"):
        sites("[controller]\n")


@pytest.mark.parametrize(
    ("one", "two"),
    [
        ("udp://0.0.0.0:4801", "udp://[::]:4801"),
        ("udp://127.0.0.1:4801", "udp://127.0.0.2:4801"),
        ("udp://0.0.0.0:0", "udp://127.0.0.1:0"),
        ("udp://0.0.0.0:4801", "tcp+udp://h:4712?data=4801"),
        ("udp+cmd://h:4713", "udp://0.0.0.0:4713"),
        ("udp://239.1.1.1:4713", "udp://239.1.1.2:4713"),
    ],
)
def test_what_does_not_clash(one: str, two: str) -> None:
    assert len(sites(f"[pmu A]\nurl = {one}\n[pmu B]\nurl = {two}\n")) == 2


# --- streams


def test_a_concentrators_stream_is_one_with_several_sites() -> None:
    n1, p1, p2, s1 = sites(GOOD)
    streams = streams_of((n1, p1, p2, s1))
    assert streams == (
        StreamSites(n1.endpoint, (n1,)),
        StreamSites(parse_endpoint("tcp://192.0.2.30:4712?idcode=300"), (p1, p2)),
        StreamSites(s1.endpoint, (s1,)),
    )
    assert [one.name for one in streams] == ["N1", "P1+P2", "S1"]
    assert [one.rate for one in streams] == [60, 60, 60]


def test_a_site_is_found_in_its_stream() -> None:
    _, p1, p2, s1 = sites(GOOD)
    stations = tuple(Station(name, number, Format(0)) for number, name in enumerate(("NORTH TWO", "X", "NORTH ONE")))
    config = StreamConfig(300, stations, 60)
    assert [p1.stations(config), p2.stations(config), s1.stations(config)] == [(2,), (0,), (0, 1, 2)]
    assert p1.stations(StreamConfig(300, stations[:2], 60)) == ()


@given(st.lists(st.tuples(st.integers(1, 4), st.integers(1, 3)), unique=True, max_size=12))
def test_every_site_is_in_one_stream(pairs: list[tuple[int, int]]) -> None:
    made = [
        Site(f"P{number}", Endpoint(parse_endpoint("tcp://h:1").scheme, "h", 4712), idcode, f"STATION {station}")
        for number, (idcode, station) in enumerate(pairs)
    ]
    streams = streams_of(made)
    assert sorted(site.name for one in streams for site in one.sites) == sorted(site.name for site in made)
    assert len({one.endpoint for one in streams}) == len(streams) == len({idcode for idcode, _ in pairs})


# --- saved configurations


def ini(folder: Path, text: str) -> tuple[Site, ...]:
    (folder / "f.ini").write_text(text, encoding="utf-8")
    return load_sites(folder / "f.ini")


def test_saved_configurations_are_found_from_the_files_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "saved").mkdir()
    write(tmp_path / "saved" / "7.c37118", recording(stream(7), 3))
    write(tmp_path / "saved" / "both.pcap", recording(stream(8), 3) + recording(stream(9), 3))
    monkeypatch.chdir("/")
    known = ini(
        tmp_path,
        "[pmu A]\nurl = udp://h:1\nconfig = saved/7.c37118\n"
        "[pmu B]\nurl = udp://h:2?idcode=9\nconfig = saved/both.pcap\n[pmu C]\nurl = udp://h:3\n",
    )
    assert saved_configs(known) == (stream(7), stream(9))


def test_saved_configurations_that_cannot_be(tmp_path: Path) -> None:
    write(tmp_path / "7.c37118", recording(stream(7), 3))
    write(tmp_path / "other.c37118", recording(stream(7, name="OTHER"), 3))
    cases = {
        "[pmu A]\nurl = udp://h:1?idcode=9\nconfig = 7.c37118\n": "holds no configuration of stream 9; it has 7",
        "[pmu A]\nurl = udp://h:1\nconfig = 7.c37118\n[pmu B]\nurl = udp://h:2\nconfig = other.c37118\n": (
            r"\[pmu B\] and \[pmu A\]: two configurations saved for IDCODE 7; keep one"
        ),
    }
    for text, message in cases.items():
        with pytest.raises(SettingsError, match=message):
            saved_configs(ini(tmp_path, text))
    with pytest.raises(SourceError, match="no-such"):
        saved_configs(ini(tmp_path, "[pmu A]\nurl = udp://h:1\nconfig = no-such.c37118\n"))


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no\.ini: No such file"):
        load_sites(tmp_path / "no.ini")
    (tmp_path / "bytes.ini").write_bytes(b"[pmu \xff]")
    with pytest.raises(SourceError, match="is no UTF-8 text"):
        load_sites(tmp_path / "bytes.ini")
