"""``pmu ini``: what it writes of live streams is read back as it was meant, whatever the streams are called."""

from __future__ import annotations

import random
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.captures import capture_path
from support.commands import Pmu, ended, run_pmu, started, wait_for_tcp, wait_for_udp
from support.live import data_frame, free_ports, free_udp_port
from support.peers import free_port, pyc37_stream, start_pyc37_pmu
from support.playing import START_NS, recording, stream

from pmutools.c37118 import Format, PhasorChannel, Station, StreamConfig, decode_config, encode_config
from pmutools.c37118.config_kinds import cut_name
from pmutools.cli.ini_text import Section, ini_text, sections_of
from pmutools.clock import SystemClock
from pmutools.flow import Flow
from pmutools.formats import open_source
from pmutools.formats.source import Block, gather
from pmutools.net.endpoint import parse_endpoint
from pmutools.settings import parse_ini
from pmutools.sites import load_sites, sites_of, streams_of
from pmutools.timebase import NS
from pmutools.tools.inventory import StreamInventory
from pmutools.tools.recordings import saved_configs
from pmutools.tools.survey import Survey, SurveyedEndpoint, SurveyedStream

ROOT = Path(__file__).parents[2]


def seen(config: StreamConfig, host: str = "192.0.2.1", frames: int = 0) -> SurveyedStream:
    """A stream that was looked at."""
    flow = Flow("udp", f"{host}:4713", "192.0.2.9:4713")
    one = SurveyedStream(host, StreamInventory(flow, config.idcode, config), senders={flow.source: None})
    for block in gather(recording(config, frames, latency_ns=30_000_000)[1:]):
        assert isinstance(block, Block)
        one.add(block.batch, 0)
    one.inventory.close()
    return one


def survey(*endpoints: SurveyedEndpoint) -> Survey:
    return Survey(list(endpoints), START_NS, 3 * NS, {})


def at(url: str, *streams: SurveyedStream) -> SurveyedEndpoint:
    return SurveyedEndpoint(parse_endpoint(url), list(streams))


def written(*endpoints: SurveyedEndpoint) -> tuple[list[Section], str]:
    found = survey(*endpoints)
    sections = sections_of(found, {})
    return sections, ini_text(found, sections)


NAMES = st.text(st.characters(codec="utf-8"), max_size=12).map(cut_name).map(lambda name: name.rstrip(" \0"))
"""As they come from the wire."""


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.tuples(NAMES, st.lists(NAMES, max_size=4)), min_size=1, max_size=3), max_size=4), st.data())
def test_whatever_streams_are_called_the_file_loads_and_names_them(
    streams: list[list[tuple[str, list[str]]]], data: st.DataObject
) -> None:
    found = []
    keys = [(idcode, host) for idcode in (0, 7, 8, 65535) for host in ("192.0.2.1", "192.0.2.2")]
    for made, (idcode, host) in zip(streams, data.draw(st.permutations(keys)), strict=False):
        stations = tuple(
            Station(name, 7, Format(0), tuple(PhasorChannel(channel) for channel in channels))
            for name, channels in made
        )
        found.append(seen(StreamConfig(idcode, stations, data.draw(st.sampled_from((50, 60, 0, -5, 1000)))), host))
    again = [seen(stream.inventory.config, stream.host) for stream in found[:1]]
    sections, text = written(at("udp://0.0.0.0:4713", *found), at("tcp://192.0.2.7:4712", *again))
    kept = [section for section in sections if not section.problem]
    names = [section.name.lower() for section in kept]
    assert len(set(names)) == len(names)
    if not kept:
        assert parse_ini(text, "f.ini", defaults_for="pmu").family("pmu") == ()
        return
    sites = sites_of(parse_ini(text, "f.ini", defaults_for="pmu"))
    assert [site.name for site in sites] == [section.name for section in kept]
    for site, section in zip(sites, kept, strict=True):
        config = section.stream.inventory.config
        assert site.stream == config.idcode
        assert section.station in site.stations(config)
        assert site.rate == (config.data_rate if config.data_rate in (50, 60) else None)
        if "voltage" in section.keys:
            channels = [channel.name for channel in config.stations[section.station].phasors]
            assert set(site.voltage) <= set(channels)


def test_names_are_safe_and_unique() -> None:
    config = [stream(idcode, name=name) for idcode, name in enumerate(("STATION A", "station-a", " ", "Ørsted/1"), 1)]
    sections, _ = written(at("udp://0.0.0.0:4713", *map(seen, config)))
    assert [section.name for section in sections] == ["STATION_A", "station_a_2", "PMU", "Ørsted_1"]


def test_a_common_rate_is_the_default() -> None:
    _, text = written(at("udp://0.0.0.0:4713", *(seen(stream(k, rate=60 if k < 3 else 30)) for k in range(1, 4))))
    assert text.count("rate = 60\n") == text.count("rate = 30\n") == 1
    assert [site.rate for site in sites_of(parse_ini(text, "", defaults_for="pmu"))] == [60, 60, 30]


