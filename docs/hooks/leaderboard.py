"""The pages of all results are made from the result files when the site is built; a bad file stops the build."""

import tempfile
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from parkenv.show.report.page import write_page
from parkenv.studies.benchmark.page import benchmark_data, result_files
from parkenv.studies.benchmark.suite import check_result

PAGES = {
    "leaderboard/page.html": "docs/leaderboard/results",
    "leaderboard/page-streets.html": "docs/leaderboard/streets",
}


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """MkDocs calls this with the files of the site."""
    root = Path(config.config_file_path).parent
    for page, source in PAGES.items():
        results = [check_result(file) for file in result_files(root / source)]
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "page.html"
            write_page(benchmark_data(results, ["parkenv", "benchmark", "page", source]), made)
            files.append(File.generated(config, page, content=made.read_text(encoding="utf-8")))
    return files
