import numpy as np
import pytest
from numpy.testing import assert_array_equal

from cosp.errors import InputError
from cosp.io import arrays


def test_what_is_written_is_what_is_seen(tmp_path):
    whole = np.arange(60, dtype=np.float32).reshape(5, 12)
    parts = [whole[1:4, 2:9], whole[:3, 5:12]]  # not contiguous
    arrays.write(tmp_path / "new" / "array.npy", parts)
    seen = arrays.view(tmp_path / "new" / "array.npy")
    assert seen.dtype == np.float32
    assert_array_equal(seen, np.stack(parts))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["array.npy"]


def test_an_array_that_fails_leaves_the_one_before(tmp_path):
    arrays.write(tmp_path / "array.npy", [np.zeros(3)])
    with pytest.raises(OSError, match="object"):
        arrays.write(tmp_path / "array.npy", [np.ones(3), None])
    assert_array_equal(arrays.view(tmp_path / "array.npy"), [[0, 0, 0]])
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("cut", [None, 3, 100])
def test_what_is_no_whole_array_is_named(tmp_path, cut):
    path = tmp_path / "array.npy"
    if cut is not None:
        arrays.write(path, [np.zeros(1000)])
        path.write_bytes(path.read_bytes()[:-cut] if cut == 100 else b"abc")
    with pytest.raises(InputError, match=r"array\.npy: not an array"):
        arrays.view(path)