def test_a_stream_without_a_rate_does_not_get_that_of_others() -> None:
    _, text = written(at("udp://0.0.0.0:4713", seen(stream(1)), seen(stream(2)), seen(stream(3, rate=-60))))
    assert "[DEFAULT]" not in text
    assert [site.rate for site in sites_of(parse_ini(text, "", defaults_for="pmu"))] == [50, 50, None]


@pytest.mark.parametrize(
    ("url", "hosts", "idcodes", "urls"),
    [
        ("udp://0.0.0.0:4713?ttl=3", "11", (1, 2), {"udp://0.0.0.0:4713?ttl=3"}),
        ("udp://0.0.0.0:1", "12", (1, 2), {"udp://0.0.0.0:1?source=192.0.2.1", "udp://0.0.0.0:1?source=192.0.2.2"}),
        ("udp://239.1.1.1:1?iface=lo", "12", (1, 2), {"udp://239.1.1.1:1?iface=lo"}),
        (
            "udp://239.1.1.1:1?iface=lo",
            "12",
            (1, 1),
            {"udp://239.1.1.1:1?iface=lo&source=192.0.2.1", "udp://239.1.1.1:1?iface=lo&source=192.0.2.2"},
        ),
        ("tcp://192.0.2.1:4712?idcode=1", "1", (1,), {"tcp://192.0.2.1:4712"}),
    ],
)
def test_a_sender_is_named_where_that_helps(url: str, hosts: str, idcodes: tuple[int, ...], urls: set[str]) -> None:
    streams = [seen(stream(idcode), f"192.0.2.{host}") for host, idcode in zip(hosts, idcodes, strict=True)]
    sections, text = written(at(url, *streams))
    assert {section.keys["url"] for section in sections} == urls
    assert {str(site.url) for site in sites_of(parse_ini(text, "", defaults_for="pmu"))} == urls


def test_remarks_say_what_is_odd() -> None:
    one = seen(stream(7), frames=100)
    one.senders["192.0.2.1:4999"] = None
    one.good[:] = 0
    _, text = written(at("udp://0.0.0.0:4713", one))
    assert "; delay (arrival less stamp): median 30.0 ms, 99 % within 30.0 ms\n" in text
    assert "; time quality: locked in every frame\n" in text
    assert "; * it comes from 2 ports: restarted, or several devices with one IDCODE\n" in text
    assert "; * its STAT never said that its data are good\n" in text
    assert ";nominal_kv =" in text and "V1 is 0.001414 kV, 0.002449 kV line to line: no usual level" in text


def test_a_recording_that_is_played_with_its_old_stamps_is_noticed() -> None:
    one = seen(stream(7))
    for block in gather(recording(stream(7), 10, latency_ns=400 * 86_400 * NS)[1:]):
        assert isinstance(block, Block)
        one.add(block.batch, 0)
    _, text = written(at("udp://0.0.0.0:4713", one))
    assert "median 400.0 days" in text
    assert "; * that is no delay: the stamps are not of now" in text


# --- live


