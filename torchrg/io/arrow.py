"""Fast parsing of plain numbers with pyarrow."""

import importlib
from contextlib import suppress

import numpy as np
import torch
from numpy.typing import NDArray

_PLAIN = b"0123456789+-.eE \t\r\nnaifNAIF"
"""Characters of numbers, ``nan`` and ``inf``. pyarrow accepts only what Python accepts of them."""


def parse_numbers(
    content: bytes, num_columns: int, delimiter: str | None = None, decimal: str = "."
) -> NDArray[np.float64] | None:
    r"""Parse rows of plain numbers, bit-identical to Python's ``float``.

    pyarrow is faster than NumPy, and more so the more digits the numbers have.

    Args:
        content: Lines that end in LF or CR; blank lines are skipped.
        num_columns: Numbers per line.
        delimiter: Delimiter; None for spaces and tabs.
        decimal: Decimal separator.

    Returns:
        The numbers, shape ``(N, num_columns)``. None if a line contains anything else, valid or
        not, or if pyarrow is not installed.
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
    for transform in (bytes, _collapse_blanks) if delimiter is None else (bytes,):
        with suppress(arrow.ArrowInvalid):
            table = csv.read_csv(arrow.BufferReader(transform(content)), *options)
            numbers = np.empty((table.num_rows, num_columns))
            for i, column in enumerate(table.columns):
                # pyarrow's to_numpy imports pandas.
                parts = [np.empty(0), *map(np.from_dlpack, column.chunks)]
                np.concatenate(parts, out=numbers[:, i])
            return numbers
    return None


def _collapse_blanks(content: bytes) -> bytes:
    """Collapse runs of blanks to one space, and strip blanks at line ends."""
    content = content.replace(b"\t", b" ")
    while b"  " in content:
        content = content.replace(b"  ", b" ")
    return content.replace(b"\n ", b"\n").replace(b" \n", b"\n").strip(b" ")
