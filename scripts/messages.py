"""Table of all error and warning messages of the package.

    python scripts/messages.py > messages.md

Read the table from top to bottom: does each message name the caller, the expected value, the actual
value, and the fix? Braces mark values inserted at run time.
"""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parents[1] / "torchrg"


class Message(NamedTuple):
    """Message with its file and line, error class, and text."""

    line: str
    error: str
    text: str


def messages_of(path: Path) -> Iterator[Message]:
    """Yield the messages of a module in order of lines."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            error, arguments = ast.unparse(node.exc.func), node.exc.args
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in (
            "warnings.warn",
            "warn",
            "wrap_errors",
        ):
            error, arguments = ast.unparse(node.func), node.args[:1]
        else:
            continue
        line = f"{path.relative_to(PACKAGE.parent)}:{node.lineno}"
        yield Message(line, error, " ".join(map(text_of, arguments)))


def text_of(node: ast.expr) -> str:
    """Return the text of an expression, with variable parts in braces."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(map(text_of, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    value = node.value if isinstance(node, ast.FormattedValue) else node
    return f"{{{ast.unparse(value)}}}"


def table() -> str:
    """Return the messages of the package as a Markdown table."""
    found = [message for path in sorted(PACKAGE.rglob("*.py")) for message in messages_of(path)]
    rows = [" | ".join(cell.replace("|", "\\|") for cell in message) for message in found]
    return "\n".join(["| line | error | message |", "|---|---|---|", *(f"| {r} |" for r in rows)])


if __name__ == "__main__":
    print(table())
