"""The pictures of the characterizer's report, ``docs/img/report-*.png``; to make them anew::

    PYTHONPATH=.:tests python docs/generate/report.py

Streams are made up: eight PMUs for five minutes, one of them bad. Chromium draws the page, matplotlib the rest.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image
from support.measured import START_NS
from support.reported import Made, run_of

from pmutools.measure.run import Run
from pmutools.report.characterizer import write_report
from pmutools.timebase import NS

IMAGES = Path(__file__).parents[1] / "img"
FIGURES = {"004-n4-delay": "delay", "004-n4-distribution": "distribution", "004-n4-tail": "tail", "quality": "quality"}
"""Those that are shown, and by what name."""
SECONDS = 300


def run() -> Run:
    """What is shown."""
    streams = [
        Made(
            f"{side}{at}", SECONDS, delay_ms=37 + at + 3 * (side == "S"), spread_ms=2.5, loss=2e-4, seed=at + ord(side)
        )
        for side in "NS"
        for at in range(1, 5)
    ]
    streams[3] = replace(streams[3], delay_ms=44, spread_ms=16, loss=0.02, copies=0.004, outage_s=(121, 148))
    return run_of(
        streams, require="delay_p99<=90ms,loss<=0.1%", begin_ns=START_NS, end_ns=START_NS + (SECONDS + 1) * NS
    )


def main() -> None:
    """Write the pictures; where there is no Chromium, not the page's."""
    with TemporaryDirectory() as folder:
        out = Path(folder)
        write_report(run(), out)
        for name, shown in FIGURES.items():
            shutil.copy(out / "figures" / f"{name}.png", IMAGES / f"report-{shown}.png")
        if (browser := shutil.which("chromium")) is not None:
            picture = out / "page.png"
            options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--virtual-time-budget=20000"]
            options += [f"--screenshot={picture}", "--window-size=1340,1260", f"--user-data-dir={out / 'profile'}"]
            subprocess.run([browser, *options, (out / "report.html").as_uri()], check=True, capture_output=True)
            Image.open(picture).convert("RGB").quantize(64).save(IMAGES / "report-page.png", optimize=True)


if __name__ == "__main__":
    main()
