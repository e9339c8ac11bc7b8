"""Pages that are cited exist, and so do the sections and places in them that links point to."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import mavftpfs

PROJECT = Path(__file__).parents[2]

CITED = re.compile(r"[\w./-]*\w\.md\b")
SECTION = re.compile(r"servers\.md (\d+)(?:\.(\d+))?")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#{1,4} (.+)$", re.MULTILINE)


@cache
def texts() -> dict[Path, str]:
    """Return every text file of the repository but this one."""
    listed = subprocess.run(
        ["git", "-c", "safe.directory=*", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split("\n")
    files = (
        PROJECT / name for name in listed if name.endswith((".py", ".md", ".toml")) or "scripts/" in name
    )
    return {file: file.read_text() for file in files if file.is_file() and file != Path(__file__)}


def pages() -> dict[Path, str]:
    """Return the Markdown pages."""
    return {file: text for file, text in texts().items() if file.suffix == ".md"}


def lacking(file: Path, text: str) -> Iterator[str]:
    """Yield the pages that a file cites and that are nowhere."""
    places = (PROJECT, PROJECT / "docs", PROJECT / "mavftpfs", file.parent)
    for name in CITED.findall(text):
        if not any((place / name).is_file() for place in places) and not name.startswith("//"):
            yield f"{file.relative_to(PROJECT)}: {name}"


def anchor(heading: str) -> str:
    """Return the name that a heading gets on GitHub."""
    kept = "".join(letter for letter in heading.lower() if letter.isalnum() or letter in " -_")
    return kept.replace(" ", "-")


def broken(file: Path, text: str) -> Iterator[str]:
    """Yield the links of a page that lead nowhere in the repository."""
    for link in LINK.findall(text):
        target, _, place = link.partition("#")
        if "://" in target:
            continue
        page = (file.parent / target).resolve() if target else file
        if not page.exists() or (place and place not in map(anchor, HEADING.findall(page.read_text()))):
            yield f"{file.relative_to(PROJECT)}: {link}"


def test_every_cited_page_is_in_the_repository() -> None:
    assert [name for file, text in texts().items() for name in lacking(file, text)] == []


def test_every_cited_section_of_the_server_facts_exists() -> None:
    page = (PROJECT / "docs/servers.md").read_text()
    sections = set(re.findall(r"^## (\d+)\.", page, re.MULTILINE))
    rules = set(
        re.findall(r"^(\d+)\. ", page.partition("\n## 14.")[2].partition("\n## 15.")[0], re.MULTILINE)
    )
    cited = {found for text in texts().values() for found in SECTION.findall(text)}
    assert {section for section, _ in cited} <= sections
    assert {rule for section, rule in cited if rule} <= rules


def test_links_between_pages_lead_somewhere() -> None:
    assert [link for file, text in pages().items() for link in broken(file, text)] == []


def unknown_modules(text: str) -> list[str]:
    """Return the modules and packages that the page about the code names, and that are not there."""
    named = re.findall(r"`((?:\w+/)+(?:\w+\.py)?|\w+\.py)(?:[:`])", text)
    package = PROJECT / "mavftpfs"
    return [name for name in named if not (package / name).exists() and not (PROJECT / name).exists()]


def test_the_pages_about_the_code_name_what_is_there() -> None:
    for page in ("architecture.md", "processes.md"):
        assert unknown_modules((PROJECT / "docs" / page).read_text()) == []
    assert unknown_modules("see `cache/nothing.py: Class` and `nowhere/`") == ["cache/nothing.py", "nowhere/"]


def test_the_newest_entry_of_the_changes_is_this_version() -> None:
    versions = re.findall(r"^## (\S+)", (PROJECT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[versions[0] == "Unreleased"] == mavftpfs.__version__
    assert len(versions) == len(set(versions))


def test_readme_stays_short() -> None:
    assert len((PROJECT / "README.md").read_text().split()) <= 1000