@contextmanager
def sending(config: StreamConfig, port: int, *, config_every: int = 100) -> Iterator[None]:
    """Frames of now to a port of this machine, from a thread; the configuration before the first, and again."""
    over, clock = threading.Event(), SystemClock()

    def run() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for number in count():
                if number % config_every == 0:
                    sock.sendto(encode_config(config), ("127.0.0.1", port))
                slot = clock.realtime_ns() * config.data_rate // NS
                sock.sendto(data_frame(config, slot * NS // config.data_rate), ("127.0.0.1", port))
                if over.wait(1 / config.data_rate):
                    return

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.realtime
def test_streams_of_several_endpoints_become_a_file_that_loads(tmp_path: Path) -> None:
    """The player as eight PMUs over UDP and as a concentrator over TCP; an endpoint that nobody serves."""
    udp, tcp, nobody = free_ports(3)
    out = tmp_path / "sites" / "f.ini"
    out.parent.mkdir()
    eight, pdc = ROOT / "captures" / "cjb-8pmu.pcap", ROOT / "captures" / "cjb-pdc-30fps.pcapng"
    urls = [f"udp://127.0.0.1:{udp}", f"tcp://127.0.0.1:{tcp}?idcode=300", f"tcp://127.0.0.1:{nobody}"]
    with (
        started("play", pdc, "--listen", urls[1].partition("?")[0], "--loop", 0) as server,
        started("ini", *urls, "--out", out, "--save-config", tmp_path / "configs", "--json") as ini,
    ):
        wait_for_tcp(tcp, server)
        wait_for_udp(udp, ini)
        with started("play", eight, "--to", urls[0], "--loop", 0, "--cfg-period", 1):
            result = ended(ini)
        server.send_signal(signal.SIGINT)
        ended(server)
    assert result.code == 0, result.err
    assert f"pmu ini: {urls[2]}: refused: nothing serves this port" in result.err
    sites = load_sites(out)
    streams = streams_of(sites)
    assert [len(one.sites) for one in streams] == [*[1] * 8, 8]
    assert {site.name for site in sites[:8]} == {f"{side}{k}" for side in "NS" for k in range(1, 5)}
    assert [site.rate for site in sites] == [*[60] * 8, *[30] * 8]
    assert {site.voltage for site in sites} == {("V1",)}
    assert {site.side for site in sites} == {"none"}
    assert len(saved_configs(sites)) == 9
    told = result.json
    assert [len(endpoint["streams"]) for endpoint in told["endpoints"]] == [8, 1, 0]
    one = told["endpoints"][0]["streams"][0]
    assert one["idcode"] == 101 and 0 < one["delay_ms"]["p50"] < 1000
    assert one["stations"][0]["voltage"] == ["V1"]
    text = out.read_text(encoding="utf-8")
    assert text.count(";nominal_kv = 500 ") == 16
    assert f";url = {urls[2]}" in text
    assert "config = ../configs/300.c37118\n" in text
    # and what it writes is what reads
    assert run_pmu("ini", *urls, "--out", out).complaint.endswith("--force overwrites it, or name another file")


@pytest.mark.realtime
def test_what_is_known_when_interrupted_is_written() -> None:
    port = free_udp_port()
    with started("ini", f"udp://127.0.0.1:{port}", f"udp://127.0.0.1:{free_udp_port()}", "--duration", 60, "-v") as ini:
        wait_for_udp(port, ini)
        with sending(stream(9), port):
            assert ini.stderr is not None
            while "streaming" not in (line := ini.stderr.readline()):
                assert line
            ini.send_signal(signal.SIGINT)
            result = ended(ini)
    assert result.code == 130
    assert len(sites_of(parse_ini(result.out, "", defaults_for="pmu"))) == 1
    assert "nothing came; is the sender on" in result.out


@pytest.mark.realtime
@pytest.mark.peer
def test_pyc37_as_a_pmu(tmp_path: Path) -> None:
    described = pyc37_stream(random.Random(5), stations=2, frames=30)
    port, idcode = free_port(), described.spec.idcode
    out = tmp_path / "f.ini"
    with start_pyc37_pmu(port, described.config(), described.data):
        result = run_pmu("ini", f"tcp://127.0.0.1:{port}?idcode={idcode}", "--out", out)
    assert result.code == 0, result.err
    config = decode_config(described.config())[1]
    sites = load_sites(out)
    assert [site.stations(config) for site in sites] == [(0,), (1,)]
    assert {str(site.endpoint) for site in sites} == {f"tcp://127.0.0.1:{port}?idcode={idcode}"}


def test_the_channels_of_real_devices() -> None:
    """Of recordings of devices beside the checkout: what is taken for their voltage."""
    voltages = {"C37.118_1PMU_TCP.pcap": "V1LPM", "C37.118_1PMU_UDP.pcap": "VA,VB,VC"}
    for name, voltage in voltages.items():
        blocks = [item for item in open_source(capture_path(name)).blocks() if isinstance(item, Block)]
        one = SurveyedStream("192.0.2.1", StreamInventory(blocks[0].flow, 1, blocks[0].batch.config))
        for block in blocks:
            one.add(block.batch, 0)
        sections, _ = written(at("udp://0.0.0.0:4713", one))
        assert [section.keys["voltage"] for section in sections] == [voltage]
        assert ["doubt" in section.notes["voltage"] for section in sections] == [False]


def test_nothing_at_all_is_a_failure(pmu: Pmu) -> None:
    url = f"udp://127.0.0.1:{free_udp_port()}"
    result = pmu("ini", url, "--duration", 0.3, "--json")
    assert result.code == 1
    assert result.complaint == f"pmu ini: {url}: nothing came; is the sender on, and sending to this address and port?"
    assert result.json["endpoints"][0]["streams"] == []


def test_users_mistakes(pmu: Pmu, tmp_path: Path) -> None:
    (tmp_path / "f.ini").write_text("mine")
    for arguments, words in (
        ((), "Missing argument 'URL...'"),
        (("127.0.0.1:4713",), "no endpoint URL; write tcp://127.0.0.1:4713"),
        (("udp://127.0.0.1:0", "--out", tmp_path / "f.ini"), "f.ini is there already; --force overwrites it"),
    ):
        result = pmu("ini", *arguments)
        assert result.code == 2
        assert words in result.complaint
    assert (tmp_path / "f.ini").read_text() == "mine"


@pytest.mark.realtime
def test_what_was_there_is_overwritten_if_forced(pmu: Pmu, tmp_path: Path) -> None:
    folder = tmp_path / "configs"
    folder.mkdir()
    (folder / "9.c37118").write_text("mine")
    port = free_udp_port()
    for force, code in (("", 2), ("--force", 0)):
        options = ["--out", tmp_path / "f.ini", "--save-config", folder, "--duration", 0.5, *force.split()]
        with sending(stream(9), port, config_every=10):
            result = pmu("ini", f"udp://127.0.0.1:{port}", *options)
        assert result.code == code, result.err
    assert saved_configs(load_sites(tmp_path / "f.ini")) == (stream(9),)
