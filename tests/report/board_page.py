"""What a person does on the published page, in words of the tests."""

from __future__ import annotations

import json

from tests.chromium import Browser


def names(page: Browser, table: str = "table") -> list[str]:
    return page.run(
        f"[...document.querySelectorAll('#{table} tbody tr:not(.more) > th')]"
        ".map((t) => t.firstChild.textContent)"
    )


def column(page: Browser, at: int, table: str = "table") -> list[str]:
    return page.run(
        f"[...document.querySelectorAll('#{table} tbody tr:not(.more)')]"
        f".map((r) => r.children[{at}].innerText.split('\\n')[0])"
    )


def ranks(page: Browser, at: int, table: str = "table") -> dict[str, str]:
    return page.run(
        f"Object.fromEntries([...document.querySelectorAll('#{table} tbody tr:not(.more)')]"
        f".map((r) => [r.querySelector('th').firstChild.textContent, r.children[{at}].dataset.rank ?? '']))"
    )


def choose(page: Browser, select: str, text: str) -> None:
    page.run(
        f"(() => {{ const s = document.getElementById({json.dumps(select)});"
        f"const o = [...s.options].find((o) => o.textContent.startsWith({json.dumps(text)}));"
        "if (!o) throw new Error('no such choice'); s.value = o.value;"
        "s.dispatchEvent(new Event('change', {bubbles: true})); })()"
    )


def type_in(page: Browser, text: str) -> None:
    page.run(
        f"(() => {{ const m = document.getElementById('method'); m.value = {json.dumps(text)};"
        "m.dispatchEvent(new Event('input', {bubbles: true})); })()"
    )


def tick(page: Browser, scene: str) -> None:
    """Press the tick box of a scene."""
    page.run("document.getElementById('scenes').open = true")
    page.click(f"#scene-ticks input[data-scene={json.dumps(scene)}]")


def heads(page: Browser, table: str = "table") -> list[str]:
    found = page.run(f"[...document.querySelectorAll('#{table} thead th button')].map((b) => b.innerText)")
    return [" ".join(h.split()) for h in found]


def said(page: Browser, name: str) -> str:
    return page.run(f"document.getElementById({json.dumps(name)}).textContent")
