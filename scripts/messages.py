"""Every message that the package raises or warns with, in one table: where, which, and its words.

    python scripts/messages.py > messages.md

The table is made to be read from top to bottom: does each message say who is told, what was
expected, what came, and what to do? What is in braces is put in when the message is made.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parents[1] / "torchrg"


class Message(NamedTuple):
    """A message: the file and line that raise it, the class of the error, and its text."""

    place: str
    error: str
    text: str


def messages_of(path: Path) -> Iterator[Message]:
    """Yield the messages of a module in the order of its lines."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            error, arguments = ast.unparse(node.exc.func), node.exc.args
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in (
            "warnings.warn",
            "wrap_errors",
        ):
            error, arguments = ast.unparse(node.func), node.args[:1]
        else:
            continue
        place = f"{path.relative_to(PACKAGE.parent)}:{node.lineno}"
        yield Message(place, error, " ".join(map(text_of, arguments)))


def text_of(node: ast.expr) -> str:
    """Return the text that an expression makes, with its parts that vary in braces."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(map(text_of, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    value = node.value if isinstance(node, ast.FormattedValue) else node
    return f"{{{ast.unparse(value)}}}"


def table() -> str:
    """Return the messages of the package as a table of Markdown."""
    found = [message for path in sorted(PACKAGE.rglob("*.py")) for message in messages_of(path)]
    rows = [" | ".join(cell.replace("|", "\\|") for cell in message) for message in found]
    return "\n".join(["| place | error | message |", "|---|---|---|", *(f"| {r} |" for r in rows)])


if __name__ == "__main__":
    print(table())
