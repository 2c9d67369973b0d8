"""Names and phrases with a better word: file, line, word and replacement.

    python scripts/words.py

Checks identifiers of the package and scripts, and phrases in prose. Codespell checks single words
with ``words.txt``. Exits with 1 if a word remains without a reason.
"""

import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
TOKENS = {"least": "min", "most": "max", "own": "input", "given": "input", "usual": "default"}
TOKENS |= {"beside": "adjacent", "told": "reported", "asked": "requested", "truth": "ground_truth"}
TOKENS |= {"absorb": "assign", "outline": "polygon"}
TOKENS |= dict.fromkeys(("place", "places"), "position, index or path")
TOKENS |= dict.fromkeys(("rest", "rests"), "remaining or residual")
TOKENS |= dict.fromkeys(("share", "shares"), "fraction")
"""Replacement of each token of an identifier."""
PHRASES = {
    r"(?:those|that) (?:that|which)|what (?:is|has|there is|it)": "the noun",
    r"(?:as|so) (?:many|much)": "the number or amount",
    r"tells?(?!\()|says?|said": "returns, shows, reports or states",
    r"whole numbers?": "integer",
    r"made (?:room|cloud|scan)s?": "synthetic",
    r"(?<!ground )(?<!ground-)(?-i:[Tt]ruths?)(?![./]|$)": "ground truth",
    r"usual|perhaps": "default or possibly",
    r"(?:a|the|this|largest) shares?": "fraction",
}
"""Replacement of each phrase of docstrings, comments, messages and guides."""
KEPT = {
    r"at_(?:least|most)|least_squares|most_frequent|in_place": "terms of the field",
    r"\w*absorb\w*": "public configuration fields",
    r"\w*outline\w*": "public configuration field, and the polygons of files",
}
"""Regular expressions of identifiers that stay, with the reason."""


def words_of(path: Path) -> Iterator[tuple[int, str, str, bool]]:
    """Yield line, word, replacement, and whether there is a reason to keep the word."""
    text, names = path.read_text(encoding="utf-8"), list[tuple[int, str]]()
    if path.suffix == ".py":
        tokens = tokenize.generate_tokens(io.StringIO(text).readline)
        names = [(token.start[0], token.string) for token in tokens if token.type == tokenize.NAME]
    for number, line in enumerate(text.splitlines(), 1):
        if path.suffix in (".cpp", ".h"):
            names += [(number, name) for name in re.findall(r"\w+", line.partition("//")[0])]
        for phrase, better in PHRASES.items():
            for found in re.finditer(rf"(?i)\b(?:{phrase})\b", line):
                yield number, found[0], better, False
    for number, name in names:
        parts = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().replace("ground_truth", "")
        for part in TOKENS.keys() & {*parts.split("_")}:
            yield number, name, TOKENS[part], any(re.fullmatch(kept, name) for kept in KEPT)


def main() -> int:
    """Print words without a reason, and the number of all words; return 1 if there are any."""
    code, scripts = 0, ROOT / "scripts"
    files = [path for path in scripts.glob("*.py") if path != Path(__file__)]
    texts = [ROOT / "README.md", *files, *scripts.glob("guides/*"), *ROOT.glob(".github/**/*.*")]
    for title, paths in (("torchrg", (ROOT / "torchrg").rglob("*")), ("texts", texts)):
        paths = [path for path in paths if path.suffix in (".py", ".md", ".yml", ".cpp", ".h")]
        found = [(path, *word) for path in sorted(paths) for word in words_of(path)]
        for path, number, word, better, _ in (word for word in found if not word[-1]):
            print(f"{path.relative_to(ROOT)}:{number} {word} -> {better}")
            code = 1
        print(f"{title}: {len(found)} words, {sum(word[-1] for word in found)} with a reason")
    return code


if __name__ == "__main__":
    sys.exit(main())
