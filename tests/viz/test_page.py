"""One HTML file with everything in it, read back by a parser that is not ours."""

import base64
import html.parser

from kjax.viz import page


class Reader(html.parser.HTMLParser):
    """Rows of the table with their classes, pictures, and paragraphs of a page."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.classes, self.pictures, self.text, self.cell = [], {}, [], "", None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self.cell = attributes.get("class", "")
        if tag == "img":
            self.pictures.append(attributes["src"])

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.cell = None

    def handle_data(self, data):
        self.text += data
        if self.cell is not None:
            self.rows[-1][-1] += data
            if self.cell:
                self.classes[data] = self.cell


def test_the_page_holds_notes_table_figures_and_provenance_and_escapes_them(tmp_path):
    picture = b"\x89PNG, or what counts as one here"
    (tmp_path / "trot.png").write_bytes(picture)
    page.write_page(
        tmp_path / "index.html",
        page.Page(
            title="Results & more",
            notes=["A note with a <tag>."],
            header=["metric", "met"],
            rows=[["falls < 1", "yes"], ["RMSE", "no"]],
            figures=[(tmp_path / "trot.png", "trot <steps>")],
            provenance={"git_revision": "abc<1>", "versions": {"jax": "0.1", "numpy": "2.0"}},
        ),
    )
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<tag>" not in text
    assert "<steps>" not in text
    found = Reader(text)
    assert found.rows == [["metric", "met"], ["falls < 1", "yes"], ["RMSE", "no"]]
    assert found.classes == {"yes": "yes", "no": "no"}
    (inside,) = found.pictures
    assert base64.b64decode(inside.removeprefix("data:image/png;base64,")) == picture
    assert "A note with a <tag>." in found.text
    assert "trot <steps>" in found.text
    assert "git_revision: abc<1>" in found.text
    assert "jax 0.1, numpy 2.0" in found.text


def test_a_page_without_a_table_has_none(tmp_path):
    page.write_page(tmp_path / "index.html", page.Page(title="Nothing yet"))
    assert "<table>" not in (tmp_path / "index.html").read_text(encoding="utf-8")
