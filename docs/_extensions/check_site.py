"""Checks the built site: ``python docs/_extensions/check_site.py docs/_build/html``.

Links lead somewhere, public names are linked; in a browser, where one is installed: no sideways
scrolling, no console error, equations without a network.
"""

from __future__ import annotations

import http.server
import json
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path
from urllib.parse import unquote

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
WIDTHS = (390, 1280)  # pixels
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # no network
    *("--window-size=1400,1000", "--virtual-time-budget=300000", "--enable-logging=stderr"),
)
_PROBE = """<body><pre id="found">wait</pre><script>
function look(page, width) {
  return new Promise(resolve => {
    const frame = document.createElement("iframe");
    Object.assign(frame.style, {width: width + "px", height: "900px"});
    frame.src = page;
    frame.onload = () => setTimeout(() => {
      const root = frame.contentDocument.documentElement;
      const plain = root.querySelectorAll("div.math, span.math").length;
      const drawn = root.querySelectorAll("mjx-container").length;
      resolve([page, width, root.scrollWidth > width, plain > 0 && drawn == 0]);
      frame.remove();
    }, 400);
    document.body.appendChild(frame);
  });
}
(async () => {
  const found = [];
  for (const page of PAGES) for (const width of WIDTHS) found.push(await look(page, width));
  document.getElementById("found").textContent = "FOUND " + JSON.stringify(found) + " END";
})();
</script>"""


def pages(root: Path) -> list[str]:
    """Return the pages of the site, without those of the source code."""
    found = (path.relative_to(root).as_posix() for path in root.rglob("*.html"))
    return sorted(p for p in found if not p.startswith(("_modules/", "_static/", "_probe")))


def dead_links(root: Path) -> list[str]:
    """Return the links of pages to files and places that are not there."""
    texts = {page: (root / page).read_text(encoding="utf-8") for page in pages(root)}
    dead = []
    for page, text in texts.items():
        for target in set(re.findall(r'(?:href|src)="([^"]+)"', text)):
            if re.match(r"(https?|mailto|data|javascript):", target):
                continue
            path, _, place = unquote(target).partition("#")
            file = (root / page).parent / path.partition("?")[0] if path else root / page
            file = file / "index.html" if file.is_dir() else file
            inside = texts.get(file.resolve().relative_to(root.resolve()).as_posix())
            missing = place and inside and f'id="{place}"' not in inside
            if not file.exists() or (missing and place not in ("", "main-content")):
                dead.append(f"{page}: {target}")
    return sorted(dead)


def unlinked_names(root: Path) -> list[str]:
    """Return the public names that no page but the reference leads to."""
    own, elsewhere = [], []
    for page in pages(root):
        reference = page.startswith(("auto_reference/", "reference/", "genindex"))
        (own if reference else elsewhere).append((root / page).read_text(encoding="utf-8"))
    name = r"torchrl_hmcts\.\w+\.\w+"
    names = set(re.findall(rf'<dt class="sig sig-object py" id="({name})"', "".join(own)))
    return sorted(names - set(re.findall(rf'href="[^"]*#({name})"', "".join(elsewhere))))


def in_browser(root: Path, browser: str) -> list[str]:
    """Return what is wrong with pages in a browser that has no network."""
    script = _PROBE.replace("PAGES", json.dumps(pages(root))).replace("WIDTHS", str(list(WIDTHS)))
    probe = root / "_probe.html"
    probe.write_text(script, encoding="utf-8")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(root)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with tempfile.TemporaryDirectory() as profile:
            address = f"http://127.0.0.1:{server.server_port}/_probe.html"
            command = [browser, *_FLAGS, f"--user-data-dir={profile}", "--dump-dom", address]
            done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    finally:
        server.shutdown()
        probe.unlink()
    match = re.search(r"FOUND (.*?) END<", done.stdout, re.DOTALL)
    if match is None:
        return [f"{browser} did not finish: {done.stderr[-500:]}"]
    wrong = []
    for page, width, scrolls, unread in json.loads(match[1]):
        wrong += [f"{page} scrolls sideways at {width} pixels"] * scrolls
        wrong += [f"{page} has equations that do not render"] * (unread and width == WIDTHS[0])
    errors = re.findall(r"(?:ERROR|WARNING):CONSOLE[^\n]*", done.stderr)
    return wrong + [error for error in errors if "ERROR" in error]


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


def main() -> int:
    root = Path(sys.argv[1])
    wrong = [f"dead link: {link}" for link in dead_links(root)]
    wrong += [f"no page leads to {name}" for name in unlinked_names(root)]
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("No browser is installed: widths, console and equations were not checked.")
    else:
        wrong += in_browser(root, browser)
    print("\n".join(wrong) or f"The site is well: {len(pages(root))} pages.")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
