"""The systemd units of the documentation: what systemd itself says of them, and what must be in them."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest

from dcon.cli import COMMANDS, dcon
from dcon.cli.run import command as run_command
from dcon.household.member import ENDED, STARTED
from dcon.settings import load
from pmutools.cli.shell import run

UNITS = Path(__file__).parents[2] / "docs" / "systemd"
PROGRAM = "/opt/pmutools/bin/dcon"
SERVICES = sorted(UNITS.glob("*.service"))
TARGET = UNITS / "dcon.target"


def keys(unit: Path) -> dict[str, list[str]]:
    """Values of each ``SECTION.KEY``, in order."""
    found = defaultdict(list)
    section = ""
    for line in unit.read_text().splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found[f"{section}.{key}"].append(value)
    return found


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_nothing_wrong(tmp_path: Path) -> None:
    verify(tmp_path, [*SERVICES, TARGET])


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_the_target_does_without_an_output(tmp_path: Path) -> None:
    """Where a site has none, its unit is not installed."""
    verify(tmp_path, [*(unit for unit in SERVICES if unit.stem != "dcon-output"), TARGET])


def verify(tmp_path: Path, units: list[Path]) -> None:
    for unit in units:
        text = unit.read_text()
        assert text.count(PROGRAM) == (unit.suffix == ".service")
        (tmp_path / unit.name).write_text(text.replace(PROGRAM, "/bin/true"))
    names = [str(tmp_path / unit.name) for unit in units]
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *names],
        capture_output=True,
        text=True,
        timeout=60,
        env={"SYSTEMD_UNIT_PATH": f"{tmp_path}:", "PATH": "/usr/bin:/bin"},
    )
    own = [line for line in done.stderr.splitlines() if "dcon" in line]
    assert (done.returncode, own) == (0, [])


def test_there_is_a_unit_for_each_process_and_one_for_all() -> None:
    assert {unit.name for unit in SERVICES} == {"dcon.service", *(f"dcon-{member.name}.service" for member in STARTED)}


@pytest.mark.parametrize("unit", SERVICES, ids=lambda unit: str(unit.stem))
def test_what_must_be_in_a_unit(unit: Path) -> None:
    found = keys(unit)
    (start,) = found["Service.ExecStart"]
    program, name, *options = shlex.split(start)
    assert program == PROGRAM and name in COMMANDS
    assert name == ("run" if unit.stem == "dcon" else unit.stem.removeprefix("dcon-"))
    assert options == ["--ini", "/etc/dcon/site.ini", "--run-dir", "/var/lib/dcon/run"]
    assert found["Service.KillMode"] == ["mixed"]  # the others are ended by whoever started them, in order
    assert found["Service.RestartPreventExitStatus"] == ["2"]
    # of those that are told to end, the server alone still tells that ticks are missing
    assert found["Service.SuccessExitStatus"] == ["3 130" if name == "server" else "130"]
    assert found["Service.StateDirectoryMode"] == ["0700"]  # nobody else may enter the run folder
    assert ("Service.WatchdogSec" in found) == (found["Service.Type"] == ["notify"])
    assert found["Service.Restart"] == ["on-failure"]
    assert found["Unit.StartLimitIntervalSec"] == ["0"]  # by default, five failures in 10 s end it for good
    # who listens or receives at an address of the site's needs it to be there
    needs_network = name in ("run", "server", "platform")
    for key in ("Unit.Wants", "Unit.After"):
        assert needs_network == ("network-online.target" in " ".join(found[key]).split())


def test_the_target_has_a_service_for_each_process() -> None:
    (wanted,) = keys(TARGET)["Unit.Wants"]
    assert set(wanted.split()) == {f"dcon-{member.name}.service" for member in STARTED}


def test_one_way_ends_the_other_before_it_starts() -> None:
    """Both meet in the same run folder."""
    found = keys(UNITS / "dcon.service")
    (others,) = found["Unit.Conflicts"]
    assert set(others.split()) == {TARGET.name, *(unit.name for unit in SERVICES)} - {"dcon.service"}
    assert set(others.split()) <= set(" ".join(found["Unit.After"]).split())


def test_the_site_of_the_page_is_one_that_dcon_takes(capsys: pytest.CaptureFixture[str]) -> None:
    settings = load(UNITS / "site.ini")
    assert [site.name for site in settings.sites] == ["N1", "N2", "S1", "S2"]
    assert str(settings.platform.run_dir) == "/var/lib/dcon/run" and settings.output.needs_process
    required = settings.params.required
    assert required.gps and required.watchdog and required.server and required.line
    assert run(dcon(), ["check", "--ini", str(UNITS / "site.ini")]) == 0
    assert "gain_mw_per_mhz" in capsys.readouterr().out


def test_systemd_waits_longer_for_the_end_than_dcon_run_does() -> None:
    (limit,) = keys(UNITS / "dcon.service")["Service.TimeoutStopSec"]
    assert float(limit) > sum(member.patience_s for member in ENDED)
    assert {option.name for option in run_command.params} >= {"ini", "run_dir"}


def test_the_platform_starts_last_and_so_ends_first() -> None:
    for member in STARTED[:-1]:
        assert keys(UNITS / f"dcon-{member.name}.service")["Unit.Before"] == ["dcon-platform.service"]
    for member in STARTED:
        found = keys(UNITS / f"dcon-{member.name}.service")
        assert found["Unit.PartOf"] == ["dcon.target"] and found["Install.WantedBy"] == ["dcon.target"]
