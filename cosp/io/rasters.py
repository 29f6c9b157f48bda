"""GeoTIFFs: read, write, windows. The only place that adds or removes half a pixel."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
from numpy.typing import DTypeLike, NDArray
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError
from rasterio.io import DatasetReader, DatasetWriter
from rasterio.shutil import copy as copy_dataset
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window as RasterioWindow

from cosp.arrays import Float32Array
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.imaging.resampling import block_mean
from cosp.imaging.windows import Window, tiles, worked_on
from cosp.io.temporary import temporary_for

# Blocks that GDAL keeps, MB, where the user says nothing: else it is a twentieth of all memory in every job.
os.environ.setdefault("GDAL_CACHEMAX", "400")

FILM_CRS = 'LOCAL_CS["film, millimetres from the centre of format",UNIT["millimetre",0.001]]'
PIXEL_CRS = 'LOCAL_CS["pixels",UNIT["pixel",1]]'

_TILE = 512


@dataclass(frozen=True)
class RasterInfo:
    """What a raster's header says."""

    shape: tuple[int, int]
    count: int
    dtype: str
    grid: PixelGrid
    crs: str | None
    nodata: float | None
    descriptions: tuple[str | None, ...]
    tags: dict[str, str]


class RasterWriter:
    """Writes windows of a raster that appears when all is written."""

    def __init__(self, dataset: DatasetWriter) -> None:
        self._dataset = dataset

    def write(self, window: Window | None, values: NDArray[Any], band: int = 1) -> None:
        """Write an array into a window (None: the whole raster) of one band, counted from one."""
        self._dataset.write(values, band, window=None if window is None else _rasterio_window(window))


def info(path: str | Path) -> RasterInfo:
    """Shape, type, grid, reference system and tags of a raster.

    Raises
    ------
    InputError
        If the file is missing or is no raster.
    """
    with _open(path) as dataset:
        crs = dataset.crs
        return RasterInfo(
            shape=(dataset.height, dataset.width),
            count=dataset.count,
            dtype=dataset.dtypes[0],
            grid=_grid_of(dataset.transform, (dataset.height, dataset.width)),
            crs=None if crs is None else (f"EPSG:{crs.to_epsg()}" if crs.to_epsg() else crs.to_wkt()),
            nodata=dataset.nodata,
            descriptions=tuple(dataset.descriptions),
            tags=dataset.tags(),
        )


def read(path: str | Path, band: int | None = 1, window: Window | None = None, *, threads: int = 1) -> NDArray[Any]:
    """Values of one band, or of all (bands, rows, columns) for `band=None`.

    Parameters
    ----------
    path, band, window
    threads : int
        That decompress; more than one pay where a window holds many blocks and no other is read at the same time.

    Raises
    ------
    InputError
        If the file is missing, is no raster, or ends too soon.
    """
    with _open(path, threads) as dataset:
        try:
            values: NDArray[Any] = dataset.read(
                None if band is None else band, window=None if window is None else _rasterio_window(window)
            )
        except RasterioIOError as error:
            reason = error.__cause__ or error
            raise InputError(f"{path}: the pixels cannot be read, the file may be truncated ({reason})") from error
    return values


