"""Names of files that are made from names of lots, scenarios and agents, and from other files."""

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

# Maximum length of a name in UTF-8; most file systems take 255, and temporary files need some.
MAX_BYTES = 180
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


def distinct_names(files: Sequence[Path]) -> list[str]:
    """Name each file by its stem; files with a name in common by their names with suffix, or else by their paths.

    Paths are from the folder that all files are in. Upper and lower case are the same here, as on many file systems.

    Examples:
        >>> distinct_names([Path("x/a.png"), Path("x/b.png"), Path("x/b.jpg"), Path("x/y/b.jpg")])
        ['a', 'b.png', 'b.jpg', 'y/b.jpg']
    """
    paths = dict.fromkeys(file.absolute() for file in files)
    folder = os.path.commonpath([path.parent for path in paths]) if paths else ""
    levels: tuple[Callable[[Path], str], ...] = (
        lambda path: path.stem,
        lambda path: path.name,
        lambda path: str(path.relative_to(folder)),
    )
    level = dict.fromkeys(paths, 0)
    while True:
        names = {path: levels[at](path) for path, at in level.items()}
        count = Counter(name.casefold() for name in names.values())
        shared = [path for path, at in level.items() if at < 2 and count[names[path].casefold()] > 1]
        if not shared:
            return [names[file.absolute()] for file in files]
        level.update((path, level[path] + 1) for path in shared)
