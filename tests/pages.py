"""Reading web pages of reports as strictly as a browser is lenient, for tests of any report."""

import gzip
import json
import re
import subprocess
from base64 import b64decode, b64encode
from hashlib import sha256
from html import unescape
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.text import Text
from PIL import Image

from studies.show import pages
from studies.show.figures import STYLE
from studies.show.pages import WIDE, render
from tests.browser import browser_command

#: A title that would be more than text, in HTML and in Markdown.
TITLE = "<script>alert(1)</script> *fast* | 10 mm ![x](http://e.org/x.png) &amp; a_b"

#: Images that a page may hold, and how they begin.
FIRST_BYTES = {
    "data:image/png;base64": b"\x89PNG\r\n\x1a\n",
    "data:image/gif;base64": b"GIF89a",
}
VOID = ("img", "meta", "br", "hr", "wbr")
#: The only script of a page sorts its tables.
SCRIPT = Path(pages.__file__).with_name("page.js").read_text(encoding="utf-8")
DIGEST = b64encode(sha256(SCRIPT.encode()).digest()).decode()
#: Nothing of a report needs one of these.
FORBIDDEN = ("link", "iframe", "object", "embed", "base", "form", "svg", "video")


class Page(HTMLParser):
    """A page as parsed; asserts that tags nest and that nothing outside the file is loaded."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.text, self.title, self.rows = [], [], "", "", []
        self.scripts = []
        self.images = []  # size in pixels and description of each
        self.policy = re.search('<meta http-equiv="Content-Security-Policy" content="(.*?)">', text)
        self.policy = self.policy[1] if self.policy else ""
        assert text.startswith('<!DOCTYPE html>\n<html lang="en">')
        self.feed(text)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag, attributes):
        assert tag not in FORBIDDEN, tag
        values = dict(attributes)
        loading = [name for name in values if name in ("src", "srcset", "background", "style")]
        assert loading == (["src"] if tag == "img" else []), (tag, loading)
        assert not [name for name in values if name.startswith("on")], values
        if tag == "img":
            kind, _, data = values["src"].partition(",")
            assert kind in FIRST_BYTES, kind
            image = b64decode(data, validate=True)
            assert image.startswith(FIRST_BYTES[kind])
            self.images.append((Image.open(BytesIO(image)).size, values["alt"]))
        if tag == "table":
            self.rows.append([])
        if tag == "tr":
            self.rows[-1].append(0)
        if tag in ("td", "th"):
            self.rows[-1][-1] += 1
        self.tags.append(tag)
        if tag not in VOID:
            assert not (tag == "figure" and "p" in self.open)
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag == "script":
            assert self.scripts == [SCRIPT] and f"sha256-{DIGEST}'" in self.policy
        assert self.open and self.open.pop() == tag, f"</{tag}> closes something else"
        if tag == "table":
            assert len(set(self.rows[-1])) == 1, f"cells of a table's rows: {self.rows[-1]}"

    def handle_data(self, data):
        if self.open[-1:] == ["style"]:
            assert "url(" not in data and "@import" not in data
        elif self.open[-1:] == ["script"]:
            self.scripts.append(data)
        elif self.open[-1:] == ["title"]:
            self.title += data
        else:
            self.text += data


def parsed(text):
    """The page of an HTML text; asserts that it is whole and stands alone."""
    page = Page(text)
    assert page.tags.count("h1") == 1 and page.tags.count("figure") == len(page.images)
    assert page.tags.count("figcaption") == len(page.images)
    assert all(size[0] > 300 and description for size, description in page.images)
    return page


#: How `text_of` begins the line of an element, and how it marks text in one.
BEGIN = {
    "pre": "",
    "h1": "# ",
    "h2": "## ",
    "h3": "### ",
    "p": "",
    "li": "- ",
    "tr": "|",
    "figcaption": "",
}
MARKS = {"b": "**", "code": "`"}


class Reader(HTMLParser):
    """Lines and tables of a page, up to its table of versions."""

    def __init__(self, html):
        super().__init__()
        self.lines, self.line, self.kind = [], "", ""
        self.tables, self.heading, self.cell = {}, "", None
        self.open = []
        self.feed(html.partition("<main>")[2].partition('<h2 id="versions">')[0])

    def end_line(self):
        text = " ".join(self.line.split()) if self.kind else ""
        text = self.line if self.kind == "pre" else text
        if text:
            depth = "  " * (self.open.count("ul") - 1) if self.kind == "li" else ""
            before = self.lines[-1].strip()[:2] if self.lines else ""
            is_next = text[:2] == before in ("- ", "| ")
            self.lines += ([""] if before and not is_next else []) + [depth + text]
        self.line, self.kind = "", ""

    def handle_starttag(self, tag, attributes):
        if tag in BEGIN:
            self.end_line()
            self.line, self.kind = BEGIN[tag], tag
        if tag == "ul":
            self.end_line()
        if tag == "figure":
            self.figure = dict(attributes)["id"].removeprefix("figure-")
        if tag == "figcaption":
            self.line = f"![{self.figure}] "
        if tag == "table":
            self.tables.setdefault(self.heading, []).append([])
        if tag == "tr":
            self.tables[self.heading][-1].append([])
        if tag in ("td", "th"):
            self.cell = ""
        self.mark(MARKS.get(tag, ""))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        self.mark(MARKS.get(tag, ""))
        if tag in ("td", "th"):
            self.tables[self.heading][-1][-1].append(self.cell)
            self.line += f" {self.cell} |"
            self.cell = None
        if tag in ("h1", "h2", "h3"):
            self.heading = self.line.lstrip("# ")
        if tag in BEGIN:
            self.end_line()
        self.open.remove(tag)

    def mark(self, text):
        if self.cell is None:
            self.line += text
        else:
            self.cell += text

    def handle_data(self, data):
        self.mark(data.replace("\xa0", " "))


def text_of(html):
    """A page's text with a line for each paragraph.

    Headings begin with #, entries of lists with -, and rows of tables are between |.
    """
    return "\n".join(Reader(html).lines)


def tables_of(html):
    """Tables of a page: for each heading a list of {column: cells}."""
    columns = {}
    for heading, tables in Reader(html).tables.items():
        for heads, *rows in tables:
            assert len(set(heads)) == len(heads) and all(len(row) == len(heads) for row in rows)
            of_table = {name: [row[k] for row in rows] for k, name in enumerate(heads)}
            columns.setdefault(heading, []).append(of_table)
    return columns


def about(html):
    """What an explorer begins with, by what it says."""
    pairs = re.findall("<dt>(.*?)</dt><dd>(.*?)</dd>", html)
    return {name: unescape(text) for name, text in pairs}


def unpacked(html):
    """What an explorer holds, and a function that gives its arrays."""
    contents = {
        name: re.search(f'<script[^>]* id="{name}">(.*?)</script>', html, re.DOTALL)[1]
        for name in ("data", "arrays")
    }
    floats = np.frombuffer(gzip.decompress(b64decode(contents["arrays"])), np.float32)

    def numbers(where):
        n, *inner = where["shape"]
        part = floats[where["first"] :][: int(np.prod(where["shape"]))]
        return np.moveaxis(part.reshape(*inner, n), -1, 0)

    return json.loads(contents["data"]), numbers


PROBE = """<script>
addEventListener("load", () => {
  const root = document.documentElement, images = [...document.images];
  const broken = images.filter(image => image.naturalWidth === 0).length;
  const over = root.scrollWidth - root.clientWidth;
  const cut = [...document.querySelectorAll(".table")].filter(x => x.scrollWidth > x.clientWidth);
  const found = `${images.length} ${broken} ${over} ${cut.length}`;
  root.setAttribute("data-found", found);
});
</script>"""


def rendered(html, folder, width):
    """What a browser with a window of this width says; skips the test where there is none.

    Returns images, broken ones among them, pixels by which the page is too wide, and tables of
    which only a part is seen.
    """
    path = folder / "probed.html"
    html = re.sub("<meta http-equiv=[^>]*>", "", html)  # it lets no script run
    path.write_text(html.replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    options = ("--headless", "--disable-gpu", "--no-sandbox", "--dump-dom")
    own = f"--user-data-dir={folder / 'browser'}", f"--window-size={width},800"
    done = subprocess.run(
        [browser_command(), *options, *own, path.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
    )
    found = re.search(r'data-found="(\d+) (\d+) (-?\d+) (\d+)"', done.stdout)
    assert found, done.stderr
    return tuple(map(int, found.groups()))


#: Height of text in a figure that can be read [px].
READABLE = 9.0
_PHONE = 390


def _css(pattern):
    """A length of `page.css` [px], given there in rem."""
    return 16 * float(re.search(pattern, render("show/page.css"))[1])


def smallest_text(figure):
    """The smallest text of a figure on its page, on a wide screen or on a phone: pixels, text."""
    inches, dpi = figure.get_figwidth(), STYLE["savefig.dpi"]
    natural = inches * dpi
    desk = min(natural, _css(r"--column: ([\d.]+)rem"))
    phone = _PHONE - 2 * _css(r"body \{[^}]*padding: 0 ([\d.]+)rem")
    if natural > WIDE:
        phone = _css(r"img\.wide \{[^}]* width: ([\d.]+)rem")
    scale = min(desk, phone, natural) / inches / 72
    texts = [x for x in figure.findobj(Text) if x.get_visible() and x.get_text().strip()]
    sizes = [(scale * x.get_fontsize(), x.get_text()) for x in texts]
    return min(sizes, default=(np.inf, ""))
