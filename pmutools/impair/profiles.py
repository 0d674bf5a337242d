"""Ready profiles, by the name that ``--impair`` takes: the cases of the paper's section V."""

from __future__ import annotations

from pathlib import Path

from pmutools.errors import SettingsError
from pmutools.impair.profile import Profile, parse_profile, read_profile_file
from pmutools.parsers import suggestion

READY = {
    "table1": """
; Table I: PMU delay (mean 44 ms, range 40-48, normal) and communication delay (mean 16, range 15-40, heavy tail).
; Of the tail the paper gives the range only; sd 1.5 ms takes it to the 40 ms limit about once a minute at 60/s.
[stream *]
delay = normal(44, 1.3, min=40, max=48) + constant(15) + lognormal(1, 1.5, max=25)
""",
    "fig10-irregular": """
; Fig. 10: at 60 frames/s packets leave a PMU 16, 9, 25 ms apart, 16.67 on average. Delays that stay below one period
; keep the order; their differences make the spacing: sd 6 ms, 0.1 to 33 ms.
[stream *]
delay = +truncnormal(8.3, 5, 0, 16.6)
""",
    "two-zero": """
; Figs. 11 and 15: two frames in one 60 Hz window of the controller, none in the next. Each pair arrives 24.5 and
; 24.7 ms after the first one's stamp: in the middle of a window, where windows begin with the stamps.
[stream *]
delay = +trace(24.5, 8)
""",
    "asymmetry-3": """
; Figs. 13 and 14: the south 3 samples (50 ms) behind the north, on top of any other delay.
[stream south, S[0-9]*]
delay = +constant(50)
""",
    "asymmetry-6": """
; Figs. 13 and 14: the south 6 samples (100 ms) behind the north, on top of any other delay.
[stream south, S[0-9]*]
delay = +constant(100)
""",
    "single-dropout": """
; Fig. 12: one frame missing, 10 s into the source at 60 frames/s.
[stream *]
drop = 600
""",
}


def ready_profile(name: str) -> Profile:
    """A ready profile; raises SettingsError."""
    if name not in READY:
        raise SettingsError(f"{name!r} is no ready profile; {suggestion(name, READY)}")
    return parse_profile(READY[name], f"profile {name}")


def load_profile(name: str) -> Profile:
    """What ``--impair`` names: a ready profile, or else a file. Raises SettingsError or SourceError."""
    if name in READY:
        return ready_profile(name)
    path = Path(name)
    if not path.exists():
        raise SettingsError(f"--impair {name}: neither a file nor a ready profile; {suggestion(name, READY)}")
    return read_profile_file(path)
