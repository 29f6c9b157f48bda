"""Figure of the search for a film on the ground."""

from __future__ import annotations

from textwrap import wrap

import numpy as np
from matplotlib.figure import Figure

from cosp.matching.placement import Located

_PANEL_INCH = 3.2


def draw_placement(scene: str, located: Located) -> Figure:
    """One panel per way the film may lie: score of every shift from the predicted place; the place found is ringed."""
    maps, footprint = located.maps, located.footprint
    figure = Figure(figsize=(_PANEL_INCH * 4, _PANEL_INCH + 0.9), layout="constrained")
    if footprint is None:
        title = "\n".join(wrap(str(located.refusal), 130))
    else:
        title = (
            f"{scene} by {footprint.reference}: {footprint.score:.1f} against {footprint.rival_score:.1f} at the best "
            f"other place, {footprint.agreeing_share:.0%} of matches agree at {footprint.posting_m:.0f} m"
        )
    figure.suptitle(title, fontsize="medium")
    if not maps:
        return figure
    panels = np.atleast_1d(figure.subplots(1, len(maps), sharex=True, sharey=True))
    top = max(float(np.nanmax(m.scores)) for m in maps)
    for panel, score_map in zip(panels, maps, strict=True):
        half_height, half_width = (n * score_map.step_m / 2000 for n in score_map.scores.shape)
        extent = (-half_width, half_width, -half_height, half_height)
        colours = panel.imshow(score_map.scores, extent=extent, cmap="magma", vmin=0.0, vmax=top)
        panel.set_facecolor("0.8")
        way = score_map.view.way
        panel.set_title(f"film {way}: at most {np.nanmax(score_map.scores):.1f}", fontsize="small")
        panel.set_xlabel("shift east (km)")
        if footprint is not None and (way.turned, way.mirrored) == (footprint.turned, footprint.mirrored):
            east, north = footprint.shift_east_m / 1000, footprint.shift_north_m / 1000
            panel.plot(east, north, "o", markersize=12, markerfacecolor="none", markeredgecolor="cyan")
    panels[0].set_ylabel("shift north (km)")
    figure.colorbar(colours, ax=list(panels), label="score (standard deviations)", shrink=0.8)
    return figure