def read_reduced(path: str | Path, factor: int, band: int = 1) -> NDArray[Any]:
    """One band reduced by block means of factor x factor pixels, read by strips.

    The result's grid is `info(path).grid.coarsened(factor)`; ragged edges repeat outwards.
    """
    rows, columns = info(path).shape
    height = max(factor, 2048 // factor * factor)
    parts = [
        block_mean(read(path, band, Window(row, min(row + height, rows), 0, columns)), factor)
        for row in range(0, rows, height)
    ]
    return np.concatenate(parts)


@contextmanager
def create(
    path: str | Path,
    *,
    shape: tuple[int, int],
    dtype: DTypeLike,
    grid: PixelGrid,
    crs: str | None,
    nodata: float | None = None,
    count: int = 1,
    descriptions: Sequence[str] | None = None,
    tags: Mapping[str, str] | None = None,
    cog: bool = False,
    compressed: bool = True,
    threads: int = 1,
) -> Iterator[RasterWriter]:
    """A raster to be written by windows; it appears under its name when all went well.

    Parameters
    ----------
    path : path
    shape : (rows, columns)
    dtype : numpy type
    grid : PixelGrid
        Its own shape is not used.
    crs : str or None
    nodata : float, optional
        Left out for floats: NaN.
    count : int
        Bands.
    descriptions : one text a band, optional
    tags : texts of the file, optional
    cog : bool
        Cloud-optimised, with overviews.
    compressed : bool
        Without loss. What is read once and then removed is handled several times quicker as it is.
    threads : int
        That compress; the file is the same whatever their number.

    Yields
    ------
    RasterWriter
    """
    path = Path(path)
    temporary = temporary_for(path)
    floating = np.issubdtype(np.dtype(dtype), np.floating)
    if nodata is None and floating:
        nodata = float("nan")
    options: dict[str, Any] = {
        "driver": "GTiff",
        "height": shape[0],
        "width": shape[1],
        "count": count,
        "dtype": np.dtype(dtype).name,
        "crs": crs,
        "transform": _transform_of(grid),
        "nodata": nodata,
        "tiled": True,
        "blockxsize": _TILE,
        "blockysize": _TILE,
        "interleave": "band",
        "bigtiff": "if_safer",
        "num_threads": threads,
    }
    if cog:
        # Compressed when it is copied into its last form: until then only as small as blocks left out make it.
        options["sparse_ok"] = True
    elif compressed:
        options |= {"compress": "zstd", "zstd_level": 1, "predictor": 3 if floating else 2}
    try:
        with _quiet(), rasterio.open(temporary, "w", **options) as dataset:
            for band, text in enumerate(descriptions or (), 1):
                dataset.set_band_description(band, text)
            dataset.update_tags(**dict(tags or {}))
            yield RasterWriter(dataset)
        if cog:
            _to_cog(temporary, options)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write(
    path: str | Path,
    array: NDArray[Any],
    *,
    grid: PixelGrid,
    crs: str | None = None,
    nodata: float | None = None,
    descriptions: Sequence[str] | None = None,
    tags: Mapping[str, str] | None = None,
    cog: bool = False,
    compressed: bool = True,
) -> None:
    """Write an array (rows, columns) or (bands, rows, columns) whole; see `create` for the rest."""
    bands = array if array.ndim == 3 else array[None]
    with create(
        path,
        shape=(bands.shape[1], bands.shape[2]),
        dtype=array.dtype,
        grid=grid,
        crs=crs,
        nodata=nodata,
        count=len(bands),
        descriptions=descriptions,
        tags=tags,
        cog=cog,
        compressed=compressed,
    ) as writer:
        for number, values in enumerate(bands, 1):
            writer.write(None, values, number)


def read_on_grid(
    path: str | Path,
    grid: PixelGrid,
    crs: str,
    *,
    resampling: Literal["nearest", "bilinear", "cubic", "average"] = "bilinear",
    band: int = 1,
) -> Float32Array:
    """One band of any georeferenced raster, warped onto a grid; float32, NaN where there is nothing.

    Raises
    ------
    InputError
        If the raster cannot be read or has no reference system.
    """
    with _open(path) as dataset:
        if dataset.crs is None:
            raise InputError(f"{path}: the raster has no coordinate reference system")
        with WarpedVRT(
            dataset,
            crs=crs,
            transform=_transform_of(grid),
            height=grid.shape[0],
            width=grid.shape[1],
            resampling=Resampling[resampling],
            src_nodata=dataset.nodata,
            nodata=float("nan"),
            dtype="float32",
        ) as warped:
            values: Float32Array = warped.read(band)
    return values


@contextmanager
def _open(path: str | Path, threads: int = 1) -> Iterator[DatasetReader]:
    if not Path(path).exists():
        raise InputError(f"{path}: no such file")
    try:
        with _quiet():
            dataset = rasterio.open(path, **({"num_threads": threads} if threads > 1 else {}))
    except RasterioIOError as error:
        raise InputError(f"{path}: not a raster that can be read ({error})") from error
    with dataset:
        yield dataset


@contextmanager
def _quiet() -> Iterator[None]:
    """Film scans have no georeference and need none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


def _to_cog(path: Path, options: dict[str, Any]) -> None:
    target = path.with_name(f"{path.stem}.cog{path.suffix}")
    overviews: list[Path] = []
    try:
        finer = path
        while max(options["height"], options["width"]) > _TILE:
            # GDAL takes what lies beside a raster under this name for its overview, and so on.
            finer = Path(f"{finer}.ovr")
            overviews.append(finer)
            options = options | {side: -(-options[side] // 2) for side in ("height", "width")}
            _write_halved(finer.with_suffix(""), finer, options)
        copy_dataset(
            path,
            target,
            driver="COG",
            compress="zstd",
            level=1,
            predictor="yes",
            bigtiff="if_safer",
            sparse_ok="yes",
            num_threads=options["num_threads"],
        )
        target.replace(path)
    finally:
        for left in (target, *overviews):
            left.unlink(missing_ok=True)


def _write_halved(path: Path, target: Path, options: dict[str, Any]) -> None:
    """Write a raster of half the rows and columns, whose pixels are means of the known ones of two by two."""

    def halved(window: Window) -> NDArray[Any]:
        fine = Window(2 * window.row0, 2 * window.row1, 2 * window.column0, 2 * window.column1)
        return np.stack([_halved(values, options["nodata"]) for values in read(path, None, fine.grown(0, shape))])

    shape = info(path).shape
    windows = tiles((options["height"], options["width"]), _TILE)
    with (
        _quiet(),
        rasterio.open(target, "w", **options) as dataset,
        ThreadPoolExecutor(options["num_threads"]) as pool,
    ):
        for window, values in worked_on(pool, halved, windows, ahead=2 * options["num_threads"]):
            dataset.write(values, window=_rasterio_window(window))


def _halved(values: NDArray[Any], nodata: float | None) -> NDArray[Any]:
    """Means of the known pixels of two by two, `nodata` where none is known."""
    floating = np.issubdtype(values.dtype, np.floating)
    known = np.isfinite(values) if floating else values != nodata
    if not known.any():
        return np.full([-(-n // 2) for n in values.shape], nodata, values.dtype)
    total = block_mean(np.where(known, values, 0).astype(np.float32), 2)
    share = block_mean(known.astype(np.float32), 2)
    empty = share == 0
    means = total / np.where(empty, np.float32(1), share)
    if not floating:
        means = np.floor(means + np.float32(0.5))
    return np.where(empty, np.float32(nodata or 0), means).astype(values.dtype)


def _rasterio_window(window: Window) -> RasterioWindow:
    rows, columns = window.shape
    return RasterioWindow(window.column0, window.row0, columns, rows)


def _transform_of(grid: PixelGrid) -> Affine:
    return Affine(grid.step_x, 0.0, grid.x0 - grid.step_x / 2, 0.0, grid.step_y, grid.y0 - grid.step_y / 2)


def _grid_of(transform: Affine, shape: tuple[int, int]) -> PixelGrid:
    return PixelGrid(transform.c + transform.a / 2, transform.f + transform.e / 2, transform.a, transform.e, shape)
