from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cosp import sheets
from cosp.film.bending import (
    Bending,
    bending_from_traces,
    choose_bending,
    film_grid,
    joined_pixels,
    no_bending,
    straighten,
)
from cosp.film.exposure import LINE_MM, Exposure
from cosp.film.joining import lay_out
from cosp.film.rail_holes import find_rail_holes
from cosp.film.stripes import Trace, band_profiles, smooth_base, trace_edge, trace_ridge
from cosp.imaging.windows import Window, tiles
from tests.film.synthetic import LENGTH_MM, STRIPE_MM, WIDTH_MM, Film, bend_mm, make_film

X_MM = np.arange(-371.5, 372.0)
CHOICE = {
    "min_share": 0.3,
    "max_noise_mm": 0.05,
    "step_mm": 5.0,
    "smoothing_mm": 60.0,
    "edge_smoothing_mm": 150.0,
    "single_sd_mm": 0.05,
    "none_sd_mm": 0.1,
}


@pytest.fixture(scope="module")
def film() -> Film:
    return make_film(np.random.default_rng(8), pixel_mm=0.112)


def _exposure(film: Film) -> Exposure:
    return Exposure(
        pixel_mm=film.pixel_mm,
        centre_px=film.centre,
        tilt_deg=float(np.degrees(film.tilt_rad)),
        half_length_mm=LENGTH_MM / 2,
        half_width_mm=WIDTH_MM / 2,
        centre_sd_mm=(0.01, 0.01),
        ends_found=(True, True),
        edges_found=(1.0, 1.0),
    )


def _band(film: Film, side: str, reach: tuple[float, float], image=None):
    sign = 1 if side == "top" else -1
    low, high = sorted(sign * r for r in reach)
    y = np.arange(high, low, -film.pixel_mm)
    base = np.full(len(X_MM), sign * WIDTH_MM / 2)
    parts = [film.image if image is None else image]
    layout = lay_out([film.image.shape], [], feather_px=1.0)
    return band_profiles(parts, layout, _exposure(film), x_mm=X_MM, y_mm=y, base_mm=base, samples=16), y, base


def _stripe(film: Film, side: str, image=None) -> Trace:
    band, y, base = _band(film, side, (0.3, 6.5), image)
    trace = trace_ridge(band, y, X_MM, side=side, slope_mm=0.02, min_contrast=4.0, outlier_mm=0.05)
    return trace.raised(base)


def _edge(film: Film, side: str) -> Trace:
    band, y, base = _band(film, side, (-1.5, 1.5))
    return trace_edge(band, y, X_MM, side=side, min_step=10.0, outlier_mm=0.05).raised(base)


@pytest.mark.parametrize(("side", "sign"), [("top", 1), ("bottom", -1)])
def test_a_stripe_is_traced_to_a_tenth_of_a_pixel(film, side, sign):
    trace = _stripe(film, side)
    truth = sign * (WIDTH_MM / 2 + STRIPE_MM) + bend_mm(X_MM, sign)
    assert trace.share > 0.97
    assert np.sqrt(np.nanmean((trace.y_mm - truth) ** 2)) < 0.1 * film.pixel_mm
    assert 0.0 < trace.noise_mm < 0.1 * film.pixel_mm


def test_the_base_follows_the_edge_of_the_picture_and_is_straight_without_one(film):
    edge = _edge(film, "top")
    base = smooth_base(edge, straight_mm=27.7, min_share=0.3)
    share = (WIDTH_MM + STRIPE_MM) / (WIDTH_MM + 2 * STRIPE_MM)  # of the way from the bottom stripe to the top one
    truth = WIDTH_MM / 2 + bend_mm(X_MM, -1) + share * (bend_mm(X_MM, 1) - bend_mm(X_MM, -1))
    assert_allclose(base, truth, atol=0.03)
    assert_array_equal(smooth_base(edge, straight_mm=27.7, min_share=1.1), np.full(len(X_MM), 27.7))


