"""Builds the page: sections in order, one template, one file."""

import re
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from skyquilt.engine.folder import FILES
from skyquilt.raster.atomic import write_text
from skyquilt.report import headline
from skyquilt.report.about import facts_of, photos_section
from skyquilt.report.attention import attention
from skyquilt.report.clips import clips_section
from skyquilt.report.effort import time_section
from skyquilt.report.ground import ground_of
from skyquilt.report.input import ReportInput
from skyquilt.report.layers import layers_of
from skyquilt.report.mapview import map_view
from skyquilt.report.overlap import overlap_section, surface_section
from skyquilt.report.parts import Section, Tile, values_section
from skyquilt.report.positions import positions_section
from skyquilt.report.quality import quality_section
from skyquilt.report.residuals import residuals_section
from skyquilt.report.seams import seams_section
from skyquilt.report.tables import (
    calibration_section,
    conflicts_section,
    control_section,
    notes_section,
    rejected_section,
    settings_section,
)

HERE = Path(__file__).parent


def build_report(data: ReportInput) -> str:
    """The whole page as text; it can be read without other files and without a network."""
    ground = ground_of(data)
    layers = layers_of(data, ground) if ground else ()
    named = {layer.id: layer for layer in layers}
    sections = (
        overlap_section(data, ground, named),
        positions_section(data, ground, named),
        residuals_section(data),
        seams_section(data, ground, named),
        *values_section(data),
        surface_section(data, ground, named),
        quality_section(data),
        *clips_section(data),
        calibration_section(data),
        control_section(data),
        conflicts_section(data),
        rejected_section(data),
        *photos_section(data),
        notes_section(data),
        time_section(data),
        settings_section(data),
    )
    return _template().render(
        data=data,
        summary=headline.summary(data),
        tiles=headline.tiles(data),
        facts=facts_of(data),
        files=[(name, FILES[name]) for name in FILES if name in data.files],
        attention=attention(data),
        map=map_view(data, ground, layers) if ground and layers else None,
        sections=sections,
        style=_asset("style.css"),
        script=_asset("script.js"),
    )


def write_report(path: Path, data: ReportInput) -> None:
    """Builds the page and writes it to `path` atomically; `OutputError` if it cannot be written."""
    write_text(path, build_report(data))


def tied(words: str) -> str:
    """The text with non-breaking spaces between figures and their units."""
    return re.sub(r"(\d) (px|m|cm|s|GB|MB)\b", "\\1\u00a0\\2", words)


def plain_page(
    *,
    title: str,
    summary: str,
    version: str,
    source: str,
    sections: tuple[Section, ...],
    tiles: tuple[Tile, ...] = (),
) -> str:
    """A self-contained page of sections without a map; `source` says in which files the figures
    are.
    """
    return _template("plain.html.j2").render(
        title=title,
        summary=summary,
        version=version,
        source=source,
        sections=sections,
        tiles=tiles,
        style=_asset("style.css"),
    )


def section_html(section: Section) -> str:
    """The HTML of one section."""
    return _template("section.html.j2").render(section=section)


@cache
def _template(name: str = "page.html.j2") -> Template:
    environment = Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["tied"] = tied
    return environment.get_template(name)


@cache
def _asset(name: str) -> Markup:
    return Markup((HERE / name).read_text(encoding="utf-8"))  # our own files, not user text


_BEGIN, _END = "<!-- other spectrum -->", "<!-- /other spectrum -->"


def add_section(output: Path, section: Section) -> None:
    """Adds a section to the report of a finished run, if it has one; a former one is replaced."""
    page = output / "report.html"
    if page.is_file():
        write_text(page, with_section(page.read_text(encoding="utf-8"), section))


def with_section(page: str, section: Section) -> str:
    """A finished report with this section at its end; a former one is replaced."""
    body = f"{_BEGIN}\n{section_html(section)}\n{_END}"
    found = re.search(f"{re.escape(_BEGIN)}.*?{re.escape(_END)}", page, re.DOTALL)
    return (
        page[: found.start()] + body + page[found.end() :]
        if found
        else page.replace("</main>", f"{body}\n</main>", 1)
    )
