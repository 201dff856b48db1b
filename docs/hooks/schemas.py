"""The schemas of files are made from the classes that validate these when the site is built."""

import json
from typing import Any

from mkdocs.structure.files import File

from parkenv.studies.study import schemas


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """MkDocs calls this with the files of the site."""
    for kind, schema in schemas().items():
        files.append(
            File.generated(config, f"schemas/{kind}.schema.json", content=json.dumps(schema, indent=1))
        )
    return files
