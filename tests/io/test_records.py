"""Records survive their files, and what is not a record is refused."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from cosp.arrays import FloatArray
from cosp.errors import InputError
from cosp.geometry.grids import PixelGrid
from cosp.io import records


@dataclass(frozen=True)
class Sample:
    KIND: ClassVar[str] = "sample"
    VERSION: ClassVar[int] = 2

    name: str
    grid: PixelGrid
    pair: tuple[float, float]
    parts: tuple[PixelGrid, ...]
    curve: FloatArray
    note: str | None = None


GRID = PixelGrid(0.0, 1.0, 2.0, -2.0, (3, 4))


def test_what_is_written_is_read(tmp_path):
    sample = Sample("a", GRID, (1.0, float("inf")), (GRID, GRID), np.arange(3.0))
    records.write(tmp_path / "s.json", sample)
    found = records.read(tmp_path / "s.json", Sample)
    assert found.grid == GRID
    assert found.parts == (GRID, GRID)
    assert np.array_equal(found.curve, sample.curve)
    assert np.isnan(found.pair[1])  # JSON has no infinity
    assert (tmp_path / "s.json").read_text().lstrip("{\n ").startswith('"kind": "sample"')


def test_another_kind_or_version_is_refused_with_a_sentence(tmp_path):
    records.write(tmp_path / "g.json", GRID)
    with pytest.raises(InputError, match="expected kind 'sample' version 2, found kind 'pixel_grid' version 1"):
        records.read(tmp_path / "g.json", Sample)


def test_a_missing_field_is_named(tmp_path):
    records.write(tmp_path / "s.json", {"kind": "sample", "version": 2, "name": "a"})
    with pytest.raises(InputError, match="'grid' is missing"):
        records.read(tmp_path / "s.json", Sample)


@pytest.mark.parametrize("text", ["", "[1, 2]", '{"kind": '])
def test_what_is_no_whole_json_object_is_refused(tmp_path, text):
    (tmp_path / "s.json").write_text(text)
    with pytest.raises(InputError, match=r"s\.json"):
        records.read(tmp_path / "s.json", Sample)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    records.write(tmp_path / "s.json", {"a": 1})
    with pytest.raises(TypeError):
        records.write(tmp_path / "s.json", {"a": object()})
    assert records.read_json(tmp_path / "s.json") == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["s.json"]