def test_gaps_in_a_stripe_are_bridged(film):
    image = film.image.copy()
    rng = np.random.default_rng(3)
    strip = slice(0, round(film.centre[1] - (WIDTH_MM / 2 + 0.5) / film.pixel_mm))
    # Six tenths of the stripe are gone, in pieces of 20 mm.
    for start in rng.choice(np.arange(0, 720, 20), 22, replace=False):
        c0 = round(film.centre[0] + (start - 370) / film.pixel_mm)
        part = image[strip, c0 : c0 + round(20 / film.pixel_mm)]
        image[strip, c0 : c0 + round(20 / film.pixel_mm)] = rng.normal(22, 2, part.shape).astype(np.uint8)
    top, bottom = _stripe(film, "top", image), _stripe(film, "bottom", image)
    assert 0.3 < top.share < 0.55
    bending = bending_from_traces(top, bottom, source="stripes", step_mm=5.0, smoothing_mm=60.0, single_sd_mm=0.05)
    assert _straightness_px(bending, film) < 0.3


@pytest.mark.parametrize("missing", ["top", "bottom"])
def test_a_stripe_missing_over_six_tenths_and_at_one_end_is_bridged_by_the_other_side(missing):
    """What is seen of it is a fifteenth of a millimetre off the other side's bend, and slowly changing."""
    rng = np.random.default_rng(4)
    bend = 0.4 * np.sin(X_MM / 90) + 0.2 * np.cos(X_MM / 33)
    opening = 0.04 * (X_MM / 372) ** 2 + 0.03 * X_MM / 372
    lines = {"top": 28.4 + bend + opening, "bottom": -28.4 + bend - opening}
    traces = {side: y + rng.normal(0, 0.001, len(y)) for side, y in lines.items()}
    gone = (X_MM < -300) | ((X_MM + 400) % 130 < 70)
    assert 0.55 < gone.mean() < 0.65
    traces[missing][gone] = np.nan
    traces[missing][:4] = lines[missing][:4] + 1.2  # a mark that was taken for the stripe
    found = bending_from_traces(
        *(Trace(side, X_MM, traces[side], np.full(len(X_MM), 20.0)) for side in ("top", "bottom")),
        source="stripes",
        step_mm=2.0,
        smoothing_mm=12.0,
        single_sd_mm=0.05,
    )
    for side, curve in (("top", found.dy_top_mm), ("bottom", found.dy_bottom_mm)):
        error = np.interp(X_MM, found.x_mm, curve) - (lines[side] - lines[side].mean())
        limit = 0.02 if side == missing else 0.002
        assert np.sqrt(np.mean((error - error.mean()) ** 2)) < limit
        # Beside the gaps it is as good as the other one.
        inner = ~gone & (np.abs(X_MM) < 360)
        assert np.sqrt(np.mean((error - error.mean())[inner] ** 2)) < max(0.003, limit / 2)


def test_straight_is_the_inverse_of_bent():
    bending = Bending("stripes", 0.01, (-372.0, 0.0, 372.0), (0.0, 0.3, -0.1), (0.1, -0.2, 0.2), 30.0, -29.0)
    points = np.random.default_rng(1).uniform([-360, -30], [360, 30], (50, 2))
    assert_allclose(bending.straight(bending.bent(points)), points, atol=1e-12)
    assert np.abs(bending.bent(points) - points).max() > 0.1


def _straightness_px(bending: Bending, film: Film) -> float:
    """Root mean square over both lines of what the curves leave, the mean of each line aside."""
    x = np.array(bending.x_mm)
    inner = np.abs(x) < LENGTH_MM / 2 - 15
    left = []
    for found, sign in ((bending.dy_top_mm, 1), (bending.dy_bottom_mm, -1)):
        truth = bend_mm(x, sign)
        error = np.array(found) - truth
        left.append((error - error.mean())[inner])
    return float(np.sqrt(np.mean(np.square(left))) / film.pixel_mm)


def test_stripes_give_the_bending(film):
    bending = choose_bending(_exposure(film), stripes=[_stripe(film, s) for s in ("top", "bottom")], edges=[], **CHOICE)
    assert bending.source == "stripes"
    assert bending.sd_mm < 0.01
    assert _straightness_px(bending, film) < 0.1
    # The axis lies midway between the lines, wherever the exposed area was said to lie.
    means = [bend_mm(X_MM, side).mean() for side in (1, -1)]
    assert_allclose(bending.y_top_mm, WIDTH_MM / 2 + STRIPE_MM + (means[0] - means[1]) / 2, atol=0.003)
    assert_allclose(bending.y_top_mm, -bending.y_bottom_mm)
    assert_allclose(np.mean([bending.dy_top_mm, bending.dy_bottom_mm]), np.mean(means), atol=0.003)


