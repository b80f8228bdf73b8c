"""Hooks of the documentation site: pages outside docs/ join it, links to code become names."""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+)([^)#]+)(#[^)]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Adds the start page, made from the README, and the pages beside it."""
    files.append(File.generated(config, "index.md", content=_inside(_read("README.md"))))
    for name in PAGES:
        files.append(File.generated(config, name, content=_inside(_read(name))))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links that leave docs/ lead to the pages that were added, or become the name of the file."""
    here = "../" * page.file.src_uri.count("/")

    def found(link: re.Match[str]) -> str:
        text, up, name, part = link.groups()
        if len(up) <= len(here):  # inside docs/
            return link.group()
        if name in PAGES:
            return f"[{text}]({here}{name}{part or ''})"
        return text if text.startswith("`") else f"{text} (`{name}`)"

    return LINK.sub(found, markdown)


def _read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def _inside(text: str) -> str:
    """A page from the project's folder as one of docs/."""
    text = text.replace("](docs/", "](")
    return re.sub(r"\[([^\]]+)\]\((?:LICENSE|examples)\)", r"\1", text)
