"""Tables in Parquet; units stand in the column names."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from cosp.errors import InputError
from cosp.io.temporary import temporary_for


def read(path: str | Path) -> pd.DataFrame:
    """A table.

    Raises
    ------
    InputError
        If the file is missing or is no Parquet file.
    """
    try:
        return pd.read_parquet(path)
    except (FileNotFoundError, ValueError, OSError) as error:
        raise InputError(f"{path}: not a table that can be read ({error})") from error


def write(path: str | Path, table: pd.DataFrame) -> None:
    """Write a table, whole or not at all."""
    path = Path(path)
    temporary = temporary_for(path)
    table.reset_index(drop=True).to_parquet(temporary, index=False)
    temporary.replace(path)
