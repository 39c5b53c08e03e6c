"""Reports as web pages: whole and self-contained, whatever users write into them.

Pages that commands write are tested where the commands are.
"""

import io
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from jinja2 import DictLoader
from matplotlib.figure import Figure
from rich.console import Console

from studies.show import pages
from studies.show.figures import SMALL, WIDTH, is_wide, new_figure, styled
from studies.show.listing import Rows
from studies.show.pages import page, render
from studies.show.report import Drawing, Items, Report, chapter, drawing, print_report, sentence
from studies.study import spec as spec_module
from studies.study.spec import Study, parse_study
from studies.study.template import own_text, toml_text
from tests.pages import (
    READABLE,
    TITLE,
    parsed,
    rendered,
    smallest_text,
    tables_of,
    text_of,
)
from tests.sweeps import MIXED, small


@pytest.fixture
def fill_report(tmp_path, monkeypatch):
    """Function that makes a page of a small report."""
    monkeypatch.setattr(pages.config, "origin", lambda: {"python": "3", "jax": "<1>"})

    def make(title="Title", text="", heads=(), rows=(), file="", image=b"", files=None):
        if image:
            (tmp_path / file).write_bytes(image)
        name = file.removesuffix(".png")
        drawing = Drawing(name, "Bending of `link`, *all*", Figure) if file else None
        parts = chapter(
            f"Numbers of {title}", Items([text]), Rows(list(heads), list(rows)), drawing
        )
        return page(Report(title, [text], "why?", "none", [], [parts], files or {}), tmp_path)

    return make


def png(width=400):
    image = io.BytesIO()
    Figure(figsize=(width / 100, 2), dpi=100).savefig(image, format="png")
    return image.getvalue()


def test_a_template_becomes_a_whole_page(fill_report):
    html = fill_report(
        f"{TITLE}: study",
        "E = ω²q² in <b>µm</b>, 5 %",
        ("", "x [µm]"),
        [["a", "1.2 †"], ["b | c", "`k`"], ["control.gain[0]", "2"]],
        "my run 100%.png",
        png(),
        {"Study file": 'title = "</pre><script>"\n'},
    )
    found = parsed(html)
    assert found.title == f"{TITLE}: study" and TITLE in found.text
    assert found.images == [((400, 200), "Bending of link, *all*")]
    assert found.rows == [[2, 2, 2, 2], [2, 2]]
    for part in (
        "E = ω²q² in <b>µm</b>, 5\xa0%.",
        "1.2\xa0†",
        "b | c",
        "`k`",
        "<1>",
        '"</pre><script>"',
    ):
        assert part in found.text
    assert "<figcaption>Bending of <code>link</code>, *all*.</figcaption>" in html
    assert "<td>control.<wbr>gain<wbr>[0]</td>" in html
    links = re.findall('<a href="#([^"]*)">', html)
    assert links[1:] == ["versions", "study-file"] and links[0].startswith("numbers-of-script")
    assert all(html.count(f'id="{link}"') == 1 for link in links)
    policy = re.search('<meta http-equiv="Content-Security-Policy" content="([^"]*)">', html)[1]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'")
    assert policy.count("script") == 1 and "script-src 'sha256-" in policy
    assert '<div class="table">\n<table>' in html and '<meta charset="utf-8">' in html


def test_texts_are_escaped_in_pages_only(monkeypatch):
    loader = DictLoader({"code.c": "/* {{ text }} */", "page.html": "<p>{{ text }}</p>"})
    monkeypatch.setattr(pages._environment(), "loader", loader)
    assert render("code.c", text='a < b & "c"') == '/* a < b & "c" */'
    assert render("page.html", text="a < b & c") == "<p>a &lt; b &amp; c</p>"


def test_a_report_begins_with_its_result(fill_report):
    """Then come the question and the next steps, in this order."""
    text = text_of(fill_report(text="**it** moves by 5 %"))
    first = ["# Title", "**Result:** **It** moves by 5 %.", "**Question:** Why?"]
    assert text.split("\n\n")[:4] == [*first, "**Next steps:** none"]


def test_a_console_shows_result_texts_and_tables():
    said = io.StringIO()
    parts = chapter("Head", "`code`\n   and **strong**", Rows(["name"], [["cell"]]), Items(["no"]))
    report = Report("T", ["**first**"], "why?", "none", [None], [parts, None], {}, "caveat")
    print_report(report, Console(file=said, width=40))
    lines = said.getvalue().splitlines()
    assert lines[:3] == ["first", "caveat", "code and strong"]
    assert any("cell" in line for line in lines) and not any("no" in line for line in lines[5:])


def test_a_figure_s_caption_is_what_its_function_says():
    def plot(value, ax):
        """Something over time.

        Dotted: more.

        Args:
            value: not in the caption.
        """
        ax.plot([0.0, value])

    made = drawing(plot, 3.0, name="curve", height=2.0)
    assert (made.name, made.caption) == ("curve", "Something over time.\n\nDotted: more.")
    assert made.draw().axes[0].lines[0].get_ydata().tolist() == [0.0, 3.0]
    assert drawing(plot, 3.0).name == "plot"


def test_small_text_in_a_figure_is_found():
    with styled():
        figure, axes = new_figure(1, 1)
        axes[0, 0].set_title("small", fontsize=6)
        figure.draw_without_rendering()
        assert smallest_text(figure) == (pytest.approx(40 * 16 / WIDTH * 6 / 72), "small")
        axes[0, 0].set_title("large", fontsize=SMALL)
        assert smallest_text(figure)[0] == pytest.approx(40 * 16 / WIDTH * SMALL / 72)
    assert 40 * 16 / WIDTH * 6 / 72 < READABLE < 40 * 16 / WIDTH * SMALL / 72


