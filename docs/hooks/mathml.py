"""Equations become MathML when the site is built, so that a page needs no script from elsewhere to show them."""

import html
import re
from typing import Any

from latex2mathml.converter import convert


def on_page_content(content: str, **_: Any) -> str:
    """MkDocs calls this with the HTML of every page."""
    return re.sub(
        r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>',
        lambda found: convert(html.unescape(found[3]), display="inline" if found[2] == "(" else "block"),
        content,
        flags=re.DOTALL,
    )
