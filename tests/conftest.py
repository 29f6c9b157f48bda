"""What all tests share: where real data lies, if it is here."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# As the launcher does: jobs and workers share the cores, libraries keep to one each.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real images and elevation models; tests that need it skip where there is none."""
    folder = os.environ.get("COSP_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("no real data here: COSP_TEST_DATA does not name a folder")
    return Path(folder)
