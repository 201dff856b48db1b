"""The page of closed forms is made from the tests of theory when the site is built; nothing is simulated."""

import sys
from pathlib import Path
from typing import Any

PAGE, MARK = "verify.md", "<!-- closed forms -->"
TESTS = Path(__file__).parents[2] / "tests"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """MkDocs calls this with the text of every page."""
    if page.file.src_uri != PAGE:
        return markdown
    sys.path[:0] = [str(TESTS), str(TESTS / "theory")]
    from closed_forms import sections

    return markdown.replace(MARK, sections())
