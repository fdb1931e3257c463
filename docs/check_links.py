"""Checks the links of the built site, offline: `python docs/check_links.py FOLDER`.

Files and anchors within the site must exist. Of addresses elsewhere only the form is checked; nothing is fetched.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ADDRESS = re.compile(r"https?://([\w-]+\.)+[a-z]{2,}(:\d+)?([/?#][\w\-.~:/?#\[\]@!$&'()*+,;=%]*)?")
LOCAL = re.compile(r"https?://(localhost|127\.0\.0\.1)[:/]")
ELSEWHERE = ("mailto:", "data:", "javascript:")


class Page(HTMLParser):
    """Where a page leads to, and what can be led to in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value and tag != "base":
                self.targets.append(value)


def find_fault(target: str, path: Path, pages: dict[Path, Page]) -> str:
    """Return what is wrong with a link of the page at `path`; empty where nothing is."""
    if target.startswith(ELSEWHERE) or LOCAL.match(target):
        return ""
    if "://" in target:
        return "" if ADDRESS.fullmatch(target) else "is no address"
    parts = urlsplit(target)
    file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if not file.exists():
        return "is not there"
    if parts.fragment and file in pages and unquote(parts.fragment) not in pages[file].anchors:
        return "has no such anchor"
    return ""


def check(folder: Path) -> list[str]:
    """Return a line for each link of the site that leads nowhere."""
    files = [path.resolve() for path in folder.rglob("*.html") if "gallery" not in path.relative_to(folder).parts[:1]]
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in files}
    return [
        f"{path.relative_to(folder.resolve())}: {target} {fault}"
        for path, page in pages.items()
        for target in sorted(set(page.targets))
        if (fault := find_fault(target, path, pages))
    ]


if __name__ == "__main__":
    faults = check(Path(sys.argv[1]))
    print("\n".join(faults) or "all links lead somewhere")
    sys.exit(bool(faults))
