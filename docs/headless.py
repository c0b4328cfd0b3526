"""What a script reports of a page in headless Chromium."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""The browser; None: there is none on this machine."""


def reported(page: Path, script: str, width: int, *options: str) -> dict[str, Any]:
    """Return the JSON that a script at the end of the page's head writes to the title, and the messages of the console as ``console``."""
    content = page.read_text(encoding="utf-8")
    probe = page.with_name(f"probe-{page.name}")  # beside the page, for its relative links
    probe.write_text(content.replace("</head>", f"<script>{script}</script></head>", 1), encoding="utf-8")
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--no-first-run", "--disable-gpu", *options]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += ["--enable-logging=stderr", f"--window-size={width},900", "--dump-dom", probe.resolve().as_uri()]
    try:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            command.insert(1, f"--user-data-dir={profile}")
            shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    finally:
        probe.unlink()
    title = re.search(r"<title>(\{.*?\})</title>", shown.stdout)
    if title is None:
        raise RuntimeError(f"{page}: the script did not end; standard error of the browser:\n{shown.stderr[-2000:]}")
    page_report: dict[str, Any] = json.loads(title.group(1).replace("&quot;", '"').replace("&amp;", "&"))
    return page_report | {"console": [line for line in shown.stderr.splitlines() if ":CONSOLE" in line]}
