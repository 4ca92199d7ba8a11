"""Every link of the documentation leads somewhere, and every page that code names exists."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from docs_blocks import ROOT, pages, text_of

_LINK = re.compile(r"!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`[^`\n]*`(?!\])")
_NAMED = re.compile(r"\b(?:docs|configs|docker)/[\w./-]+\.(?:md|toml|json5|png|gif|yaml|service|rules)\b")


def links(page: Path) -> list[str]:
    bare = _CODE.sub("", _FENCE.sub("", text_of(page)))
    return [to for to in _LINK.findall(bare) if not re.match(r"https?:|mailto:", to)]


def anchors(page: Path) -> set[str]:
    """What GitHub makes of the headings: lower case, punctuation gone, blanks to hyphens."""
    heads = re.findall(r"^#{1,6} (.+?)\s*$", _FENCE.sub("", text_of(page)), re.MULTILINE)
    bare = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", head).lower() for head in heads]
    return {re.sub(r"[^\w\- ]", "", head).replace(" ", "-") for head in bare}


def test_anchors_are_githubs() -> None:
    page = ROOT / "docs" / "explanation" / "design.md"
    assert "33-lockstep-sync--lockstep-on-both-sides" in anchors(page)


@pytest.mark.parametrize("page", [*pages(), ROOT / "CHANGELOG.md"], ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_and_images_exist(page: Path) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), f"{page.relative_to(ROOT)}: {link}"
        if anchor:
            assert anchor in anchors(target), f"{page.relative_to(ROOT)}: {link}: no such heading"


def test_every_page_is_reached_from_the_readme() -> None:
    reached, open_pages = set(), [ROOT / "README.md"]
    while open_pages:
        page = open_pages.pop()
        if page in reached:
            continue
        reached.add(page)
        found = [(page.parent / link.partition("#")[0]).resolve() for link in links(page) if link[0] != "#"]
        open_pages += [target for target in found if target.suffix == ".md"]
    lost = {str(page.relative_to(ROOT)) for page in pages()} - {str(page.relative_to(ROOT)) for page in reached}
    assert not lost


def test_files_that_code_and_pages_name_exist() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    wrong = []
    for name in listed:
        if not name.endswith((".py", ".toml", ".json5", ".yaml", ".md", ".service")) or name == "CHANGELOG.md":
            continue
        path = ROOT / name
        if path.is_file():
            named = set(_NAMED.findall(path.read_text(encoding="utf-8")))
            wrong += [f"{name}: {each}" for each in sorted(named) if not (ROOT / each).exists() and "NAME" not in each]
    assert not wrong