def test_numbers_need_a_logarithmic_scale_if_all_are_positive_and_far_apart():
    assert is_wide(np.array([1.0, np.nan, 31.0])) and not is_wide(np.array([1.0, 29.0]))
    assert not is_wide(np.array([-1.0, 1.0, 100.0])) and not is_wide(np.array([np.nan]))


def test_a_figure_without_its_image_is_a_fault_of_the_program(fill_report):
    with pytest.raises(ValueError, match="'none'"):
        fill_report(file="none.png")


@pytest.mark.parametrize(
    "text",
    [
        TITLE,
        "# x",
        "- 1. x",
        "1. x",
        "12) y",
        "+",
        "===",
        "--- a",
        "***",
        "~~~",
        "> q",
        "-0.5",
        "[x]: http://e",
        "[a][b] [c](d)",
        "a\\*b",
        "`x`",
        "<http://e.org>",
        "_a_ b_c",
        "&lt;",
    ],
)
def test_texts_of_users_are_shown_as_they_are(fill_report, text):
    told = text.replace("`", "'")  # between backticks is code, wherever that comes from
    html = fill_report(text, told, [text], [[text]])
    found = parsed(html)
    assert found.title == text and found.text.count(text) >= 5
    assert text_of(html).startswith(f"# {text}\n\n**Result:** {sentence(told)}\n")
    assert tables_of(html) == {f"Numbers of {text}": [{text: [text]}]}
    assert set(found.tags) <= {
        *["html", "head", "meta", "title", "style", "script", "body", "main", "h1", "h2", "p", "a"],
        *["div", "table", "thead", "tbody", "tr", "th", "td", "ul", "li", "wbr", "b"],
    }


def test_control_characters_are_shown_as_escapes(fill_report):
    assert "a\\x1bb" in parsed(fill_report("a\x1bb")).text


HEAD = '<!DOCTYPE html>\n<html lang="en"><body><h1>a</h1>'


@pytest.mark.parametrize(
    "inside",
    [
        "<p>",
        "<b><i></b></i>",
        "<script></script>",
        "<link>",
        '<img src="http://e.org/x.png">',
        '<img src="data:image/png;base64,AAAA" alt="x">',
        "<style>@import 'x'</style>",
        "<h1>b</h1>",
        "<table><tr><td></td></tr><tr></tr></table>",
        '<p onclick="x()"></p>',
        "<figure></figure>",
    ],
)
def test_the_parser_of_these_tests_finds_faults(inside):
    parsed(HEAD + "</body></html>")
    with pytest.raises(AssertionError):
        parsed(HEAD + inside + "</body></html>")


def test_toml_is_read_back():
    files = sorted(Path(spec_module.__file__).parents[1].glob("specs/*.toml"))
    assert len(files) > 5
    written = [tomllib.loads(path.read_text()) for path in files]
    odd = {"title": 'a "b"\n', "a": {"b.c": {"x": [{"y": 1}], "z": {}}, "t": {"u": {"v": True}}}}
    for data in (*written, small(MIXED), odd):
        assert tomllib.loads(toml_text(data)) == data


@pytest.mark.parametrize("width", [1280, 600])
def test_a_wide_report_fits_a_browsers_window(fill_report, tmp_path, width):
    heads = [f"column {k}" for k in range(30)]
    files = {"Study file": "x = " + "1" * 500}
    html = fill_report("b" * 200, "a" * 300, heads, [["123456789"] * 30], "a.png", png(3000), files)
    assert rendered(html, tmp_path, width) == (1, 0, 0, 1)


@pytest.mark.parametrize(("width", "cut"), [(1280, 0), (600, 1)])
def test_a_table_of_a_sweep_is_seen_whole_on_a_wide_screen(fill_report, tmp_path, width, cut):
    """Long names of columns break at their joints; a narrow screen scrolls and says so."""
    names = ["control.velocity_gain[0]", "electronics.lowpass_ratio[2]", "link.stiffness_factor"]
    metrics = ["residual_rms [µm]", "peak_voltage [V]", "damping_ratio[controlled_mode=1]"]
    heads = ["case", "id", *names, *(f"{x}[1]" for x in names), *metrics, "gain_margin"]
    html = fill_report(heads=heads, rows=[["1", "efac70d3", *["0.1234"] * 10]])
    assert rendered(html, tmp_path, width) == (0, 0, 0, cut)
    assert ".table:has(th:nth-child(4))::before" in html and "scroll sideways" in html


def test_a_browser_finds_faults(tmp_path):
    bad = '<img src="data:image/png;base64,AAAA"><p style="width: 3000px">wide</p>'
    images, broken, over, _ = rendered(HEAD + bad + "</body></html>", tmp_path, 1280)
    assert (images, broken) == (1, 1) and over > 1000


@pytest.mark.parametrize(
    "sections",
    [
        {},
        {"machine": {"kind": "five_bar"}},
        # equal to the defaults of the default mechanism, not to those of its own
        {"machine": {"kind": "rrr"}, "motion": {"waypoints": Study().motion.waypoints}},
        {"title": 'a "b"', "link": {"length": [0.2, 0.21, 0.22]}, "drive": {"locked": True}},
    ],
)
def test_what_differs_from_the_defaults_reads_back_as_the_study(sections):
    study = parse_study(sections)
    text = own_text(study)
    assert parse_study(tomllib.loads(text)) == study
    assert tomllib.loads(text).keys() == sections.keys()
