"""Documentation site: guides with tested examples, and the API reference; see ``docs.sh``.

Exits with a nonzero code and a line for each broken name, link or image, or the failed example.
"""

import multiprocessing
import os
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path

os.environ["SPHINX_APIDOC_OPTIONS"] = "members"  # The default includes members without docstrings.

from guide_pages import GUIDES, guide_files, make_page
from sphinx.cmd.build import build_main
from sphinx.ext.apidoc import main as write_reference

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "torchrg"
BUILD = Path("build")
PRIVATE = ("__main__.py", "cli", "kernels", "version.py")
"""Modules that users do not import, in addition to those with an underscore."""


def write_pages(folder: Path) -> None:
    """Write all pages for Sphinx; the examples of several guides run in parallel."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        for page in pool.map(make_page, guide_files(), repeat(folder)):
            print(page, flush=True)
    write_modules(folder)


def write_modules(folder: Path) -> None:
    """Write a page for each module except private ones and the command line."""
    hidden = [str(PACKAGE / name) for name in PRIVATE]
    options = ["-q", "--separate", "--module-first", "--no-toc"]
    write_reference([*options, "-o", str(folder / "reference"), str(PACKAGE), *hidden])


def build_site(pages: Path, site: Path) -> int:
    """Build the site from its pages and return the exit code, 0 without broken links."""
    trees = pages.with_name(f"{pages.name}.trees")
    where = ["-c", str(GUIDES), "-d", str(trees), "-b", "html", str(pages), str(site)]
    return build_main(["-q", "-W", "--keep-going", "-j", "auto", *where])


def main() -> int:
    """Rebuild the site."""
    pages, site = BUILD / "pages", BUILD / "docs"
    for folder in (pages, site):
        shutil.rmtree(folder, ignore_errors=True)
    try:
        write_pages(pages)
    except RuntimeError as error:
        sys.exit(f"docs.py: {error}")
    if code := build_site(pages, site):
        return code
    print(f"{site / 'index.html'}: guides, commands, and API reference")
    return 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))  # The scenes of tests.made.
    sys.exit(main())