def test_without_stripes_the_edges_of_the_format_give_the_bending():
    film = make_film(np.random.default_rng(9), pixel_mm=0.112, stripes=False)
    stripes = [_stripe(film, side) for side in ("top", "bottom")]
    assert max(trace.share for trace in stripes) < 0.3  # nothing there, nothing seen
    edges = [_edge(film, side) for side in ("top", "bottom")]
    bending = choose_bending(_exposure(film), stripes=stripes, edges=edges, **CHOICE)
    assert bending.source == "edges"
    assert _straightness_px(bending, film) < 0.3


def test_nothing_traced_leaves_the_film_as_it_is_with_a_stated_deviation(film):
    bending = choose_bending(_exposure(film), stripes=[], edges=[], **CHOICE)
    points = np.array([[10.0, 20.0], [-300.0, -25.0]])
    assert bending.source == "none"
    assert bending.sd_mm == CHOICE["none_sd_mm"]
    assert_array_equal(bending.bent(points), points)


def test_one_stripe_bends_both_sides_and_says_it_is_less_sure(film):
    both = choose_bending(_exposure(film), stripes=[_stripe(film, s) for s in ("top", "bottom")], edges=[], **CHOICE)
    one = choose_bending(_exposure(film), stripes=[_stripe(film, "top")], edges=[], **CHOICE)
    assert_allclose(one.dy_top_mm, one.dy_bottom_mm)
    assert_allclose(np.diff(one.dy_top_mm), np.diff(both.dy_top_mm), atol=1e-9)
    assert one.sd_mm > 5 * both.sd_mm


