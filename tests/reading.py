"""What a reader sees of a page."""

import re
from html import unescape


def without_frame(page: str) -> str:
    """The page without the 3D view in it."""
    return re.sub(r'srcdoc="[^"]*"', "", page)


def text_of(page: str) -> str:
    """Its words, each white space one space."""
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", without_frame(page).split("<body>")[1])).split())


def headings(page: str) -> list[str]:
    return [unescape(text) for text in re.findall(r"<h2[^>]*>(.*?)</h2>", without_frame(page))]


def rows(page: str) -> list[list[str]]:
    """The cells of its tables."""
    cells = re.findall(r"<tr>(<td>.*?)</tr>", without_frame(page), flags=re.DOTALL)
    return [[unescape(cell) for cell in re.findall(r"<td>(.*?)</td>", row)] for row in cells]


def captions(page: str) -> list[tuple[str, str]]:
    """Of each figure its description for those who cannot see it, and its caption."""
    pairs = re.findall(r'<img alt="([^"]+)" src="data:image/svg[^"]*"><figcaption>(.*?)</figcaption>', page)
    return [(unescape(label), unescape(caption)) for label, caption in pairs]


def is_self_contained(page: str) -> bool:
    """Whether a page opens offline, runs nothing outside its view, and shows no number that is missing as NaN."""
    own = without_frame(page)
    loads = any(
        re.search(r"""(src|href)\s*=\s*["']?\s*(https?:)?//|@import|url\((?!#)""", text.split("<script>")[0])
        for text in (own, unescape(page))
    )
    shown = re.sub(r'"data:[^"]*"', "", own).split("</style>")[1]
    return (
        "default-src 'none'" in page.split("<title>")[0] and not loads and "<script" not in own and "nan" not in shown
    )
