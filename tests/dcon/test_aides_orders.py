"""Signed orders through the ``gui`` loop, what it remembers across restarts, and the three loops as one process."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.modbus_device import wait_for
from support.run_folder import in_thread, is_socket, listening, send

from dcon.aides.order_gate import OrderGate, Passed
from dcon.aides.orders import GuiAide
from dcon.core.values import Order
from dcon.link.keys import SEQUENCES, add_key, read_keys
from dcon.link.orders import SignedOrder, Verifier, digest, sign
from dcon.link.paths import AIDE, CONTROL, REPLIES, WATCHDOG, Sender, bind_datagram, prepare, release
from dcon.server.desk import Desk
from pmutools.errors import SourceError
from pmutools.timebase import NS

UTC_NS = 1_800_000_000 * NS
WINDOW_S = 5.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = prepare(tmp_path / "run")
    add_key(path / "keys", "ann")
    add_key(path / "keys", "bob", ("disarm", "estop"))
    return path


def gate(folder: Path, utc_ns: int = UTC_NS - NS) -> OrderGate:
    return OrderGate(read_keys(folder / "keys"), WINDOW_S, folder, utc_ns)


def signed(folder: Path, name: str = "arm", *, who: str = "ann", time_ns: int = UTC_NS, **other: Any) -> bytes:
    order = SignedOrder(who, other.pop("sequence", time_ns), time_ns, name, **other)
    return sign(order, read_keys(folder / "keys")[who].key)


def datagram(order: bytes, reply_to: str = "") -> bytes:
    return json.dumps({"kind": "signed", "order": order.hex(), "reply_to": reply_to}).encode()


def why_not(passed: Passed) -> str:
    """Why an order was refused; "" where it was not."""
    return "" if passed.reply is None else str(passed.reply["refused"])


# --- the gate ----------------------------------------------------------------------------------------------------


def test_an_order_passes_with_all_that_it_says(folder: Path) -> None:
    order = signed(folder, "gain", value=12.0, why="more damping", text="")
    passed = gate(folder).take(datagram(order, "/somewhere"), 0, UTC_NS)
    assert passed.news == Order("gain", 12.0, "", "ann", "more damping")
    assert passed.reply is None


def test_what_is_refused_becomes_an_input_that_says_why(folder: Path) -> None:
    forged = signed(folder).replace(b'"arm"', b'"off"')
    for order, reason, who in (
        (forged, "the signature does not hold", "ann"),
        (signed(folder, "arm", who="bob"), "not allowed to this operator", "bob"),
        (signed(folder, time_ns=UTC_NS - 6 * NS), "too old", "ann"),
        (signed(folder, time_ns=UTC_NS + 6 * NS), "from the future", "ann"),
        (b"arm, please", "no signed order", ""),
    ):
        it = gate(folder)
        passed = it.take(datagram(order, "/somewhere"), 0, UTC_NS)
        assert (
            passed.reply_to == "/somewhere"
            and passed.news is not None
            and passed.news.name == "link_refused"
            and passed.news.who == who
        )
        assert reason in passed.news.text and it.refused == 1
        assert passed.reply == {"digest": digest(order), "refused": passed.news.text}


def test_no_more_than_ten_refusals_a_second_are_told_and_the_rest_is_counted(folder: Path) -> None:
    it = gate(folder)
    told = [it.take(datagram(b"x"), k * NS // 1000, UTC_NS).news for k in range(500)]
    assert sum(news is not None for news in told) == 10 and it.refused == 500
    last = it.take(datagram(b"x"), 2 * NS, UTC_NS).news
    assert last is not None and "and 490 more were refused" in last.text


def test_what_was_accepted_once_never_is_again_and_a_restart_does_not_forget(folder: Path) -> None:
    first, second = signed(folder, sequence=5), signed(folder, "disarm", sequence=6)
    it = gate(folder)
    assert why_not(it.take(datagram(second), 0, UTC_NS)) == ""
    for later in (it, gate(folder)):
        for order in (first, second):
            assert "replayed" in why_not(later.take(datagram(order), 0, UTC_NS))
    assert json.loads((folder / SEQUENCES).read_text()) == {"ann": 6}
    assert why_not(gate(folder).take(datagram(signed(folder, sequence=7)), 0, UTC_NS)) == ""


@pytest.mark.parametrize("content", [None, b"", b"{", b"[1]", b'{"ann": "6"}', b"\xff\xfe", b'{"ann": 6.0}'])
def test_with_a_file_that_is_gone_or_damaged_only_what_is_signed_from_now_on_counts(
    content: bytes | None, folder: Path
) -> None:
    gate(folder).take(datagram(signed(folder, sequence=5)), 0, UTC_NS)
    (folder / SEQUENCES).unlink()
    if content is not None:
        (folder / SEQUENCES).write_bytes(content)
    it = gate(folder, UTC_NS + NS)
    assert "replayed" in why_not(it.take(datagram(signed(folder, sequence=5)), 0, UTC_NS + NS))
    assert why_not(it.take(datagram(signed(folder, sequence=5, time_ns=UTC_NS + NS + 1)), 0, UTC_NS + NS)) == ""
    assert json.loads((folder / SEQUENCES).read_text()) == {"ann": 5}


def test_where_nothing_can_be_written_orders_pass_and_no_old_file_stays(folder: Path) -> None:
    it = gate(folder)
    assert why_not(it.take(datagram(signed(folder, sequence=5)), 0, UTC_NS)) == ""
    (folder / f"{SEQUENCES}.new").mkdir()
    assert why_not(it.take(datagram(signed(folder, "estop", sequence=6)), 0, UTC_NS)) == ""
    assert not (folder / SEQUENCES).exists()


@given(
    st.one_of(
        st.binary(max_size=200), st.recursive(st.none() | st.text(max_size=9), st.lists, max_leaves=4).map(json.dumps)
    )
)
@settings(max_examples=50)
def test_other_datagrams_are_counted(data: bytes | str) -> None:
    it = OrderGate({}, WINDOW_S, Path("/nowhere"), UTC_NS)
    assert it.take(data if isinstance(data, bytes) else data.encode(errors="replace"), 0, UTC_NS).news is None
    assert it.malformed == 1


def test_without_keys_nobody_can_order(folder: Path) -> None:
    passed = OrderGate({}, WINDOW_S, folder, UTC_NS - NS).take(datagram(signed(folder)), 0, UTC_NS)
    assert why_not(passed) == "unknown operator"


# --- the loop ----------------------------------------------------------------------------------------------------


@pytest.mark.realtime
def test_the_loop_passes_on_and_replies_within_the_folder_only(folder: Path, tmp_path: Path) -> None:
    with listening(folder, WATCHDOG, CONTROL, "server.reply") as (watchdog, control, server):
        aide = GuiAide(gate(folder, time.time_ns()), folder)
        elsewhere = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        elsewhere.bind(str(tmp_path / "elsewhere"))
        elsewhere.setblocking(False)
        with elsewhere, in_thread(aide.run, aide.stop):
            now = time.time_ns()
            send(folder, AIDE, b"nonsense")
            send(folder, AIDE, datagram(signed(folder, time_ns=now)))
            for away in ("elsewhere", "run/../elsewhere"):
                send(folder, AIDE, datagram(signed(folder, time_ns=now), str(tmp_path / away)))
            send(folder, AIDE, datagram(signed(folder, time_ns=now), str(folder / "server.reply")))
            wait_for(lambda: len(control.said("order")) == 4 and server.heard)
            assert [news["name"] for news in control.said("order")] == ["arm", *3 * ["link_refused"]]
            assert json.loads(server.heard[0][1])["refused"].startswith("replayed")
            with pytest.raises(BlockingIOError):
                elsewhere.recv(100)
            assert aide.gate.malformed == 1
            wait_for(lambda: len(watchdog.beats("gui")) > 5)
        with pytest.raises(FileNotFoundError):
            send(folder, AIDE, b"")


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("place", "malformed"),
    [
        ("\0/a", 1),
        ("{folder}/\0/a", 1),
        ("\ud800/a", 1),
        ("{folder}/\udfff", 1),
        ("{folder}/ring/a", 1),
        ("{folder}", 0),
    ],
)
def test_an_order_counts_whose_answer_can_go_nowhere(place: str, malformed: int, folder: Path) -> None:
    (folder / "ring").symlink_to(folder / "ring")
    with listening(folder, CONTROL) as (control,):
        aide = GuiAide(gate(folder, time.time_ns()), folder)
        with in_thread(aide.run, aide.stop):
            order = signed(folder, "estop", time_ns=time.time_ns())
            for _ in range(2):  # the second is a replay, and would be answered at once
                send(folder, AIDE, datagram(order, place.format(folder=folder)))
            send(folder, AIDE, datagram(signed(folder, "disarm", time_ns=time.time_ns())))
            wait_for(lambda: len(control.said("order")) == 3)
        assert aide.failure == "" and aide.gate.malformed == malformed
        assert [news["name"] for news in control.said("order")] == ["estop", "link_refused", "disarm"]


@pytest.mark.realtime
def test_the_server_hears_why_an_order_of_its_operator_was_refused(folder: Path) -> None:
    operators = read_keys(folder / "keys")
    with listening(folder, CONTROL, REPLIES) as (control, replies):
        aide = GuiAide(gate(folder, time.time_ns()), folder)
        desk = Desk(folder, dict, Verifier(operators))
        desk.reply_to = str(folder / REPLIES)
        with in_thread(aide.run, aide.stop):
            order = signed(folder, time_ns=time.time_ns())
            for asker in ("first", "second"):
                ask = json.dumps({"signed": order.decode()}).encode()
                assert desk.ask(asker, ask, utc_ns=time.time_ns(), now_ns=time.monotonic_ns()) is None
            wait_for(lambda: replies.heard)
            assert len(control.said("order")) == 2
            (answer,) = desk.reply(replies.heard[0][1])[:1]
        desk.close()
    assert "replayed" in json.dumps(answer)


@pytest.mark.realtime
def test_an_order_for_which_the_controller_has_no_room_is_tried_again_then_refused(folder: Path) -> None:
    control = bind_datagram(folder, CONTROL)
    filler = Sender(folder / CONTROL)
    with listening(folder, WATCHDOG, REPLIES) as (_, replies):
        aide = GuiAide(gate(folder, time.time_ns()), folder)
        with in_thread(aide.run, aide.stop):
            while filler.send(b"a status"):
                pass
            send(folder, AIDE, datagram(signed(folder, time_ns=time.time_ns()), str(folder / REPLIES)))
            wait_for(lambda: len(aide.handing) == 1)
            taken: list[bytes] = []

            def came() -> bool:
                with suppress(BlockingIOError):
                    taken.append(control.recv(1 << 16))
                return taken[-1:] != [] and b'"arm"' in taken[-1]

            wait_for(came)
            assert replies.heard == []
            while filler.send(b"a status"):
                pass
            late = signed(folder, "disarm", time_ns=time.time_ns())
            send(folder, AIDE, datagram(late, str(folder / REPLIES)))
            wait_for(lambda: replies.heard)
    assert json.loads(replies.heard[0][1]) == {"digest": digest(late), "refused": "the controller did not take it"}
    filler.close()
    release(control)


@pytest.mark.realtime
def test_a_flood_of_forged_orders_delays_no_beat(folder: Path) -> None:
    with listening(folder, WATCHDOG, CONTROL) as (watchdog, control):
        aide = GuiAide(gate(folder, time.time_ns()), folder)
        forged = datagram(signed(folder, time_ns=time.time_ns())[:-10] + b'00000000"}')
        with in_thread(aide.run, aide.stop):
            end = time.monotonic() + 1
            while time.monotonic() < end:
                send(folder, AIDE, forged)
            wait_for(lambda: len(watchdog.beats("gui")) >= 8)
        assert aide.gate.refused > 500
        assert len(control.said("order")) <= 10 * 3


# --- the process -------------------------------------------------------------------------------------------------


def write_ini(folder: Path, extra: str = "") -> Path:
    ini = folder / "dcon.ini"
    ini.write_text(
        "[pmu A]\nurl = udp://127.0.0.1:1\nside = north\n[pmu B]\nurl = udp://127.0.0.1:2\nside = south\n"
        f"[server]\nkeys = {folder}/keys\n[platform]\ntime_source = kernel\n{extra}"
    )
    return ini


@contextmanager
def process(ini: Path, folder: Path) -> Iterator[subprocess.Popen[str]]:
    arguments = ["-m", "dcon.aides", "--ini", str(ini), "--run-dir", str(folder)]
    started = subprocess.Popen([sys.executable, *arguments], stderr=subprocess.PIPE, text=True)
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


@pytest.mark.realtime
def test_three_loops_in_one_process(folder: Path) -> None:
    with listening(folder, WATCHDOG, CONTROL) as (watchdog, control), process(write_ini(folder), folder) as aides:
        wait_for(lambda: all(len(watchdog.beats(name)) > 3 for name in ("gps", "gui", "pdci")), 20)
        send(folder, AIDE, datagram(signed(folder, time_ns=time.time_ns(), why="trial")))
        wait_for(lambda: control.said("order") and control.said("gps"))
        assert control.said("order")[0]["why"] == "trial"
        assert control.said("gps")[0]["source"] == "kernel"
        aides.send_signal(signal.SIGTERM)
        assert aides.wait(10) == 0
        assert all(watchdog.beats(name)[-1][2] == 2 for name in ("gps", "gui", "pdci"))
        assert not (folder / AIDE).exists()


@pytest.mark.realtime
def test_a_second_process_or_a_wrong_setting_is_one_line(folder: Path) -> None:
    ini = write_ini(folder)
    with process(ini, folder) as aides:
        wait_for(lambda: is_socket(folder / AIDE), 20)
        with process(ini, folder) as second:
            _, said = second.communicate(timeout=20)
            assert second.returncode == 1
            assert said.startswith(f"aides: {folder / AIDE}: another process") and said.count("\n") == 1
        assert aides.poll() is None
    (folder / "keys").chmod(0o644)
    with process(ini, folder) as wrong:
        _, said = wrong.communicate(timeout=20)
        assert wrong.returncode == 1 and said.startswith("aides: ") and "chmod 600" in said and said.count("\n") == 1


@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a child of its parent's end")
def test_it_ends_with_its_parent(folder: Path) -> None:
    ini = write_ini(folder)
    launch = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-m', 'dcon.aides', *sys.argv[1:]])\n"
        "print(child.pid, flush=True)\ntime.sleep(60)\n"
    )
    arguments = ["--ini", str(ini), "--run-dir", str(folder)]
    with subprocess.Popen([sys.executable, "-c", launch, *arguments], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        wait_for(lambda: is_socket(folder / AIDE), 20)
        parent.kill()
        wait_for(lambda: not _alive(child))


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_taken_port_of_the_line_frees_what_was_taken_before(folder: Path) -> None:
    from dcon.aides.crew import aides as make
    from dcon.settings import load

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        ini = write_ini(folder, f"[pdci]\nurl = udp://127.0.0.1:{other.getsockname()[1]}\n")
        with pytest.raises(SourceError, match="already in use"):
            make(load(ini), folder)
    assert not os.path.lexists(folder / AIDE)
