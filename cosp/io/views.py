"""Views: small files through which programs that use GDAL see a window of another raster."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from cosp.imaging.windows import Window
from cosp.io import rasters, records

_TYPES = {"uint8": "Byte", "uint16": "UInt16", "int16": "Int16", "float32": "Float32", "float64": "Float64"}


def write(
    path: str | Path,
    source_path: str | Path,
    window: Window,
    *,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
) -> None:
    """Write a view of a window of a raster's first band, without its georeference, whole or not at all.

    Parameters
    ----------
    path : path
        Of the view, ending in .vrt. The raster is named relative to it.
    source_path : path of a raster
    window : Window
    metadata : texts by domain, optional
        Such as {"RPC": {...}}.

    Raises
    ------
    InputError
        If the raster cannot be read.
    """
    source = rasters.info(source_path)
    rows, columns = window.shape
    view = ElementTree.Element("VRTDataset", rasterXSize=str(columns), rasterYSize=str(rows))
    for domain, texts in (metadata or {}).items():
        items = ElementTree.SubElement(view, "Metadata", domain=domain)
        for key, text in texts.items():
            ElementTree.SubElement(items, "MDI", key=key).text = text
    band = ElementTree.SubElement(view, "VRTRasterBand", dataType=_TYPES[source.dtype], band="1")
    if source.nodata is not None:
        ElementTree.SubElement(band, "NoDataValue").text = repr(source.nodata)
    cut = ElementTree.SubElement(band, "SimpleSource")
    relative = os.path.relpath(source_path, Path(path).parent)
    ElementTree.SubElement(cut, "SourceFilename", relativeToVRT="1").text = Path(relative).as_posix()
    ElementTree.SubElement(cut, "SourceBand").text = "1"
    size = {"xSize": str(columns), "ySize": str(rows)}
    ElementTree.SubElement(cut, "SrcRect", {"xOff": str(window.column0), "yOff": str(window.row0), **size})
    ElementTree.SubElement(cut, "DstRect", {"xOff": "0", "yOff": "0", **size})
    ElementTree.indent(view)
    records.write_text(path, ElementTree.tostring(view, encoding="unicode") + "\n")
