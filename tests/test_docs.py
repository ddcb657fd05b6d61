"""The pages a newcomer reads: links that lead somewhere, commands where .ci/run looks for them."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

import pytest

import skipgs_plug
from skipgs_plug import adapters, fallback_raster, trainer

ROOT = Path(__file__).parents[1]
FOLDERS = ("", "docs/", "docs/how_it_works/", "benchmarks/notes/", "examples/", "tests/")
PAGES = sorted(page for folder in FOLDERS for page in ROOT.glob(f"{folder}*.md"))
# All pages for users.
USER_PATH = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_between_files_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" not in link:
            file, _, anchor = link.partition("#")
            target = (page.parent / file).resolve() if file else page
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


def test_readme_stays_short_and_links_every_page() -> None:
    readme = (ROOT / "README.md").read_text()
    assert len(readme.splitlines()) <= 110
    assert {page.name for page in ROOT.glob("docs/*.md")} <= set(re.findall(r"\(docs/([\w.]+)", readme))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_lists_begin_after_an_empty_line_as_the_site_needs_it(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    assert not re.findall(r"^(?!\s|- |#|\d+\. |<!--)[^\n]+\n- .*$", text, re.MULTILINE)


def test_user_path_stays_below_8000_words() -> None:
    words = {page.name: sum(any(map(str.isalnum, word)) for word in page.read_text().split()) for page in USER_PATH}
    assert sum(words.values()) < 8_000, words


@pytest.mark.parametrize("package", [skipgs_plug, adapters, trainer, fallback_raster], ids=lambda one: one.__name__)
def test_every_public_name_is_on_an_api_page(package: ModuleType) -> None:
    pages = "".join(page.read_text() for page in ROOT.glob("docs/api/*.md"))
    listed = set(re.findall(r"^::: (.*)$", pages, re.MULTILINE))
    homes = {name: getattr(getattr(package, name), "__module__", None) for name in package.__all__}
    # A page names an object or a whole module. A constant does not know its module.
    missing = {name for name, home in homes.items() if not {f"{home}.{name}", home} & listed}
    assert {name for name in missing if not any(one.endswith(f".{name}") for one in listed)} == set()


@pytest.mark.parametrize("page", sorted(ROOT.glob("docs/how_it_works/*.md")), ids=lambda page: page.name)
def test_inner_pages_name_files_that_exist(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for file in re.findall(r"`([\w/]+\.(?:py|h))`", text):
        assert list(ROOT.glob(f"skipgs_plug/**/{file}")) or (ROOT / file).exists(), file


def test_notes_and_inner_pages_are_listed_and_out_of_the_reading_path() -> None:
    for folder in ("docs/how_it_works", "benchmarks/notes"):
        index = (ROOT / folder / "README.md").read_text()
        for page in ROOT.glob(f"{folder}/*.md"):
            assert page.name == "README.md" or f"]({page.name})" in index, page
    path = "".join(page.read_text() for page in USER_PATH)
    links = re.findall(r"\]\(([^)]*benchmarks/notes/[^)]*)\)", path)
    assert links == ["../benchmarks/notes/README.md"]


def test_table_of_contents_of_the_notes_names_every_section() -> None:
    folder = ROOT / "benchmarks/notes"
    # Each page has a block: a heading with a link to the page, then one item per section, in the page's order.
    blocks = re.split(r"^## ", (folder / "README.md").read_text(), flags=re.MULTILINE)[1:]
    listed = {}
    for block in blocks:
        page = re.match(r"\[[^]]*\]\(([^)]+)\)", block)
        assert page, block
        listed[page[1]] = re.findall(r"^- \[(.*)\]\(", block, re.MULTILINE)
    pages = sorted(page for page in folder.glob("*.md") if page.name != "README.md")
    headings = {page.name: re.findall(r"^## (.*)$", page.read_text(), re.MULTILINE) for page in pages}
    assert listed == headings


@pytest.mark.parametrize(("mark", "command"), [("demo", "skipgs-plug demo"), ("tests", "pytest -n 2 --dist loadfile")])
def test_marked_blocks_hold_one_command_line(mark: str, command: str) -> None:
    block = re.findall(rf"<!-- {mark} -->\n```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert len(block) == 1 and len(block[0].splitlines()) == 1 and block[0].strip().endswith(command)
