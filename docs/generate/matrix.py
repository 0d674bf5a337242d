"""Which checks each of the paper's cases must raise, and which it may, at default settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dcon.core.rows import CORE
from generate.markdown import code, table

START_S = 1.0
STARTING = ("no_data", "no_ready_instance")
"""Up before ``START_S``, while the first frames are still to come."""


@dataclass(frozen=True)
class Case:
    """A run of ``dcon simulate`` (``plan`` are fields of its Plan), and what its checks make of it."""

    text: str
    plan: dict[str, Any]
    must: tuple[str, ...] = ()
    may: tuple[str, ...] = ()
    """Besides those that it must raise."""
    ends: str = "ACTIVE"
    """State of the controller at the end."""


def _case(text: str, *must: str, may: tuple[str, ...] = (), ends: str = "ACTIVE", **plan: Any) -> Case:
    return Case(text, {"gain_mw_per_mhz": 12.0, "duration_s": 12.0, **plan}, must, may, ends)


CASES = {
    "cjb-9": _case("brake, 9 MW/mHz", gain_mw_per_mhz=9.0, duration_s=20.0),
    "cjb-12": _case("brake, 12 MW/mHz", duration_s=20.0),
    "cjb-15": _case("brake, 15 MW/mHz: saturates for a moment", gain_mw_per_mhz=15.0),
    "bc-us-separation": _case("a mode without damping", scenario="bc-us-separation", duration_s=25.0),
    "bc-alberta-separation": _case(
        "British Columbia and Alberta part", scenario="bc-alberta-separation", duration_s=20.0
    ),
    "south-generation-loss": _case(
        "generation is lost in the south", scenario="south-generation-loss", duration_s=20.0
    ),
    "probing": _case("multisine of ±20 MW, 0.1 to 5 Hz", scenario="probing", duration_s=25.0),
    "square-pulse": _case("±125 MW at the mode's frequency", scenario="square-pulse", duration_s=20.0),
    "ambient": _case("random load, 0.3 mrad of noise", scenario="ambient", noise_rad=3e-4, duration_s=20.0),
    "ambient-noisy": _case(
        "random load, 1.5 mrad of noise: 1.4 mHz, 17 MW",
        "ringing",
        may=("slew_limited", "off_median"),
        ends="STANDBY",
        scenario="ambient",
        noise_rad=1.5e-3,
        duration_s=20.0,
    ),
    "stream-stop": _case("N1 stops at 10 s", "arrival_gap", faults=("stream-stop",)),
    "all-stop": _case("all stop at 10 s", "arrival_gap", "no_ready_instance", faults=("all-stop",), ends="STANDBY"),
    "dropout": _case("one frame of N1 is lost", "stamp_step", faults=("dropout",)),
    "two-zero-arrival": _case("frames come by two", faults=("two-zero-arrival",)),
    "south-delay-3": _case("the south is 50 ms late", "latency_high", faults=("south-delay-3",)),
    "south-delay-6": _case("the south is 100 ms late", "latency_high", faults=("south-delay-6",)),
    "table1-delays": _case("delays as in Table I", may=("latency_high",), faults=("table1-delays",)),
    "irregular": _case("spacing as in Fig. 10", faults=("irregular",)),
    "line-rings": _case(
        "brake, 40 MW/mHz, five modes: beyond what the line bears",
        "ringing",
        may=("slew_limited", "off_median"),
        ends="STANDBY",
        plant="modal-five",
        gain_mw_per_mhz=40.0,
    ),
}


def matrix() -> str:
    """The cases by the checks that any of them raises; the others stay down throughout."""
    columns = [name for name in CORE.names if any(name in (*case.must, *case.may) for case in CASES.values())]
    rows = (
        (
            code(name),
            case.text,
            *("**must**" if check in case.must else "may" if check in case.may else "" for check in columns),
            case.ends,
        )
        for name, case in CASES.items()
    )
    return table(("case", "what it is", *map(code, columns), "ends in"), rows)


GENERATORS = {"check-matrix": matrix}
