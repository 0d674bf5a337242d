"""Endpoint URLs: what is understood, that it comes back, and mistakes told in one line with a remedy."""

from __future__ import annotations

import ipaddress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmutools.errors import SettingsError
from pmutools.net.endpoint import Endpoint, Scheme, parse_endpoint

hosts = st.one_of(
    st.ip_addresses(v=4).map(str),
    st.ip_addresses(v=6).map(str),
    st.from_regex(r"[a-z][a-z0-9-]{0,10}(\.[a-z]{2,5})?", fullmatch=True),
)
ports = st.integers(0, 65535)


@st.composite
def endpoints(draw: st.DrawFn) -> Endpoint:
    scheme = draw(st.sampled_from(Scheme))
    over_udp = scheme is Scheme.TCP_UDP
    return Endpoint(
        scheme,
        draw(hosts),
        draw(ports),
        idcode=draw(st.none() | st.integers(1, 65534)),
        iface=draw(st.none() | st.sampled_from(["127.0.0.1", "eth0", "::1"])),
        source=draw(st.none() | st.ip_addresses().map(str)),
        data_host=draw(st.none() | hosts) if over_udp else None,
        data_port=draw(ports) if over_udp else None,
        ttl=draw(st.none() | st.integers(0, 255)),
        hardware_stamps=draw(st.booleans()),
    )


@settings(deadline=None)
@given(endpoints())
def test_a_url_comes_back(endpoint: Endpoint) -> None:
    assert parse_endpoint(str(endpoint)) == endpoint


@pytest.mark.parametrize(
    ("url", "endpoint"),
    [
        ("udp://0.0.0.0:4713", Endpoint(Scheme.UDP, "0.0.0.0", 4713)),
        (" UDP+CMD://Pmu1:4713/ ", Endpoint(Scheme.UDP_COMMANDED, "pmu1", 4713)),
        ("tcp://[2001:db8::1]:4712?idcode=7", Endpoint(Scheme.TCP, "2001:db8::1", 4712, idcode=7)),
        ("tcp+udp://h:1?data=2", Endpoint(Scheme.TCP_UDP, "h", 1, data_port=2)),
        ("tcp+udp://h:1?data=[ff02::9]:2", Endpoint(Scheme.TCP_UDP, "h", 1, data_host="ff02::9", data_port=2)),
        ("tcp://h:1?stamps=hardware", Endpoint(Scheme.TCP, "h", 1, hardware_stamps=True)),
        ("tcp://h:1?stamps=kernel", Endpoint(Scheme.TCP, "h", 1)),
        (
            "udp://239.0.0.1:4713?iface=10.0.0.2&source=10.0.0.1&ttl=3",
            Endpoint(Scheme.UDP, "239.0.0.1", 4713, iface="10.0.0.2", source="10.0.0.1", ttl=3),
        ),
    ],
)
def test_urls(url: str, endpoint: Endpoint) -> None:
    assert parse_endpoint(url) == endpoint


@pytest.mark.parametrize(
    ("url", "hint"),
    [
        ("pmu1:4712", "write tcp://pmu1:4712"),
        ("udp:0.0.0.0:4713", "write udp://0.0.0.0:4713"),
        ("http://h:1", "unknown scheme 'http'; use one of udp://, udp+cmd://, tcp://, tcp+udp://"),
        ("tcp://h", "no port; C37.118 customarily has tcp://h:4712"),
        ("udp://h", "udp://h:4713"),
        ("udp://:4713", "no host; write udp://0.0.0.0:4713"),
        ("tcp://h:65536", "0..65535"),
        ("tcp://h:abc", "0..65535"),
        ("tcp://fe80::1:4712", "in brackets"),
        ("tcp://[::1:4712", "in brackets"),
        ("tcp://h:1/pmu", "only tcp://HOST:PORT?key=value"),
        ("tcp://user@h:1", "only tcp://HOST:PORT?key=value"),
        ("tcp://h:1?idcod=7", "is 'idcode' meant?"),
        ("tcp://h:1?colour=red", "known: idcode"),
        ("tcp://h:1?idcode=7&idcode=8", "given twice"),
        ("tcp://h:1?idcode=", "has no value"),
        ("tcp://h:1?idcode=0", "1..65534"),
        ("tcp://h:1?idcode=65535", "1..65534"),
        ("tcp://h:1?idcode=7a", "1..65534"),
        ("udp://h:1?ttl=256", "0..255"),
        ("udp://h:1?stamps=card", "neither kernel nor hardware"),
        ("udp://h:1?source=pmu1", "not an IP address"),
        ("tcp+udp://h:1", "add ?data=PORT"),
        ("tcp+udp://h:1?data=x", "not a port"),
        ("tcp+udp://h:1?data=65536", "not a port"),
        ("udp://h:1?data=4", "belongs to tcp+udp:// only"),
    ],
)
def test_mistakes_name_the_url_and_the_remedy(url: str, hint: str) -> None:
    with pytest.raises(SettingsError) as caught:
        parse_endpoint(url)
    message = str(caught.value)
    assert message.startswith(url)
    assert hint in message
    assert "\n" not in message


@settings(deadline=None)
@given(st.text(max_size=40))
def test_any_text_is_an_endpoint_or_a_mistake(text: str) -> None:
    for url in (text, f"udp://{text}", f"tcp://h:1?{text}"):
        try:
            endpoint = parse_endpoint(url)
        except SettingsError:
            continue
        assert parse_endpoint(str(endpoint)) == endpoint


@settings(deadline=None)
@given(st.ip_addresses())
def test_multicast_is_told_by_the_data_host(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> None:
    host = f"[{address}]" if address.version == 6 else str(address)
    assert parse_endpoint(f"udp://{host}:4713").is_multicast == address.is_multicast
    assert not parse_endpoint("tcp+udp://224.0.0.1.example:1?data=2").is_multicast
    assert parse_endpoint("tcp+udp://h:1?data=239.1.1.1:2").is_multicast
