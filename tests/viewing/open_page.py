"""What tests do with a page that is open in the browser."""

from __future__ import annotations

import json
from typing import Any

from tests.chromium import Browser

SETTLED = """(() => {
  const models = panes().filter((p) => p.choice !== PHOTO);
  const sorted = models.every((p) => !p.spark.sorting && !p.spark.sortDirty && p.spark.activeSplats);
  const ready = sorted && models.every((p) => p.drawn);
  const now = models.map((p) => p.canvas.toDataURL()).join();
  const same = ready && !wanted && window.before === now;
  window.before = now;
  return same;
})()"""


def settle(page: Browser) -> None:
    """Wait until models are loaded, sorted and drawn: two pictures in a row are the same."""
    page.until("$('busy').textContent === '' && Boolean(controls)")
    page.until(SETTLED)


def box(page: Browser) -> tuple[int, int, int, int]:
    values = page.run(
        "(() => { const b = $('stage').getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"
    )
    return tuple(round(v) for v in values)  # type: ignore[return-value]


def mouse(page: Browser, kind: str, x: float, y: float, **more: Any) -> None:
    page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


def facts(page: Browser, script: str) -> Any:
    return json.loads(page.run(f"JSON.stringify({script})"))
