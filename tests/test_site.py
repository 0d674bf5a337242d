"""The built documentation asks nothing of any other host, and its search runs from a folder."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("material", reason="mkdocs-material is not installed")
ROOT = Path(__file__).parents[1]
FETCHED = re.compile(
    r"<(?:script|iframe|img|link rel=\"(?:stylesheet|preconnect|icon)\")[^>]*(?:src|href)=\"(?:https?:)?//"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One page, by the settings of all."""
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    pages, built = tmp_path_factory.mktemp("docs"), tmp_path_factory.mktemp("site")
    for name in ("site.css", "iframe-worker.js"):
        shutil.copy(ROOT / "docs" / name, pages)
    (pages / "index.md").write_text("# Swings\n\nA ringdown is a free swing.\n", encoding="utf-8")
    config = load_config(
        str(ROOT / "mkdocs.yml"), docs_dir=str(pages), site_dir=str(built), hooks=[], nav=None, exclude_docs=""
    )
    config.plugins.on_startup(command="build", dirty=False)
    build(config)
    return built


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert pages
    for page in pages:
        assert FETCHED.search(page.read_text(encoding="utf-8")) is None, page.name
    assert FETCHED.search('<script src="https://unpkg.com/iframe-worker/shim"></script>')


def test_the_search_runs_from_a_folder(site: Path, tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium is installed")
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND")
    done = subprocess.run(
        [
            *(browser, *options, f"--user-data-dir={tmp_path / 'profile'}"),
            *("--virtual-time-budget=8000", "--dump-dom", f"{(site / 'index.html').as_uri()}?q=ringdown"),
        ],
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert "1 matching document" in done.stdout, done.stderr[-2000:]
