"""Papers are cited as in docs/references.md, not by names of files that readers do not have."""

import re

from tests.docs.blocks import ROOT

PRIVATE = re.compile("papers" + r"/00\d|" + "METHODS" + r"\.md")
"""Names of files that only the authors had; `SurstSplat, eq. 13` is how to cite instead."""
FOLDERS = ("gsjax", "experiments", "benchmarks", "docs", "tests")
TEXTS = (".py", ".md", ".toml", ".yml", ".yaml", ".json", ".bib", ".txt")


def test_no_file_names_papers_that_only_their_authors_have():
    paths = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*"))]
    files = [path for path in (*paths, *sorted(ROOT.iterdir())) if path.is_file() and path.suffix in TEXTS]
    assert len(files) > 500
    for path in files:
        name = path.relative_to(ROOT).as_posix()
        found = PRIVATE.search(path.read_text(encoding="utf-8", errors="ignore"))
        assert not found, f"{name}: expected a paper as in docs/references.md, found {found[0]}"
