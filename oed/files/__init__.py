"""Records from and to files and other libraries' objects: CSV, MAT, Parquet, npz, pandas, xarray, control.

Nothing here ever runs what a file holds: no pickle is read. The libraries are imported when first needed.
"""

from oed.files.objects import from_control, from_pandas, from_xarray, to_control, to_pandas, to_xarray
from oed.files.reading import read_record, read_table
from oed.files.writing import write_bytes, write_record

__all__ = [
    "from_control", "from_pandas", "from_xarray", "read_record", "read_table", "to_control", "to_pandas",
    "to_xarray", "write_bytes", "write_record",
]  # fmt: skip
