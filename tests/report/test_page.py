"""The page holds everything itself, takes no text for markup, and is the same for the same input."""

from __future__ import annotations

import base64
import math
import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from cosp.dem.tally import Tally
from cosp.geometry.grids import PixelGrid
from cosp.report.film import (
    Bending,
    SeamProfile,
    draw_bending,
    draw_control,
    draw_seams,
    draw_straightness,
    draw_y_parallax,
)
from cosp.report.page import Section, Table, build_page, comparison, flat, picture, readable
from cosp.report.site import common_grid, draw_tally, library_versions, pair_table


def _figure() -> Figure:
    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([0, 1])
    return figure


def test_pictures_are_inside_the_page_byte_for_byte() -> None:
    drawn = picture(_figure(), "a line")
    page = build_page("Site", "fine", [Section("One", pictures=(drawn,))])
    (held,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert base64.b64decode(held) == drawn.png
    assert "http" not in page


def test_the_same_figure_gives_the_same_bytes() -> None:
    assert picture(_figure(), "a").png == picture(_figure(), "a").png


def test_text_is_never_taken_for_markup() -> None:
    table = Table("<b>", ("<i>",), (("a & b <u>",),))
    page = build_page("<script>", "x < y", [Section("<h3>", "<p>", tables=(table,))])
    for harmless in ("&lt;script&gt;", "x &lt; y", "&lt;h3&gt;", "a &amp; b &lt;u&gt;", "&lt;i&gt;"):
        assert harmless in page
    assert "<script>" not in page


def test_records_stand_side_by_side_with_a_dash_where_one_lacks_a_value() -> None:
    table = comparison("two", {"one": {"kind": "x", "a": {"b": 1.5}}, "two": {"a": {"c": None}, "d": [1, 2]}})
    assert table.columns == ("", "one", "two")
    assert table.rows == (("a.b", 1.5, None), ("a.c", None, None), ("d", None, "1, 2"))


def test_long_lists_and_lists_of_records_are_left_out() -> None:
    assert dict(flat({"a": list(range(99)), "b": [{"c": 1}], "d": []})) == {"d": ""}


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (math.nan, "–"), (True, "yes"), (0.123456, "0.1235"), (12345.6, "12,346"), (7, "7"), ("x", "x")],
)
def test_values_are_readable(value: object, text: str) -> None:
    assert readable(value) == text


def test_figures_of_films_are_drawn_even_where_nothing_was_found() -> None:
    empty = np.full((4, 30), np.nan)
    x = np.linspace(-350, 350, 20)
    figures = [
        draw_bending([Bending("s", "stripes", x, x * 1e-3, x * 2e-3), Bending("t", "none", x, x * 0, x * 0)]),
        draw_bending([]),
        draw_control({"s": {"control": np.zeros((3, 2))}, "t": {}}, half_width_mm=28.0),
        draw_y_parallax({"p": empty, "q": np.ones((4, 5000))}),
        draw_seams([], title="a film of one part"),
        draw_seams([SeamProfile("a - b", np.empty(0), np.empty((0, 2)), np.empty((0, 2)))], title="nothing seen"),
        draw_straightness({}, {}, title="neither lines nor holes"),
    ]
    for figure in figures:
        assert picture(figure, "drawn").png.startswith(b"\x89PNG")


def test_bending_is_drawn_in_micrometres() -> None:
    x = np.linspace(-350, 350, 5)
    (panel,) = draw_bending([Bending("s", "edges", x, np.full(5, 0.25), np.full(5, -0.1))]).axes
    assert panel.lines[0].get_ydata() == pytest.approx(np.full(5, 250.0))


def test_steps_and_holes_are_drawn_about_zero() -> None:
    x = np.arange(5.0)
    level, steps = np.full((5, 2), 0.7), np.repeat([[0.0, 0.0], [1.0, -1.0]], [2, 3], axis=0)
    (panel,) = draw_seams([SeamProfile("a - b", x, level + steps, steps)], title="t").axes
    assert panel.lines[0].get_ydata() == pytest.approx(steps[:, 0])
    holes = np.column_stack([x, [0.01, -0.01, 0.01, -0.01, 5.0]])
    top, bottom = draw_straightness({"top": holes * [1, 0]}, {"top": holes}, title="t").axes
    assert top.lines[1].get_ydata()[:4] == pytest.approx([10.0, -10.0, 10.0, -10.0])
    assert len(bottom.lines) == 1


def test_the_common_grid_covers_every_pair_and_keeps_the_posting() -> None:
    west = PixelGrid.covering((600_000.0, 4_800_000.0, 601_000.0, 4_800_500.0), 10.0)
    south = PixelGrid.covering((600_300.0, 4_799_700.0, 600_900.0, 4_800_200.0), 10.0)
    grid = common_grid([west, south])
    assert grid.bounds == (600_000.0, 4_799_700.0, 601_000.0, 4_800_500.0)
    assert (grid.step_x, grid.step_y, grid.shape) == (10.0, -10.0, (80, 100))


def test_grids_of_different_postings_are_refused() -> None:
    grids = [PixelGrid.covering((0.0, 0.0, 100.0, 100.0), posting) for posting in (10.0, 20.0)]
    with pytest.raises(ValueError, match="postings"):
        common_grid(grids)


def test_versions_of_what_shapes_the_products_are_known() -> None:
    versions = library_versions()
    assert versions["numpy"] == np.__version__
    assert versions["snakemake"] != "not installed"


def test_long_tables_stay_folded_until_asked_for() -> None:
    page = build_page("Site", "fine", [Section("One", details=(Table("all of it", ("", "x"), (("a", 1),)),))])
    assert "<details><summary>all of it</summary>" in page
    assert page.count("<details>") == page.count("</details>") == 1


def test_a_pairs_table_has_a_column_for_each_state_and_model() -> None:
    said = {"before": {"median": 2.0}, "after": {"median": 0.1, "textured": {"median": 0.05}}}
    table = pair_table({**said, "check": said})
    assert len(table.columns) == 1 + 8
    median = next(row for row in table.rows if row[0] == "median (m)")
    assert median[1:5] == (2.0, None, 0.1, 0.05)


def test_a_tallys_distribution_has_unit_area() -> None:
    tally = Tally()
    differences = np.random.default_rng(2).normal(0.4, 3.0, (300, 300))
    tally.add(differences, np.ones(differences.shape, bool))
    (panel,) = draw_tally(tally, title="differences").axes
    values, edges, _ = panel.patches[0].get_data()
    assert float(np.sum(values * np.diff(edges))) == pytest.approx(1.0, abs=0.01)
    assert picture(draw_tally(Tally(), title="none"), "none").png.startswith(b"\x89PNG")
