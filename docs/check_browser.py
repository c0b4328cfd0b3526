"""Look at the built documentation in headless Chromium: ``python docs/check_browser.py docs/_build``.

The interactive filter of the page on coning must draw, follow its sliders, reach the verdict that is right, and draw 30 times a second; on
this page, the first and the index no script may fail and nothing may be wider than a phone. Without Chromium the script says so and ends
well.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import headless

FRAME = 1000.0 / 30.0
MAX_BYTES = 150_000

# All at once, before the browser writes down the page: what waits for the next frame is done at once.
PROBE = """
const found = {};
addEventListener("load", () => {
  const root = document.getElementById("coning-interactive");
  if (root) {
    window.requestAnimationFrame = (draw) => { draw(performance.now()); return 0; };
    const set = (name, value) => {
      const control = root.querySelector(`[name=${name}]`);
      control.value = value;
      control.dispatchEvent(new Event(name === "algorithm" ? "change" : "input", {bubbles: true}));
      return root.dataset.verdict;
    };
    found.better = set("algorithm", "four-sample");
    found.first = set("algorithm", "one-sample");
    found.small = set("angle", 0);
    found.before = Number(root.dataset.drawn);
    found.drawn = Array.from({length: 40}, (_, k) => {
      const begin = performance.now();
      set("angle", 5 * k);
      return performance.now() - begin;
    });
    found.redrawn = Number(root.dataset.drawn) - found.before;
    found.ink = Array.from(root.querySelectorAll("canvas"), (canvas) => {
      const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
      return pixels.some((value) => value > 0);
    });
  }
  // The page and the theme's container of the text, which would scroll instead of it.
  const scrolled = [document.documentElement, document.querySelector(".content")];
  found.overflow = Math.max(...scrolled.map((element) => element.scrollWidth - element.clientWidth));
  document.title = JSON.stringify(found);
});
"""


def faults(reported: dict[str, Any], width: int) -> list[str]:
    """Return what is wrong with a page."""
    wrong = [f"the console says: {line}" for line in reported["console"]]
    if reported["overflow"] > 0:
        wrong.append(f"the page is {reported['overflow']} pixels wider than the window of {width}")
    if "first" in reported:
        if reported["first"] != "not consistent":
            wrong.append(f"one sample a step: the verdict is {reported['first']!r}, not 'not consistent'")
        for name in ("better", "small"):
            if not reported[name].startswith("cannot tell"):
                wrong.append(f"{name}: the verdict is {reported[name]!r}, not 'cannot tell'")
        if not all(reported["ink"]) or len(reported["ink"]) != 3:
            wrong.append(f"drawings are empty: {reported['ink']}")
        if reported["redrawn"] != len(reported["drawn"]):
            wrong.append(f"{reported['redrawn']} drawings for {len(reported['drawn'])} moves of a slider")
        quick = sorted(reported["drawn"])[len(reported["drawn"]) // 4]  # the machine may have other work
        if quick > FRAME:
            wrong.append(f"a drawing takes {quick:.0f} ms, more than {FRAME:.0f}")
    return wrong


def main() -> int:
    """Check the pages and print what is wrong."""
    built = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/_build")
    size = (built / "_static/coning.js").stat().st_size
    wrong = [f"coning.js has {size} bytes, more than {MAX_BYTES}"] if size > MAX_BYTES else []
    if headless.CHROMIUM is None:
        print("no Chromium on this machine: the pages were not looked at in a browser")
    else:
        for name in ("index.html", "guide/coning.html", "genindex.html"):
            for width in (1280, 500):  # the least width of a headless window
                reported = headless.reported(built / name, PROBE, width)
                wrong += [f"{name}, {width} pixels: {fault}" for fault in faults(reported, width)]
    print("\n".join(wrong) if wrong else f"coning.js has {size} bytes; pages as they should be")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