def test_straightened_stripes_lie_on_one_row(film):
    exposure = _exposure(film)
    bending = choose_bending(exposure, stripes=[_stripe(film, s) for s in ("top", "bottom")], edges=[], **CHOICE)
    grid = film_grid(exposure, half_length_mm=357.0, half_width_mm=32.0)
    straight = _straightened(film, bending, grid, turned=False)
    y = grid.y0 + grid.step_y * np.arange(grid.shape[0])
    for side, place in (("top", bending.y_top_mm), ("bottom", bending.y_bottom_mm)):
        near = np.abs(y - place) < 1.2
        columns = straight[near][:, : grid.shape[1] // 9 * 9].reshape(near.sum(), -1, 9).mean(axis=2)
        x = np.arange(columns.shape[1], dtype=float)
        trace = trace_ridge(
            columns.astype(np.float32), y[near], x, side=side, slope_mm=0.02, min_contrast=4.0, outlier_mm=0.05
        )
        assert trace.share > 0.95
        assert np.nanstd(trace.y_mm) < 0.2 * film.pixel_mm


def _straightened(film: Film, bending: Bending, grid, *, turned: bool):
    exposure = _exposure(film)
    layout = lay_out([film.image.shape], [], feather_px=1.0)
    out = np.zeros(grid.shape, np.uint8)
    for window in tiles(grid.shape, (grid.shape[0], 1500)):
        out[window.slices] = straighten([film.image], layout, grid, window, exposure, bending, turned=turned)
    return out


def test_a_turned_film_is_the_straight_film_turned(film):
    exposure = _exposure(film)
    bending = no_bending(exposure, sd_mm=0.1)
    grid = film_grid(exposure, half_length_mm=357.0, half_width_mm=27.0)
    plain, turned = (_straightened(film, bending, grid, turned=t) for t in (False, True))
    assert np.abs(plain.astype(int) - turned[::-1, ::-1]).max() <= 2


def test_a_window_of_the_straight_film_is_where_the_map_says(film):
    exposure = _exposure(film)
    bending = Bending("stripes", 0.01, (-372.0, 0.0, 372.0), (0.0, 0.3, -0.1), (0.1, -0.2, 0.2), 30.0, -30.0)
    grid = film_grid(exposure, half_length_mm=350.0, half_width_mm=27.0)
    window = Window(100, 180, 2000, 2090)
    rows, columns = joined_pixels(grid.window(100, 180, 2000, 2090).centres(), exposure, bending, turned=False)
    row0, column0 = int(rows.min()) - 5, int(columns.min()) - 5
    ramp = np.zeros(film.image.shape, np.uint8)
    ramp[row0 : row0 + 110, column0 : column0 + 110] = np.add.outer(np.arange(110) * 0.5, np.arange(110) + 1.0)
    layout = lay_out([ramp.shape], [], feather_px=1.0)
    found = straighten([ramp], layout, grid, window, exposure, bending, turned=False)
    expected = 0.5 * (rows - row0) + (columns - column0) + 1
    assert expected.max() < 200
    assert np.abs(found - expected).max() < 1.6  # rounding of both, a 32nd of a pixel


def test_rail_holes_are_found_to_a_third_of_a_pixel(film):
    step = 0.112
    x = np.arange(-200, 200, step)
    y = np.arange(WIDTH_MM / 2 + 6.4, WIDTH_MM / 2 + 3.0, -step)
    layout = lay_out([film.image.shape], [], feather_px=1.0)
    band = band_profiles([film.image], layout, _exposure(film), x_mm=x, y_mm=y, base_mm=np.zeros(len(x)), samples=1)
    holes = find_rail_holes(band, x, y, diameter_mm=1.0, spacing_mm=10.0, min_contrast=20.0)
    assert 37 <= len(holes) <= 41
    offset = (holes[:, 0] + 5.0) % 10.0 - 5.0
    assert np.sqrt(np.mean(offset**2)) < 0.3 * step
    truth = WIDTH_MM / 2 + 4.6 + bend_mm(holes[:, 0], 1)
    assert np.sqrt(np.mean((holes[:, 1] - truth) ** 2)) < 0.3 * step


def test_an_edge_bent_nearly_out_of_the_band_is_still_traced_where_it_is():
    pixel_mm = 0.05
    y_mm = np.arange(1.2, -1.25, -pixel_mm)
    edge_mm = -0.1 - 0.98 * np.sin(np.linspace(0.0, np.pi, len(X_MM)))
    band = np.where(y_mm[:, None] < edge_mm, 120.0, 20.0).astype(np.float32)
    trace = trace_edge(band, y_mm, X_MM, side="top", min_step=6.0, outlier_mm=0.08)
    assert edge_mm.min() - y_mm[-1] < 0.2, "less picture in the band than a line is thick"
    assert trace.share > 0.99
    assert np.nanmax(np.abs(trace.y_mm - edge_mm)) < 0.8 * pixel_mm


def test_stripes_are_looked_for_from_where_lines_begin_and_edges_as_far_as_films_bend():
    defaults = sheets.fill_defaults(sheets.schema("config"), {"sites": {}})["trace_stripes"]
    assert defaults["stripe_reach_mm"][0] < LINE_MM, "stripes lie 0.6 mm and more beside the picture"
    assert defaults["edge_reach_mm"][0] <= -1.2
    assert defaults["edge_reach_mm"][1] >= 1.2


def test_a_row_of_bright_rail_holes_does_not_draw_the_trace_from_a_faint_stripe():
    pixel = 0.028
    y = np.arange(6.5, 0.2, -pixel)
    rng = np.random.default_rng(2)
    band = rng.normal(26, 0.3, (len(y), len(X_MM)))
    stripe = 0.72 + 0.03 * np.sin(X_MM / 40)
    band += 15 * np.exp(-0.5 * ((y[:, None] - stripe) / 0.05) ** 2)
    holes = (np.abs(y[:, None] - 2.1) < 0.3) & (np.abs(X_MM % 10 - 5) < 0.6)
    band[holes] = 250
    band[y < 0.3] = 120  # the picture itself, where its edge was not followed well
    trace = trace_ridge(
        band.astype(np.float32), y, X_MM, side="top", slope_mm=0.02, min_contrast=4.0, outlier_mm=0.05
    )  # fmt: skip
    assert trace.share > 0.95
    assert np.nanmax(np.abs(trace.y_mm - stripe)) < 0.2 * pixel


def test_a_precise_trace_is_followed_where_the_film_waves():
    """A curve that waves every 90 mm by half a millimetre, traced to a tenth of a micrometre."""
    wave = 0.25 * np.sin(2 * np.pi * X_MM / 90) + 0.3 * np.sin(2 * np.pi * X_MM / 400)
    noise = np.random.default_rng(3).normal(0, 1e-4, (2, len(X_MM)))
    traces = [
        Trace(side, X_MM, sign * 28.4 + wave + error, np.full(len(X_MM), 20.0))
        for side, sign, error in (("top", 1, noise[0]), ("bottom", -1, noise[1]))
    ]
    found = bending_from_traces(*traces, source="stripes", step_mm=2.0, smoothing_mm=12.0, single_sd_mm=0.05)
    bent = found.bent(np.stack([X_MM, np.zeros_like(X_MM)], axis=-1))[:, 1]
    inside = np.abs(X_MM) < 365
    assert np.abs(bent - wave)[inside].max() < 0.3 * 0.007  # of a pixel of 7 um


def test_a_scratch_along_a_stripe_does_not_bend_the_film():
    """Digitised at 7 um a stripe is known to a third of a micrometre; a scratch beside it draws 12 mm of it aside."""
    rng = np.random.default_rng(6)
    x = np.arange(-360.0, 361.0)
    curve = 0.3 * np.sin(x / 90.0)
    traces = {side: Trace(side, x, curve + rng.normal(0, 3e-4, x.size), np.ones_like(x)) for side in ("top", "bottom")}
    scratched = (x > 100) & (x < 112)
    for side in ("top", "bottom"):
        drawn = traces[side].y_mm + np.where(scratched, 0.015 + rng.normal(0, 0.004, x.size), 0.0)
        both = {**traces, side: Trace(side, x, drawn, np.ones_like(x))}
        found = bending_from_traces(
            both["top"], both["bottom"], source="stripes", step_mm=2.0, smoothing_mm=12.0, single_sd_mm=0.05
        )
        for displaced in (found.dy_top_mm, found.dy_bottom_mm):
            off = np.interp(x, found.x_mm, displaced) - curve
            assert np.abs(off - np.median(off)).max() < 0.0015


def test_both_stripes_are_followed_where_the_scanner_steps():
    """A block of the scanner moves both lines alike: neither is left out, and the curves go with them."""
    rng = np.random.default_rng(7)
    x = np.arange(-360.0, 361.0)
    stepped = 0.3 * np.sin(x / 90.0) + np.where(np.abs(x) < 70.0, 0.012 * (np.floor(x / 14.0) % 2), 0.0)
    traces = {
        side: Trace(side, x, stepped + rng.normal(0, 3e-4, x.size), np.ones_like(x)) for side in ("top", "bottom")
    }
    found = bending_from_traces(
        traces["top"], traces["bottom"], source="stripes", step_mm=2.0, smoothing_mm=12.0, single_sd_mm=0.05
    )
    middles = (np.abs(x) < 70.0) & (np.abs(x % 14.0 - 6.5) < 2.0)  # of the blocks
    for displaced in (found.dy_top_mm, found.dy_bottom_mm):
        off = np.interp(x, found.x_mm, displaced) - stepped
        assert np.abs(off - np.median(off))[middles].max() < 0.003


@pytest.mark.parametrize("pixel", [0.007, 0.014, 0.028, 0.056])
def test_a_flat_and_a_sloping_stripe_are_placed_alike_at_every_digitisation(pixel):
    y = np.arange(3.0, 0.2, -pixel)
    rng = np.random.default_rng(4)
    x = X_MM[:200]
    stripe = 1.2 + 0.15 * np.sin(x / 25)  # level at its crests, steep between them
    fine = y[:, None] + (np.arange(9) - 4) / 9 * pixel  # a pixel is the mean over its side
    inside = np.abs(fine[:, :, None] - stripe) < 0.06
    band = 26 + 160 * inside.mean(axis=1) + rng.normal(0, 1.5, (len(y), len(x)))
    trace = trace_ridge(
        band.astype(np.float32), y, x, side="top", slope_mm=0.02, min_contrast=4.0, outlier_mm=0.05
    )  # fmt: skip
    error = trace.y_mm - stripe
    assert trace.share > 0.95
    assert np.sqrt(np.nanmean(error**2)) < max(0.1 * pixel, 0.0007)
    assert abs(np.nanmean(error[np.abs(np.cos(x / 25)) < 0.3])) < 0.1 * pixel  # no bias where it is level
