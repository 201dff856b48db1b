"""The page of the leaderboard is made from its result files when the site is built; a bad file stops the build."""

import tempfile
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from parkenv.show.report.page import write_page
from parkenv.studies.benchmark.page import benchmark_data, result_files
from parkenv.studies.benchmark.suite import check_result

PAGE = "leaderboard/page.html"
RESULTS = "docs/leaderboard/results"


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """MkDocs calls this with the files of the site."""
    root = Path(config.config_file_path).parent
    results = [check_result(file) for file in result_files(root / RESULTS)]
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "page.html"
        write_page(benchmark_data(results, ["parkenv", "benchmark", "page", RESULTS]), made)
        files.append(File.generated(config, PAGE, content=made.read_text(encoding="utf-8")))
    return files
