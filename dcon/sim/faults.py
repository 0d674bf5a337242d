"""The paper's faults by name, as impairment profiles: ``dcon simulate --fault NAME``."""

from __future__ import annotations

from typing import Final, NamedTuple

from pmutools.errors import SettingsError
from pmutools.impair.profile import Profile, parse_profile
from pmutools.impair.profiles import ready_profile
from pmutools.parsers import suggestion


class Fault(NamedTuple):
    """An impairment profile, and how long a run must be to show all of what it does."""

    profile: Profile
    shown_s: float = 0.0


def _own(text: str) -> Profile:
    return parse_profile(text, "fault")


FAULTS: Final = {
    "stream-stop": Fault(_own("[stream N1]\ndisable = 10..40\n"), shown_s=65.0),
    "all-stop": Fault(_own("[stream *]\ndisable = 10..\n")),
    "dropout": Fault(_own("[stream N1]\ndrop = 600\n")),
    "two-zero-arrival": Fault(ready_profile("two-zero")),
    "south-delay-3": Fault(ready_profile("asymmetry-3")),
    "south-delay-6": Fault(ready_profile("asymmetry-6")),
    "table1-delays": Fault(ready_profile("table1")),
    "irregular": Fault(ready_profile("fig10-irregular")),
}
"""N1 is the north PMU of the pair that a simulated session begins with."""


def fault(name: str) -> Fault:
    """The fault ``name``. Raises SettingsError for one that there is not."""
    if name not in FAULTS:
        raise SettingsError(f"no fault {name!r}; {suggestion(name, FAULTS)}")
    return FAULTS[name]
