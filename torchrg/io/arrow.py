"""Lines of plain numbers through pyarrow, which is faster than NumPy the more digits they have."""

import importlib
from contextlib import suppress

import numpy as np
import torch
from numpy.typing import NDArray

_PLAIN = b"0123456789+-.eE \t\r\nnaifNAIF"
"""Characters of numbers, ``nan`` and ``inf``; all that pyarrow makes of these, Python does, too."""


def parse_numbers(
    content: bytes, num_columns: int, delimiter: str | None = None, decimal: str = "."
) -> NDArray[np.float64] | None:
    r"""Parse lines of so many plain numbers, to the bits that Python's ``float`` gives.

    Args:
        content: Lines, which end in LF or CR; blank ones do not count.
        num_columns: How many numbers a line has.
        delimiter: What is between them; None for spaces and tabs.
        decimal: What their decimals begin with.

    Returns:
        The numbers, shape ``(N, num_columns)``. None if a line holds anything else, which may be
        right or not, or if pyarrow is not installed.

    Example:
        >>> table = parse_numbers(b"0 1.5 -2\n3 4 1e3\n", 3)
        >>> table is None or table.tolist() == [[0, 1.5, -2], [3, 4, 1000]]
        True
    """
    try:
        arrow, csv = map(importlib.import_module, ("pyarrow", "pyarrow.csv"))
    except ImportError:
        return None
    if decimal != ".":
        content = content.replace(decimal.encode(), b".")
    if content.translate(None, _PLAIN + (delimiter or "").encode()):
        return None
    names = [str(i) for i in range(num_columns)]
    options = (
        csv.ReadOptions(column_names=names, use_threads=torch.get_num_threads() > 1),
        csv.ParseOptions(delimiter=delimiter or " ", quote_char=False),
        csv.ConvertOptions(
            column_types=dict.fromkeys(names, arrow.float64()), null_values=[], check_utf8=False
        ),
    )
    for prepare in (bytes, _single_spaced) if delimiter is None else (bytes,):
        with suppress(arrow.ArrowInvalid):
            table = csv.read_csv(arrow.BufferReader(prepare(content)), *options)
            numbers = np.empty((table.num_rows, num_columns))
            for i, column in enumerate(table.columns):
                # Its own way to NumPy imports pandas.
                parts = [np.empty(0), *map(np.from_dlpack, column.chunks)]
                np.concatenate(parts, out=numbers[:, i])
            return numbers
    return None


def _single_spaced(content: bytes) -> bytes:
    """Return lines with one space between words, and none around them."""
    content = content.replace(b"\t", b" ")
    while b"  " in content:
        content = content.replace(b"  ", b" ")
    return content.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")
