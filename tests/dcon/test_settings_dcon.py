"""The initialisation file: what it says is in force, and every mistake in it is one line that says where."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dcon.cli import dcon
from dcon.core.params import Pair, Params, Required, Thresholds
from dcon.effective import effective
from dcon.places import IioPlace
from dcon.settings import load, parse
from pmutools.cli.shell import run
from pmutools.errors import SettingsError, SourceError
from pmutools.net.endpoint import Endpoint

GOOD = """\
[DEFAULT]
rate = 60
voltage = VA,VB,VC
nominal_kv = 500
[pmu N1]
url = udp://0.0.0.0:4801?source=192.0.2.11
idcode = 101
side = north
[pmu N2]
url = udp://0.0.0.0:4802
side = north
voltage = V1LPM
[pmu S1]
url = tcp://192.0.2.21:4712
idcode = 201
station = SOUTH ONE
side = south
[pmu S2]
url = tcp://192.0.2.21:4712?idcode=201
station = SOUTH TWO
side = south
[pmu X]
url = udp://0.0.0.0:4803
nominal_kv = 230 ; recorded only
[controller]
gain_mw_per_mhz = 12
align = true
[supervisor]
gap_ms = 60
[platform]
phase_ms = 4.5
[watchdog]
[server]
[output]
url = udp://192.0.2.30:4790
[pdci]
[log]
path = /var/log/dcon.mcap
"""

PAIR = "[pmu N1]\nurl = udp://h:1\nside = north\n[pmu S1]\nurl = udp://h:2\nside = south\n"


def test_what_the_file_says_is_in_force() -> None:
    settings = parse(GOOD, "dcon.ini")
    params = settings.params
    assert (params.gain_mw_per_mhz, params.deadband_mhz, params.rate_hz, params.align) == (12.0, 0.25, 60, True)
    assert params.instance_names == ("N1-S1", "N1-S2", "N2-S1", "N2-S2")
    assert params.thresholds.gap_ms == 60
    assert [pmu.nominal_kv for pmu in params.pmus] == [500, 500, 500, 500, 230]
    assert [site.voltage for site in settings.sites][:2] == [("VA", "VB", "VC"), ("V1LPM",)]
    assert [site.stream for site in settings.sites] == [101, None, 201, 201, None]
    assert settings.sites[0].url.source == "192.0.2.11"
    assert (settings.platform.phase_ms, settings.platform.fifo) == (4.5, True)
    assert str(settings.output.url) == "udp://192.0.2.30:4790"
    assert settings.log.path == "/var/log/dcon.mcap"
    assert settings.text == GOOD


def test_outputs_and_the_line_have_urls() -> None:
    text = GOOD.replace(
        "url = udp://192.0.2.30:4790", "url = iio:///sys/bus/iio/devices/iio:device0?readback=1\nhold_ms = 50"
    )
    settings = parse(text.replace("[pdci]", "[pdci]\nurl = udp://0.0.0.0:4791?source=192.0.2.31\nrequired = yes"), "x")
    assert isinstance(settings.output.url, IioPlace) and settings.output.url.keys.readback == 1
    assert settings.output.hold_ms == 50 and settings.params.required.line
    assert isinstance(settings.line_input.url, Endpoint) and settings.line_input.url.source == "192.0.2.31"
    assert ("pdci", "url", "udp://0.0.0.0:4791?source=192.0.2.31") in [row[:3] for row in effective(settings)]
    assert ("platform", "time_source", "auto") in [row[:3] for row in effective(settings)]
    assert parse(GOOD, "x").line_input.url is None


def test_defaults_are_those_of_the_controller() -> None:
    text = "[pmu A]\nurl = udp://h:1\nside = north\n[pmu B]\nurl = udp://h:2\nside = south\n"
    settings = parse(text, "dcon.ini")
    assert settings.params.thresholds == Thresholds()
    assert settings.params == Params(settings.params.pmus, (Pair(0, 1),), required=Required(line=True))
    assert settings.output.url is None


def test_a_priority_orders_the_instances() -> None:
    settings = parse(GOOD.replace("align = true", "priority = N2-S2, N1-S1"), "dcon.ini")
    assert settings.params.instance_names == ("N2-S2", "N1-S1")
    assert settings.params.instances == (Pair(1, 3), Pair(0, 2))


def test_names_with_hyphens_pair_where_that_is_unambiguous() -> None:
    text = GOOD.replace("[pmu N1]", "[pmu N-1]").replace("[pmu S1]", "[pmu S-1]")
    settings = parse(text.replace("align = true", "priority = N-1-S-1"), "dcon.ini")
    assert settings.params.instances == (Pair(0, 2),)


def test_other_rates_than_60() -> None:
    settings = parse(GOOD.replace("rate = 60", "rate = 30"), "dcon.ini")
    assert settings.params.rate_hz == 30 and settings.params.coefficients.rate_hz == 30


MISTAKES = {
    "thresholds that exclude each other": (
        "gap_ms = 60",
        "voltage_max_pu = 0.7",
        "dcon.ini:29: [supervisor] voltage_max_pu: voltage_min_pu = 0.8: must be below voltage_max_pu = 0.7",
    ),
    "an unknown signal": (
        "[watchdog]",
        "[watchdog]\n[probing]\nkind = sine",
        "dcon.ini:34: [probing] kind: 'sine' is not one of none, square, multisine, chirp, file",
    ),
    "a signal from a file that is not given": (
        "[watchdog]",
        "[watchdog]\n[probing]\nkind = file",
        "dcon.ini:34: [probing] kind: file: no samples; give file = NAME.csv",
    ),
    "a signal from a file that is not there": (
        "[watchdog]",
        "[watchdog]\n[probing]\nkind = file\nfile = /nowhere/x.csv",
        "dcon.ini:35: [probing] file: /nowhere/x.csv: No such file",
    ),
    "frequencies of a signal the wrong way round": (
        "[watchdog]",
        "[watchdog]\n[probing]\nlow_hz = 6",
        "dcon.ini:34: [probing] low_hz: 6: must be below high_hz = 5",
    ),
    "an output without its device": (
        "url = udp://192.0.2.30:4790",
        "url = iio://device0",
        "dcon.ini:35: [output] url: iio://device0: write three slashes and the device's folder",
    ),
    "an output with a register that there cannot be": (
        "url = udp://192.0.2.30:4790",
        "url = modbus://192.0.2.30?register=65536",
        "dcon.ini:35: [output] url: modbus://192.0.2.30? register: 65536 is out of range; it must be 0 to 65535",
    ),
    "an output that is held for too long": (
        "[output]",
        "[output]\nhold_ms = 5000",
        "dcon.ini:35: [output] hold_ms: 5000 is out of range; it must be 20 to 1000",
    ),
    "a source of the line's status that tells none": (
        "[pdci]",
        "[pdci]\nurl = tcp://192.0.2.31:4791",
        "dcon.ini:37: [pdci] url: tcp://192.0.2.31:4791: the line's status comes by udp://HOST:PORT",
    ),
    "an unknown key of the line": ("[pdci]", "[pdci]\nrating = 1", "dcon.ini:37: [pdci] rating: unknown key; "),
    "an unknown source of time": (
        "phase_ms = 4.5",
        "time_source = ntp",
        "dcon.ini:31: [platform] time_source: 'ntp' is not one of auto, kernel, chrony, gpsd, ptp, none",
    ),
    "a rating below nothing": ("[pdci]", "[pdci]\nrating_ns_mw = -1", "dcon.ini:37: [pdci] rating_ns_mw: -1 is out of"),
    "an unknown section": ("[log]", "[logg]", "dcon.ini:37: [logg]: unknown section; did you mean 'log'?"),
    "an unknown key of the controller": (
        "align = true",
        "gain = 12",
        "dcon.ini:27: [controller] gain: unknown key; ",
    ),
    "an unknown key of a PMU": ("side = south", "sid = south", "dcon.ini:17: [pmu S1] sid: unknown key; did you mean"),
    "an unknown check": ("gap_ms", "gap_s", "dcon.ini:29: [supervisor] gap_s: unknown key; did you mean 'gap_ms'?"),
    "a key of a section that has none yet": (
        "[watchdog]",
        "[watchdog]\ntimeout_ms = 100",
        "dcon.ini:33: [watchdog] timeout_ms: unknown key",
    ),
    "a unit in a value": ("gap_ms = 60", "gap_ms = 60 ms", "dcon.ini:29: [supervisor] gap_ms: '60 ms' is not a number"),
    "not a number": ("= 4.5", "= nan", "dcon.ini:31: [platform] phase_ms: 'nan' is not a finite number"),
    "neither yes nor no": ("= true", "= maybe", "dcon.ini:27: [controller] align: 'maybe' is neither yes nor no"),
    "a threshold out of range": (
        "gap_ms = 60",
        "voltage_max_pu = 3",
        "dcon.ini:29: [supervisor] voltage_max_pu: 3 is out of range; it must be 0 to 2",
    ),
    "a gain out of range": (
        "gain_mw_per_mhz = 12",
        "gain_mw_per_mhz = 16",
        "dcon.ini:26: [controller] gain_mw_per_mhz: 16 MW/mHz is above gain_max_mw_per_mhz = 15; 9 to 15 are usable",
    ),
    "a largest gain below the default": (
        "gain_mw_per_mhz = 12",
        "gain_max_mw_per_mhz = 5",
        "dcon.ini:26: [controller] gain_max_mw_per_mhz: 9 MW/mHz is above gain_max_mw_per_mhz = 5",
    ),
    "a negative gain": ("= 12", "= -1", "dcon.ini:26: [controller] gain_mw_per_mhz: -1 is out of range; "),
    "a limit above the line's": ("align = true", "limit_mw = 200", "dcon.ini:27: [controller] limit_mw: 200 is out"),
    "a section given twice": ("[pmu N2]", "[pmu N1]", "dcon.ini:9: [pmu N1]: section given twice, first on line 5"),
    "a key given twice": ("side = north\n[pmu N2]", "url = udp://h:1\n[pmu N2]", "dcon.ini:8: [pmu N1] url: key given"),
    "no url": (
        "url = udp://0.0.0.0:4802\n",
        "",
        "dcon.ini:9: [pmu N2]: url is missing; add a line 'url = ...'",
    ),
    "a url without a scheme": (
        "udp://0.0.0.0:4802",
        "0.0.0.0:4802",
        "dcon.ini:10: [pmu N2] url: 0.0.0.0:4802: no endpoint URL; write tcp://0.0.0.0:4802",
    ),
    "a url without a port": ("udp://0.0.0.0:4802", "udp://h", "dcon.ini:10: [pmu N2] url: udp://h: no port; "),
    "an output that is no datagram": (
        "udp://192.0.2.30:4790",
        "tcp://192.0.2.30:4790",
        "dcon.ini:35: [output] url: tcp://192.0.2.30:4790: commands leave as udp://HOST:PORT, iio://FOLDER or",
    ),
    "an IDCODE that cannot be": ("idcode = 101", "idcode = 70000", "dcon.ini:7: [pmu N1] idcode: 70000 is out of"),
    "two IDCODEs": (
        "station = SOUTH TWO",
        "idcode = 202\nstation = SOUTH TWO",
        "dcon.ini:20: [pmu S2] idcode: 202, but the url says 201; keep one",
    ),
    "two PMUs of one stream": (
        "station = SOUTH TWO",
        "station = SOUTH ONE",
        "dcon.ini:18: [pmu S2]: tcp://192.0.2.21:4712?idcode=201 gives it the frames of S1 too; tell the two apart by",
    ),
    "two PMUs that share a port": (
        "udp://0.0.0.0:4802",
        "udp://0.0.0.0:4801",
        "dcon.ini:9: [pmu N2]: udp://0.0.0.0:4801 gives it the frames of N1 too; tell the two apart by idcode, ",
    ),
    "a side that is none": ("side = south", "side = west", "dcon.ini:17: [pmu S1] side: 'west' is not one of north, "),
    "two channels for V1": (
        "voltage = V1LPM",
        "voltage = VA,VB",
        "dcon.ini:12: [pmu N2] voltage: 'VA,VB' is neither one positive-sequence channel nor three phases VA,VB,VC",
    ),
    "different rates": (
        "voltage = V1LPM",
        "rate = 30",
        "dcon.ini:12: [pmu N2] rate: 30 frames/s, but N1 has 60; the controller needs one rate",
    ),
    "a rate that the filter cannot have": (
        "rate = 60",
        "rate = 5",
        "dcon.ini:2: [DEFAULT] rate: 5 is not one of 30, 50, 60, 100, 120 frames/s",
    ),
    "a pair of unknown PMUs": (
        "align = true",
        "priority = N1-S1,N1-S9",
        "dcon.ini:27: [controller] priority: 'N1-S9' is no pair NORTH-SOUTH of PMUs; there are N1, N2, S1, S2, X",
    ),
    "a pair the wrong way round": (
        "align = true",
        "priority = S1-N1",
        "dcon.ini:27: [controller] priority: 'S1-N1': S1 must have side = north and N1 side = south",
    ),
    "a pair with a PMU of no side": (
        "align = true",
        "priority = N1-X",
        "dcon.ini:27: [controller] priority: 'N1-X': N1 must have side = north and X side = south",
    ),
    "a pair listed twice": (
        "align = true",
        "priority = N1-S1,N2-S1,N1-S1",
        "dcon.ini:27: [controller] priority: 'N1-S1' is listed twice; keep the first",
    ),
    "an empty priority": ("align = true", "priority =", "dcon.ini:27: [controller] priority: lists no pair; "),
    "an empty item": ("align = true", "priority = N1-S1,,N2-S1", "dcon.ini:27: [controller] priority: 'N1-S1,,N2-S1' "),
    "no north": ("side = north", "side = none", "dcon.ini: no PMU has side = north; add that line to at least one"),
    "operators without a port": (
        "[server]",
        "[server]\nlisten = 127.0.0.1",
        "dcon.ini:34: [server] listen: ",
    ),
    "operators over UDP": (
        "[server]",
        "[server]\nlisten = udp://127.0.0.1:4790",
        "dcon.ini:34: [server] listen: udp://127.0.0.1:4790: operators connect over TCP; write HOST:PORT,",
    ),
    "operators at a port": (
        "[server]",
        "[server]\nlisten = 4790",
        "dcon.ini:34: [server] listen: 4790: operators connect over TCP; write HOST:PORT, as in 127.0.0.1:4790;",
    ),
    "commands by another scheme": (
        "url = udp://192.0.2.30:4790",
        "url = http://x",
        "dcon.ini:35: [output] url: http://x: commands leave as udp://HOST:PORT, iio://FOLDER or modbus://HOST:PORT",
    ),
    "commands without a port": (
        "url = udp://192.0.2.30:4790",
        "url = udp://x",
        "dcon.ini:35: [output] url: udp://x: commands leave as udp://HOST:PORT, iio://FOLDER or modbus://HOST:PORT",
    ),
    "a key of the line that is none": (
        "[pdci]",
        "[pdci]\nfrom = x",
        "dcon.ini:37: [pdci] from: unknown key; known: url, required, rating_ns_mw,",
    ),
    "orders that never grow old": (
        "[server]",
        "[server]\nwindow_s = 3600",
        "dcon.ini:34: [server] window_s: 3600 is out of range; it must be 0.1 to 60",
    ),
    "no backfill": (
        "[log]",
        "[log]\nbackfill_s = 0",
        "dcon.ini:38: [log] backfill_s: 0 is out of range; it must be 1 to 3600",
    ),
    "a line that is nothing": ("align = true", "align", "dcon.ini:27: 'align' is neither [section] nor key = value"),
}


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_one_line_that_says_where_and_what_to_do(
    old: str,
    new: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, -1 if new == "side = none" else 1)
    monkeypatch.chdir(tmp_path)
    Path("dcon.ini").write_text(text)
    assert run(dcon(), ["check", "--ini", "dcon.ini"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"dcon: {message}")
    assert err.count("\n") == 1


CLASHES = {
    "a warning after what it warns of": ("supervisor", "latency_warn_ms=300", "latency_warn_ms: 300: must be below"),
    "the same from the other side": (
        "supervisor",
        "latency_max_ms=80",
        "latency_max_ms: latency_warn_ms = 90: must be",
    ),
    "a warning as late": (
        "supervisor",
        "latency_warn_ms=200",
        "latency_warn_ms: 200: must be below latency_max_ms = 200",
    ),
    "late frames too old to align": (
        "supervisor",
        "alignment_age_ms=80",
        "alignment_age_ms: latency_warn_ms = 90: must",
    ),
    "always too early": ("supervisor", "latency_min_ms=0\nlatency_warn_ms=0", "latency_min_ms: 0: must be below"),
    "a time to warn after that to disable": (
        "supervisor",
        "freq_warn_s=5",
        "freq_warn_s: 5: must be below freq_disable_s",
    ),
    "no voltage is right": (
        "supervisor",
        "voltage_min_pu=1.3",
        "voltage_min_pu: 1.3: must be below voltage_max_pu = 1.2",
    ),
    "no band of ringing": ("supervisor", "ringing_low_hz=9", "ringing_low_hz: 9: must be below ringing_high_hz = 8"),
    "no band of swings": ("supervisor", "growth_high_hz=0.2\ngrowth_low_hz=0.3", "growth_low_hz: 0.3: must be below"),
    "no response is right": ("supervisor", "response_gain_max=1\nresponse_gain_min=1", "response_gain_min: 1: must be"),
    "a band above half the ticks": ("supervisor", "ringing_high_hz=40", "ringing_high_hz: 40: at most 24 Hz, 0.4 of"),
    "a band too near it": (
        "supervisor",
        "ringing_high_hz=24.1",
        "ringing_high_hz: 24.1: at most 24 Hz, 0.4 of tick_hz = 60",
    ),
    "ticks too slow for a band": (
        "controller",
        "tick_hz=10",
        "tick_hz: ringing_high_hz = 8: at most 4 Hz, 0.4 of tick_hz",
    ),
    "more late ticks than there are": (
        "controller",
        "tick_hz=20\n[supervisor]\noverruns_max=20",
        "overruns_max: 20: must be below tick_hz = 20",
    ),
    "an age below a frame period": (
        "supervisor",
        "alignment_age_ms=16\nlatency_warn_ms=15",
        "alignment_age_ms: 16: must be above the 16.7 ms from frame to frame",
    ),
    "a deadband that nothing leaves": (
        "controller",
        "deadband_mhz=100\n[supervisor]\ndelta_f_max_mhz=100",
        "deadband_mhz",
    ),
    "a nominal frequency between": ("controller", "nominal_hz=55", "nominal_hz: 55: C37.118 has 50 and 60 Hz only"),
    "a minimum above the rating": ("pdci", "minimum_mw=5000", "minimum_mw: 5000: must be below rating_ns_mw = 3220"),
    "a rating below the minimum": (
        "pdci",
        "rating_sn_mw=300",
        "rating_sn_mw: minimum_mw = 310: must be below rating_sn",
    ),
    "no room for the command": (
        "pdci",
        "minimum_mw=3000",
        "minimum_mw: 3000: leaves 220 MW below the rating, but ±limit_mw needs 250",
    ),
    "a line without a rating": (
        "pdci",
        "rating_ns_mw=0\nrating_sn_mw=0",
        "rating_ns_mw: minimum_mw = 310: leaves -310 MW",
    ),
    "a signal above half the ticks": (
        "controller",
        "tick_hz=20\n[probing]\nkind=chirp\nhigh_hz=10",
        "high_hz: 10: must be below half of 20 ticks/s",
    ),
    "a pulse above half the ticks": (
        "controller",
        "tick_hz=20\n[probing]\nkind=square\nfrequency_hz=10",
        "frequency_hz: 10: must be below half of 20 ticks/s",
    ),
    "a signal that would be clipped": (
        "controller",
        "limit_mw=15\n[probing]\nkind=square",
        "limit_mw: amplitude_mw = 20: above limit_mw = 15, the signal would be clipped",
    ),
    "a pulse of days": (
        "probing",
        "kind=square\ncycles=1000\nfrequency_hz=0.01",
        "cycles: 1000: at frequency_hz = 0.01",
    ),
    "a tone without a whole cycle": (
        "probing",
        "kind=multisine\nperiod_s=5",
        "period_s: low_hz = 0.1: no whole cycle in",
    ),
    "no voltage is right below nominal": ("supervisor", "voltage_min_pu=1", "voltage_min_pu: 1: must be below 1, or"),
    "no voltage is right above nominal": ("supervisor", "voltage_max_pu=1", "voltage_max_pu: 1: must be above 1, or"),
    "a share that cannot be": (
        "supervisor",
        "saturation_max_percent=100",
        "saturation_max_percent: 100: must be below 100",
    ),
    "ringing where the mode is": ("supervisor", "ringing_low_hz=1", "ringing_low_hz: 1: must be above 1 Hz, the band"),
    "a phase of a whole tick": (
        "platform",
        "phase_ms=16.7",
        "phase_ms: 16.7: must be below the 16.7 ms from tick to tick",
    ),
    "ticks as short as the phase": (
        "controller",
        "tick_hz=250\n[platform]\nphase_ms=4",
        "phase_ms: 4: must be below the 4.0 ms from tick to tick",
    ),
    "a period that does not come whole": (
        "probing",
        "kind=multisine\nduration_s=39",
        "duration_s: period_s = 40: above duration_s = 39",
    ),
    "ramps longer than the signal": (
        "probing",
        "kind=chirp\nduration_s=1",
        "duration_s: ramp_s = 1: more than half of",
    ),
}
"""(section, its keys, what is said of the line of the last key but for section and place)."""


@pytest.mark.parametrize(("section", "keys", "message"), CLASHES.values(), ids=CLASHES)
def test_settings_that_clash_are_said_of_a_key(section: str, keys: str, message: str) -> None:
    text = f"{PAIR}[{section}]\n{keys}\n"
    with pytest.raises(SettingsError) as caught:
        parse(text, "dcon.ini")
    said = str(caught.value)
    key = message.partition(":")[0]
    line = next(number for number, one in enumerate(text.split("\n"), 1) if one.startswith(f"{key}="))
    assert said.startswith(f"dcon.ini:{line}: [") and f"] {message}" in said and "\n" not in said


def test_a_clash_over_the_file_is_said_of_what_was_changed() -> None:
    with pytest.raises(SettingsError, match=r"^--set: \[supervisor\] latency_warn_ms: 300: must be below"):
        parse(PAIR, "dcon.ini", ("supervisor.latency_warn_ms=300",))


def test_a_line_that_goes_one_way_only() -> None:
    assert parse(f"{PAIR}[pdci]\nrating_sn_mw = 0\n", "dcon.ini").params.line.rating_sn_mw == 0


@pytest.mark.parametrize("command", ["check", "platform"])
def test_only_simulations_and_replays_go_beyond_a_gain_of_15(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "dcon.ini"
    text = f"{PAIR}[controller]\ngain_mw_per_mhz = 9\ngain_max_mw_per_mhz = {{}}\n"
    path.write_text(text.format("15.5"))
    assert run(dcon(), [command, "--ini", str(path)]) == 2
    said = ":9: [controller] gain_max_mw_per_mhz: 15.5 MW/mHz is above 15; only simulations and replays go beyond it"
    assert said in capsys.readouterr().err
    path.write_text(text.format("15"))
    load(path)
    assert parse(text.format("100"), "log").params.gain_max_mw_per_mhz == 100


@pytest.mark.parametrize("name", ["N,1", "N 1", "N(1"])
def test_a_name_that_no_priority_could_list(name: str) -> None:
    text = PAIR.replace("[pmu N1]", f"[pmu {name}]")
    with pytest.raises(
        SettingsError, match=r"^dcon.ini:1: \[pmu N.1\]: the name of a PMU with a side has no space, comma"
    ):
        parse(text, "dcon.ini")
    recorded = f"[pmu {name}]\nurl = udp://h:3\n{PAIR}"
    assert parse(recorded, "dcon.ini").params.instance_names == ("N1-S1",)


def test_a_change_of_the_defaults_says_where_to_make_it() -> None:
    with pytest.raises(
        SettingsError, match=r"^--set: \[DEFAULT\] rate: is merged into each \[pmu NAME\]; change it there"
    ):
        parse(GOOD, "dcon.ini", ("DEFAULT.rate=30",))


def test_a_file_without_pmus() -> None:
    with pytest.raises(SettingsError, match=r"^dcon.ini: no \[pmu NAME\] section; add one for each PMU$"):
        parse("[controller]\ngain_mw_per_mhz = 9\n", "dcon.ini")


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00[", "folder"])
def test_a_file_that_cannot_be_read_fails_in_one_line(
    content: bytes | str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "dcon.ini"
    if content == "folder":
        path.mkdir()
    elif isinstance(content, bytes):
        path.write_bytes(content)
    for command in ("check", "platform"):
        assert run(dcon(), [command, "--ini", str(path)]) == 1
        err = capsys.readouterr().err
        assert err.startswith(f"dcon: {path}: ") and err.count("\n") == 1
    with pytest.raises(SourceError):
        load(path)


def test_changes_lie_over_the_file_and_know_where_they_come_from() -> None:
    settings = parse(GOOD, "dcon.ini", ("controller.gain_mw_per_mhz=9", "pmu N1.nominal_kv=345", "platform.fifo=no"))
    assert settings.params.gain_mw_per_mhz == 9.0
    assert settings.params.pmus[0].nominal_kv == 345
    assert not settings.platform.fifo
    for change, message in {
        "controller.gain_mw_per_mhz": "is not SECTION.KEY=VALUE",
        "controller.gain_mw_per_mhz=99": r"--set: \[controller\] gain_mw_per_mhz: 99 MW/mHz is above",
        "nowhere.gain=9": r"\[nowhere\]: unknown section",
    }.items():
        with pytest.raises(SettingsError, match=message):
            parse(GOOD, "dcon.ini", (change,))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("mw\n1\n", "no column 'probe_mw'; there are mw: set column"),
        ("", "no column 'probe_mw'; there are none: set column"),
        ("probe_mw\n1\n126\n", ":3: 126 is out of range; it must be -125 to 125"),
        ("probe_mw\n1\nnan\n", ":3: 'nan' is not a finite number"),
        ("t,probe_mw\n1\n", ":2: '' is not a number"),
    ],
)
def test_a_probing_file_with_a_mistake_names_its_line(content: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "probe.csv"
    path.write_text(content)
    with pytest.raises(SettingsError) as caught:
        parse(f"{GOOD}[probing]\nkind = file\nfile = {path}\n", "dcon.ini")
    assert str(caught.value).startswith(f"dcon.ini:41: [probing] file: {path}") and message in str(caught.value)


def test_a_probing_signal_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "probe.csv"
    path.write_text("t,mw\n0,1.5\n1,-2\n")
    text = f"{GOOD}[probing]\nkind = file\nfile = {path}\ncolumn = mw\n"
    settings = parse(text, "dcon.ini")
    assert settings.params.waveform.samples == (1.5, -2.0) and settings.probe_file == path.read_bytes()
    path.unlink()
    assert parse(text, "log", probe_file=settings.probe_file).params == settings.params


def test_check_prints_every_setting_with_unit_default_and_source(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "dcon.ini"
    path.write_text(GOOD.replace("align = true", "align = true\ndeadband_mhz = 0"))
    assert run(dcon(), ["check", "--ini", str(path)]) == 0
    text = capsys.readouterr().out
    for line in (
        "[pmu S1] url = tcp://192.0.2.21:4712   (initialisation file)",
        "[pmu S1] idcode = 201   (initialisation file; default not set)",
        "[pmu S1] station = SOUTH ONE   (initialisation file; default not set)",
        "[pmu S1] voltage = VA,VB,VC   (initialisation file)",
        "[pmu N2] voltage = V1LPM   (initialisation file; default VA,VB,VC)",
        "[pmu N2] rate = 60 frames/s   (initialisation file)",
        "[pmu X] nominal_kv = 230 kV   (initialisation file; default not set)",
        "[controller] gain_mw_per_mhz = 12 MW/mHz   (initialisation file; default 9 MW/mHz)",
        "[controller] deadband_mhz = 0 mHz   (initialisation file; default 0.25 mHz)",
        "[controller] limit_mw = 125 MW   (section I)",
        "[controller] align = true   (initialisation file)",
        "[controller] priority = N1-S1,N1-S2,N2-S1,N2-S2   (own choice)",
        "[supervisor] gap_ms = 60 ms   (initialisation file; default 50 ms)",
        "[platform] phase_ms = 4.5 ms   (initialisation file; default 4 ms)",
        "[watchdog] required = false   (own choice)",
        "[output] url = udp://192.0.2.30:4790   (initialisation file; default not set)",
        "[log] max_mb = 1000 MB   (own choice)",
        "[log] max_minutes = 60 min   (own choice)",
    ):
        assert line in text.splitlines()
    assert run(dcon(), ["check", "--ini", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [pmu["name"] for pmu in found["pmus"]] == ["N1", "N2", "S1", "S2", "X"]
    shown = {(row["section"], row["key"]): row for row in found["settings"]}
    assert shown["controller", "priority"]["value"] == "N1-S1,N1-S2,N2-S1,N2-S2"
    assert (shown["controller", "deadband_mhz"]["default"], shown["log", "max_mb"]["default"]) == ("0.25 mHz", None)
    sections = "controller supervisor probing pdci platform watchdog server output log"
    pmus = {f"pmu {name}" for name in ("N1", "N2", "S1", "S2", "X")}
    assert {section for section, _ in shown} == {*sections.split(), *pmus}
    assert len(shown) == len(found["settings"]) == len(effective(load(path)))


def test_every_setting_says_where_it_comes_from_and_every_number_its_unit() -> None:
    """At their defaults, so of every section: the sources of numbers that nothing else fixes are our own choice."""
    bare = ("growth_max", "response_gain_min", "response_gain_max", "seed")
    for row in effective(parse(PAIR, "dcon.ini")):
        assert row.source and row.value, row
        if row.value.replace(".", "").lstrip("-").isdigit() and row.section != "watchdog":  # which has counts
            assert row.key in bare, row
    (gain,) = (row for row in effective(parse(PAIR, "dcon.ini")) if row.key == "gain_mw_per_mhz")
    (ramp,) = (row for row in effective(parse(PAIR, "dcon.ini")) if row.key == "gain_ramp_per_s")
    assert ramp.source == "own choice"
    assert (gain.value, gain.default) == ("9 MW/mHz", None) and gain.source.startswith("section VI")


FITTED = """[platform]
gpsd = [::1]:2948
run_dir = /run/dcon
[watchdog]
beats = control,udp,parse
estop_a = /sys/a
[server]
listen = 0.0.0.0:4792
keys = keys.ini
[output]
url = modbus://192.0.2.1?readback=5
[pdci]
url = modbus://192.0.2.2:503
"""


@pytest.mark.parametrize("text", [PAIR, GOOD, PAIR + FITTED], ids=["bare", "given", "fitted"])
def test_every_value_that_is_printed_can_be_copied_into_a_file(text: str) -> None:
    """But for the unit of a number."""
    rows = effective(parse(text, "dcon.ini"))
    sections: dict[str, list[str]] = {}
    for row in rows:
        number, *unit = row.value.split(" ")
        value = number if unit and number.replace(".", "", 1).removeprefix("-").isdigit() else row.value
        sections.setdefault(row.section, []).extend([] if value == "not set" else [f"{row.key} = {value}"])
    copied = "".join(f"[{name}]\n" + "".join(f"{line}\n" for line in lines) for name, lines in sections.items())
    assert [row[:3] for row in effective(parse(copied, "copied.ini"))] == [row[:3] for row in rows]


def test_a_default_that_is_written_out_comes_from_the_file() -> None:
    text = f"{PAIR}[controller]\nInit_S = 20\npriority = N1-S1\n[supervisor]\ngap_ms = 50\n[log]\nmax_mb = 1000\n"
    rows = {(row.section, row.key): row for row in effective(parse(text, "dcon.ini", ("platform.fifo=true",)))}
    given = {place for place, row in rows.items() if row.source == "initialisation file"}
    keys = {("controller", "init_s"), ("controller", "priority"), ("supervisor", "gap_ms"), ("log", "max_mb")}
    named = {(f"pmu {name}", key) for name in ("N1", "S1") for key in ("url", "side")}
    assert given == keys | named | {("platform", "fifo")}
    assert all(rows[place].default is None for place in keys)


@pytest.mark.parametrize(
    ("keys", "idle"),
    [
        ("limit_mw = 20", ["growing", "bias", "the limit of arming"]),
        ("limit_mw = 0", ["growing", "bias", "saturation", "the limit of arming"]),
        ("limit_mw = 20\narm_limit_mw = 19\n[supervisor]\ngrowth_min_mw = 5\nbias_max_mw = 19", []),
        ("limit_mw = 62.5", ["the limit of arming"]),
        ("limit_mw = 62.6", []),
        ("limit_mw = 100\n[supervisor]\nbias_max_mw = 100", ["bias"]),
        ("limit_mw = 100\n[supervisor]\nbias_max_mw = 99.9", []),
        ("", []),
    ],
)
def test_a_check_that_cannot_fire_is_a_warning(
    keys: str, idle: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "dcon.ini"
    safe = PAIR.replace("udp://h:", "udp://127.0.0.1:")
    path.write_text(f"{safe}[pdci]\nurl = udp://127.0.0.1:3\n[controller]\n{keys}\n")
    assert run(dcon(), ["check", "--ini", str(path), "--json"]) == 0
    out, err = capsys.readouterr()
    warnings = json.loads(out)["warnings"]
    assert [warning.partition(" can never fire at limit_mw = ")[0] for warning in warnings] == idle
    assert err == "".join(f"warning: {warning}\n" for warning in warnings)
    assert run(dcon(), ["check", "--ini", str(path)]) == 0
    assert capsys.readouterr().err == err


@pytest.mark.parametrize("how", ["by name", "by a link", "by a hard link"])
@pytest.mark.parametrize("key", ["[log]\npath", "[watchdog]\nlog"])
@pytest.mark.parametrize(
    ("what", "name"), [("initialisation file", "dcon.ini"), ("probing signal", "p.csv"), ("file of keys", "k")]
)
def test_a_log_is_not_a_file_that_is_read(
    what: str, name: str, key: str, how: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read, ini = tmp_path / name, tmp_path / "dcon.ini"
    log = read if how == "by name" else tmp_path / "log"
    for file in (ini, tmp_path / "p.csv", tmp_path / "k"):
        file.write_text("probe_mw\n1\n")
    if how == "by a link":
        log.symlink_to(read)
    elif how == "by a hard link":
        log.hardlink_to(read)
    text = f"{PAIR}[probing]\nkind = file\nfile = {tmp_path}/p.csv\n[server]\nkeys = {tmp_path}/k\n"
    ini.write_text(f"{text}{key} = {log}\n")
    assert run(dcon(), ["check", "--ini", str(ini)]) == 2
    said = capsys.readouterr().err
    section, _, entry = key.partition("\n")
    assert said.startswith(f"dcon: {ini}:13: {section} {entry}: {log} is the {what}, and would be overwritten")
    ini.write_text(f"{text}{key} = {tmp_path}/new\n")
    assert run(dcon(), ["check", "--ini", str(ini)]) == 0


def test_the_default_log_may_be_the_file_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("session.mcap").write_text(PAIR)
    assert run(dcon(), ["check", "--ini", "session.mcap"]) == 2
    assert "[log] path: session.mcap is the initialisation file" in capsys.readouterr().err


def test_a_probing_file_that_is_set_goes_over_the_recorded_one(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("probe_mw\n3\n4\n")
    text, recorded = f"{PAIR}[probing]\nkind = file\nfile = gone.csv\n", b"probe_mw\n1\n"
    assert parse(text, "log", probe_file=recorded).params.probing.samples == (1.0,)
    assert parse(text, "log", ("probing.amplitude_mw=5",), probe_file=recorded).params.probing.samples == (1.0,)
    changed = parse(text, "log", (f"probing.file={path}",), probe_file=recorded)
    assert changed.params.probing.samples == (3.0, 4.0) and changed.probe_file == path.read_bytes()


@pytest.mark.parametrize("rate", [10, 25, 59, 61, 240])
def test_rates_that_the_filter_is_not_made_for(rate: int) -> None:
    with pytest.raises(SettingsError, match="is not one of 30, 50, 60, 100, 120 frames/s"):
        parse(GOOD.replace("rate = 60", f"rate = {rate}"), "dcon.ini")
    with pytest.raises(SettingsError, match=r"^rate_hz = "):
        Params.paired(("N",), ("S",), rate_hz=rate)


@pytest.mark.parametrize("seconds", ["0", "0.09"])
def test_an_instance_takes_time_to_be_ready(seconds: str) -> None:
    with pytest.raises(SettingsError, match=r"init_s: .* out of range; it must be 0\.1 to 3600"):
        parse(f"{PAIR}[controller]\ninit_s = {seconds}\n", "dcon.ini")


def test_a_priority_of_ones_own() -> None:
    rows = effective(parse(GOOD.replace("align = true", "priority = N2-S2"), "dcon.ini"))
    assert "[controller] priority = N2-S2   (initialisation file; default every north with every south)" in map(
        str, rows
    )
