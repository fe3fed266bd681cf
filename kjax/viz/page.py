"""Results as one HTML file that can be sent: notes, table, figures, provenance; no scripts."""

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2


@dataclasses.dataclass(frozen=True, kw_only=True)
class Page:
    """What a page shows.

    Attributes:
      title: of the page.
      notes: paragraphs above the table.
      header: of the table.
      rows: of the table; a cell of yes or no is coloured.
      figures: (file, caption) of each.
      provenance: as ``cli.provenance`` gives it: when, where, which versions.
    """

    title: str
    notes: Sequence[str] = ()
    header: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    figures: Sequence[tuple[Path, str]] = ()
    provenance: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def write_page(path: Path, page: Page) -> None:
    """Write a page with its figures inside it."""
    text = files("kjax.viz").joinpath("page.html.jinja").read_text(encoding="utf-8")
    template = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(text)
    figures = [{"data": _inline(file), "caption": caption} for file, caption in page.figures]
    path.write_text(
        template.render(
            title=page.title, notes=page.notes, header=page.header, rows=page.rows,
            figures=figures, provenance=provenance_lines(page.provenance),
        ),
        encoding="utf-8",
    )  # fmt: skip


def provenance_lines(provenance: Mapping[str, Any]) -> list[str]:
    """When, where and with which versions, a line each."""
    lines = [f"{key}: {value}" for key, value in provenance.items() if key != "versions"]
    versions = provenance.get("versions", {})
    return lines + ([", ".join(f"{k} {v}" for k, v in versions.items())] if versions else [])


def _inline(file: Path) -> str:
    """A picture as a data URL."""
    return "data:image/png;base64," + base64.b64encode(file.read_bytes()).decode()
