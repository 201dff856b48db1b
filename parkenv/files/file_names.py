"""Names of files that are made from names of lots, scenarios and agents."""

from __future__ import annotations

import hashlib
import re

MAX_BYTES = 180
"""Maximum length of a name in UTF-8; most file systems take 255, and temporary files need some."""
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_FORBIDDEN = re.compile(r'[<>:"/\\|?*]|^[. ]+|[. ]+$|^(?=(con|prn|aux|nul|com\d|lpt\d)(\.|$))', re.IGNORECASE)


def is_plain(name: str) -> bool:
    """Whether a name has no control characters, lone surrogates or changes of direction, which terminals obey."""
    return _CONTROL.search(name) is None


def file_name(name: str, suffix: str = "") -> str:
    r"""Return a file name for any text: the text itself where every system takes it, else a similar name with a hash.

    Different texts have different file names; none leaves its folder.

    Args:
        name: any text, such as the name of a lot in a file.
        suffix: appended as it is, such as `.png`.

    Examples:
        >>> file_name("campus", ".png"), file_name("../a/b", ".png")
        ('campus.png', '__a_b-8e7e11e4.png')
    """
    plain = _FORBIDDEN.sub("_", "".join(c if c.isprintable() else "_" for c in name))
    if plain == name and name and len(name.encode()) <= MAX_BYTES:
        return name + suffix
    digest = hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:8]
    return plain.encode()[: MAX_BYTES - 9].decode(errors="ignore") + f"-{digest}{suffix}"
