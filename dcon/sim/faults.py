"""The paper's faults by name, as impairment profiles: ``dcon simulate --fault NAME``."""

from __future__ import annotations

from typing import Final

from pmutools.errors import SettingsError
from pmutools.impair.profile import Profile, parse_profile
from pmutools.impair.profiles import ready_profile
from pmutools.parsers import suggestion

_READY: Final = {
    "two-zero-arrival": "two-zero",
    "south-delay-3": "asymmetry-3",
    "south-delay-6": "asymmetry-6",
    "table1-delays": "table1",
    "irregular": "fig10-irregular",
}
_OWN: Final = {
    "stream-stop": "[stream N1]\ndisable = 10..40\n",
    "all-stop": "[stream *]\ndisable = 10..\n",
    "dropout": "[stream N1]\ndrop = 600\n",
}
FAULTS: Final = (*_OWN, *_READY)


def fault(name: str) -> Profile:
    """The fault ``name``. Raises SettingsError for one that there is not."""
    if name in _READY:
        return ready_profile(_READY[name])
    if name not in _OWN:
        raise SettingsError(f"no fault {name!r}; {suggestion(name, FAULTS)}")
    return parse_profile(_OWN[name], f"fault {name}")
